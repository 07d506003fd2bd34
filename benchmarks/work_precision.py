"""Part: error against time of all engines on all problems."""

from collections.abc import Sequence

from engines import ENGINES
from problem import missing_problems, problems
from report import paragraph, sentence, table
from trajectories import Point, available_engines, failures, time_at_error
from trajectories import measure as measure_engine

QUICK = ("andrews_squeezer", "mini_forwarder", "slider_crank")
ERRORS = (1e-2, 1e-3, 1e-4, 1e-6, 1e-8)  # of the columns [m]


def measure(quick: bool, names: Sequence[str] = ()) -> list[Point]:
    """Points of all engines on all problems, on a few, or on those of some names."""
    engines, missing = available_engines()
    for line in [*missing, *missing_problems()]:
        print(line)
    points: list[Point] = []
    for problem in problems(list(names or (QUICK if quick else ()))):
        found = [point for engine in engines for point in measure_engine(problem, engine)]
        print(f"{problem.name}: {len(found)} runs", flush=True)
        points += found
    return points


def tables(points: Sequence[Point]) -> list[str]:
    """For each problem: times of all engines at equal errors, and their best."""
    head = [
        "engine", *(f"{error:.0e} m [ms]" for error in ERRORS), "least error [m]",
        "loops open [m]", "energy [J]", "setting of that",
    ]  # fmt: skip
    parts = []
    measured = list(dict.fromkeys(point.problem for point in points))
    for problem in problems(measured):
        own = [point for point in points if point.problem == problem.name]
        names = [engine.name for engine in ENGINES if any(p.engine == engine.name for p in own)]
        rows = [_row(name, [p for p in own if p.engine == name]) for name in names]
        about = f"{problem.duration:g} s. Source: {problem.source.strip()}."
        parts += [f"### {sentence(problem.title)}", paragraph(about), table(head, rows)]
        parts += ["\n".join(f"- {line}" for line in failures(own))] if failures(own) else []
    return parts


def _row(name: str, points: Sequence[Point]) -> list[str]:
    """Cells of an engine: times at equal errors, and its point with the least error."""
    reached = [point for point in points if not point.failure]
    if not reached:
        return [name, *["-"] * (len(ERRORS) + 3), points[-1].failure]
    times = [time_at_error(reached, error) for error in ERRORS]
    best = min(reached, key=lambda point: point.error)
    drift = "-" if best.energy_drift != best.energy_drift else f"{best.energy_drift:.0e}"
    return [
        name, *("-" if time is None else f"{1e3 * time:.3g}" for time in times),
        f"{best.error:.0e}", f"{best.loop_error:.0e}", drift, best.setting,
    ]  # fmt: skip
