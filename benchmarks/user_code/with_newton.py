"""Newton: the URDF, a ball joint outside of the tree closes the loop, Kamino simulates."""

from pathlib import Path

import newton
import warp

warp.config.quiet = True
builder = newton.ModelBuilder()
builder.default_joint_cfg.armature = 0.0
builder.add_urdf(
    str(Path(__file__).with_name("four_bar.urdf")), floating=False, collapse_fixed_joints=True
)
builder.joint_target_mode[:] = [newton.JointTargetMode.NONE] * builder.joint_dof_count
coupler, rocker = (builder.body_label.index(f"four_bar/{name}") for name in ("coupler", "rocker"))
builder.add_joint_ball(
    coupler, rocker, parent_xform=((0.7, 0, -0.2), (0, 0, 0, 1)),
    child_xform=((0.1, 0, -0.5), (0, 0, 0, 1)),
)  # fmt: skip
model = builder.finalize()
config = newton.solvers.SolverKamino.Config(dynamics_solver="dvi", sparse_dynamics=True)
solver = newton.solvers.SolverKamino(model, config=config)
one, two, control = model.state(), model.state(), model.control()
newton.eval_fk(model, model.joint_q, model.joint_qd, one)
for _ in range(500):
    one.clear_forces()
    solver.step(one, two, control, None, 2e-3)
    one, two = two, one
pose = warp.transform(*one.body_q.numpy()[rocker])
print(*warp.transform_point(pose, warp.vec3(0.1, 0, -0.5)))
