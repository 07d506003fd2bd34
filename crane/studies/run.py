"""Design studies: the same measures of many variants, here or on a cluster."""

import itertools
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import CraneError, CraneWarning, InputError, at, known
from crane.common.samples import Array, as_count, as_samples, as_seed
from crane.common.waiting import telling
from crane.description.number_units import number_unit
from crane.dynamics import Dynamics
from crane.formats import load
from crane.formats.loading import Variants
from crane.machine import Machine
from crane.ratings.rules import Rule, rule_of
from crane.studies.computing import computed, described, processes_of
from crane.studies.design.expressions import Expression, requirement
from crane.studies.design.own import Measure, kept, own_measures
from crane.studies.design.quantities import PLAIN, Point, Terms, places_in, refuse_taken
from crane.studies.measures import (
    notes,
    of_strokes,
    of_task,
    stroke_measures,
    task_measures,
    together,
)
from crane.studies.table import Study

_MOST = 100_000  # variants
_SLACK = 1e-9  # by which a requirement may fail
# Parameters that inverse dynamics does not know, by their first word.
_IDLE = ("control", "supply", "oil", "cylinder", "valve", "valve_control")
Progress = Callable[[float], None]

# One machine per set of formulas: as long as it lives, variants share its machine code.
_KEPT: dict[int, Machine] = {}


class Job(NamedTuple):
    """What a variant is computed from, wherever that happens.

    Attributes:
        machine: What `load` takes.
        changes: Of its parameters.
        lock: Joints that are fixed.
        tasks: To measure it with.
        strokes: Whether to measure its strokes.
        expressions: Of measures, see `crane.studies.design`.
        require: What has to hold.
        own: A Python file of a user's own measures, or these.
        frame: Where loads hang.
        rule: By which they are rated.
        asked: Tasks that expressions are measured with.
    """

    machine: str
    changes: dict[str, float]
    lock: dict[str, float]
    tasks: tuple[str, ...]
    strokes: bool
    expressions: tuple[str, ...] = ()
    require: tuple[str, ...] = ()
    own: str | Mapping[str, Measure] | None = None
    frame: str | None = None
    rule: str | Rule = "none"
    asked: tuple[str, ...] = ()


def study(
    machine: Machine | str | Path,
    vary: Mapping[str, ArrayLike],
    tasks: Sequence[str] | None = None,
    measures: Sequence[str] | None = None,
    *,
    require: Sequence[str] = (),
    own: str | Path | Mapping[str, Measure] | None = None,
    frame: str | None = None,
    rule: str | Rule = "none",
    draws: int | None = None,
    seed: int = 0,
    processes: int = 1,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> Study:
    """Measure variants of a machine: the grid of all values, or random draws.

    Measures, see `crane.studies.measures`: peak_JOINT, rms_JOINT, energy and work of the active
    joints over the tasks; reach, range, lower_JOINT and upper_JOINT of the strokes; and any
    expression that `crane.design` takes, such as "load(4, 0) / mass". Tasks of levers are
    simulated with their circuit. Every variant is loaded afresh, so its row does not depend on
    where it is computed, or after what.

    Args:
        machine: What `crane.load` takes, or what it gave.
        vary: By name of a parameter, see `crane.description.parameters`: values, of which all
            combinations are taken, or with `draws` the two ends of a range.
        tasks: Of the machine; all if not given.
        measures: Which ones; all if not given.
        require: "A >= B", "A <= B" or "A == B" of such expressions; variants that fail are not
            measured, and say by how much.
        own: Functions of a machine by name that expressions know, or a Python file of them.
        frame: Where loads hang, of expressions; the tip if not given.
        rule: By which they are rated.
        draws: Number of variants drawn uniformly from the ranges.
        seed: Of the draws.
        processes: How many to compute with, at most eight per core; more than one need a main
            module that may be imported (`if __name__ == "__main__":`).
        scheduler: Address of a Dask scheduler whose workers compute instead.
        progress: Called with the finished share, 0 to 1.

    Raises:
        InputError: Unknown names, values that do not go together, no variant can be measured, or a
            machine that was changed after it was loaded.
    """
    progress = telling(progress)
    processes_of(processes)
    seed = as_seed(seed)
    base, name = described(machine)
    values, grid = _variants(vary, draws, seed)
    tasks = _chosen("task", base.tasks, tasks)
    levers = any(base.tasks[task].space == "joystick" for task in tasks)
    of_tasks = task_measures(base) if tasks else {}
    available = of_tasks | stroke_measures(base)
    functions = own_measures(own)
    refuse_taken(functions, available)
    expressions = tuple(x for x in measures or () if _composed(x, available, functions))
    for text in require:
        requirement(text)
    plain = [x for x in measures or () if x not in expressions]
    chosen = _chosen("measure", available, plain or (None if not expressions else ()))
    units = _parameter_units(base, vary, levers or bool(expressions) or bool(require))
    asked = tasks
    if not set(chosen) & set(of_tasks):
        tasks = ()
    jobs = [
        Job(
            name,
            {**base.changes, **dict(zip(vary, row.tolist(), strict=True))},
            dict(base.locks),
            tasks,
            not set(chosen) <= set(of_tasks),
            expressions,
            tuple(require),
            kept(own),
            frame,
            rule_of(rule),
            asked,
        )
        for row in values
    ]
    rows: dict[int, tuple[dict[str, float], str]] = {}
    for index, row in computed(variant, jobs, processes, scheduler):
        rows[index] = row
        if progress is not None:
            progress(len(rows) / len(jobs))
    columns = dict(zip(vary, values.T, strict=True))
    measures = tuple(dict.fromkeys((*(measures or ()), *chosen)))
    available |= {x: PLAIN.get(x, "") for x in expressions}
    for measure in measures:
        names = [measure]
        if measure in of_tasks and len(tasks) > 1:
            names += [f"{measure} {task}" for task in tasks]
        for column in names:
            columns[column] = np.array([rows[i][0].get(column, np.nan) for i in range(len(jobs))])
            units[column] = available[measure]
    reasons = tuple(rows[i][1] for i in range(len(jobs)))
    if all(reasons):
        raise InputError(f"none of {len(jobs)} variants can be measured, the first: {reasons[0]}")
    return Study(
        name, tuple(vary), measures, tasks, units, columns, reasons, grid, notes(base, measures)
    )


def variant(job: Job) -> tuple[dict[str, float], str]:
    """Columns of one variant, and why some are missing."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)  # told of the machine itself
        try:
            machine = load(job.machine, job.changes, job.lock)
        except CraneError as error:
            return {}, str(error)
        return _measured(machine, job)


def _measured(machine: Machine, job: Job) -> tuple[dict[str, float], str]:
    found: dict[str, float] = {}
    reasons = []
    if machine.closure.compiled:
        _KEPT.setdefault(id(machine.closure.fast.programs), machine)
    dynamics, done = Dynamics(machine), []
    if job.expressions or job.require:
        try:
            found |= _expressed(machine, job)
        except CraneError as error:
            return {}, str(error)
    for task in job.tasks:
        try:
            done.append(of_task(machine, dynamics, task))
            found |= {f"{name} {task}": value for name, value in done[-1][1].items()}
        except CraneError as error:
            reasons.append(at(f"task '{task}'", error))
    if done and len(done) == len(job.tasks):
        found |= together(done)
    if job.strokes:
        found |= of_strokes(machine)
    return found, "; ".join(reasons)


def _composed(text: str, available: Mapping[str, str], functions: Mapping[str, Measure]) -> bool:
    """Whether a measure is an expression and no name of the study's own.

    Raises:
        InputError: It is neither.
    """
    if text in available:
        return False
    if text.isidentifier() and text not in functions and text not in PLAIN:
        names = [*available, *PLAIN, *functions]
        raise InputError(f"measure '{text}' is unknown, {known(names, text)}")
    places_in([Expression(text)])
    return True


def _expressed(machine: Machine, job: Job) -> dict[str, float]:
    """Values of a variant's expressions.

    Raises:
        CraneError: One has no value, or a requirement fails.
    """
    texts = [*map(Expression, job.expressions), *(requirement(x)[0] for x in job.require)]
    terms = Terms(job.frame, job.rule, job.asked, own_measures(job.own))
    none = np.zeros(0)
    point = Point(Variants(machine), (), none, none, terms, places_in(texts))
    values = [point.value(x) for x in texts]
    for text, value in zip(job.require, values[len(job.expressions) :], strict=True):
        lacks = abs(value) if requirement(text)[1] else -value
        if lacks > _SLACK * max(1.0, abs(value)):
            raise InputError(f"requires {text}: lacks {lacks:.4g}")
    return dict(zip(job.expressions, values, strict=False))


def _variants(
    vary: Mapping[str, ArrayLike], draws: int | None, seed: int
) -> tuple[Array, tuple[int, ...]]:
    """Values (V, parameters), and the shape of the grid."""
    if not vary:
        raise InputError("nothing varies, name a parameter and its values")
    axes = []
    for name, given in vary.items():
        axis = np.atleast_1d(given)
        axes.append(as_samples(axis, len(axis), f"what '{name}' is varied over"))
        if axis.ndim > 1 or not len(axis):
            raise InputError(f"parameter '{name}' has no list of values, give one")
    count = math.prod(len(axis) for axis in axes) if draws is None else draws
    count = as_count(count, "the number of variants", 1, _MOST)
    if draws is None:
        return np.array(list(itertools.product(*axes))), tuple(len(axis) for axis in axes)
    for name, axis in zip(vary, axes, strict=True):
        if len(axis) != 2 or not axis[0] < axis[1]:
            raise InputError(f"'{name}' is drawn between two values, give the lower and the upper")
    low, high = np.array(axes).T
    return np.random.default_rng(seed).uniform(low, high, (count, len(axes))), ()


def _chosen(
    what: str, available: Mapping[str, object], wanted: Sequence[str] | None
) -> tuple[str, ...]:
    """Names without doubles, all if none are given."""
    for name in wanted or ():
        if name not in available:
            raise InputError(f"{what} '{name}' is unknown, {known(available, name)}")
    return tuple(dict.fromkeys(available if wanted is None else wanted))


def _parameter_units(machine: Machine, vary: Mapping[str, object], driven: bool) -> dict:
    """Units by parameter; refuses those that do not exist or change nothing.

    Args:
        machine: The machine.
        vary: By name.
        driven: Whether something is measured that circuits and controllers change.
    """
    names = Variants(machine).values
    units = {}
    for wanted in vary:
        if wanted not in names:
            raise InputError(f"parameter '{wanted}' is unknown, {known(names, wanted)}")
        head, *rest = wanted.split(".")
        if not driven and head in _IDLE and rest[-1] not in ("lower", "upper"):
            raise InputError(
                f"'{wanted}' changes nothing: the forces are those of the reference motion, "
                "without controller and hydraulics; take a task of levers, or a load"
            )
        units[wanted] = number_unit(machine.tree, wanted)
    return units
