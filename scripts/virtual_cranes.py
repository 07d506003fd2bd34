"""Calibrate virtual log cranes with wrong files; count how often intervals cover the true values.

    python scripts/virtual_cranes.py [COUNT]

Each crane is `patu655` with twelve wrong parameters: friction ten times, modulus half, air in
a chamber, neutrals by up to 30 mV, all others by up to 30 %. A lever motion of 20 s is recorded
at 100 Hz with noise; its first 12 s are fitted from the file's values, the rest is held out.
"""

import fnmatch
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np

import crane
from crane.formats.machine_loading import MachineVariants
from crane.recordings import timeseries

HELD, FILE = {"X_ext": 0.3, "slew": 0.0}, {"payload.mass": 150.0}
NOISE = {"X": 2e-4, "p": 2e4}  # of strokes [m], of pressures [Pa]
LEVERS = {
    "X_lift": [(0, 0), (1, 0), (1.3, 0.5), (4, 0.5), (4.2, 0), (5, 0), (5.2, -0.4), (7.5, -0.4),
               (7.7, 0), (12, 0), (12.2, 0.3), (14, 0.3), (14.1, 0), (16, 0), (16.1, -0.3),
               (17.5, -0.3), (17.7, 0), (20, 0)],
    "X_tilt": [(0, 0), (2, 0), (2.2, -0.4), (4.5, -0.4), (4.7, 0), (8, 0), (8.2, 0.5),
               (10.5, 0.5), (10.8, 0), (14.5, 0), (14.7, -0.5), (16.5, -0.5), (16.7, 0), (20, 0)],
}  # fmt: skip


def truth_of(values, seed):
    """The true numbers of a crane; with `*` a common factor."""
    random = np.random.default_rng(100 + seed)

    def off(name, factor=1.0):
        return values[name] * factor * (1 + 0.3 * random.uniform(-1, 1))

    true = {"payload.mass": off("payload.mass")}
    for joint in ("X_lift", "X_tilt"):
        for what in ("coulomb", "viscous"):
            name = f"friction.{joint}.{what}"
            true[name] = off(name, 10.0)
    for joint in ("X_lift", "X_tilt"):
        name = f"valve.{joint}.neutral"
        true[name] = values[name] + 0.03 * random.uniform(-1, 1)
    true["valve.X_lift.dead_band"] = off("valve.X_lift.dead_band")
    true["valve.*.bandwidth"] = 1 + 0.3 * random.uniform(-1, 1)
    true["oil.bulk_modulus"] = off("oil.bulk_modulus", 0.5)
    true["cylinder.X_lift.gas_a"] = 2e-5 * (1 + 0.3 * random.uniform(-1, 1))
    true["cylinder.X_lift.leakage_a"] = off("cylinder.X_lift.leakage_a", 3.0)
    return true


def recorded(machine, values, true, seed, path):
    """Write what noisy sensors say of the true crane."""
    changes = dict(FILE)
    for name, value in true.items():
        every = fnmatch.filter(values, name) if "*" in name else ()
        changes |= {one: values[one] * value for one in every} or {name: value}
    crane_ = crane.load("patu655", changes=changes, lock=HELD)
    times, random = np.arange(0, 20.0, 0.01), np.random.default_rng(seed)
    levers = crane.joystick(machine, LEVERS).references(times)
    signals = dict(zip(machine.hydraulics.joints, levers.T, strict=True))
    drive = crane.control.ValveSignals(crane_, times, signals)
    run = crane.simulate(crane_, drive, [0.15, 0.3], 19.99, 0.01, tolerance=1e-9)
    columns, units, read = run.columns(), {"time": "s"}, [times]
    for joint, signal in signals.items():
        units[f"voltage_{joint}"] = "V"
        read.append(signal)
    for joint in signals:
        for name in (joint, f"pressure_{joint}_a", f"pressure_{joint}_b"):
            noisy = columns[name] + NOISE[name[0]] * random.normal(size=len(times))
            units[name] = "m" if name == joint else "Pa"
            read.append(noisy if name == joint else np.maximum(noisy, 0.0))
    timeseries.write_table(path, timeseries.Table(units, np.column_stack(read), {}))


def main():
    """Print a line per crane, and how many numbers lie within their intervals."""
    warnings.simplefilter("ignore")
    machine = crane.load("patu655", changes=FILE, lock=HELD)
    values, inside, total = MachineVariants(machine).values, 0, 0
    folder = Path(tempfile.mkdtemp())
    for seed in range(int(sys.argv[1]) if len(sys.argv) > 1 else 20):
        true, path = truth_of(values, seed), folder / f"{seed}.csv"
        recorded(machine, values, true, seed, path)
        fit = dict.fromkeys(true) | {"cylinder.X_lift.gas_a": (1e-6, 0.0, 1e-3)}
        begun = time.process_time()
        found = crane.calibrate(machine, path, fit, train=(0.0, 12.0))
        took = time.process_time() - begun
        far = {
            x.name: abs(x.value - true[x.name]) / x.interval_half_width for x in found.parameters
        }
        held = [x.rms(x.simulated_after, False) / NOISE[x.name[0]] for x in found.channels]
        inside, total = inside + sum(x <= 1 for x in far.values()), total + len(far)
        worst = max(far, key=far.get)
        print(
            f"{seed}: {took:.0f} s, {sum(x <= 1 for x in far.values())} of {len(far)} within, "
            f"farthest {worst} {far[worst]:.2f}, held out {max(held):.2f} noises at most",
            flush=True,
        )
    print(f"{inside} of {total} numbers within their intervals of 95 %")


if __name__ == "__main__":
    main()
