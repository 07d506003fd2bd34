"""Problems of hydraulics, friction and stops: references, and errors over time of all candidates.

References are scipy's DOP853, compared with its Radau, on the equations by hand
(`hand_equations`), with steps that end at their kinks; or a closed form. Candidates are crane,
scipy on the same equations in Python, which is what one writes without a simulator, and Exudyn
where it has the elements.

python benchmarks/drives.py                # all problems
python benchmarks/drives.py --references   # compute the reference solutions again
"""

import argparse
import statistics
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import exudyn_drives
import numpy as np
import yaml
from hand_equations import MACHINES, Array, FallOnStop, HandEquations, LoadsOnCylinders
from scipy import integrate
from scipy.optimize import brentq
from stick_slip import StickSlip
from trajectories import time_at_error
from two_arm_crane import TwoArms

import crane

FOLDER = Path(__file__).parent / "problems" / "drives"
REFERENCES = FOLDER.parent / "references"
OUTPUT_COUNT = 10  # instants with outputs, after the start
EQUATIONS: dict[str, Callable[[Any], HandEquations]] = {
    "stick_slip": StickSlip, "end_stop": FallOnStop, "two_arm_crane": TwoArms,
}  # fmt: skip
ROUNDS = 3  # runs of a setting, whose median counts
LONGEST_RUN = 0.6  # CPU time [s] after which finer settings are left out
TOLERANCES = tuple(10.0**-k for k in range(3, 13))
SCIPY_TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-10)
RK4_STEPS = (0.02, 0.01, 5e-3, 2e-3, 1e-3, 5e-4, 2e-4)  # [s]
ERRORS = (1e-3, 1e-4, 1e-5, 1e-6, 1e-8)
REFERENCE_TOLERANCE = 1e-12
MAX_STEP_TO_STOP = 0.02  # shorter than a contact, whose begin and end are events [s]
MAX_DIFFERENCE = 1e-10  # between the two computations of a reference [m]


@dataclass(frozen=True)
class Run:
    """A run of a candidate.

    Attributes:
        problem: Name of the problem.
        engine: Name of the candidate.
        setting: Step length [s] or tolerance, and further settings.
        time: CPU time, median [s].
        error: Largest error of the strokes at the outputs [m].
        pressure_error: Largest error of pressures over the range of each; NaN without.
        failure: Why there is none, in one line.
    """

    problem: str
    engine: str
    setting: str = ""
    time: float = np.inf
    error: float = np.inf
    pressure_error: float = np.nan
    failure: str = ""


class DriveProblem:
    """A problem of the folder.

    Args:
        path: Its file.
    """

    def __init__(self, path: Path):
        self.name, self.data = path.stem, yaml.safe_load(path.read_text(encoding="utf-8"))
        self.title: str = self.data["title"]
        self.equations = EQUATIONS.get(self.name, LoadsOnCylinders)(self.data)
        self.reference_path = REFERENCES / f"{self.name}.csv"
        self.duration: float = self.data["duration"]
        self.times = self.duration / OUTPUT_COUNT * np.arange(1, OUTPUT_COUNT + 1)
        self.stroke_count = len(self.equations.machine["active"])

    @cached_property
    def reference(self) -> Array:
        """Strokes [m], then pressures [Pa] at the outputs (k, m)."""
        return np.loadtxt(self.reference_path, delimiter=",", comments="#", ndmin=2)

    @cached_property
    def machine(self) -> crane.Machine:
        """The machine in crane."""
        return crane.load(MACHINES / self.data["machine"])

    def command(self) -> Any:
        """Controller in crane."""
        machine = self.machine
        if "signals" in self.data:
            return crane.control.ValveSignals(machine, self.data["time"], self.data["signals"])
        if "spring" not in self.data:
            return None
        path = crane.motion.polynomial([[0.0, self.data["speed"]]], self.duration)
        gains = {machine.active[0]: crane.description.PIGains(self.data["spring"], 0.0)}
        return crane.PI(machine, path, gains, np.zeros(1))

    def simulate(self, method: str, setting: float) -> Array:
        """Outputs of crane, of the whole call of `crane.simulate`."""
        start = [self.data["start"][joint] for joint in self.machine.active]
        every, options = 1, {"tolerance": setting, "step": self.times[0]}
        if method == "rk4":
            every, options = round(self.times[0] / setting), {"step": setting}
        run = crane.simulate(
            self.machine, self.command(), start, self.duration, method=method, **options
        )
        pressures = [run.channels[name] for name in self.equations.pressure_names]
        return np.column_stack([run.q, *pressures])[every::every]

    def errors(self, outputs: Array) -> tuple[float, float]:
        """Largest errors of strokes [m], and of pressures over their ranges."""
        n, reference = self.stroke_count, self.reference
        if outputs.shape[1] < reference.shape[1]:
            return float(np.abs(outputs - reference[:, :n]).max()), np.nan
        difference = np.abs(outputs - reference)
        if reference.shape[1] == n:
            return float(difference.max()), np.nan
        ranges = np.ptp(reference[:, n:], axis=0)
        return float(difference[:, :n].max()), float((difference[:, n:] / ranges).max())


def problems() -> list[DriveProblem]:
    """All problems."""
    return [DriveProblem(path) for path in sorted(FOLDER.glob("*.yaml"))]


def solve_by_scipy(problem: DriveProblem, method: str, tolerance: float) -> Array:
    """Outputs of scipy on the equations by hand, from corner to corner of the signals."""
    equations = problem.equations
    if isinstance(equations, StickSlip):
        return solve_slips(equations, problem.times, method, tolerance)
    found, y, begin = [], equations.start, 0.0
    options = {"method": method, "rtol": tolerance, "atol": tolerance * equations.scales}
    while begin < problem.duration:
        end = min(t for t in (*equations.corners, problem.duration) if t > begin)
        events, longest = None, np.inf
        if isinstance(equations, FallOnStop):
            events, longest = touches(equations.lower, y), MAX_STEP_TO_STOP
        run = integrate.solve_ivp(
            equations.rate, (begin, end), y, events=events, dense_output=True, max_step=longest,
            **options,
        )  # fmt: skip
        if not run.success or not run.t[-1] > begin + 1e-12:
            raise RuntimeError(f"{method} stops at {begin:g} s")
        inside = problem.times[(problem.times > begin) & (problem.times <= run.t[-1])]
        found += [equations.outputs(run.sol(t)) for t in inside]
        y, begin = run.y[:, -1], float(run.t[-1])
    return np.array(found)


def touches(height: float, y: Array) -> Callable[[float, Array], float]:
    """Event of a load that leaves a stop which its state has just touched, else touches it."""

    def event(_: float, y: Array) -> float:
        return float(y[0] - height)

    has_touched = y[1] < 0 and y[0] < height + 1e-9
    direction = 1.0 if has_touched else -1.0
    event.terminal, event.direction = True, direction  # type: ignore[attr-defined]
    return event


def solve_slips(equations: StickSlip, times: Array, method: str, tolerance: float) -> Array:
    """Positions (k, 1) by scipy, with an event where the block stops; it rests in closed form."""

    def stops(_: float, y: Array) -> float:
        return float(y[1])

    stops.terminal, stops.direction = True, -1.0  # type: ignore[attr-defined]
    t, x = 0.0, float(equations.start[0])
    found = np.full(len(times), x)
    while t < times[-1]:
        begin = equations.slips_at(x)
        found[times > t] = x
        if begin >= times[-1]:
            break
        # beyond the begin, where the velocity is the first term of its series
        moment, jerk = 1e-4, equations.spring * equations.speed / equations.mass
        run = integrate.solve_ivp(
            equations.rate, (begin + moment, begin + 10.0),
            [x + jerk * moment**3 / 6, jerk * moment**2 / 2], method, events=stops,
            rtol=tolerance, atol=tolerance, dense_output=True,
        )  # fmt: skip
        t = float(run.t_events[0][-1])
        inside = (times > begin + moment) & (times <= t)
        found[inside] = run.sol(times[inside])[0]
        x = float(run.y_events[0][-1][0])
    return found[:, None]


def solve_exactly(problem: DriveProblem, method: str, tolerance: float) -> Array:
    """Outputs of scipy's DOP853 or Radau with steps that end at the kinks of the rate."""
    equations, found, y, t = problem.equations, [], problem.equations.start, 0.0
    for end in np.union1d(problem.times, equations.corners):
        y = _solve_to(equations, method, tolerance, t, y, float(end))
        t = float(end)
        if t in problem.times:
            found.append(equations.outputs(y))
    return np.array(found)


def _solve_to(
    equations: HandEquations, method: str, tolerance: float, t: float, y: Array, end: float
) -> Array:
    """State at an end within which signals have no corners."""
    kind = getattr(integrate, method)
    options = {"rtol": tolerance, "atol": 1e-2 * tolerance * equations.scales}
    solver, before = kind(equations.rate, t, y, end, **options), equations.kinks(t, y)
    while solver.status == "running":
        t, y = solver.t, solver.y
        if solver.step() is not None:
            raise RuntimeError(f"{method} stops at {t:g} s")
        after, inside = equations.kinks(solver.t, solver.y), solver.dense_output()
        crossed = np.flatnonzero(before * after < 0)
        kink = min((_crossing(equations, inside, t, solver.t, i) for i in crossed), default=end)
        before = after
        if t + 1e-11 < kink < solver.t - 1e-11:
            step = kind(equations.rate, t, y, kink, **options)
            while step.status == "running":
                step.step()
            t, y = kink, step.y
            solver, before = kind(equations.rate, t, y, end, **options), equations.kinks(t, y)
    return np.asarray(solver.y)


def _crossing(
    equations: HandEquations, inside: Callable[[float], Array], begin: float, end: float, i: int
) -> float:
    """Instant within a step at which a value of `HandEquations.kinks` changes its sign."""

    def value(t: float) -> float:
        return float(equations.kinks(t, inside(t))[i])

    if value(begin) * value(end) >= 0:
        return end
    return float(brentq(value, begin, end, xtol=1e-15))


def write_reference(problem: DriveProblem) -> float:
    """Compute a reference two ways and write it; the difference of their strokes [m]."""
    equations, n = problem.equations, problem.stroke_count
    if isinstance(equations, StickSlip):
        outputs = equations.closed_form(problem.times)[:, None]
        other = solve_slips(equations, problem.times, "DOP853", 1e-13)
        ways = "a closed form", "scipy's DOP853"
    else:
        outputs = solve_exactly(problem, "DOP853", REFERENCE_TOLERANCE)
        other = solve_exactly(problem, "Radau", REFERENCE_TOLERANCE)
        ways = f"scipy's DOP853, tolerance {REFERENCE_TOLERANCE:g}, on equations by hand", "Radau"
    difference = float(np.abs(outputs - other)[:, :n].max())
    pressures = np.abs(outputs - other)[:, n:]
    names = [f"{joint} [m]" for joint in equations.machine["active"]]
    names += [f"{name} [Pa]" for name in equations.pressure_names]
    head = (
        f"{problem.title}: {', '.join(names)} at the ends of {OUTPUT_COUNT} equal parts of "
        f"{problem.duration:g} s\nby {ways[0]}; {ways[1]} differs by {difference:.1e} m"
        + (f" and {pressures.max():.1e} Pa" if pressures.size else "")
    )
    np.savetxt(problem.reference_path, outputs, delimiter=",", header=head, fmt="%.16g")
    return difference


Candidate = tuple[str, Sequence[Any], Callable[[Any], Callable[[], Array]]]
"""Name, settings, and a function that builds what is timed for one of them."""


def candidates(problem: DriveProblem, quick: bool) -> list[Candidate]:
    """Candidates of a problem.

    With valves crane's other methods are scipy's on equations in Python, which are for checks.
    """
    has_valves = "signals" in problem.data
    own: list[tuple[str, Sequence[float]]] = [("rosenbrock", TOLERANCES)]
    if not has_valves:
        own += [("DOP853", TOLERANCES), ("Radau", TOLERANCES), ("rk4", RK4_STEPS)]
    found: list[Candidate] = [
        (f"crane {method}", settings, partial(_crane_run, problem, method))
        for method, settings in own
    ]
    found += [
        (f"scipy {method}", SCIPY_TOLERANCES[:: 3 if quick else 1],
         partial(_scipy_run, problem, method))
        for method in ("LSODA", "Radau", "BDF", *(() if has_valves else ("DOP853",)))
    ]  # fmt: skip
    settings = exudyn_drives.settings(problem.equations)[:: 3 if quick else 1]
    return [*found, ("Exudyn GeneralizedAlpha", settings, partial(_exudyn_run, problem))]


def _crane_run(problem: DriveProblem, method: str, setting: float) -> Callable[[], Array]:
    problem.simulate(method, setting)  # compiles
    return lambda: problem.simulate(method, setting)


def _scipy_run(problem: DriveProblem, method: str, setting: float) -> Callable[[], Array]:
    return lambda: solve_by_scipy(problem, method, setting)


def _exudyn_run(problem: DriveProblem, setting: exudyn_drives.Setting) -> Callable[[], Array]:
    return exudyn_drives.build(problem.equations, float(problem.times[0]), setting)


def measure_setting(problem: DriveProblem, candidate: Candidate, setting: Any) -> Run:
    """A run of a candidate with a setting."""
    name, _, build = candidate
    found = {"problem": problem.name, "engine": name,
             "setting": " ".join(f"{x:g}" for x in np.atleast_1d(setting))}  # fmt: skip
    times: list[float] = []
    try:
        run = build(setting)
        while len(times) < ROUNDS and sum(times) < LONGEST_RUN:
            begin = time.process_time()
            outputs = run()
            times.append(time.process_time() - begin)
        error, pressure_error = problem.errors(outputs)
    except Exception as failure:  # a candidate that gives up
        return Run(**found, failure=f"{type(failure).__name__}: {failure}".splitlines()[0])
    if not np.isfinite(error):
        return Run(**found, failure="unstable")
    return Run(**found, time=statistics.median(times), error=error, pressure_error=pressure_error)


def measure(quick: bool = False) -> list[Run]:
    """Runs of all candidates on all problems; every third setting of the others if quick."""
    runs: list[Run] = []
    for problem in problems():
        for candidate in candidates(problem, quick):
            for setting in candidate[1]:
                runs.append(measure_setting(problem, candidate, setting))
                if not runs[-1].failure and runs[-1].time > LONGEST_RUN:
                    break
    return runs


def tables(runs: Iterable[Run]) -> list[str]:
    """For each problem: times of all candidates at equal errors of strokes, and their best."""
    parts = []
    for problem in problems():
        own = [run for run in runs if run.problem == problem.name]
        if not own:
            continue
        rows = [
            table_row(problem, name, [run for run in own if run.engine == name])
            for name in dict.fromkeys(run.engine for run in own)
        ]
        head = ["engine", *(f"{error:.0e} m [ms]" for error in ERRORS), "times real time at 1e-06",
                "least error [m]", "of pressures then", "setting of that"]  # fmt: skip
        marks = ["---", *["---:"] * (len(head) - 1)]
        parts += [
            f"#### {problem.title[0].upper()}{problem.title[1:]}",
            f"{problem.duration:g} s. Source: {problem.data['source']}.",
            "\n".join(f"| {' | '.join(row)} |" for row in (head, marks, *rows)),
        ]
    return parts


def table_row(problem: DriveProblem, name: str, runs: Sequence[Run]) -> list[str]:
    """Times of a candidate at errors, and its best run."""
    reached = [run for run in runs if not run.failure]
    if not reached:
        return [name, *["-"] * (len(ERRORS) + 3), runs[-1].failure]
    times = [time_at_error(reached, error) for error in ERRORS]
    at_micrometre = time_at_error(reached, 1e-6)
    best = min(reached, key=lambda run: run.error)
    return [
        name,
        *("-" if spent is None else f"{1e3 * spent:.3g}" for spent in times),
        "-" if at_micrometre is None else f"{problem.duration / at_micrometre:.3g}",
        f"{best.error:.0e}",
        "-" if np.isnan(best.pressure_error) else f"{best.pressure_error:.0e}",
        best.setting,
    ]


def main() -> None:
    """Measure and print, or compute references."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer settings")
    parser.add_argument("--references", action="store_true", help="compute reference solutions")
    options = parser.parse_args()
    warnings.simplefilter("ignore", crane.CraneWarning)
    if not options.references:
        print("\n\n".join(tables(measure(options.quick))))
        return
    for problem in problems():
        difference = write_reference(problem)
        print(f"{problem.name}: two computations differ by {difference:.1e} m", flush=True)
        if difference > MAX_DIFFERENCE:
            raise SystemExit(f"error: {problem.name} has no reference, the two do not agree")


if __name__ == "__main__":
    main()
