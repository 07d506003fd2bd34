"""What is the fastest lift within speed and force of the cylinder?"""

import casadi as ca
import numpy as np

import crane

machine = crane.load(
    "patu655", changes={"payload.mass": 200.0}, lock={"slew": 0.0, "X_tilt": 0.246, "X_ext": 0.1}
)
inverse = crane.simulation.casadi_function(machine, "inverse")  # (q, v_A, a_A) -> forces
loops = crane.simulation.casadi_function(machine, "loops")  # q -> 0 where the loops are closed

PARTS, WAY, SPEED, FORCE = 40, 0.3, 0.15, 70e3  # distance of the stroke [m], limits [m/s], [N]
lift = int(machine.closure.active[0])

opti = ca.Opti()
q = opti.variable(len(machine.home), PARTS + 1)  # all joints: loops are constraints
v, a = opti.variable(1, PARTS + 1), opti.variable(1, PARTS)  # accelerations are piecewise constant
duration = opti.variable()
h = duration / PARTS
for k in range(PARTS + 1):
    opti.subject_to(loops(q[:, k]) == 0)
    opti.subject_to(opti.bounded(0, v[k] / SPEED, 1))
for k in range(PARTS):
    opti.subject_to(v[k + 1] == v[k] + h * a[k])
    opti.subject_to(q[lift, k + 1] == q[lift, k] + h * (v[k] + v[k + 1]) / 2)
    for end in (k, k + 1):
        opti.subject_to(opti.bounded(0, inverse(q[:, end], v[end], a[k]) / FORCE, 1))
opti.subject_to([v[0] == 0, v[PARTS] == 0])
opti.subject_to([q[lift, 0] == machine.home[lift], q[lift, PARTS] == machine.home[lift] + WAY])
opti.subject_to(duration >= 0.1)
opti.set_initial(q, np.tile(machine.home[:, None], PARTS + 1))
opti.set_initial(duration, 4.0)
opti.minimize(duration)
opti.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes"})
found = opti.solve()
q, v, a = found.value(q).T, found.value(v)[:, None], found.value(a)[:, None]
print(f"{found.value(duration):.2f} s for {WAY} m")

# recomputed forces, and Pontryagin's principle: the fastest motion is always at a limit
assert np.abs(machine.closure.residual(q)).max() < 1e-8
dynamics, stroke = crane.Dynamics(machine), q[:, [lift]]
force = np.hstack([dynamics.inverse(stroke[i], v[i], a) for i in (slice(-1), slice(1, None))])
room = np.hstack([1 - v[:-1] / SPEED, 1 - v[1:] / SPEED, 1 - force / FORCE, force / FORCE])
print(f"in {np.sum(room.min(axis=1) < 1e-3)} of {PARTS} parts it is at a limit")
assert room.min() > -1e-6 and np.sum(room.min(axis=1) > 1e-3) < 3
