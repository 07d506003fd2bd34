"""How heavy is the log that the crane has lifted?"""

from dataclasses import replace

import numpy as np

import crane

LOG = 0.15  # [kg], to be estimated; the crane is a table-top model

empty = crane.load("mini_forwarder")
loaded = crane.load("mini_forwarder", changes={"payload.mass": LOG})
trajectory = crane.task_trajectory(loaded, "loading")
run = crane.simulate(loaded, crane.ComputedTorque(loaded, trajectory), step=0.005)
noise = np.random.default_rng(0).normal(size=run.tau.shape)
recording = replace(run, tau=run.tau + 0.1 * noise)  # noise of force sensors: 0.1 N, 0.1 N m

found = crane.identification.identify_payload(empty, recording)
low, high = found.confidence_interval()[0]
print(f"it carries {1e3 * found.mass:.0f} g, 95 % between {1e3 * low:.0f} and {1e3 * high:.0f} g")
assert low < LOG < high and high - low < 0.02
