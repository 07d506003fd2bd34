"""Numbers of a machine that are best for measures of it."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np
from scipy.optimize import minimize
from scipy.stats import qmc

from crane.common.errors import CraneError, CraneWarning, InputError, known
from crane.common.samples import Array, as_count, as_seed
from crane.common.shown import Brief
from crane.common.waiting import telling
from crane.formats import load
from crane.formats.loading import Variants
from crane.machine import Machine
from crane.ratings import Capacity, capacity
from crane.ratings.rules import Rule, rule_of
from crane.studies.computing import computed, described, processes_of
from crane.studies.design.dual import Dual
from crane.studies.design.expressions import Expression, requirement
from crane.studies.design.own import Measure, kept, own_measures
from crane.studies.design.quantities import Point, Terms, available, places_in, refuse_taken
from crane.studies.measures import stroke_measures, task_measures

_ACCURACY = 1e-10  # of a goal, as a share of its size
_ITERATIONS = 200
_SLACK = 1e-6  # of a requirement's size
_TRIES = 50  # draws of a start, until a machine can be made
_WALL = 1e3  # what a variant costs that cannot be made, in sizes of the goal


class Job(NamedTuple):
    """One search, wherever it is done.

    Attributes:
        machine: What `load` takes.
        changes: Of its numbers.
        lock: Joints that are held.
        names: Numbers that vary.
        low: (k,) their lower ends.
        high: (k,) their upper ends.
        goals: Expressions, the least of which is sought.
        requires: Expressions that must not be below 0.
        equal: Which of them have to be 0.
        frame: Of `Terms`.
        rule: Likewise.
        tasks: Likewise.
        own: Path of a user's own measures, or these.
        start: (k,) where to begin.
        weights: Of the goals, where there are several.
        ideal: Their least values, likewise.
        sizes: Their ranges, likewise.
    """

    machine: str
    changes: dict[str, float]
    lock: dict[str, float]
    names: tuple[str, ...]
    low: Array
    high: Array
    goals: tuple[str, ...]
    requires: tuple[str, ...]
    equal: tuple[bool, ...]
    frame: str | None
    rule: str | Rule
    tasks: tuple[str, ...]
    own: Any
    start: Array
    weights: Array | None = None
    ideal: Array | None = None
    sizes: Array | None = None


@dataclass(frozen=True, eq=False)
class Solution(Brief):
    """Where a search ended.

    Attributes:
        start: (k,) where it began.
        values: (k,) numbers.
        goals: (m,) values of the goals, as they were written.
        slacks: (r,) what is left of each requirement, of "A == B" -|A - B|; below 0 it fails.
        fits: Whether all requirements hold.
        says: How it ended.
    """

    start: Array
    values: Array
    goals: Array
    slacks: Array
    fits: bool
    says: str


@dataclass(frozen=True, eq=False, repr=False)
class Design(Brief):
    """The best numbers that were found.

    Attributes:
        machine: The machine before.
        names: Numbers that varied.
        low: (k,) their lower ends.
        high: (k,) their upper ends.
        goals: As they were written, "minimise ..." or "maximise ...".
        requires: Likewise.
        before: The machine's own numbers, as a solution.
        solutions: Of all starts, best first; of several goals those that no other one beats in
            all, by the first goal.
        terms: What measures were taken with.
    """

    machine: Machine
    names: tuple[str, ...]
    low: Array
    high: Array
    goals: tuple[str, ...]
    requires: tuple[str, ...]
    before: Solution
    solutions: tuple[Solution, ...]
    terms: Terms

    def _line(self) -> str:
        """What was varied for what, and the best of it."""
        best = self.solutions[0]
        values = ", ".join(f"{x:.6g}" for x in best.goals)
        return f"Design of {self.machine.name} for {'; '.join(self.goals)}: {values}"

    def changes(self, k: int = 0) -> dict[str, float]:
        """The numbers of a solution by name, as `crane.load` takes them."""
        values = self.solutions[k].values.tolist()
        return {**self.machine.changes, **dict(zip(self.names, values, strict=True))}

    def variant(self, k: int = 0) -> Machine:
        """The machine of a solution."""
        return Variants(self.machine).machine(self.changes(k))

    def charts(self, k: int = 0) -> tuple[Capacity, Capacity] | None:
        """Lifting capacity before and with a solution; None where no load is asked for."""
        if not any("load(" in text for text in (*self.goals, *self.requires)):
            return None
        before, after = (
            capacity(machine, self.terms.frame, rule=self.terms.rule)
            for machine in (self.machine, self.variant(k))
        )
        return before, after

    def to_markdown(self) -> str:
        """Numbers and goals before and after, starts or front, ends that were reached."""
        lines = [f"# Design of {self.machine.name}\n"]
        lines += [f"- {goal}" for goal in self.goals]
        lines += [f"- require {text}" for text in self.requires]
        best = self.solutions[0]
        lines += ["", "| | before | after |", "| --- | ---: | ---: |"]
        units = [f"`{name}`" for name in self.names]
        for title, one, two in (
            *zip(units, self.before.values, best.values, strict=True),
            *zip(self.goals, self.before.goals, best.goals, strict=True),
            *((f"left of {x}", one, two) for x, one, two in
              zip(self.requires, self.before.slacks, best.slacks, strict=True)),
        ):  # fmt: skip
            lines.append(f"| {title} | {one:.6g} | {two:.6g} |")
        at_end = [
            name
            for name, x, a, b in zip(self.names, best.values, self.low, self.high, strict=True)
            if min(x - a, b - x) < 1e-6 * (b - a)
        ]
        if at_end:
            lines.append(f"\nAt the end of their range: {', '.join(at_end)}.")
        many = "not beaten in all goals" if len(self.goals) > 1 else "by where they began"
        lines += ["", f"{len(self.solutions)} solutions, {many}:", ""]
        lines.append("| " + " | ".join([*self.goals, *units, "requirements", "ended"]) + " |")
        lines.append(
            "| " + " | ".join(["---:"] * (len(self.goals) + len(units)) + ["---"] * 2) + " |"
        )
        for x in self.solutions:
            cells = [f"{value:.6g}" for value in (*x.goals, *x.values)]
            lines.append("| " + " | ".join([*cells, "hold" if x.fits else "fail", x.says]) + " |")
        return "\n".join([*lines, ""])

    def to_csv(self, path: str | Path) -> None:
        """Write a row per solution: numbers, goals, requirements, whether they hold.

        Raises:
            OutputError: The file cannot be written.
        """
        from crane.recordings.timeseries import Table, write

        units = {name: "1" for name in self.names}
        units |= {f"goal_{i}": "1" for i in range(len(self.goals))}
        units |= {f"slack_{i}": "1" for i in range(len(self.requires))} | {"fits": "1"}
        rows = [[*x.values, *x.goals, *x.slacks, float(x.fits)] for x in self.solutions]
        notes = {"machine": self.machine.call}
        notes |= {f"goal_{i}": text for i, text in enumerate(self.goals)}
        notes |= {f"slack_{i}": text for i, text in enumerate(self.requires)}
        write(path, Table(units, np.array(rows), notes))


def design(
    machine: Machine | str | Path,
    vary: Mapping[str, tuple[float, float]],
    *,
    minimise: Sequence[str] = (),
    maximise: Sequence[str] = (),
    require: Sequence[str] = (),
    measures: str | Path | Mapping[str, Measure] | None = None,
    frame: str | None = None,
    rule: str | Rule = "none",
    tasks: Sequence[str] | None = None,
    starts: int = 10,
    points: int = 15,
    seed: int = 0,
    processes: int = 1,
    scheduler: str | None = None,
    progress: Any = None,
) -> Design:
    """Find the numbers of a machine that are best for measures of it.

    Goals are expressions of measures: load(RADIUS, HEIGHT[, SLEW in degrees]) [kg], reach,
    highest, lowest, nearest(X, Y, Z), mass, gross_torque, net_torque(RADIUS), slewing_torque,
    those of `study` (peak_JOINT, rms_JOINT, energy, work, lower_JOINT, upper_JOINT), numbers of
    the machine by name, and functions of your own. Sequential quadratic programming (SLSQP) from
    the machine's own numbers and from others drawn by a Latin hypercube. Slopes are exact where
    `Point` says so. Several goals f give a front of solutions, each of which has the least of the
    largest w_i (f_i - ideal_i) / size_i for weights w all over their simplex (Steuer and Choo, An
    interactive weighted Tchebycheff procedure, Mathematical Programming 26, 1983).

    Args:
        machine: What `crane.load` takes, or what it gave.
        vary: By name of a number its range.
        minimise: Goals whose least value is sought.
        maximise: Goals whose largest value is sought.
        require: "A >= B", "A <= B" or "A == B".
        measures: Functions of a machine by name, or a Python file that defines them.
        frame: Where loads hang; the tip if not given.
        rule: By which they are rated.
        tasks: For forces and energy; all if not given.
        starts: How many searches.
        points: Of the front, where there are several goals.
        seed: Of the starts.
        processes: To compute with.
        scheduler: Address of a Dask scheduler whose workers compute instead.
        progress: Called with the finished share, 0 to 1.

    Raises:
        InputError: Unknown names, no goal, ranges that are none, or no solution.
    """
    progress = telling(progress)
    base, name = described(machine)
    processes = processes_of(processes)
    starts = as_count(starts, "the number of starts", 1, 10_000)
    goals = [("minimise", x) for x in minimise] + [("maximise", x) for x in maximise]
    if not goals:
        raise InputError("nothing is sought, name what to minimise or to maximise")
    names, low, high = _ranges(base, vary)
    told = rule_of(rule)
    chosen = tuple(base.tasks if tasks is None else tasks)
    for task in chosen:
        if task not in base.tasks:
            raise InputError(f"task '{task}' is unknown, {known(base.tasks, task)}")
    parsed = [Expression(x) for _, x in goals]
    texts = tuple(x if way == "minimise" else f"-({x})" for way, x in goals)
    needs = [requirement(x) for x in require]
    terms = Terms(frame, told, chosen, own_measures(measures))
    known_measures = task_measures(base) | stroke_measures(base)
    refuse_taken(terms.own, known_measures)
    _check_names(base, [*parsed, *(x for x, _ in needs)], terms)
    blank = Job(
        name, dict(base.changes), dict(base.locks), names, low, high, texts,
        tuple(x.text for x, _ in needs), tuple(equal for _, equal in needs), frame, told, chosen,
        kept(measures), np.zeros(len(names)),
    )  # fmt: skip
    own = np.array([Variants(base).values[x] for x in names])
    before = _judged(Searched(blank), own, own, "as it is")
    random = qmc.LatinHypercube(len(names), rng=as_seed(seed)).random(starts)
    begun = [np.clip(own, low, high), *(low + random * (high - low))][:starts]
    singles = [blank._replace(start=start, goals=(text,)) for text in texts for start in begun]
    total = len(singles) + (points if len(texts) > 1 else 0)

    def told_of(done: int) -> None:
        if progress is not None:
            progress(done / total)

    found = _done(computed(searched, singles, processes, scheduler), told_of, 0)
    if len(texts) > 1:
        front = _front(blank, found, as_count(points, "the number of points", 2, 1000))
        more = _done(computed(searched, front, processes, scheduler), told_of, len(singles))
        problem = Searched(blank)
        found = [problem.whole(x) for x in (*found, *more)]
    fitting = [x for x in found if x.fits]
    if not fitting:
        first = found[0]
        worst = int(np.argmin(first.slacks)) if len(first.slacks) else 0
        says = first.says
        if len(first.slacks) and np.isfinite(first.slacks[worst]):
            says = f"'{require[worst]}' lacks {-first.slacks[worst]:.4g}"
        raise InputError(f"no start of {len(found)} leads to what is required, the first: {says}")
    if len(texts) > 1:
        ordered = _unbeaten(fitting)
    else:
        ordered = sorted(found, key=lambda x: (not x.fits, x.goals[0]))
    signs = np.array([1.0 if way == "minimise" else -1.0 for way, _ in goals])
    return Design(
        base, names, low, high, tuple(f"{way} {text}" for way, text in goals),
        tuple(x.strip() for x in require), _signed(before, signs),
        tuple(_signed(x, signs) for x in ordered), terms,
    )  # fmt: skip


class Searched:
    """A problem and the variants that were asked for."""

    def __init__(self, job: Job):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CraneWarning)
            machine = load(job.machine, job.changes, job.lock)
        self.job, self._variants = job, Variants(machine)
        self.goals = [Expression(text) for text in job.goals]
        self.requires = [Expression(text) for text in job.requires]
        self._terms = Terms(job.frame, job.rule, job.tasks, own_measures(job.own))
        self._places = places_in([*self.goals, *self.requires])
        self._kept: Point | None = None
        self._last: tuple[bytes, list[Dual] | CraneError] = b"", []

    def at(self, values: Array) -> list[Dual]:
        """Goals, then requirements.

        Raises:
            CraneError: No machine can be made with these numbers, or measured.
        """
        if self._last[0] != values.tobytes():
            job = self.job
            try:
                with warnings.catch_warnings(), np.errstate(all="ignore"):
                    warnings.simplefilter("ignore")  # own measures' among them
                    point = Point(
                        self._variants, job.names, values, job.high - job.low, self._terms,
                        self._places,
                    )  # fmt: skip
                    found = [point.dual(x) for x in (*self.goals, *self.requires)]
                for text, x in zip((*self.goals, *self.requires), found, strict=True):
                    if not (np.isfinite(x.value) and np.isfinite(x.slopes).all()):
                        raise InputError(f"'{text.text}' is no finite number there")
                self._kept = point  # and its machine code, for the next variant
                self._last = values.tobytes(), found
            except CraneError as error:
                self._last = values.tobytes(), error
        answer = self._last[1]
        if isinstance(answer, CraneError):
            raise answer
        return answer

    def whole(self, solution: Solution) -> Solution:
        """A solution with all goals."""
        return _judged(self, solution.start, solution.values, solution.says)


def searched(job: Job) -> Solution:
    """Do one search."""
    problem = Searched(job)
    span, random = job.high - job.low, np.random.default_rng(crc32(job.start.tobytes()))
    start = job.start
    for _ in range(_TRIES):
        try:
            first = problem.at(start)
            break
        except CraneError as error:
            failure = error
            start = random.uniform(job.low, job.high)
    else:
        nothing = np.full(len(job.requires), -np.inf)
        return Solution(job.start, job.start, np.full(len(job.goals), np.inf), nothing, False,
                        str(failure))  # fmt: skip
    count, many = len(job.goals), len(job.goals) > 1
    sizes = job.sizes if job.sizes is not None else np.array([max(abs(first[0].value), 1e-12)])
    ideal = job.ideal if job.ideal is not None else np.zeros(1)
    weights = job.weights if job.weights is not None else np.ones(1)
    needs = [max(abs(x.value), float(np.abs(x.slopes * span).max(initial=0.0)), 1e-12)
             for x in first[count:]]  # fmt: skip
    worst = 1.0 + abs(first[0].value) / sizes[0]

    best: list[tuple[tuple[float, float], Array]] = []  # the best of all that can be made

    def shares(x: Array) -> tuple[Array, Array] | None:
        """Goals, then requirements, each over its size, and their slopes by x."""
        values = np.clip(job.low + x[: len(span)] * span, job.low, job.high)
        try:
            found = problem.at(values)
        except CraneError:
            return None
        value = np.array([d.value for d in found])
        slopes = np.array([d.slopes * span for d in found]).reshape(len(found), len(span))
        value[:count] = weights * (value[:count] - ideal) / sizes
        slopes[:count] *= (weights / sizes)[:, None]
        value[count:] /= needs
        slopes[count:] /= np.array(needs).reshape(-1, 1)
        short = max(0.0, -_short(value[count:], job.equal))
        merit = short if short > _SLACK else 0.0, float(value[:count].max() if many else value[0])
        if not best or merit < best[0][0]:
            best[:] = [(merit, values)]
        return value, slopes

    def cost(x: Array) -> tuple[float, Array]:
        if many:  # the last variable bounds all goals
            return float(x[-1]), np.r_[np.zeros(len(span)), 1.0]
        found = shares(x)
        if found is None:
            return _WALL * worst, np.zeros(len(x))
        return float(found[0][0]), found[1][0]

    def left(x: Array) -> Array:
        """Goals below the last variable, where there are several, then requirements."""
        found = shares(x)
        if found is None:
            return np.full(len(needs) + (count if many else 0), -_WALL)
        value = found[0]
        return np.concatenate([x[-1] - value[:count], value[count:]]) if many else value[count:]

    def left_slopes(x: Array) -> Array:
        found = shares(x)
        rows = len(needs) + (count if many else 0)
        if found is None:
            return np.zeros((rows, len(x)))
        if not many:
            return found[1][count:]
        slopes = np.hstack([np.vstack([-found[1][:count], found[1][count:]]), np.zeros((rows, 1))])
        slopes[:count, -1] = 1.0
        return slopes

    x = (start - job.low) / span
    if many:
        value = np.array([d.value for d in first[:count]])
        x = np.r_[x, (weights * (value - ideal) / sizes).max()]
    equal = np.r_[np.zeros(count if many else 0, dtype=bool), np.array(job.equal, dtype=bool)]
    constraints: Any = [
        {"type": kind, "fun": lambda x, k=k: left(x)[k], "jac": lambda x, k=k: left_slopes(x)[k]}
        for kind, k in (("ineq", np.flatnonzero(~equal)), ("eq", np.flatnonzero(equal)))
        if len(k)
    ]
    bounds = [(0.0, 1.0)] * len(span) + ([(None, None)] if many else [])
    ended = minimize(
        cost, x, jac=True, bounds=bounds, constraints=constraints, method="SLSQP",
        options={"ftol": _ACCURACY, "maxiter": _ITERATIONS},
    )  # fmt: skip
    values = np.clip(job.low + ended.x[: len(span)] * span, job.low, job.high)
    says, found = str(ended.message).lower(), shares(ended.x)
    if best and (found is None or not np.array_equal(best[0][1], values)):
        short = max(0.0, -_short(found[0][count:], job.equal)) if found is not None else np.inf
        if short > _SLACK and best[0][0][0] < short:
            values = best[0][1]
    return _judged(problem, start, values, says)


def _short(left: Array, equal: Sequence[bool]) -> float:
    """The least of what is left of requirements, over their sizes; 0 where there are none."""
    if not len(left):
        return 0.0
    return float(np.where(np.array(equal, dtype=bool), -np.abs(left), left).min())


def _judged(problem: Searched, start: Array, values: Array, says: str) -> Solution:
    """Goals and requirements at some numbers."""
    count = len(problem.goals)
    try:
        found = problem.at(values)
    except CraneError as error:
        nothing = np.full(len(problem.requires), -np.inf)
        return Solution(start, values, np.full(count, np.nan), nothing, False, str(error))
    span = problem.job.high - problem.job.low
    sizes = [
        max(abs(x.value), float(np.abs(x.slopes * span).max(initial=0.0))) for x in found[count:]
    ]
    equal = np.array(problem.job.equal, dtype=bool)
    slacks = np.array([x.value for x in found[count:]])
    slacks = np.where(equal, -np.abs(slacks), slacks)
    fits = bool((slacks >= -_SLACK * np.array(sizes)).all())
    return Solution(start, values, np.array([x.value for x in found[:count]]), slacks, fits, says)


def _check_names(machine: Machine, expressions: Sequence[Expression], terms: Terms) -> None:
    """Refuse what is no measure, before anything is searched."""
    every = available(machine, terms.own)
    values = Variants(machine).values

    def named(name: str) -> float:
        if name not in every and name not in values:
            raise InputError(f"measure '{name}' is unknown, {known(every, name)}")
        return 1.0

    places_in(expressions)
    for expression in expressions:
        expression(named, lambda name, arguments: 1.0)


def _ranges(
    machine: Machine, vary: Mapping[str, tuple[float, float]]
) -> tuple[tuple[str, ...], Array, Array]:
    """Names, lower and upper ends."""
    if not vary:
        raise InputError("nothing varies, name numbers and their ranges")
    values = Variants(machine).values
    for name, ends in vary.items():
        if name not in values:
            raise InputError(f"number '{name}' is unknown, {known(values, name)}")
        try:
            both = np.array(ends, dtype=float).ravel()
        except (TypeError, ValueError):
            both = np.zeros(0)
        if len(both) != 2 or not np.isfinite(both).all() or not both[0] < both[1]:
            raise InputError(f"'{name}' has no range, give its lower and upper end")
    low, high = np.array([np.ravel(ends) for ends in vary.values()], dtype=float).T
    return tuple(vary), low, high


def _done(results: Any, progress: Any, before: int) -> list[Solution]:
    """Results in the order of their jobs."""
    found: dict[int, Solution] = {}
    for index, solution in results:
        found[index] = solution
        progress(before + len(found))
    return [found[i] for i in sorted(found)]


def _front(blank: Job, singles: Sequence[Solution], points: int) -> list[Job]:
    """Searches for points of the front, each from the nearest of the goals' own optima."""
    problem, per = Searched(blank), len(singles) // len(blank.goals)
    best = []
    for i in range(len(blank.goals)):
        every = [x for x in singles[i * per : (i + 1) * per] if x.fits]
        if not every:
            raise InputError(f"goal {i + 1} alone leads to nothing that fits what is required")
        best.append(problem.whole(min(every, key=lambda x: x.goals[0])))
    ends = np.array([x.goals for x in best])
    ideal = ends.min(axis=0)
    sizes = np.maximum(ends.max(axis=0) - ideal, 1e-9 * np.maximum(np.abs(ideal), 1e-12))
    weights = _simplex(len(best), points)
    starts = np.array([x.values for x in best])
    jobs = []
    for row in weights:
        start = (row / row.sum()) @ starts
        jobs.append(
            blank._replace(start=start, weights=np.maximum(row, 1e-6), ideal=ideal, sizes=sizes)
        )
    return jobs


def _simplex(goals: int, points: int) -> Array:
    """Weights (points, goals) all over their simplex, inverse to where they put the solution."""
    if goals == 2:
        share = np.linspace(0.0, 1.0, points + 2)[1:-1]
        return np.column_stack([share, 1.0 - share])
    drawn = qmc.Sobol(goals, rng=0).random(1 << (points - 1).bit_length())[:points]
    drawn = -np.log(np.clip(drawn, 1e-9, 1.0))
    return np.asarray(drawn / drawn.sum(axis=1, keepdims=True))


def _unbeaten(solutions: Sequence[Solution]) -> list[Solution]:
    """Those that no other one beats in all goals, by the first goal."""
    goals = np.array([x.goals for x in solutions])
    size = np.maximum(np.ptp(goals, axis=0), 1e-300)
    kept: list[int] = []
    for i in np.lexsort(goals.T[::-1]).tolist():
        beaten = any((goals[k] <= goals[i] + 1e-7 * size).all() for k in kept)
        if not beaten:
            kept.append(i)
    return [solutions[i] for i in kept]


def _signed(x: Solution, signs: Array) -> Solution:
    """Goals as they were written."""
    return Solution(x.start, x.values, signs * x.goals, x.slacks, x.fits, x.says)
