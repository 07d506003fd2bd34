"""Which motion identifies the masses and the friction of my machine best?"""

import numpy as np

import crane

# only the boom, so that this takes seconds: the other drives are locked
machine = crane.load("mini_forwarder", lock={"q1": 0.0, "X2": 0.0108})
motion = crane.excite(machine, period=5.0, harmonics=3, periods=2, starts=1)
print(motion.to_text())
motion.to_csv("motion.csv")  # the reference; use motion.trajectory in a simulation

gain = motion.optimized_information.logdet - motion.initial_information.logdet
print(f"it tells exp({gain:.1f}) times as much as a random motion within the same limits")
time, q, v, a, tau = motion.motion()
used = np.ptp(q) / (machine.upper - machine.lower)[0]
print(f"it needs {100 * used:.0f} % of the stroke and {np.abs(tau).max():.0f} N")
assert gain > 0 and used < 0.9  # margin of 5 % to both ends
assert np.allclose(motion.trajectory.velocity([0.0, time[-1] + 1.0]), 0)  # from rest to rest
