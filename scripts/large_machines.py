"""Forward dynamics over the number of joints, beside pin.constraintDynamics.

Every machine of `families.py` is loaded twice, in processes of their own that share a new cache
folder: the first compiles, the second finds machine code kept. Times are CPU times; those of a
call and of its peer take turns in one process.

    python scripts/large_machines.py                               # all, printed
    python scripts/large_machines.py --only chain --joints 30      # one of them
    python scripts/large_machines.py --write docs/performance.md   # also into the page
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import families
from growth import draw
from measuring import table
from results import conditions, put

SIZES = {
    "chain": (10, 19, 28, 40, 61, 100, 151, 199),
    "tree": (10, 19, 28, 40, 61, 100, 151, 199),
    "ring": (4, 7, 10, 20, 30, 45, 60),
    "spatial ring": (6, 8, 10, 20, 30, 45, 60),
}
MARKS = "<!-- large machines: written by scripts/large_machines.py -->", "<!-- end of them -->"
PICTURE = "images/large_machines.png"
HEAD = (
    "machine", "joints", "loops", "freedoms", "load [s]", "first call [s]", "kept [s]",
    "one call [us], ratio", "of a stack", "of closed postures", "`pin.constraintDynamics` [us]",
    "difference", "iterations, mu",
)  # fmt: skip


def measured(family: str, joints: int, rounds: int, limit: float) -> dict:
    """What `one_machine.py` tells of a machine, `kept` the first call of a later process [s].

    `failed` says why there is none, in a line.
    """
    with tempfile.TemporaryDirectory() as name:
        path = families.write(family, joints, Path(name))
        environment = dict(os.environ, XDG_CACHE_HOME=name, OMP_NUM_THREADS="1")
        found: dict = {"family": family, "joints": joints}
        try:
            found |= _process(path, rounds, limit, environment)
            found["kept"] = _process(path, 0, limit, environment)["first"]
        except subprocess.TimeoutExpired:
            found["failed"] = f"longer than {limit:g} s"
        except subprocess.CalledProcessError as error:
            found["failed"] = (error.stderr.strip().splitlines() or ["killed"])[-1]
    return found


def _process(path: Path, rounds: int, limit: float, environment: dict[str, str]) -> dict:
    script = Path(__file__).parent / "one_machine.py"
    command = [sys.executable, str(script), str(path), "--rounds", str(rounds)]
    done = subprocess.run(
        command, check=True, capture_output=True, text=True, env=environment, timeout=limit
    )
    return json.loads(done.stdout)


def row(found: dict) -> tuple[str, ...]:
    """Of the table."""
    begin = found["family"], str(found["joints"])
    if "failed" in found:
        return *begin, *["-"] * (len(HEAD) - 3), found["failed"]
    note = "" if found["backend"] == "compiled" else f" ({found['backend']})"
    counts = (str(found[name]) for name in ("loops", "freedoms"))
    times = [
        f"{1e6 * found[name]:.1f}, {found[f'{name} ratio']:.2g}"
        for name in ("one", "stack", "given")
    ]
    times.append(f"{1e6 * found['theirs']:.1f}")
    settings = f"{found['iterations']}, {found['mu']:.0e}"
    spent = f"{found['load']:.2f}", f"{found['first']:.2f}{note}", f"{found['kept']:.3f}"
    return *begin, *counts, *spent, *times, f"{found['gap']:.0e}", settings


def machines(options: argparse.Namespace) -> Iterator[tuple[str, int]]:
    """Families and sizes that were asked for."""
    for family in options.only or families.FAMILIES:
        for joints in options.joints or SIZES[family]:
            if joints >= families.FAMILIES[family]:
                yield family, joints


def main() -> None:
    """Measure, print, draw and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", action="append", choices=families.FAMILIES, help="families")
    parser.add_argument("--joints", action="append", type=int, help="sizes")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--limit", type=float, default=240, help="of a process [s]")
    parser.add_argument("--picture", type=Path, help="file for it")
    parser.add_argument("--write", type=Path, help="page to put the results into")
    options = parser.parse_args()
    results = []
    for line in table(HEAD, []).splitlines():
        print(line)
    for family, joints in machines(options):
        results.append(measured(family, joints, options.rounds, options.limit))
        print(table(row(results[-1]), []).splitlines()[0], flush=True)
    if options.picture:
        draw(results, options.picture)
    if options.write:
        draw(results, options.write.parent / PICTURE)
        parts = [conditions(), table(HEAD, [row(found) for found in results])]
        put(options.write, MARKS, parts)


if __name__ == "__main__":
    main()
