"""How does a motor in the shank of the walking robot Cassie turn its foot, through a rod?"""

import warnings

import numpy as np

import crane
from crane.description.machine_lookup import example_root

warnings.simplefilter("ignore", crane.CraneWarning)  # about its file, which is for Gazebo

# Agility Robotics' Cassie by DAIRLab, ISC licence, from example-robot-data
sdf = example_root() / "cassie_description" / "robots" / "cassie_v2.sdf"
motors = ("roll-op", "yaw-op", "pitch-op", "knee-op", "tarsus-crank-joint")
springs = {f"{side}-knee-shin-joint": 0.0 for side in ("left", "right")}  # stiff springs, locked
machine = crane.load(
    sdf, active=[f"{side}-{motor}" for side in ("left", "right") for motor in motors], lock=springs
)
print(f"{len(machine.joints)} joints, {len(machine.active)} motors: the legs are closed by rods")

crank = machine.active.index("left-tarsus-crank-joint")
q_a = machine.home[machine.closure.active]
turn = np.linspace(0.0, -1.5, 16)  # of the crank from home [rad]
posture = np.tile(q_a, (16, 1))
posture[:, crank] += turn
q = machine.closure.solve(posture)
foot = q[:, machine.column("left-foot-op")]
ratio = machine.closure.gamma(q)[:, machine.column("left-foot-op"), crank]
turned = np.rad2deg([turn[-1], foot[-1] - foot[0]])
print(f"the crank turns by {turned[0]:.0f} deg, the foot by {turned[1]:.0f} deg")
print(f"the foot turns {ratio.min():.3f} to {ratio.max():.3f} times as fast as the crank")
assert abs(turned[0] - turned[1]) < 0.5 and np.ptp(ratio) < 0.01  # crank and rod: a parallelogram
