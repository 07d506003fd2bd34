"""How does a crane follow a path from a table?"""

from pathlib import Path

import numpy as np

import crane

# positions of the tip over time; from rest to rest with minimum jerk
Path("path.csv").write_text("""time [s],x [m],y [m],z [m]
0,4.5,0,0.0
3,4.8,0,0.6
6,4.3,1.0,0.6
9,3.8,1.5,-0.2
""")

machine = crane.load("patu655")
path = crane.motion.read_path(machine, "path.csv")  # inverse kinematics through the loops
recording = crane.simulate(machine, crane.ComputedTorque(machine, path), step=0.005)

tip = np.column_stack([recording[f"tip_{axis}"] for axis in "xyz"])  # [m]
for t, *goal in ((0, 4.5, 0, 0), (3, 4.8, 0, 0.6), (6, 4.3, 1, 0.6), (9, 3.8, 1.5, -0.2)):
    off = np.linalg.norm(tip[np.argmin(np.abs(recording.time - t))] - goal)
    print(f"{t} s: the tip is {1e3 * off:.3f} mm from its point")
    assert off < 1e-3
for joint, way in zip(machine.active, np.ptp(recording.q, axis=0), strict=True):
    print(f"{joint} moves by {way:.2f} {machine.unit(joint)}")
