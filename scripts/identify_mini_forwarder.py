"""Identify the mini forwarder on virtual rigs with known true parameters.

    python scripts/identify_mini_forwarder.py            # 50 rigs, some ten minutes
    python scripts/identify_mini_forwarder.py --rigs 5

Each rig is a plant with random masses, inertias, centres of mass and friction within tolerances.
It follows an optimised periodic reference, and then another one for validation. Geometry is
assumed to be known and currents to be calibrated: resistors that are off by 5 to 10 % scale all
forces, and with them all parameters, which no estimator can detect.
"""

import argparse
import dataclasses
import warnings

import numpy as np
from rig import Converter, Rig, Tolerances, default_sensors

import crane
from crane.identification.excitation.periodic_excitation import excite
from crane.identification.mechanics.identification_model import IdentificationModel
from crane.identification.mechanics.identify import identify
from crane.identification.mechanics.model_terms import InertialTerm, ModelTerm, friction_term

SLOW = (0.05, 0.004, 0.004)  # beyond Stribeck velocities [rad/s], [m/s]: below, friction sticks
BANDWIDTH = 5.0  # [Hz], five times the highest harmonic
PRIOR = {"*": "30 %", "bodies": "10 %"}  # of the model that predicts: the description's tolerances


def terms(machine: crane.Machine) -> list[ModelTerm]:
    """Bodies and friction, with a sign that jumps: rows where it does not are left out."""
    passive = [joint for joint in machine.joints if joint not in machine.active]
    return [
        InertialTerm(machine),
        *(friction_term(machine, joint, smoothing=0.0) for joint in machine.active),
        *(friction_term(machine, joint, ("viscous",)) for joint in passive),
    ]


def rig(machine: crane.Machine, seed: int, noise: float = 1.0) -> Rig:
    """A rig with calibrated currents, whose sensors are so many times as coarse as the paper's."""

    def scaled(converter: Converter) -> Converter:
        return dataclasses.replace(converter, step=noise * converter.step)

    sensors = {}
    for joint in machine.active:
        usual = default_sensors(machine, joint)
        sensors[joint] = dataclasses.replace(
            usual,
            position=scaled(usual.position),
            noise=noise * usual.noise,
            current=scaled(usual.current),
            current_noise=noise * usual.current_noise,
            error=(0.0, 0.0),
        )
    return Rig(machine, seed, Tolerances(pins=0.0), sensors)


def main() -> None:
    """Identify and judge."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rigs", type=int, default=50)
    options = parser.parse_args()
    warnings.simplefilter("ignore", crane.CraneWarning)
    machine = crane.load("mini_forwarder")
    learn, judge = (
        excite(machine, IdentificationModel(machine, terms(machine)), seed=k) for k in (0, 1)
    )
    print(learn.to_text())
    print(
        "rig  rank  covered  error [% of force: q1, X1, X2]  held out      ... of the noise floor"
    )
    covered, floors = [], []
    for seed in range(1, options.rigs + 1):
        virtual = rig(machine, seed)
        one, other = (virtual.run(reference.trajectory) for reference in (learn, judge))
        settings = {"terms": terms(machine), "min_speed": SLOW, "bandwidth": BANDWIDTH}
        result = identify(machine, one, **settings)
        truth = result.base.values(
            IdentificationModel(virtual.plant, terms(virtual.plant)).nominal
        )
        low, high = result.confidence_interval().T
        covered.append(float(np.mean((low <= truth) & (truth <= high))))
        model = identify(machine, one, other, prior=PRIOR, **settings)
        # the floor: what the true parameters leave of the same recording
        exact = identify(virtual.plant, other, terms=terms(virtual.plant), prior=1e-6,
                         min_speed=SLOW, bandwidth=BANDWIDTH)  # fmt: skip
        ratio = model.validation.rmse / exact.training.rmse
        floors.append(ratio)
        shares = [" ".join(f"{100 * x:5.2f}" for x in fit.relative_error)
                  for fit in (result.training, model.validation)]  # fmt: skip
        print(
            f"{seed:3d}  {result.base.rank:4d}  {100 * covered[-1]:5.1f} %  {shares[0]}"
            f"               {shares[1]}  {' '.join(f'{x:.2f}' for x in ratio)}"
        )
    print(
        f"\n{len(covered)} rigs: {100 * np.mean(covered):.1f} % of the 95 % intervals cover the "
        f"truth; held-out error over what the true parameters leave, median: "
        f"{', '.join(f'{x:.3f}' for x in np.median(floors, axis=0))} (q1, X1, X2)"
    )


if __name__ == "__main__":
    main()
