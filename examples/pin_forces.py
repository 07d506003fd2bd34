"""Which forces act on the pins of an excavator while its bucket is loaded?"""

import numpy as np

import crane

LOAD = np.array([0.0, 0.0, -20e3, 0.0, 0.0, 0.0])  # at the bucket's lip: force [N], moment [N m]

machine = crane.load("excavator")
q_a = machine.home[machine.closure.active]
q = machine.closure.solve(q_a)
reactions = crane.dynamics.Reactions(machine)
found = dict(
    zip(reactions.names, reactions.joint_wrenches(q, wrenches={"bucket_lip": LOAD}), strict=True)
)
for pin in ("boom", "arm", "bucket"):
    print(f"pin of the {pin}: {np.linalg.norm(found[pin][:3]) / 1e3:.0f} kN")

# the first joint carries the weight of all moving bodies, and the load
first = reactions.names[0]
mass = sum(inertia.mass for inertia in machine.model.inertias[1:])  # [0] is fixed
print(f"the slewing ring carries {found[first][2] / 1e3:.1f} kN")
assert np.isclose(found[first][2], 9.81 * mass + 20e3, rtol=1e-9)
