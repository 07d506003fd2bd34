"""What are the friction and the inertia of a machine whose strokes and forces I recorded?"""

import numpy as np
from scipy.interpolate import CubicSpline

import crane

held = {"q1": 0.0, "X2": 0.0108}
machine = crane.load("mini_forwarder", lock=held)  # the described machine
truth = {"friction.X1.viscous": 800.0, "friction.X1.coulomb": 20.0, "link3.mass": 0.4}
true = crane.load("mini_forwarder", lock=held, changes=truth)  # unknown in practice


def recorded(frequencies, seed):
    """40 s of the true machine at 100 Hz, with sensor noise: 1 um, 0.05 N.

    Velocities are not measured, and the simulated ones are dropped: they would be exact.
    """
    time = np.arange(0.0, 40.0, 0.01)
    way = sum(1 - np.cos(2 * np.pi * f * time) for f in frequencies) / (2 * len(frequencies))
    curve = CubicSpline(time, (0.005 + 0.02 * way)[:, None], bc_type="clamped")
    run = crane.simulate(
        true, crane.ComputedTorque(true, crane.motion.Trajectory(curve)), step=0.01
    )
    return run.with_noise({"X1": 1e-6, "X1_force": 0.05}, seed)


learn, judge = recorded([0.05, 0.09], 1), recorded([0.04, 0.075], 2)
before = {"bodies": "10 %", "q*.viscous": "10 %"}  # prior of the others, as of a drawing
found = crane.identify(machine, learn, judge, prior=before)
print(found.to_text())

known = dict(zip(found.model.names, found.parameters, strict=True))
print(f"friction of the cylinder: {known['X1.coulomb']:.1f} N, {known['X1.viscous']:.0f} N s/m")
print(f"forces of the other recording are off by {found.validation.rmse[0]:.3f} N")
assert abs(known["X1.coulomb"] - 20.0) < 0.2 and abs(known["X1.viscous"] - 800.0) < 40.0
assert found.validation.rmse[0] < 0.05  # less than the noise, which the filter removes
