"""Random linkages with friction that sticks, springs and stops, ten seconds each: what comes out.

Every run has to balance its energies to 1e-6 of what went through with its loops closed, or to say
in one line why it cannot.
"""

import argparse
import sys
import tempfile
import time
import warnings
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

import crane
from crane.machine import Machine

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from test_random_linkages import driven, linkage  # noqa: E402

BALANCE, CLOSED = 1e-6, 1e-9
DURATION, STEP = 10.0, 1e-2


def drawn(seed: int, folder: Path) -> Machine | None:
    """A machine, or None where the draw makes none."""
    random = np.random.default_rng(seed)
    loops = int(random.integers(1, 4))
    count = 2 * loops + int(random.integers(1, 4))
    parents = [int(random.integers(max(0, i - 3), i + 1)) for i in range(count)]
    kinds = [bool(random.integers(4) == 0) for _ in range(count)]
    cuts = []
    for _ in range(loops):
        one, two = int(random.integers(1, count + 1)), int(random.integers(0, count))
        cuts.append((one, two if two < one else two + 1))
    machine = driven(linkage(folder, parents, kinds, cuts, int(random.integers(2**31))))
    if machine is None:
        return None
    friction, forces = {}, []
    for joint in machine.joints:
        if random.random() < 0.6:
            stiction = random.uniform(0, 1) * (random.random() < 0.5)
            friction[joint] = crane.Friction(
                coulomb=random.uniform(0, 3), stiction=stiction,
                stribeck=random.uniform(0.01, 0.1),
                viscous=random.uniform(0, 0.5), coulomb_offset=random.uniform(-0.3, 0.3),
            )  # fmt: skip
        if random.random() < 0.3:
            forces.append(
                crane.ForceElement(joint, random.uniform(5, 50), random.normal(), random.random())
            )
    stops = tuple(
        crane.EndStop(joint, 10 ** random.uniform(4, 7), random.uniform(0, 2))
        for joint in machine.joints
        if np.isfinite(machine.coordinates.upper[machine.column(joint)])
    )
    return machine.replace(friction=friction, forces=tuple(forces), end_stops=stops)


def run(seed: int) -> tuple[int, str, float, float, str]:
    """Seed, what came out, the balance, open loops, and what was said."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always", crane.CraneWarning)
                machine = drawn(seed, Path(folder))
                if machine is None:
                    return seed, "no machine", 0.0, 0.0, ""
                begun = len(caught)
                found = crane.simulate(machine, duration=DURATION, step=STEP)
        except crane.CraneError as error:
            one = "\n" not in str(error)
            return seed, "one line" if one else "MORE LINES", 0.0, 0.0, str(error)
    told = "; ".join(str(one.message) for one in caught[begun:])
    c = found.channels
    stored = c["kinetic"] + c["potential"]
    through = max(np.ptp(c[x]) for x in ("kinetic", "potential", "work", "dissipated"))
    gap = float(np.abs(c["work"] - (stored - stored[0]) - c["dissipated"]).max())
    q = np.column_stack(
        [
            found.q[:, machine.active.index(x)] if x in machine.active else c[x]
            for x in machine.joints
        ]
    )
    still = "rests" if (found.v[-1] == 0).all() else "moves"
    open_by = float(machine.closure.residual(q).max())
    return seed, still, gap / max(through, 1e-9), open_by, told


def main() -> None:
    """Run and count."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("count", type=int, nargs="?", default=500)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    begun, outcomes, worst, bad = time.time(), Counter(), [0.0, 0.0], []
    seed = options.first
    with ProcessPoolExecutor(options.processes) as pool:
        while sum(n for what, n in outcomes.items() if what != "no machine") < options.count:
            some = range(seed, seed + 10 * options.processes)
            seed += len(some)
            for one in pool.map(run, some):
                outcomes[one[1]] += 1
                worst = [max(worst[0], one[2]), max(worst[1], one[3])]
                off = one[2] > BALANCE or one[3] > CLOSED
                if one[1] in ("one line", "MORE LINES") or off:
                    bad.append(one)
                    print(f"{one[0]}: {one[1]}, {one[2]:.1e}, {one[3]:.1e}, {one[4]}", flush=True)
    print(f"{dict(outcomes)} in {time.time() - begun:.0f} s; balance {worst[0]:.1e}, loops "
          f"{worst[1]:.1e}; {len(bad)} to look at")  # fmt: skip


if __name__ == "__main__":
    main()
