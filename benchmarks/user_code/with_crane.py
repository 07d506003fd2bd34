"""crane: reads the loop from the URDF."""

from pathlib import Path

import crane

machine = crane.load(Path(__file__).with_name("four_bar.urdf"))
run = crane.simulate(machine, None, [0.0], duration=1.0, step=0.01)
print(*crane.Kinematics(machine, "rocker_end").position(run.q[-1]))
