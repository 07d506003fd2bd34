"""How do I simulate a machine with controlled forces, and save the results?"""

import numpy as np

import crane

machine = crane.load("mini_forwarder")
trajectory = crane.task_trajectory(machine, "lift")  # a task of its machine file
recording = crane.simulate(machine, crane.PI(machine, trajectory), label="lift")

recording.to_csv("lift.csv")
crane.report(machine, recording, "lift.html")  # a page that plays the motion, for any browser

for joint in machine.active:
    off = np.abs(recording.error(joint)).max()  # deviation from its reference
    print(f"{joint}: off by {off:.1e} {machine.unit(joint)} at most")
lifted = np.ptp(recording["tip_z"])
print(f"the tip rises by {lifted:.3f} m in {recording.time[-1]:g} s")

# the energy balance: the work of the drives is potential or kinetic energy, or lost to friction
energy = {name: recording[name] for name in ("kinetic", "potential", "dissipated")}
work = recording["work"]
left = work - sum(x - x[0] for x in energy.values())
print(f"work {work[-1]:.3f} J, of which friction takes {energy['dissipated'][-1]:.3f} J")
assert np.abs(left).max() < 1e-6 * np.abs(work).max()
assert abs(lifted - 0.1923) < 0.002  # 0.01923 m/s for ten seconds, by the task
