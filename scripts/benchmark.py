"""Measure the parts of crane on the mini forwarder beside other engines; write tables.

All candidates of a table run in turns in one process; the tables give medians of CPU times over
the rounds. Ratios apply to other computers, too, times do not. Needs MuJoCo (extra "mjcf").

    python scripts/benchmark.py                              # print
    python scripts/benchmark.py --write docs/performance.md  # also into the page
"""

import argparse
import warnings
from pathlib import Path

from benchmark_machine import swinging
from derivatives import derivatives, gradients
from evaluations import agree, forward_dynamics, one_step, stacks, task, threads
from measuring import conditions, put
from start_times import starts
from valve_cranes import at_work, hydraulic_crane

import crane

MARKS = "<!-- results: written by scripts/benchmark.py -->", "<!-- end of results -->"


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=15, help="of short measurements")
    parser.add_argument("--write", type=Path, help="page to put the results into")
    options = parser.parse_args()
    warnings.simplefilter("ignore", crane.CraneWarning)
    mini = crane.load("mini_forwarder")
    bare, few = swinging(mini), max(3, options.rounds // 5)
    parts = [conditions(), agree(bare)]
    for title, part in (
        ("Forward dynamics", lambda: forward_dynamics(bare, options.rounds)),
        ("Derivatives", lambda: derivatives(options.rounds)),
        ("One step", lambda: one_step(mini, bare, options.rounds)),
        ("A controlled task", lambda: task(mini, few)),
        ("Stacks", lambda: stacks(mini, few)),
        ("Threads", lambda: threads(mini, few)),
        ("A crane on its valves", lambda: hydraulic_crane(few)),
        ("A grapple, and ground under it", lambda: at_work(few)),
        ("Gradients of a motion", gradients),
        ("Starting", lambda: starts(few)),
    ):
        parts += [f"### {title}", part()]
        print("\n\n".join(parts[-4:] if title == "Forward dynamics" else parts[-2:]) + "\n")
    if options.write:
        put(options.write, MARKS, parts)


if __name__ == "__main__":
    main()
