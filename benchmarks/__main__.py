"""The referee: error against time and cost of calls of all engines on all problems.

python benchmarks                              # everything, printed
python benchmarks --quick                      # a few minutes
python benchmarks --only bricard               # one problem
python benchmarks --write docs/performance.md  # also into the page
python benchmarks --references                 # compute the reference solutions again
"""

import argparse
import json
import warnings
from pathlib import Path

import drives
import forward_dynamics
import report
import valve_crane
from problem import Problem, problems
from reference import write_reference
from trajectories import Point, available_engines, measure

import crane

QUICK_PROBLEMS = ("andrews_squeezer", "mini_forwarder", "slider_crank")
QUICK_MACHINES = ("chain 10", "ring 7", "mini_forwarder/mini_forwarder.yaml")
MAX_DIFFERENCE = 1e-8  # between the two computations of a reference [m]


def main() -> None:
    """Run what the options say."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", action="append", help="name of a problem; may be repeated")
    parser.add_argument("--quick", action="store_true", help="a few problems and machines")
    parser.add_argument("--write", type=Path, help="page to put the results into")
    parser.add_argument("--json", type=Path, help="file for all results")
    parser.add_argument("--references", action="store_true", help="compute reference solutions")
    options = parser.parse_args()
    warnings.simplefilter("ignore", crane.CraneWarning)
    names = options.only or (list(QUICK_PROBLEMS) if options.quick else None)
    chosen = problems(names)
    known = [problem.name for problem in problems()]
    unknown = sorted(set(names or ()) - set(known))
    if unknown:
        parser.error(f"no problem '{unknown[0]}', there are {', '.join(known)}")
    if options.references:
        write_references(chosen)
        return
    parts = [report.conditions()]
    print(parts[0], flush=True)
    points = run_work_precision(chosen)
    parts += report.work_precision_tables(chosen, points)
    results = []
    if not options.only:
        parts += ["### Hydraulics, friction and stops"]
        parts += drives.tables(drives.measure(options.quick))
        parts += valve_crane.tables(valve_crane.measure(options.quick))
        results = run_forward_dynamics(options.quick)
        parts += ["### Forward dynamics of all engines", report.forward_dynamics_table(results)]
    print("\n\n".join(parts[1:]))
    if options.json:
        rows = [point.as_json() for point in points]
        options.json.write_text(json.dumps({"points": rows, "forward": results}, indent=1))
    if options.write:
        images = options.write.parent / "images"
        report.draw_work_precision(chosen, points, images / "work_precision.png")
        report.draw_forward_dynamics(results, images / "forward_dynamics.png")
        report.write_section(options.write, parts)


def run_work_precision(chosen: list[Problem]) -> list[Point]:
    """Points of all engines on some problems."""
    engines, missing = available_engines()
    for line in missing:
        print(line)
    points: list[Point] = []
    for problem in chosen:
        for engine in engines:
            points += measure(problem, engine)
        print(f"{problem.name}: {sum(point.problem == problem.name for point in points)} runs",
              flush=True)  # fmt: skip
    return points


def run_forward_dynamics(quick: bool) -> list[dict]:
    """Forward dynamics of all machines, each in a process of its own."""
    machines = QUICK_MACHINES if quick else (
        "mini_forwarder/mini_forwarder.yaml",
        *(f"{family} {joints}" for family, sizes in forward_dynamics.SIZES.items()
          for joints in sizes),
    )  # fmt: skip
    results = []
    for machine in machines:
        results.append(forward_dynamics.measure(machine, 5 if quick else 15))
        print(f"{machine}: {results[-1].get('failure', 'done')}", flush=True)
    return results


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
