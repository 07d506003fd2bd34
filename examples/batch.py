"""How do I simulate one motion with a hundred different loads in one call?"""

import numpy as np

import crane

empty = crane.load("mini_forwarder")
trajectory = crane.task_trajectory(empty, "lift")
masses = np.linspace(0.0, 0.2, 100)  # [kg]
machines = [empty.with_payload(crane.Payload("link7_tip", mass=m)) for m in masses]

# all runs share the machine code; threads use all cores
batch = crane.simulation.simulate_batch(
    machines, lambda machine: crane.PI(machine, trajectory), step=0.01
)
assert not batch.failures

peak = np.abs(batch.tau[:, :, 1]).max(axis=1)  # of cylinder X1 [N]
print(f"{len(masses)} motions of {batch.time[-1]:g} s")
print(f"the peak of X1 goes from {peak[0]:.1f} N without a load to {peak[-1]:.1f} N with 200 g")
gain = np.polyfit(masses, batch.energy[:, -1, 1] - batch.energy[:, 0, 1], 1)[0]
print(f"a load of 1 kg would take {gain:.2f} J of lifting, {gain / 9.81:.3f} m times its weight")
assert abs(gain / 9.81 - 0.1923) < 0.005  # the tip rises by 0.1923 m
