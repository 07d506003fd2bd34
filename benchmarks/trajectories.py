"""Error against time: every engine on every trajectory problem, over a sweep of its settings."""

import json
import statistics
import subprocess
import sys
import time
import warnings
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from engines import ENGINES
from engines.engine import Engine, UnsupportedError
from problem import Problem, problems

import crane

MARK = "point "  # before the lines of a point, beside what engines print
ROUNDS = 3  # runs of a setting, whose median counts; fewer where they take long
LONGEST_RUN = 1.0  # CPU time [s] after which finer settings are left out


@dataclass(frozen=True)
class Point:
    """A run of an engine with a setting.

    Attributes:
        problem: Name of the problem.
        engine: Name of the engine.
        setting: Step length [s] or tolerance, and further settings.
        error: Largest error of a centre of mass at the outputs [m].
        time: CPU time of the run, median [s].
        loop_error: Largest distance of the origins of a loop at the end [m].
        energy_drift: Change of the energy over the run [J]; NaN where forces do work.
        build: CPU time of building the simulator [s].
        failure: Why there is none, in one line.
    """

    problem: str
    engine: str
    setting: str = ""
    error: float = np.inf
    time: float = np.inf
    loop_error: float = np.inf
    energy_drift: float = np.nan
    build: float = np.nan
    failure: str = ""

    def as_json(self) -> dict[str, Any]:
        """Its values, without those that are not finite."""
        return {key: value for key, value in asdict(self).items()
                if value != "" and (isinstance(value, str) or np.isfinite(value))}  # fmt: skip


def measure(problem: Problem, engine: Engine) -> list[Point]:
    """Points of an engine on a problem, in a process of its own: engines may crash."""
    command = [sys.executable, __file__, problem.name, engine.name]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    lines = [line[len(MARK) :] for line in done.stdout.splitlines() if line.startswith(MARK)]
    points = [Point(**json.loads(line)) for line in lines]
    if done.returncode:
        cause = f"the process ended with {done.returncode}"
        points.append(Point(problem.name, engine.name, failure=cause))
    return points


def main() -> None:
    """Print the points of one engine on one problem."""
    problem, name = problems([sys.argv[1]])[0], sys.argv[2]
    engine = next(engine for engine in ENGINES if engine.name == name)
    warnings.simplefilter("ignore", crane.CraneWarning)
    spent = 0.0
    for setting in engine.settings(problem):
        start = time.process_time()
        point = measure_setting(problem, engine, setting)
        print(MARK + json.dumps(point.as_json()), flush=True)
        spent += time.process_time() - start - np.nan_to_num(point.build)
        long = LONGEST_RUN < point.time < np.inf
        if (spent > engine.budget) if engine.budget else long:
            break


def measure_setting(problem: Problem, engine: Engine, setting: Any) -> Point:
    """The point of one setting."""
    values = setting if isinstance(setting, tuple) else (setting,)
    text = " ".join(x if isinstance(x, str) else f"{x:g}" for x in values)
    found: dict[str, Any] = {"problem": problem.name, "engine": engine.name, "setting": text}
    start = time.process_time()
    try:
        simulator = engine.build(problem, setting)
        found["build"] = time.process_time() - start
        times, result = [], None
        for _ in range(ROUNDS):
            start = time.process_time()
            result = simulator.run()
            times.append(time.process_time() - start)
            if sum(times) > LONGEST_RUN / 2:
                break
        states = simulator.states(result)
    except UnsupportedError as error:
        return Point(**found, failure=str(error))
    except Exception as error:  # an engine that gives up
        return Point(**found, failure=f"{type(error).__name__}: {error}".splitlines()[0])
    if len(states) < len(problem.times) - 1:
        return Point(**found, failure=f"unstable after {len(states)} outputs")
    positions = np.array([state.position for state in states])
    error = problem.error(positions)
    if not np.isfinite(error):
        return Point(**found, failure="unstable")
    system = problem.system
    drift = np.nan
    if problem.is_conservative:
        energies = [system.energy(state) for state in states]
        drift = max(abs(energy - system.energy(system.start)) for energy in energies)
    return Point(
        **found,
        error=error,
        time=statistics.median(times),
        loop_error=max(system.loop_error(state) for state in states),
        energy_drift=drift,
    )


def failures(points: Sequence[Point]) -> list[str]:
    """A line for each engine of which settings failed, with the most frequent cause."""
    lines = []
    for name in dict.fromkeys(point.engine for point in points):
        own = [point for point in points if point.engine == name]
        causes = Counter(point.failure for point in own if point.failure)
        if causes:
            cause, _ = causes.most_common(1)[0]
            lines.append(f"{name}: {causes.total()} of {len(own)} settings fail, most: {cause}")
    return lines


def time_at_error(points: Iterable[Point], error: float) -> float | None:
    """Least time [s] in which an engine gets below an error, None if it never does.

    Times between two settings of the frontier are interpolated on logarithmic scales.
    """
    frontier: list[Point] = []
    for point in sorted(points, key=lambda point: point.time):
        if not point.failure and (not frontier or point.error < frontier[-1].error):
            frontier.append(point)
    if not frontier or frontier[-1].error > error:
        return None
    errors = np.log([max(point.error, 1e-16) for point in frontier[::-1]])
    times = np.log([point.time for point in frontier[::-1]])
    return float(np.exp(np.interp(np.log(error), errors, times)))


def available_engines() -> tuple[list[Engine], list[str]]:
    """The engines that are installed, and a line for each that is not."""
    missing = [
        f"{engine.name} is left out: {engine.package} is not installed"
        for engine in ENGINES
        if not engine.version()
    ]
    return [engine for engine in ENGINES if engine.version()], missing


if __name__ == "__main__":
    main()
