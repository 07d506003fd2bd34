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

from crane.common.errors import CraneError, CraneWarning, InputError, suggest_names
from crane.common.one_line_repr import OneLineRepr
from crane.common.progress import progress_reporter
from crane.common.result import Result
from crane.common.samples import Array, as_count, as_seed
from crane.formats import load
from crane.formats.machine_loading import MachineVariants
from crane.machine import Machine
from crane.ratings import Capacity, capacity
from crane.ratings.rating_rules import Rule, find_rule
from crane.studies.design.dual_numbers import DualNumber
from crane.studies.design.measure_expressions import MeasureExpression, parse_requirement
from crane.studies.design.user_measures import (
    MeasureFunction,
    load_user_measures,
    transferable_measures,
)
from crane.studies.design.variant_measures import (
    MeasureOptions,
    VariantEvaluation,
    available_measures,
    check_unique_names,
    load_positions,
)
from crane.studies.measures import stroke_measures, task_measures
from crane.studies.parallel_jobs import check_process_count, compute_jobs, machine_from_files

_OBJECTIVE_TOLERANCE = 1e-10  # of a goal, as a share of its size
_MAX_ITERATIONS = 200
_REQUIREMENT_TOLERANCE = 1e-6  # of a requirement's size
_MAX_START_DRAWS = 50  # draws of a start, until a machine can be made
_INFEASIBLE_COST = 1e3  # what a variant costs that cannot be made, in sizes of the goal


class DesignJob(NamedTuple):
    """One search, wherever it is done.

    Attributes:
        machine: What `load` takes.
        changes: Of its numbers.
        locked_joints: Joints that are held.
        parameter_names: Numbers that vary.
        lower: (k,) their lower ends.
        upper: (k,) their upper ends.
        objectives: Expressions, the least of which is sought.
        requirements: Expressions that must not be below 0.
        is_equality: Which of them have to be 0.
        frame: Of `MeasureOptions`.
        rule: Likewise.
        tasks: Likewise.
        user_measures: Path of a user's own measures, or these.
        initial_values: (k,) where to begin.
        weights: Of the goals, where there are several.
        ideal_objectives: Their least values, likewise.
        objective_ranges: Their ranges, likewise.
    """

    machine: str
    changes: dict[str, float]
    locked_joints: dict[str, float]
    parameter_names: tuple[str, ...]
    lower: Array
    upper: Array
    objectives: tuple[str, ...]
    requirements: tuple[str, ...]
    is_equality: tuple[bool, ...]
    frame: str | None
    rule: str | Rule
    tasks: tuple[str, ...]
    user_measures: Any
    initial_values: Array
    weights: Array | None = None
    ideal_objectives: Array | None = None
    objective_ranges: Array | None = None


@dataclass(frozen=True, eq=False)
class DesignSolution(OneLineRepr):
    """Where a search ended.

    Attributes:
        initial_values: (k,) where it began.
        values: (k,) numbers.
        objectives: (m,) values of the goals, as they were written.
        slacks: (r,) what is left of each requirement, of "A == B" -|A - B|; below 0 it fails.
        is_feasible: Whether all requirements hold.
        message: How it ended.
    """

    initial_values: Array
    values: Array
    objectives: Array
    slacks: Array
    is_feasible: bool
    message: str


@dataclass(frozen=True, eq=False, repr=False)
class Design(Result):
    """The best numbers that were found.

    Attributes:
        machine: The machine before.
        parameter_names: Numbers that varied.
        lower: (k,) their lower ends.
        upper: (k,) their upper ends.
        objectives: As they were written, "minimise ..." or "maximise ...".
        requirements: Likewise.
        initial: The machine's own numbers, as a solution.
        solutions: Of all starts, best first; of several goals those that no other one beats in
            all, by the first goal.
        options: What measures were taken with.
    """

    machine: Machine
    parameter_names: tuple[str, ...]
    lower: Array
    upper: Array
    objectives: tuple[str, ...]
    requirements: tuple[str, ...]
    initial: DesignSolution
    solutions: tuple[DesignSolution, ...]
    options: MeasureOptions

    def _one_line(self) -> str:
        """What was varied for what, and the best of it."""
        best_solution = self.solutions[0]
        values = ", ".join(f"{x:.6g}" for x in best_solution.objectives)
        return f"Design of {self.machine.name} for {'; '.join(self.objectives)}: {values}"

    def parameter_changes(self, k: int = 0) -> dict[str, float]:
        """The numbers of a solution by name, as `crane.load` takes them."""
        values = self.solutions[k].values.tolist()
        return {
            **self.machine.parameter_changes,
            **dict(zip(self.parameter_names, values, strict=True)),
        }

    def variant(self, k: int = 0) -> Machine:
        """The machine of a solution."""
        return MachineVariants(self.machine).machine(self.parameter_changes(k))

    def capacity_charts(self, k: int = 0) -> tuple[Capacity, Capacity] | None:
        """Lifting capacity before and with a solution; None where no load is asked for."""
        if not any("load(" in text for text in (*self.objectives, *self.requirements)):
            return None
        initial_chart, optimized_chart = (
            capacity(machine, self.options.frame, rule=self.options.rule)
            for machine in (self.machine, self.variant(k))
        )
        return initial_chart, optimized_chart

    def to_markdown(self) -> str:
        """Numbers and goals before and after, starts or front, ends that were reached."""
        lines = [f"# Design of {self.machine.name}\n"]
        lines += [f"- {goal}" for goal in self.objectives]
        lines += [f"- require {text}" for text in self.requirements]
        best_solution = self.solutions[0]
        lines += ["", "| | before | after |", "| --- | ---: | ---: |"]
        parameter_labels = [f"`{name}`" for name in self.parameter_names]
        for title, initial_value, optimized_value in (
            *zip(parameter_labels, self.initial.values, best_solution.values, strict=True),
            *zip(self.objectives, self.initial.objectives, best_solution.objectives, strict=True),
            *((f"left of {x}", one, two) for x, one, two in
              zip(self.requirements, self.initial.slacks, best_solution.slacks, strict=True)),
        ):  # fmt: skip
            lines.append(f"| {title} | {initial_value:.6g} | {optimized_value:.6g} |")
        at_bounds = [
            name
            for name, x, a, b in zip(
                self.parameter_names, best_solution.values, self.lower, self.upper, strict=True
            )
            if min(x - a, b - x) < 1e-6 * (b - a)
        ]
        if at_bounds:
            lines.append(f"\nAt the end of their range: {', '.join(at_bounds)}.")
        order_text = (
            "not beaten in all goals" if len(self.objectives) > 1 else "by where they began"
        )
        lines += ["", f"{len(self.solutions)} solutions, {order_text}:", ""]
        lines.append(
            "| "
            + " | ".join([*self.objectives, *parameter_labels, "requirements", "ended"])
            + " |"
        )
        lines.append(
            "| "
            + " | ".join(["---:"] * (len(self.objectives) + len(parameter_labels)) + ["---"] * 2)
            + " |"
        )
        for x in self.solutions:
            cells = [f"{value:.6g}" for value in (*x.objectives, *x.values)]
            lines.append(
                "| " + " | ".join([*cells, "hold" if x.is_feasible else "fail", x.message]) + " |"
            )
        return "\n".join([*lines, ""])

    def to_csv(self, path: str | Path) -> None:
        """Write a row per solution: numbers, goals, requirements, whether they hold.

        Raises:
            OutputError: The file cannot be written.
        """
        from crane.recordings.timeseries import Table, write_table

        units = {name: "1" for name in self.parameter_names}
        units |= {f"goal_{i}": "1" for i in range(len(self.objectives))}
        units |= {f"slack_{i}": "1" for i in range(len(self.requirements))} | {"fits": "1"}
        rows = [
            [*x.values, *x.objectives, *x.slacks, float(x.is_feasible)] for x in self.solutions
        ]
        notes = {"machine": self.machine.load_expression}
        notes |= {f"goal_{i}": text for i, text in enumerate(self.objectives)}
        notes |= {f"slack_{i}": text for i, text in enumerate(self.requirements)}
        write_table(path, Table(units, np.array(rows), notes))


def design(
    machine: Machine | str | Path,
    vary: Mapping[str, tuple[float, float]],
    *,
    minimise: Sequence[str] = (),
    maximise: Sequence[str] = (),
    require: Sequence[str] = (),
    measures: str | Path | Mapping[str, MeasureFunction] | None = None,
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
    progress = progress_reporter(progress)
    base_machine, name = machine_from_files(machine)
    processes = check_process_count(processes)
    starts = as_count(starts, "the number of starts", 1, 10_000)
    objectives = [("minimise", x) for x in minimise] + [("maximise", x) for x in maximise]
    if not objectives:
        raise InputError("nothing is sought, name what to minimise or to maximise")
    names, lower, upper = _parameter_ranges(base_machine, vary)
    rating_rule = find_rule(rule)
    chosen_tasks = tuple(base_machine.tasks if tasks is None else tasks)
    for task in chosen_tasks:
        if task not in base_machine.tasks:
            raise InputError(
                f"task '{task}' is unknown, {suggest_names(base_machine.tasks, task)}"
            )
    expressions = [MeasureExpression(x) for _, x in objectives]
    objective_texts = tuple(x if sense == "minimise" else f"-({x})" for sense, x in objectives)
    requirements = [parse_requirement(x) for x in require]
    options = MeasureOptions(frame, rating_rule, chosen_tasks, load_user_measures(measures))
    known_measures = task_measures(base_machine) | stroke_measures(base_machine)
    check_unique_names(options.user_measures, known_measures)
    _check_names(base_machine, [*expressions, *(x for x, _ in requirements)], options)
    base_job = DesignJob(
        name,
        dict(base_machine.parameter_changes),
        dict(base_machine.locked_joints),
        names,
        lower,
        upper,
        objective_texts,
        tuple(x.text for x, _ in requirements),
        tuple(equal for _, equal in requirements),
        frame,
        rating_rule,
        chosen_tasks,
        transferable_measures(measures),
        np.zeros(len(names)),
    )
    initial_values = np.array([MachineVariants(base_machine).values[x] for x in names])
    initial_solution = _evaluate_solution(
        DesignProblem(base_job), initial_values, initial_values, "as it is"
    )
    random = qmc.LatinHypercube(len(names), rng=as_seed(seed)).random(starts)
    initial_points = [np.clip(initial_values, lower, upper), *(lower + random * (upper - lower))][
        :starts
    ]
    single_objective_jobs = [
        base_job._replace(initial_values=start, objectives=(text,))
        for text in objective_texts
        for start in initial_points
    ]
    total = len(single_objective_jobs) + (points if len(objective_texts) > 1 else 0)

    def report_progress(done: int) -> None:
        if progress is not None:
            progress(done / total)

    solutions = _collect_results(
        compute_jobs(solve_design_job, single_objective_jobs, processes, scheduler),
        report_progress,
        0,
    )
    if len(objective_texts) > 1:
        front_jobs = _pareto_front_jobs(
            base_job, solutions, as_count(points, "the number of points", 2, 1000)
        )
        front_solutions = _collect_results(
            compute_jobs(solve_design_job, front_jobs, processes, scheduler),
            report_progress,
            len(single_objective_jobs),
        )
        problem = DesignProblem(base_job)
        solutions = [problem.with_all_objectives(x) for x in (*solutions, *front_solutions)]
    feasible = [x for x in solutions if x.is_feasible]
    if not feasible:
        first_solution = solutions[0]
        worst_requirement = (
            int(np.argmin(first_solution.slacks)) if len(first_solution.slacks) else 0
        )
        message = first_solution.message
        if len(first_solution.slacks) and np.isfinite(first_solution.slacks[worst_requirement]):
            message = (
                f"'{require[worst_requirement]}' lacks "
                f"{-first_solution.slacks[worst_requirement]:.4g}"
            )
        raise InputError(
            f"no start of {len(solutions)} leads to what is required, the first: {message}"
        )
    if len(objective_texts) > 1:
        ordered_solutions = _nondominated(feasible)
    else:
        ordered_solutions = sorted(solutions, key=lambda x: (not x.is_feasible, x.objectives[0]))
    signs = np.array([1.0 if way == "minimise" else -1.0 for way, _ in objectives])
    return Design(
        base_machine,
        names,
        lower,
        upper,
        tuple(f"{way} {text}" for way, text in objectives),
        tuple(x.strip() for x in require),
        _restore_signs(initial_solution, signs),
        tuple(_restore_signs(x, signs) for x in ordered_solutions),
        options,
    )


class DesignProblem:
    """A problem and the variants that were asked for."""

    def __init__(self, job: DesignJob):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CraneWarning)
            machine = load(job.machine, job.changes, job.locked_joints)
        self.job, self._variants = job, MachineVariants(machine)
        self.objectives = [MeasureExpression(text) for text in job.objectives]
        self.requirements = [MeasureExpression(text) for text in job.requirements]
        self._options = MeasureOptions(
            job.frame, job.rule, job.tasks, load_user_measures(job.user_measures)
        )
        self._load_positions = load_positions([*self.objectives, *self.requirements])
        self._last_evaluation: VariantEvaluation | None = None
        self._last_outcome: tuple[bytes, list[DualNumber] | CraneError] = b"", []

    def evaluate(self, values: Array) -> list[DualNumber]:
        """Goals, then requirements.

        Raises:
            CraneError: No machine can be made with these numbers, or measured.
        """
        if self._last_outcome[0] != values.tobytes():
            job = self.job
            try:
                with warnings.catch_warnings(), np.errstate(all="ignore"):
                    warnings.simplefilter("ignore")  # own measures' among them
                    evaluation = VariantEvaluation(
                        self._variants,
                        job.parameter_names,
                        values,
                        job.upper - job.lower,
                        self._options,
                        self._load_positions,
                    )
                    duals = [
                        evaluation.evaluate_dual(x) for x in (*self.objectives, *self.requirements)
                    ]
                for text, x in zip((*self.objectives, *self.requirements), duals, strict=True):
                    if not (np.isfinite(x.value) and np.isfinite(x.derivatives).all()):
                        raise InputError(f"'{text.text}' is no finite number there")
                self._last_evaluation = evaluation  # and its machine code, for the next variant
                self._last_outcome = values.tobytes(), duals
            except CraneError as error:
                self._last_outcome = values.tobytes(), error
        outcome = self._last_outcome[1]
        if isinstance(outcome, CraneError):
            raise outcome
        return outcome

    def with_all_objectives(self, solution: DesignSolution) -> DesignSolution:
        """A solution with all goals."""
        return _evaluate_solution(self, solution.initial_values, solution.values, solution.message)


def solve_design_job(job: DesignJob) -> DesignSolution:
    """Do one search."""
    problem = DesignProblem(job)
    ranges, random = (
        job.upper - job.lower,
        np.random.default_rng(crc32(job.initial_values.tobytes())),
    )
    start = job.initial_values
    for _ in range(_MAX_START_DRAWS):
        try:
            initial_duals = problem.evaluate(start)
            break
        except CraneError as error:
            last_error = error
            start = random.uniform(job.lower, job.upper)
    else:
        infinite_shortfalls = np.full(len(job.requirements), -np.inf)
        return DesignSolution(
            job.initial_values,
            job.initial_values,
            np.full(len(job.objectives), np.inf),
            infinite_shortfalls,
            False,
            str(last_error),
        )
    count, is_multi_objective = len(job.objectives), len(job.objectives) > 1
    objective_scales = (
        job.objective_ranges
        if job.objective_ranges is not None
        else np.array([max(abs(initial_duals[0].value), 1e-12)])
    )
    ideal = job.ideal_objectives if job.ideal_objectives is not None else np.zeros(1)
    weights = job.weights if job.weights is not None else np.ones(1)
    requirement_scales = [
        max(abs(x.value), float(np.abs(x.derivatives * ranges).max(initial=0.0)), 1e-12)
        for x in initial_duals[count:]
    ]
    worst_objective = 1.0 + abs(initial_duals[0].value) / objective_scales[0]

    best_point: list[tuple[tuple[float, float], Array]] = []  # the best of all that can be made

    def scaled_values(x: Array) -> tuple[Array, Array] | None:
        """Goals, then requirements, each over its size, and their slopes by x."""
        values = np.clip(job.lower + x[: len(ranges)] * ranges, job.lower, job.upper)
        try:
            found = problem.evaluate(values)
        except CraneError:
            return None
        value = np.array([d.value for d in found])
        derivatives = np.array([d.derivatives * ranges for d in found]).reshape(
            len(found), len(ranges)
        )
        value[:count] = weights * (value[:count] - ideal) / objective_scales
        derivatives[:count] *= (weights / objective_scales)[:, None]
        value[count:] /= requirement_scales
        derivatives[count:] /= np.array(requirement_scales).reshape(-1, 1)
        shortfall = max(0.0, -_smallest_slack(value[count:], job.is_equality))
        merit = (
            shortfall if shortfall > _REQUIREMENT_TOLERANCE else 0.0,
            float(value[:count].max() if is_multi_objective else value[0]),
        )
        if not best_point or merit < best_point[0][0]:
            best_point[:] = [(merit, values)]
        return value, derivatives

    def cost(x: Array) -> tuple[float, Array]:
        if is_multi_objective:  # the last variable bounds all goals
            return float(x[-1]), np.r_[np.zeros(len(ranges)), 1.0]
        scaled = scaled_values(x)
        if scaled is None:
            return _INFEASIBLE_COST * worst_objective, np.zeros(len(x))
        return float(scaled[0][0]), scaled[1][0]

    def constraint_values(x: Array) -> Array:
        """Goals below the last variable, where there are several, then requirements."""
        found = scaled_values(x)
        if found is None:
            return np.full(
                len(requirement_scales) + (count if is_multi_objective else 0), -_INFEASIBLE_COST
            )
        value = found[0]
        return (
            np.concatenate([x[-1] - value[:count], value[count:]])
            if is_multi_objective
            else value[count:]
        )

    def constraint_jacobian(x: Array) -> Array:
        found = scaled_values(x)
        row_count = len(requirement_scales) + (count if is_multi_objective else 0)
        if found is None:
            return np.zeros((row_count, len(x)))
        if not is_multi_objective:
            return found[1][count:]
        slopes = np.hstack(
            [np.vstack([-found[1][:count], found[1][count:]]), np.zeros((row_count, 1))]
        )
        slopes[:count, -1] = 1.0
        return slopes

    x = (start - job.lower) / ranges
    if is_multi_objective:
        value = np.array([d.value for d in initial_duals[:count]])
        x = np.r_[x, (weights * (value - ideal) / objective_scales).max()]
    is_equality = np.r_[
        np.zeros(count if is_multi_objective else 0, dtype=bool),
        np.array(job.is_equality, dtype=bool),
    ]
    constraints: Any = [
        {
            "type": kind,
            "fun": lambda x, k=k: constraint_values(x)[k],
            "jac": lambda x, k=k: constraint_jacobian(x)[k],
        }
        for kind, k in (
            ("ineq", np.flatnonzero(~is_equality)),
            ("eq", np.flatnonzero(is_equality)),
        )
        if len(k)
    ]
    bounds = [(0.0, 1.0)] * len(ranges) + ([(None, None)] if is_multi_objective else [])
    result = minimize(
        cost, x, jac=True, bounds=bounds, constraints=constraints, method="SLSQP",
        options={"ftol": _OBJECTIVE_TOLERANCE, "maxiter": _MAX_ITERATIONS},
    )  # fmt: skip
    values = np.clip(job.lower + result.x[: len(ranges)] * ranges, job.lower, job.upper)
    message, found = str(result.message).lower(), scaled_values(result.x)
    if best_point and (found is None or not np.array_equal(best_point[0][1], values)):
        short = (
            max(0.0, -_smallest_slack(found[0][count:], job.is_equality))
            if found is not None
            else np.inf
        )
        if short > _REQUIREMENT_TOLERANCE and best_point[0][0][0] < short:
            values = best_point[0][1]
    return _evaluate_solution(problem, start, values, message)


def _smallest_slack(slacks: Array, is_equality: Sequence[bool]) -> float:
    """The least of what is left of requirements, over their sizes; 0 where there are none."""
    if not len(slacks):
        return 0.0
    return float(np.where(np.array(is_equality, dtype=bool), -np.abs(slacks), slacks).min())


def _evaluate_solution(
    problem: DesignProblem, initial_values: Array, values: Array, message: str
) -> DesignSolution:
    """Goals and requirements at some numbers."""
    count = len(problem.objectives)
    try:
        duals = problem.evaluate(values)
    except CraneError as error:
        infinite_shortfalls = np.full(len(problem.requirements), -np.inf)
        return DesignSolution(
            initial_values, values, np.full(count, np.nan), infinite_shortfalls, False, str(error)
        )
    ranges = problem.job.upper - problem.job.lower
    requirement_scales = [
        max(abs(x.value), float(np.abs(x.derivatives * ranges).max(initial=0.0)))
        for x in duals[count:]
    ]
    is_equality = np.array(problem.job.is_equality, dtype=bool)
    slacks = np.array([x.value for x in duals[count:]])
    slacks = np.where(is_equality, -np.abs(slacks), slacks)
    is_feasible = bool((slacks >= -_REQUIREMENT_TOLERANCE * np.array(requirement_scales)).all())
    return DesignSolution(
        initial_values,
        values,
        np.array([x.value for x in duals[:count]]),
        slacks,
        is_feasible,
        message,
    )


def _check_names(
    machine: Machine, expressions: Sequence[MeasureExpression], options: MeasureOptions
) -> None:
    """Refuse what is no measure, before anything is searched."""
    known_measures = available_measures(machine, options.user_measures)
    values = MachineVariants(machine).values

    def check_name(name: str) -> float:
        if name not in known_measures and name not in values:
            raise InputError(f"measure '{name}' is unknown, {suggest_names(known_measures, name)}")
        return 1.0

    load_positions(expressions)
    for expression in expressions:
        expression(check_name, lambda name, arguments: 1.0)


def _parameter_ranges(
    machine: Machine, vary: Mapping[str, tuple[float, float]]
) -> tuple[tuple[str, ...], Array, Array]:
    """Names, lower and upper ends."""
    if not vary:
        raise InputError("nothing varies, name numbers and their ranges")
    values = MachineVariants(machine).values
    for name, interval in vary.items():
        if name not in values:
            raise InputError(f"number '{name}' is unknown, {suggest_names(values, name)}")
        try:
            bounds = np.array(interval, dtype=float).ravel()
        except (TypeError, ValueError):
            bounds = np.zeros(0)
        if len(bounds) != 2 or not np.isfinite(bounds).all() or not bounds[0] < bounds[1]:
            raise InputError(f"'{name}' has no range, give its lower and upper end")
    lower, upper = np.array([np.ravel(ends) for ends in vary.values()], dtype=float).T
    return tuple(vary), lower, upper


def _collect_results(results: Any, progress: Any, finished_count: int) -> list[DesignSolution]:
    """Results in the order of their jobs."""
    solutions: dict[int, DesignSolution] = {}
    for index, solution in results:
        solutions[index] = solution
        progress(finished_count + len(solutions))
    return [solutions[i] for i in sorted(solutions)]


def _pareto_front_jobs(
    base_job: DesignJob, single_objective_solutions: Sequence[DesignSolution], points: int
) -> list[DesignJob]:
    """Searches for points of the front, each from the nearest of the goals' own optima."""
    problem, solutions_per_objective = (
        DesignProblem(base_job),
        len(single_objective_solutions) // len(base_job.objectives),
    )
    single_optima = []
    for i in range(len(base_job.objectives)):
        feasible = [
            x
            for x in single_objective_solutions[
                i * solutions_per_objective : (i + 1) * solutions_per_objective
            ]
            if x.is_feasible
        ]
        if not feasible:
            raise InputError(f"goal {i + 1} alone leads to nothing that fits what is required")
        single_optima.append(
            problem.with_all_objectives(min(feasible, key=lambda x: x.objectives[0]))
        )
    optimum_objectives = np.array([x.objectives for x in single_optima])
    ideal = optimum_objectives.min(axis=0)
    objective_ranges = np.maximum(
        optimum_objectives.max(axis=0) - ideal, 1e-9 * np.maximum(np.abs(ideal), 1e-12)
    )
    weights = _simplex_weights(len(single_optima), points)
    optimum_values = np.array([x.values for x in single_optima])
    jobs = []
    for row in weights:
        start = (row / row.sum()) @ optimum_values
        jobs.append(
            base_job._replace(
                initial_values=start,
                weights=np.maximum(row, 1e-6),
                ideal_objectives=ideal,
                objective_ranges=objective_ranges,
            )
        )
    return jobs


def _simplex_weights(objective_count: int, point_count: int) -> Array:
    """Weights (points, goals) all over their simplex, inverse to where they put the solution."""
    if objective_count == 2:
        first_weights = np.linspace(0.0, 1.0, point_count + 2)[1:-1]
        return np.column_stack([first_weights, 1.0 - first_weights])
    samples = qmc.Sobol(objective_count, rng=0).random(1 << (point_count - 1).bit_length())[
        :point_count
    ]
    samples = -np.log(np.clip(samples, 1e-9, 1.0))
    return np.asarray(samples / samples.sum(axis=1, keepdims=True))


def _nondominated(solutions: Sequence[DesignSolution]) -> list[DesignSolution]:
    """Those that no other one beats in all goals, by the first goal."""
    objectives = np.array([x.objectives for x in solutions])
    objective_ranges = np.maximum(np.ptp(objectives, axis=0), 1e-300)
    kept_indices: list[int] = []
    for i in np.lexsort(objectives.T[::-1]).tolist():
        is_dominated = any(
            (objectives[k] <= objectives[i] + 1e-7 * objective_ranges).all() for k in kept_indices
        )
        if not is_dominated:
            kept_indices.append(i)
    return [solutions[i] for i in kept_indices]


def _restore_signs(x: DesignSolution, signs: Array) -> DesignSolution:
    """Goals as they were written."""
    return DesignSolution(
        x.initial_values, x.values, signs * x.objectives, x.slacks, x.is_feasible, x.message
    )
