"""Compute how often the intervals of `crane.identify` cover the true value of each parameter.

    python scripts/coverage_of_intervals.py                       # 50 rigs, default settings
    python scripts/coverage_of_intervals.py --method huber
    python scripts/coverage_of_intervals.py --tuned               # settings of an expert
    python scripts/coverage_of_intervals.py --noise 0.1           # sensors ten times as accurate

Each rig has its own plant, see `identify_mini_forwarder.py`. z is the error of a parameter divided
by its standard deviation: its mean over the rigs shows a bias, its standard deviation shows
whether the standard deviations are correct.
"""

import argparse
import warnings

import numpy as np
from identify_mini_forwarder import BANDWIDTH, SLOW, rig, terms

import crane
from crane.identification.excitation.periodic_excitation import excite
from crane.identification.mechanics.identification_model import IdentificationModel, default_terms
from crane.identification.mechanics.identify import METHODS, identify


def main() -> None:
    """Identify rig after rig."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rigs", type=int, default=50)
    parser.add_argument("--first", type=int, default=1, help="seed of the first rig")
    parser.add_argument("--method", choices=METHODS, default="wls")
    parser.add_argument("--tuned", action="store_true", help="terms, bandwidth, slow by hand")
    parser.add_argument("--noise", type=float, default=1.0, help="times that of the sensors")
    options = parser.parse_args()
    warnings.simplefilter("ignore", crane.CraneWarning)
    machine = crane.load("mini_forwarder")
    given = terms if options.tuned else default_terms
    settings = {"min_speed": SLOW, "bandwidth": BANDWIDTH} if options.tuned else {}
    path = excite(machine, IdentificationModel(machine, terms(machine)), seed=0).trajectory
    found: dict[str, list[tuple[float, bool]]] = {}
    shares = []
    for seed in range(options.first, options.first + options.rigs):
        virtual = rig(machine, seed, options.noise)
        result = identify(
            machine, virtual.run(path), method=options.method, terms=given(machine), **settings
        )
        truth = result.base.values(
            IdentificationModel(virtual.plant, given(virtual.plant)).nominal
        )
        low, high = result.confidence_interval().T
        covered = (low <= truth) & (truth <= high)
        z = (result.values - truth) / result.std
        for name, *pair in zip(result.names, z.tolist(), covered.tolist(), strict=True):
            found.setdefault(name, []).append(tuple(pair))
        shares.append(covered.mean())
    print(f"{'parameter':<20}{'rigs':>6}{'covered':>10}{'mean z':>9}{'std z':>8}")
    for name, pairs in sorted(found.items(), key=lambda item: np.mean([c for _, c in item[1]])):
        z, covered = np.array(pairs).T
        print(f"{name:<20}{len(z):>6}{covered.mean():>10.0%}{z.mean():>9.2f}{z.std():>8.2f}")
    every = np.mean([c for pairs in found.values() for _, c in pairs])
    least = min(np.mean([c for _, c in pairs]) for pairs in found.values())
    print(
        f"\n{len(shares)} rigs, {options.method}: {every:.1%} of the 95 % intervals cover the "
        f"truth; least of a parameter {least:.0%}, of a rig {min(shares):.0%}"
    )


if __name__ == "__main__":
    main()
