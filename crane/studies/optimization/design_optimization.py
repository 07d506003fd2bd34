"""Design optimization: parameters of a machine that are best for measures of it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.stats import qmc

from crane.common.errors import InputError, check_name
from crane.common.progress import Progress, progress_reporter
from crane.common.result import Result
from crane.common.samples import Array, as_count, as_seed
from crane.formats.machine_loading import MachineVariants
from crane.machine.machine import Machine
from crane.ratings.lifting_capacity import Capacity, capacity
from crane.ratings.rating_rules import Rule, find_rule
from crane.recordings.timeseries import Table, write_table
from crane.studies.measures import stroke_measures, task_measures
from crane.studies.optimization.design_problem import (
    DesignJob,
    DesignProblem,
    DesignSolution,
    kept_solutions,
    solution_columns,
    solve_design_job,
)
from crane.studies.optimization.measure_expressions import (
    MeasureExpression,
    MeasureFunction,
    load_user_measures,
    measure_source,
    parse_requirement,
    transferable_measures,
)
from crane.studies.optimization.variant_measures import (
    MeasureOptions,
    available_measures,
    check_unique_names,
    load_positions,
    unique_names,
)
from crane.studies.parallel_jobs import (
    StoredResults,
    check_process_count,
    compute_jobs,
    machine_from_files,
)


@dataclass(frozen=True, eq=False, repr=False)
class Design(Result):
    """Result of a design optimization.

    Attributes:
        machine: The machine before the optimization.
        parameter_names: Parameters that vary.
        lower: (k,) lower bounds.
        upper: (k,) upper bounds.
        objectives: Objectives, "minimise ..." or "maximise ...".
        requirements: Requirements as given.
        initial: The machine's own parameters, as a solution.
        solutions: Solutions of all starts, best first; with several objectives those of the
            Pareto front, by the first objective.
        options: Options of the measures.
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
        values = ", ".join(f"{x:.6g}" for x in self.solutions[0].objectives)
        return f"Design of {self.machine.name} for {'; '.join(self.objectives)}: {values}"

    def parameter_changes(self, k: int = 0) -> dict[str, float]:
        """Return the parameters of a solution by name, as `crane.load` takes them."""
        return {
            **self.machine.parameter_changes,
            **dict(zip(self.parameter_names, self.solutions[k].values.tolist(), strict=True)),
        }

    def variant(self, k: int = 0) -> Machine:
        """Return the machine of a solution."""
        return MachineVariants(self.machine).machine(self.parameter_changes(k))

    def capacity_charts(self, k: int = 0) -> tuple[Capacity, Capacity] | None:
        """Return load charts before and with a solution; None if no objective is a load."""
        if not any("load(" in text for text in (*self.objectives, *self.requirements)):
            return None
        initial_chart, optimized_chart = (
            capacity(machine, self.options.frame, rule=self.options.rule)
            for machine in (self.machine, self.variant(k))
        )
        return initial_chart, optimized_chart

    def to_markdown(self) -> str:
        """Return parameters and objectives before and after, and a table of all solutions."""
        best = self.solutions[0]
        labels = [f"`{name}`" for name in self.parameter_names]
        slack_labels = [f"slack of {x}" for x in self.requirements]
        compared = (
            *zip(labels, self.initial.values, best.values, strict=True),
            *zip(self.objectives, self.initial.objectives, best.objectives, strict=True),
            *zip(slack_labels, self.initial.slacks, best.slacks, strict=True),
        )
        lines = [
            f"# Design of {self.machine.name}\n",
            *(f"- {objective}" for objective in self.objectives),
            *(f"- require {text}" for text in self.requirements),
            "",
            "| | before | after |",
            "| --- | ---: | ---: |",
            *(f"| {title} | {before:.6g} | {after:.6g} |" for title, before, after in compared),
        ]
        ends = zip(self.parameter_names, best.values, self.lower, self.upper, strict=True)
        at_bounds = [name for name, x, a, b in ends if min(x - a, b - x) < 1e-6 * (b - a)]
        if at_bounds:
            lines.append(f"\nAt a bound of their range: {', '.join(at_bounds)}.")
        order = "Pareto front" if len(self.objectives) > 1 else "best first, by start"
        columns = [*self.objectives, *labels]
        lines += [
            "",
            f"{len(self.solutions)} solutions, {order}:",
            "",
            f"| {' | '.join([*columns, 'requirements', 'termination'])} |",
            f"| {' | '.join(['---:'] * len(columns) + ['---'] * 2)} |",
        ]
        for x in self.solutions:
            cells = [f"{value:.6g}" for value in (*x.objectives, *x.values)]
            cells += ["hold" if x.is_feasible else "fail", x.message]
            lines.append(f"| {' | '.join(cells)} |")
        return "\n".join([*lines, ""])

    def to_csv(self, path: str | Path) -> None:
        """Write one row per solution: parameters, objectives, slacks, feasibility.

        Raises:
            OutputError: The file cannot be written.
        """
        columns = solution_columns(
            self.parameter_names, len(self.objectives), len(self.requirements)
        )
        units = dict.fromkeys(columns, "1")
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
    checkpoint: str | Path | None = None,
    progress: Progress | None = None,
) -> Design:
    """Find the parameters of a machine that are best for measures of it.

    Objectives are expressions of measures: load(RADIUS, HEIGHT[, SLEW in degrees]) [kg], reach,
    highest, lowest, nearest(X, Y, Z), mass, gross_torque, net_torque(RADIUS), slewing_torque,
    those of `study` (peak_JOINT, rms_JOINT, energy, work, lower_JOINT, upper_JOINT), parameters
    of the machine by name, and functions of the user. The search is sequential quadratic
    programming (SLSQP) from the machine's own parameters and from starts drawn by a Latin
    hypercube. Derivatives are exact where `VariantEvaluation` says so. Several objectives f give
    a Pareto front, each point of which minimizes the largest w_i (f_i - ideal_i) / range_i for
    weights w over their simplex (Steuer and Choo, An interactive weighted Tchebycheff procedure,
    Mathematical Programming 26, 1983).

    Args:
        machine: Argument or result of `crane.load`.
        vary: Range of each parameter that varies, by name.
        minimise: Objectives to minimize.
        maximise: Objectives to maximize.
        require: Requirements "A >= B", "A <= B" or "A == B".
        measures: Functions of a machine by name, or a Python file that defines them.
        frame: Link at which loads hang; the tip by default.
        rule: Rating rule of loads.
        tasks: Tasks for forces and energy; all by default.
        starts: Number of searches per objective.
        points: Number of points of the front, with several objectives.
        seed: Seed of the starts.
        processes: Number of processes.
        scheduler: Address of a Dask scheduler whose workers compute instead.
        checkpoint: File to which the solution of each search is appended, with the objectives as
            they are minimized; those in it are not searched again, as in `crane.study`.
        progress: Function that is called with the finished share, 0 to 1.

    Raises:
        InputError: A name is unknown, there is no objective, a range is empty, no solution
            satisfies the requirements, or the checkpoint is of another optimization.
        TerminatedWorkerError: Processes or the scheduler ended before their time.
        OutputError: The checkpoint cannot be written.
    """
    progress = progress_reporter(progress)
    base_machine, name = machine_from_files(machine)
    processes = check_process_count(processes)
    starts = as_count(starts, "the number of starts", 1, 10_000)
    objectives = [("minimise", x) for x in minimise] + [("maximise", x) for x in maximise]
    if not objectives:
        raise InputError("no objective is given, name what to minimise or to maximise")
    names, lower, upper = ranges = _parameter_ranges(base_machine, vary)
    chosen_tasks = unique_names("task", base_machine.tasks, tasks)
    options = MeasureOptions(frame, find_rule(rule), chosen_tasks, load_user_measures(measures))
    base_job = _base_job(base_machine, name, ranges, objectives, require, options, measures)
    initial_values = np.array([MachineVariants(base_machine).values[x] for x in names])
    initial_solution = DesignProblem(base_job).solution(initial_values, initial_values, "as it is")
    random = qmc.LatinHypercube(len(names), rng=as_seed(seed)).random(starts)
    initial_points = [np.clip(initial_values, lower, upper), *(lower + random * (upper - lower))]
    is_multi_objective = len(objectives) > 1
    total = starts * len(objectives) + (points if is_multi_objective else 0)

    def solve_jobs(
        jobs: Sequence[DesignJob], finished: int, kept: StoredResults[DesignSolution]
    ) -> list[DesignSolution]:
        return compute_jobs(
            solve_design_job, jobs, processes, scheduler,
            lambda done: progress((finished + done) / total),
            replace(kept, keys=[(str(finished + i),) for i in range(len(jobs))]),
        )  # fmt: skip

    single_jobs = [
        base_job._replace(initial_values=start, objectives=(text,))
        for text in base_job.objectives
        for start in initial_points[:starts]
    ]
    settings = base_job, initial_points, points, measure_source(measures)
    with kept_solutions(checkpoint, base_machine, base_job, settings) as kept:
        solutions = solve_jobs(single_jobs, 0, kept)
        if is_multi_objective:
            points = as_count(points, "the number of points", 2, 1000)
            front_jobs = _pareto_front_jobs(base_job, solutions, points)
            problem, finished = DesignProblem(base_job), len(solutions)
            front = solve_jobs(front_jobs, finished, kept)
            solutions = [problem.with_all_objectives(x) for x in (*solutions, *front)]
        _check_feasible(solutions, require)
    if is_multi_objective:
        solutions = _nondominated([x for x in solutions if x.is_feasible])
    else:
        solutions = sorted(solutions, key=lambda x: (not x.is_feasible, x.objectives[0]))
    signs = np.array([1.0 if sense == "minimise" else -1.0 for sense, _ in objectives])
    return Design(
        base_machine,
        names,
        lower,
        upper,
        tuple(f"{sense} {text}" for sense, text in objectives),
        tuple(x.strip() for x in require),
        replace(initial_solution, objectives=signs * initial_solution.objectives),
        tuple(replace(x, objectives=signs * x.objectives) for x in solutions),
        options,
    )


def _base_job(
    machine: Machine,
    name: str,
    ranges: tuple[tuple[str, ...], Array, Array],
    objectives: Sequence[tuple[str, str]],
    require: Sequence[str],
    options: MeasureOptions,
    measures: str | Path | Mapping[str, MeasureFunction] | None,
) -> DesignJob:
    """Check the expressions, and return the job with all objectives."""
    expressions = [MeasureExpression(x) for _, x in objectives]
    requirements = [parse_requirement(x) for x in require]
    check_unique_names(options.user_measures, task_measures(machine) | stroke_measures(machine))
    _check_names(machine, [*expressions, *(x for x, _ in requirements)], options)
    return DesignJob(
        name,
        dict(machine.parameter_changes),
        dict(machine.locked_joints),
        *ranges,
        tuple(x if sense == "minimise" else f"-({x})" for sense, x in objectives),
        tuple(x.text for x, _ in requirements),
        tuple(equal for _, equal in requirements),
        replace(options, user_measures=transferable_measures(measures)),
        np.zeros(len(ranges[0])),
    )


def _check_feasible(solutions: Sequence[DesignSolution], require: Sequence[str]) -> None:
    if any(x.is_feasible for x in solutions):
        return
    first = solutions[0]
    message = first.message
    if len(first.slacks):
        worst = int(np.argmin(first.slacks))
        if np.isfinite(first.slacks[worst]):
            message = f"'{require[worst]}' lacks {-first.slacks[worst]:.4g}"
    raise InputError(
        f"no start of {len(solutions)} satisfies the requirements, the first: {message}"
    )


def _check_names(
    machine: Machine, expressions: Sequence[MeasureExpression], options: MeasureOptions
) -> None:
    known_measures = available_measures(machine, options.user_measures)
    values = MachineVariants(machine).values

    def check(name: str) -> float:
        if name not in values:
            check_name(name, known_measures, f"measure '{name}' is unknown")
        return 1.0

    load_positions(expressions)
    for expression in expressions:
        expression(check, lambda name, arguments: 1.0)


def _parameter_ranges(
    machine: Machine, vary: Mapping[str, tuple[float, float]]
) -> tuple[tuple[str, ...], Array, Array]:
    if not vary:
        raise InputError("nothing varies, name parameters and their ranges")
    values = MachineVariants(machine).values
    for name, interval in vary.items():
        check_name(name, values, f"parameter '{name}' is unknown")
        try:
            bounds = np.array(interval, dtype=float).ravel()
        except (TypeError, ValueError):
            bounds = np.zeros(0)
        if len(bounds) != 2 or not np.isfinite(bounds).all() or not bounds[0] < bounds[1]:
            raise InputError(f"'{name}' has no range, give its lower and upper end")
    lower, upper = np.array([np.ravel(ends) for ends in vary.values()], dtype=float).T
    return tuple(vary), lower, upper


def _pareto_front_jobs(
    base_job: DesignJob, solutions: Sequence[DesignSolution], points: int
) -> list[DesignJob]:
    """Return the searches for points of the front, from means of the single optima.

    Args:
        base_job: Job with all objectives.
        solutions: Solutions for each objective alone, in the order of the objectives.
        points: Number of points.
    """
    problem, count = DesignProblem(base_job), len(solutions) // len(base_job.objectives)
    optima = []
    for i in range(len(base_job.objectives)):
        feasible = [x for x in solutions[i * count : (i + 1) * count] if x.is_feasible]
        if not feasible:
            raise InputError(f"objective {i + 1} alone has no feasible solution")
        optima.append(problem.with_all_objectives(min(feasible, key=lambda x: x.objectives[0])))
    objectives = np.array([x.objectives for x in optima])
    ideal = objectives.min(axis=0)
    smallest_ranges = 1e-9 * np.maximum(np.abs(ideal), 1e-12)
    values = np.array([x.values for x in optima])
    return [
        base_job._replace(
            initial_values=(row / row.sum()) @ values,
            weights=np.maximum(row, 1e-6),
            ideal_objectives=ideal,
            objective_ranges=np.maximum(objectives.max(axis=0) - ideal, smallest_ranges),
        )
        for row in _simplex_weights(len(optima), points)
    ]


def _simplex_weights(objective_count: int, point_count: int) -> Array:
    if objective_count == 2:
        first_weights = np.linspace(0.0, 1.0, point_count + 2)[1:-1]
        return np.column_stack([first_weights, 1.0 - first_weights])
    samples = qmc.Sobol(objective_count, rng=0).random(1 << (point_count - 1).bit_length())[
        :point_count
    ]
    samples = -np.log(np.clip(samples, 1e-9, 1.0))
    return samples / samples.sum(axis=1, keepdims=True)


def _nondominated(solutions: Sequence[DesignSolution]) -> list[DesignSolution]:
    """Return the solutions that no other one dominates, by the first objective."""
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
