"""Pinocchio: constraintDynamics in a Runge-Kutta loop, its corrector closes the loop."""

from pathlib import Path

import numpy as np
import pinocchio as pin

model = pin.buildModelFromUrdf(str(Path(__file__).with_name("four_bar.urdf")))
data = model.createData()
coupler, rocker = (model.frames[model.getFrameId(f"{name}_end")] for name in ("coupler", "rocker"))
loop = pin.RigidConstraintModel(
    pin.ContactType.CONTACT_3D, model, coupler.parentJoint, coupler.placement,
    rocker.parentJoint, rocker.placement, pin.LOCAL,
)  # fmt: skip
h = 1e-3
loop.m_baumgarte_parameters.Kp, loop.m_baumgarte_parameters.Kd = (0.02 / h) ** 2, 0.04 / h
models, datas = [loop], [loop.createData()]
pin.initConstraintDynamics(model, data, models, datas)
settings = pin.ProximalSettings(1e-12, 1e-8, 5)


def acceleration(q, v):
    """Accelerations of all joints."""
    tau = np.zeros(model.nv)
    return pin.constraintDynamics(model, data, q, v, tau, models, datas, settings).copy()


q, v = pin.neutral(model), np.zeros(model.nv)
for _ in range(1000):
    a1 = acceleration(q, v)
    v2 = v + h / 2 * a1
    a2 = acceleration(pin.integrate(model, q, h / 2 * v), v2)
    v3 = v + h / 2 * a2
    a3 = acceleration(pin.integrate(model, q, h / 2 * v2), v3)
    v4 = v + h * a3
    a4 = acceleration(pin.integrate(model, q, h * v3), v4)
    q = pin.integrate(model, q, h / 6 * (v + 2 * (v2 + v3) + v4))
    v = v + h / 6 * (a1 + 2 * (a2 + a3) + a4)
pin.framesForwardKinematics(model, data, q)
print(*data.oMf[model.getFrameId("rocker_end")].translation)
