"""How do I fit a hydraulic machine to its logged valve signals, strokes and pressures?"""

import numpy as np

import crane

held = {"slew": 0.0, "X_tilt": 0.246, "X_ext": 0.1}
truth = {"payload.mass": 240.0, "valve.X_lift.neutral": 5.7}
described = crane.load("patu655", changes={"payload.mass": 200.0}, lock=held)
true = crane.load("patu655", changes=truth, lock=held)  # unknown in practice

# the log, every 20 ms: signals of the valve, stroke, pressures; with noise of 0.2 mm, 0.2 bar
time = np.array([0.0, 0.3, 0.5, 1.2, 1.4, 1.8, 2.0, 2.6, 2.8])  # [s]
volts = np.array([5.8, 5.8, 4.5, 4.5, 5.8, 5.8, 6.9, 6.9, 5.8])
run = crane.simulate(
    true, crane.control.ValveSignals(true, time, {"X_lift": volts}), duration=4.0, step=0.02
)
columns = ["time", "voltage_X_lift", "X_lift", "pressure_X_lift_a", "pressure_X_lift_b"]
noise = np.random.default_rng(0).normal(size=(len(run.time), 5)) * [0, 0, 2e-4, 2e4, 2e4]
table = np.column_stack([run.columns()[name] for name in columns]) + noise
units = ["s", "V", "m", "Pa", "Pa"]
heads = ",".join(f"{name} [{unit}]" for name, unit in zip(columns, units, strict=True))
np.savetxt("log.csv", table, delimiter=",", header=heads, comments="")

found = crane.calibrate(described, "log.csv", list(truth), train=(0.0, 3.0))  # rest held out
print(found.to_text())
for one in found.parameters:
    print(
        f"{one.name} is {one.value:.1f} +- {one.interval_half_width:.1g} and not "
        f"{one.initial_value:g}"
    )
    assert abs(one.value - truth[one.name]) < 2 * one.interval_half_width
