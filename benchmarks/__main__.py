"""The referee: error against time and cost of calls of all engines on all problems.

python benchmarks                              # everything, printed; rows in build/referee.json
python benchmarks runs starts                  # some parts
python benchmarks --quick                      # a little of each, in three minutes
python benchmarks --problem bricard            # one problem, all engines
python benchmarks --write docs/performance.md  # also into the pages
python benchmarks --kept --write docs/performance.md  # from the rows of earlier runs
python benchmarks --references                 # compute the reference solutions again
"""

import argparse
import json
import time
import warnings
from pathlib import Path

import work_precision
from pages import Results, conditions, faults, write_pages
from parts import PARTS
from problem import Problem, problems
from reference import write_reference

import crane

ROWS = Path(__file__).parents[1] / "build" / "referee.json"
MAX_DIFFERENCE = 1e-8  # between the two computations of a reference [m]


def main() -> None:
    """Run what the options say."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}")
    parser.add_argument("--problem", action="append", help="name of a problem; may be repeated")
    parser.add_argument("--quick", action="store_true", help="a little of each part")
    parser.add_argument("--write", type=Path, help="page to put the summary into")
    parser.add_argument("--kept", action="store_true", help="measure nothing")
    parser.add_argument("--references", action="store_true", help="compute reference solutions")
    options = parser.parse_args()
    warnings.simplefilter("ignore", crane.CraneWarning)
    refuse_unknown(parser, "part", options.parts, list(PARTS))
    refuse_unknown(parser, "problem", options.problem or [], [one.name for one in problems()])
    if options.quick and options.write:
        parser.error("a quick run is not written")
    if options.references:
        write_references(problems(options.problem))
        return
    if options.problem:
        found = work_precision.measure(options.quick, options.problem)
        print("\n\n".join(work_precision.tables(found)))
        return
    kept = json.loads(ROWS.read_text()) if ROWS.exists() and not options.quick else {}
    chosen = [] if options.kept else options.parts or list(PARTS)
    results = kept | run(chosen, options.quick, kept)
    missing = [name for name in PARTS if name not in results]
    if options.write and missing:
        raise SystemExit(f"error: not written, there are no rows yet of {', '.join(missing)}")
    if options.write:
        write_pages(options.write, results)
    lines = faults(results)
    if lines:
        raise SystemExit("\n".join(f"error: {line}" for line in lines))
    print(f"{len(chosen)} parts, crane as exact as it has to be")


def refuse_unknown(
    parser: argparse.ArgumentParser, kind: str, names: list[str], known: list[str]
) -> None:
    """End with a line if a name is not known."""
    for name in names:
        if name not in known:
            parser.error(f"no {kind} '{name}', there are {', '.join(known)}")


def run(names: list[str], quick: bool, kept: Results) -> Results:
    """Run parts one after another; the rows of complete ones are kept, whatever comes after."""
    found: Results = {}
    for name in names:
        told, start = conditions(), time.monotonic()
        print(f"\n## {PARTS[name].title}\n\n{told}\n", flush=True)
        rows, tables = PARTS[name].run(quick)
        found[name] = {"conditions": told, "rows": rows, "tables": tables}
        print("\n\n".join(["", *tables]), f"\n\n{time.monotonic() - start:.0f} s", flush=True)
        if not quick:
            ROWS.parent.mkdir(exist_ok=True)
            ROWS.write_text(json.dumps(kept | found, indent=1))
    return found


def write_references(chosen: list[Problem]) -> None:
    """Compute reference solutions two ways, and write those that agree.

    Raises:
        SystemExit: Two computations differ.
    """
    for problem in chosen:
        difference = write_reference(problem)
        print(f"{problem.name}: two computations differ by {difference:.1e} m", flush=True)
        if difference > MAX_DIFFERENCE:
            raise SystemExit(f"error: {problem.name} has no reference, the two do not agree")


if __name__ == "__main__":
    main()
