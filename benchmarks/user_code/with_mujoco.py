"""MuJoCo: the URDF as MjSpec, a connection closes the loop."""

from pathlib import Path

import mujoco

spec = mujoco.MjSpec.from_file(str(Path(__file__).with_name("four_bar.urdf")))
spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
spec.option.timestep = 1e-3
spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_REFSAFE
spec.body("coupler").add_site(name="coupler_end", pos=[0.7, 0, -0.2])
spec.body("rocker").add_site(name="rocker_end", pos=[0.1, 0, -0.5])
loop = spec.add_equality(type=mujoco.mjtEq.mjEQ_CONNECT, objtype=mujoco.mjtObj.mjOBJ_SITE)
loop.name1, loop.name2 = "coupler_end", "rocker_end"
loop.solref, loop.solimp[:2] = [1.5e-3, 1.0], [0.9999, 0.9999]
model = spec.compile()
data = mujoco.MjData(model)
mujoco.mj_step(model, data, 1000)
mujoco.mj_forward(model, data)
print(*data.site("rocker_end").xpos)
