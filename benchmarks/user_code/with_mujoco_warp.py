"""MuJoCo Warp: the model of MuJoCo, simulated by kernels that are compiled first."""

from pathlib import Path

import mujoco
import mujoco_warp
import warp

warp.config.quiet = True
spec = mujoco.MjSpec.from_file(str(Path(__file__).with_name("four_bar.urdf")))
spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
spec.option.timestep = 5e-3
spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_REFSAFE
spec.option.iterations, spec.option.tolerance = 2, 1e-6
spec.body("coupler").add_site(name="coupler_end", pos=[0.7, 0, -0.2])
spec.body("rocker").add_site(name="rocker_end", pos=[0.1, 0, -0.5])
loop = spec.add_equality(type=mujoco.mjtEq.mjEQ_CONNECT, objtype=mujoco.mjtObj.mjOBJ_SITE)
loop.name1, loop.name2 = "coupler_end", "rocker_end"
loop.solref, loop.solimp[:2] = [7.5e-3, 1.0], [0.9999, 0.9999]
model = spec.compile()
start = mujoco.MjData(model)
mujoco.mj_forward(model, start)
device_model, data = mujoco_warp.put_model(model), mujoco_warp.put_data(model, start)
device_model.opt.warn_overflow = 0
for _ in range(200):
    mujoco_warp.step(device_model, data)
mujoco_warp.kinematics(device_model, data)
print(*data.site_xpos.numpy()[0, model.site("rocker_end").id])
