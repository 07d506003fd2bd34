"""Calibrate seven numbers to a recording of lifting from random starts; count the best minimum.

    python scripts/random_starts.py RECORDING [FIRST] [END] [FACTOR]

The starts lie within a factor, 2 by default, of the machine's values, even in the logarithm; those
of the pin within 2, since the machine does not close farther away. A fit is in the best minimum
if its sum of squares is within 2 % of the lowest; otherwise its report should warn of another
minimum, which is counted.
"""

import sys
import time
import warnings
from pathlib import Path

import numpy as np

import crane
from crane.formats.machine_loading import MachineVariants

COLUMNS = Path(__file__).parent / "columns" / "patu655.txt"
LOADED = {"payload.mass": 211.4}
LOCKED = {"slew": 0.0, "X_ext": 0.1}
SENSORS = ["X_lift", "pressure_X_lift_a", "pressure_X_lift_b"]  # of the cylinder that moves
NAMES = [
    "valve.X_lift.c1", "valve.X_lift.c2", "valve.X_lift.bandwidth", "lift_boom_rod.x",
    "cylinder.X_lift.stiffness", "cylinder.X_lift.damping", "friction.X_lift.coulomb",
]  # fmt: skip
PINS = ["lift_boom_rod.x"]
SIZES = {"m": 1e-3, "Pa": 5e4, "rad": 0.01}  # of what a channel may leave


def main():
    """Print a line per start, and how many end in the best minimum."""
    warnings.simplefilter("ignore")
    machine = crane.load("patu655", lock=LOCKED, changes=LOADED)
    values = MachineVariants(machine).values
    seeds, costs, told = range(*map(int, sys.argv[2:4] or [0, 100])), [], []
    factor = float(sys.argv[4]) if len(sys.argv) > 4 else 2.0
    for seed in seeds:
        widths = [min(factor, 2.0) if x in PINS else factor for x in NAMES]
        factors = np.array(widths) ** np.random.default_rng(seed).uniform(-1, 1, len(NAMES))
        fit = {x: values[x] * y for x, y in zip(NAMES, factors.tolist(), strict=True)}
        begun = time.process_time()
        found = crane.calibrate(machine, sys.argv[1], fit, columns=COLUMNS, sensors=SENSORS)
        took = time.process_time() - begun
        cost = sum((x.rms(x.simulated_after, True) / SIZES[x.unit]) ** 2 for x in found.channels)
        costs.append(cost)
        told.append(bool(found.quality_warnings))
        print(
            f"{seed}: {took:.0f} s, {cost:.4f}, "
            + ", ".join(f"{x.name} {x.value:.4g}" for x in found.parameters)
            + (" | " + " ".join(found.quality_warnings) if told[-1] else ""),
            flush=True,
        )
    best = np.array(costs) < 1.02 * min(costs)
    warned = sum(x for x, y in zip(told, best, strict=True) if not y)
    print(f"{best.sum()} of {len(best)} in the best minimum, {warned} of the others told")


if __name__ == "__main__":
    main()
