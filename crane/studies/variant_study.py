"""Design studies: the same measures of many variants of a machine."""

import itertools
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from crane.common.checkpoint import open_checkpoint
from crane.common.errors import (
    CraneError,
    CraneWarning,
    InputError,
    check_name,
    prefix_location,
)
from crane.common.progress import Progress, progress_reporter
from crane.common.samples import Array, as_count, as_samples, as_seed
from crane.description.machine_parameters import parameter_unit
from crane.dynamics.dynamics import Dynamics
from crane.formats.machine_loading import MachineVariants, load
from crane.machine.machine import Machine
from crane.ratings.rating_rules import Rule, find_rule
from crane.studies.measures import (
    combine_task_measures,
    measure_strokes,
    measure_task,
    resolution_notes,
    stroke_measures,
    task_measures,
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
    PLAIN_MEASURES,
    MeasureOptions,
    VariantEvaluation,
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
from crane.studies.study_table import Study, study_headings

_VariantRow = tuple[dict[str, float], str]  # columns, and the reasons for missing ones
_MAX_VARIANTS = 100_000
_REQUIREMENT_TOLERANCE = 1e-9  # relative violation of a requirement that is accepted
# first words of parameters that do not change inverse dynamics
_NON_MECHANICAL_PREFIXES = ("control", "supply", "oil", "cylinder", "valve", "valve_control")

# one machine per set of formulas; variants share its machine code as long as it exists
_CODE_OWNERS: dict[int, Machine] = {}


class StudyJob(NamedTuple):
    """Everything that the measures of a variant depend on, independent of the process.

    Attributes:
        machine: Argument of `load`.
        changes: Parameter changes.
        locked_joints: Joints that are held.
        tasks: Tasks that are measured.
        with_strokes: Whether the strokes are measured.
        expressions: Expressions of measures, see `crane.studies.optimization`.
        requirements: Requirements.
        options: Options of the expressions.
    """

    machine: str
    changes: dict[str, float]
    locked_joints: dict[str, float]
    tasks: tuple[str, ...]
    with_strokes: bool
    expressions: tuple[str, ...] = ()
    requirements: tuple[str, ...] = ()
    options: MeasureOptions = MeasureOptions()


def study(
    machine: Machine | str | Path,
    vary: Mapping[str, ArrayLike],
    tasks: Sequence[str] | None = None,
    measures: Sequence[str] | None = None,
    *,
    require: Sequence[str] = (),
    user_measures: str | Path | Mapping[str, MeasureFunction] | None = None,
    frame: str | None = None,
    rule: str | Rule = "none",
    draws: int | None = None,
    seed: int = 0,
    processes: int = 1,
    scheduler: str | None = None,
    checkpoint: str | Path | None = None,
    progress: Progress | None = None,
) -> Study:
    """Measure variants of a machine: a grid of parameter values, or random draws.

    The measures (see `crane.studies.measures`) are peak_JOINT, rms_JOINT, energy and work of the
    active joints over the tasks; reach, range, lower_JOINT and upper_JOINT of the strokes; and
    any expression that `crane.design` takes, such as "load(4, 0) / mass". Tasks of levers are
    simulated with their circuit. Every variant is loaded from the files, so that its row does not
    depend on the process that computes it, nor on the order.

    Args:
        machine: Argument or result of `crane.load`.
        vary: Values by parameter name (see `crane.description.parameters`), of which all
            combinations are taken; with `draws` the two ends of a range.
        tasks: Tasks of the machine; all by default.
        measures: Measures; all by default.
        require: Requirements "A >= B", "A <= B" or "A == B" of expressions. Variants that fail
            are not measured; their reason states the violation.
        user_measures: Functions of a machine by name for expressions, or a Python file of them.
        frame: Link at which loads of expressions hang; the tip by default.
        rule: Rating rule of loads.
        draws: Number of variants that are drawn uniformly from the ranges.
        seed: Seed of the draws.
        processes: Number of processes, at most eight per core. More than one needs a main module
            that can be imported (`if __name__ == "__main__":`).
        scheduler: Address of a Dask scheduler whose workers compute instead.
        checkpoint: File to which each finished variant is appended, as a row of `Study.to_csv`;
            those in it are not computed again. It stays until it is removed, as by `Study.write`
            into its folder, where it is named "unfinished.csv".
        progress: Function that is called with the finished share, 0 to 1.

    Raises:
        InputError: A name is unknown, values are inconsistent, no variant can be measured, the
            machine was changed after it was loaded, or the checkpoint is of another study.
        TerminatedWorkerError: Processes or the scheduler ended before their time.
        OutputError: The checkpoint cannot be written.
    """
    progress = progress_reporter(progress)
    check_process_count(processes)
    seed = as_seed(seed)
    base_machine, name = machine_from_files(machine)
    values, grid_shape = _variant_values(vary, draws, seed)
    tasks = unique_names("task", base_machine.tasks, tasks)
    has_lever_tasks = any(base_machine.tasks[task].space == "joystick" for task in tasks)
    task_measure_units = task_measures(base_machine) if tasks else {}
    available = task_measure_units | stroke_measures(base_machine)
    user_functions = load_user_measures(user_measures)
    check_unique_names(user_functions, available)
    expressions = tuple(x for x in measures or () if _is_expression(x, available, user_functions))
    for text in require:
        parse_requirement(text)
    named_measures = [x for x in measures or () if x not in expressions]
    selected_measures = unique_names(
        "measure", available, named_measures or (None if not expressions else ())
    )
    with_circuit = bool(has_lever_tasks or expressions or require)
    units = _parameter_units(base_machine, vary, with_circuit)
    options = MeasureOptions(frame, find_rule(rule), tasks, transferable_measures(user_measures))
    if not set(selected_measures) & set(task_measure_units):
        tasks = ()
    job = StudyJob(
        name, dict(base_machine.parameter_changes), dict(base_machine.locked_joints), tasks,
        not set(selected_measures) <= set(task_measure_units), expressions, tuple(require),
        options,
    )  # fmt: skip
    jobs = [
        job._replace(changes=job.changes | dict(zip(vary, row, strict=True)))
        for row in values.tolist()
    ]
    measures = tuple(dict.fromkeys((*(measures or ()), *selected_measures)))
    available |= {x: PLAIN_MEASURES.get(x, "") for x in expressions}
    column_measures = {
        column: x
        for x in measures
        for column in (
            x, *(f"{x} {task}" for task in tasks if len(tasks) > 1 and x in task_measure_units)
        )
    }  # fmt: skip
    units |= {column: available[measure] for column, measure in column_measures.items()}
    with _kept_rows(
        checkpoint, base_machine, (job, values, measure_source(user_measures)),
        [*vary, *column_measures], units,
    ) as kept:  # fmt: skip
        rows = compute_jobs(
            measure_variant, jobs, processes, scheduler,
            lambda done: progress(done / len(jobs)), kept,
        )  # fmt: skip
        reasons = tuple(reason for _, reason in rows)
        if all(reasons):
            raise InputError(
                f"none of {len(jobs)} variants can be measured, the first: {reasons[0]}"
            )
    columns = dict(zip(vary, values.T, strict=True)) | {
        column: np.array([row.get(column, np.nan) for row, _ in rows])
        for column in column_measures
    }
    return Study(
        name, tuple(vary), measures, tasks,
        units, columns, reasons, grid_shape, resolution_notes(base_machine, measures),
    )  # fmt: skip


@contextmanager
def _kept_rows(
    checkpoint: str | Path | None,
    machine: Machine,
    settings: tuple[StudyJob, Array, object],
    columns: Sequence[str],
    units: Mapping[str, str],
) -> Iterator[StoredResults[_VariantRow]]:
    """Context of the rows of a study in a checkpoint, if there is one; see `Study.to_csv`."""
    values = settings[1]
    count = values.shape[1]

    def to_cells(row: _VariantRow) -> list[object]:
        return [*(float(row[0][x]) if x in row[0] else "" for x in columns[count:]), row[1]]

    def from_cells(cells: list[str]) -> _VariantRow:
        named_cells = zip(columns[count:], cells[:-1], strict=True)
        return {name: float(cell) for name, cell in named_cells if cell}, cells[-1]

    with open_checkpoint(
        checkpoint,
        {"machine data": MachineVariants(machine).spec, "settings": settings},
        study_headings(columns, units),
        count,
    ) as table:
        keys = [tuple(map(repr, row)) for row in values.tolist()]
        yield StoredResults(table, keys, to_cells, from_cells)


def measure_variant(study_job: StudyJob) -> _VariantRow:
    """Return the columns of one variant, and the reasons for missing ones."""
    # the machine itself has given its warnings
    with warnings.catch_warnings(action="ignore", category=CraneWarning):
        try:
            machine = load(study_job.machine, study_job.changes, study_job.locked_joints)
        except CraneError as error:
            return {}, str(error)
        return _measure(machine, study_job)


def _measure(machine: Machine, study_job: StudyJob) -> _VariantRow:
    measures: dict[str, float] = {}
    reasons = []
    if machine.closure.is_compiled:
        _CODE_OWNERS.setdefault(id(machine.closure.compiled_closure.programs), machine)
    dynamics, task_results = Dynamics(machine), []
    if study_job.expressions or study_job.requirements:
        try:
            measures |= _evaluate_expressions(machine, study_job)
        except CraneError as error:
            return {}, str(error)
    for task in study_job.tasks:
        try:
            task_results.append(measure_task(machine, dynamics, task))
            measures |= {f"{name} {task}": value for name, value in task_results[-1][1].items()}
        except CraneError as error:
            reasons.append(prefix_location(f"task '{task}'", error))
    if task_results and len(task_results) == len(study_job.tasks):
        measures |= combine_task_measures(task_results)
    if study_job.with_strokes:
        measures |= measure_strokes(machine)
    return measures, "; ".join(reasons)


def _is_expression(
    text: str, available: Mapping[str, str], functions: Mapping[str, MeasureFunction]
) -> bool:
    """Return whether a measure is an expression, and not a name of the study.

    Raises:
        InputError: It is neither.
    """
    if text in available:
        return False
    if text.isidentifier():
        names = [*available, *PLAIN_MEASURES, *functions]
        check_name(text, names, f"measure '{text}' is unknown")
    load_positions([MeasureExpression(text)])
    return True


def _evaluate_expressions(machine: Machine, study_job: StudyJob) -> dict[str, float]:
    """Return the values of a variant's expressions.

    Raises:
        CraneError: An expression has no value, or a requirement fails.
    """
    expressions = [
        *map(MeasureExpression, study_job.expressions),
        *(parse_requirement(x)[0] for x in study_job.requirements),
    ]
    functions = load_user_measures(study_job.options.user_measures)
    options = replace(study_job.options, user_measures=functions)
    evaluation = VariantEvaluation(
        MachineVariants(machine), {}, options, load_positions(expressions)
    )
    values = [evaluation.evaluate(x).value for x in expressions]
    for text, value in zip(
        study_job.requirements, values[len(study_job.expressions) :], strict=True
    ):
        shortfall = abs(value) if parse_requirement(text)[1] else -value
        if shortfall > _REQUIREMENT_TOLERANCE * max(1.0, abs(value)):
            raise InputError(f"requires {text}: lacks {shortfall:.4g}")
    return dict(zip(study_job.expressions, values, strict=False))


def _variant_values(
    vary: Mapping[str, ArrayLike], draws: int | None, seed: int
) -> tuple[Array, tuple[int, ...]]:
    """Return the values (V, parameters) and the shape of the grid."""
    if not vary:
        raise InputError("nothing varies, name a parameter and its values")
    axes = []
    for name, parameter_values in vary.items():
        axis = np.atleast_1d(parameter_values)
        axes.append(as_samples(axis, len(axis), f"what '{name}' is varied over"))
        if axis.ndim > 1 or not len(axis):
            raise InputError(f"parameter '{name}' has no list of values, give one")
    count = math.prod(len(axis) for axis in axes) if draws is None else draws
    count = as_count(count, "the number of variants", 1, _MAX_VARIANTS)
    if draws is None:
        return np.array(list(itertools.product(*axes))), tuple(len(axis) for axis in axes)
    for name, axis in zip(vary, axes, strict=True):
        if len(axis) != 2 or not axis[0] < axis[1]:
            raise InputError(f"'{name}' is drawn between two values, give the lower and the upper")
    lower, upper = np.array(axes).T
    return np.random.default_rng(seed).uniform(lower, upper, (count, len(axes))), ()


def _parameter_units(machine: Machine, vary: Mapping[str, object], with_circuit: bool) -> dict:
    """Return units by parameter; raise for those that do not exist or change nothing.

    Args:
        machine: The machine.
        vary: Names of the parameters.
        with_circuit: Whether a measure depends on circuits and controllers.
    """
    names = MachineVariants(machine).values
    units = {}
    for parameter in vary:
        check_name(parameter, names, f"parameter '{parameter}' is unknown")
        prefix, *remaining_names = parameter.split(".")
        if (
            not with_circuit
            and prefix in _NON_MECHANICAL_PREFIXES
            and remaining_names[-1] not in ("lower", "upper")
        ):
            raise InputError(
                f"'{parameter}' changes nothing: the forces are those of the reference motion, "
                "without controller and hydraulics; take a task of levers, or a load"
            )
        units[parameter] = parameter_unit(machine.tree, parameter)
    return units
