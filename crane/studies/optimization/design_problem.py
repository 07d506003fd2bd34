"""One search of a design optimization: its problem and its solution by SLSQP."""

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np
from scipy.optimize import minimize

from crane.common.checkpoint import open_checkpoint
from crane.common.errors import CraneError, CraneWarning, InputError
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array
from crane.formats.machine_loading import MachineVariants, load
from crane.machine.machine import Machine
from crane.studies.optimization.measure_expressions import (
    DualNumber,
    MeasureExpression,
    load_user_measures,
)
from crane.studies.optimization.variant_measures import (
    MeasureOptions,
    VariantEvaluation,
    load_positions,
)
from crane.studies.parallel_jobs import StoredResults

_OBJECTIVE_TOLERANCE = 1e-10  # of an objective, as a share of its scale
_MAX_ITERATIONS = 200
_REQUIREMENT_TOLERANCE = 1e-6  # of a requirement, as a share of its scale
_MAX_START_DRAWS = 50  # draws of a start, until a machine can be assembled
_INFEASIBLE_COST = 1e3  # cost of a variant that cannot be assembled, in scales of the objective


@dataclass(frozen=True, eq=False)
class DesignSolution(OneLineRepr):
    """Solution of one search.

    Attributes:
        initial_values: (k,) parameters at the start.
        values: (k,) parameters at the end.
        objectives: (m,) values of the objectives, with the signs of their expressions.
        slacks: (r,) slack of each requirement, -|A - B| for "A == B"; it fails below 0.
        is_feasible: Whether all requirements hold.
        message: Termination message.
    """

    initial_values: Array
    values: Array
    objectives: Array
    slacks: Array
    is_feasible: bool
    message: str


class DesignJob(NamedTuple):
    """Everything that one search depends on, independent of the process.

    Attributes:
        machine: Argument of `load`.
        changes: Parameter changes of the machine.
        locked_joints: Joints that are held.
        parameter_names: Parameters that vary.
        lower: (k,) lower bounds.
        upper: (k,) upper bounds.
        objectives: Expressions to minimize.
        requirements: Expressions that must not be negative.
        is_equality: Whether each of them has to be 0.
        options: Options of the measures.
        initial_values: (k,) start.
        weights: (m,) weights of several objectives.
        ideal_objectives: (m,) smallest values of several objectives.
        objective_ranges: (m,) ranges of several objectives.
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
    options: MeasureOptions
    initial_values: Array
    weights: Array | None = None
    ideal_objectives: Array | None = None
    objective_ranges: Array | None = None


class DesignProblem:
    """Objectives and requirements of a job, as functions of the parameters."""

    def __init__(self, job: DesignJob):
        with warnings.catch_warnings(action="ignore", category=CraneWarning):
            machine = load(job.machine, job.changes, job.locked_joints)
        self.job, self._variants = job, MachineVariants(machine)
        self.objectives = [MeasureExpression(text) for text in job.objectives]
        self.requirements = [MeasureExpression(text) for text in job.requirements]
        functions = load_user_measures(job.options.user_measures)
        self._options = replace(job.options, user_measures=functions)
        self._load_positions = load_positions([*self.objectives, *self.requirements])
        self._last_evaluation: VariantEvaluation | None = None
        self._last_outcome: tuple[bytes, list[DualNumber] | CraneError] = b"", []

    def evaluate(self, values: Array) -> list[DualNumber]:
        """Return the objectives, then the requirements, at parameters (k,).

        Raises:
            CraneError: The machine cannot be assembled or measured with these parameters.
        """
        if self._last_outcome[0] != values.tobytes():
            job = self.job
            try:
                # also warnings of user measures
                with warnings.catch_warnings(action="ignore"), np.errstate(all="ignore"):
                    evaluation = VariantEvaluation(
                        self._variants,
                        dict(zip(job.parameter_names, values.tolist(), strict=True)),
                        self._options,
                        self._load_positions,
                        dict(zip(job.parameter_names, job.upper - job.lower, strict=True)),
                    )
                    duals = [
                        evaluation.evaluate(x) for x in (*self.objectives, *self.requirements)
                    ]
                for text, x in zip((*self.objectives, *self.requirements), duals, strict=True):
                    if not (np.isfinite(x.value) and np.isfinite(x.derivatives).all()):
                        raise InputError(f"'{text.text}' is not finite there")
                self._last_evaluation = evaluation  # keeps its machine code for the next variant
                self._last_outcome = values.tobytes(), duals
            except CraneError as error:
                self._last_outcome = values.tobytes(), error
        outcome = self._last_outcome[1]
        if isinstance(outcome, CraneError):
            raise outcome
        return outcome

    def solution(self, initial_values: Array, values: Array, message: str) -> DesignSolution:
        """Return a solution with all objectives and slacks at parameters (k,)."""
        count = len(self.objectives)
        try:
            duals = self.evaluate(values)
        except CraneError as error:
            return DesignSolution(
                initial_values, values, np.full(count, np.nan),
                np.full(len(self.requirements), -np.inf), False, str(error),
            )  # fmt: skip
        slacks = self.signed_slacks(np.array([x.value for x in duals[count:]]))
        tolerances = _REQUIREMENT_TOLERANCE * np.array(self.scales(duals[count:], 0.0))
        objectives = np.array([x.value for x in duals[:count]])
        return DesignSolution(
            initial_values,
            values,
            objectives,
            slacks,
            bool((slacks >= -tolerances).all()),
            message,
        )

    def with_all_objectives(self, solution: DesignSolution) -> DesignSolution:
        """Return a solution with the values of all objectives."""
        return self.solution(solution.initial_values, solution.values, solution.message)

    def signed_slacks(self, values: Array) -> Array:
        """Return the slacks of requirements with these values, never above 0 for equalities."""
        return np.where(np.array(self.job.is_equality, dtype=bool), -np.abs(values), values)

    def scales(self, duals: Sequence[DualNumber], smallest: float) -> list[float]:
        """Return the scale of each value: its magnitude, or its change over a range."""
        ranges = self.job.upper - self.job.lower
        return [
            max(abs(x.value), float(np.abs(x.derivatives * ranges).max(initial=0.0)), smallest)
            for x in duals
        ]


def solution_columns(
    parameter_names: Sequence[str], objective_count: int, requirement_count: int
) -> list[str]:
    """Return the columns of solutions in a table."""
    goals = (f"goal_{i}" for i in range(objective_count))
    return [*parameter_names, *goals, *(f"slack_{i}" for i in range(requirement_count)), "fits"]


@contextmanager
def kept_solutions(
    checkpoint: str | Path | None, machine: Machine, job: DesignJob, settings: tuple[object, ...]
) -> Iterator[StoredResults[DesignSolution]]:
    """Context of the solutions in a checkpoint, if there is one, without the keys of jobs.

    Args:
        checkpoint: The checkpoint.
        machine: The machine.
        job: Job with all objectives; jobs with one objective leave cells empty.
        settings: All that the solutions depend on besides the machine.
    """
    sizes = len(job.lower), len(job.objectives), len(job.requirements), 1, len(job.lower), 1
    ends = np.cumsum(sizes).tolist()

    def to_cells(x: DesignSolution) -> list[object]:
        unknown = [""] * (len(job.objectives) - len(x.objectives))
        numbers = (x.values, x.objectives, unknown, x.slacks, [x.is_feasible], x.initial_values)
        return [*(y if y == "" else repr(float(y)) for part in numbers for y in part), x.message]

    def from_cells(cells: list[str]) -> DesignSolution:
        parts = [cells[end - size : end] for size, end in zip(sizes, ends, strict=True)]
        values, objectives, slacks, (is_feasible,), initial_values = (
            np.array([float(x) for x in part if x]) for part in parts[:-1]
        )
        (message,) = parts[-1]
        return DesignSolution(
            initial_values, values, objectives, slacks, bool(is_feasible), message
        )

    starts = [f"start {name}" for name in job.parameter_names]
    columns = solution_columns(job.parameter_names, len(job.objectives), len(job.requirements))
    with open_checkpoint(
        checkpoint,
        {"machine data": MachineVariants(machine).spec, "settings": settings},
        ["search", *columns, *starts, "termination"],
        1,
    ) as table:
        yield StoredResults(table, (), to_cells, from_cells)


def solve_design_job(job: DesignJob) -> DesignSolution:
    """Run one search: SLSQP from the start of a job."""
    problem = DesignProblem(job)
    random = np.random.default_rng(crc32(job.initial_values.tobytes()))
    start = job.initial_values
    for _ in range(_MAX_START_DRAWS):
        try:
            initial_duals = problem.evaluate(start)
            break
        except CraneError as error:
            last_error = error
            start = random.uniform(job.lower, job.upper)
    else:
        return DesignSolution(
            job.initial_values, job.initial_values, np.full(len(job.objectives), np.inf),
            np.full(len(job.requirements), -np.inf), False, str(last_error),
        )  # fmt: skip
    return _DesignSearch(problem, start, initial_duals).solve()


class _DesignSearch:
    """Scaled functions of a problem for SLSQP, and the best variant that was evaluated.

    The variables x are the parameters as shares of their ranges. With several objectives there is
    one more variable, an upper bound of all weighted objectives, which is minimized.
    """

    def __init__(self, problem: DesignProblem, start: Array, initial_duals: list[DualNumber]):
        job = self._job = problem.job
        self._problem, self._start = problem, start
        self._ranges, count = job.upper - job.lower, len(job.objectives)
        self._objective_count, self._has_bound = count, count > 1
        self._initial = np.array([d.value for d in initial_duals[:count]])
        self._objective_scales = (
            job.objective_ranges
            if job.objective_ranges is not None
            else np.array([max(abs(initial_duals[0].value), 1e-12)])
        )
        self._ideal = np.zeros(1) if job.ideal_objectives is None else job.ideal_objectives
        self._weights = np.ones(1) if job.weights is None else job.weights
        self._requirement_scales = problem.scales(initial_duals[count:], 1e-12)
        self._best: tuple[tuple[float, float], Array] | None = None  # merit, parameters

    def solve(self) -> DesignSolution:
        """Run SLSQP; return its solution, or the best variant if that violates less."""
        job, x = self._job, (self._start - self._job.lower) / self._ranges
        is_equality = np.array(job.is_equality, dtype=bool)
        bounds: Any = [(0.0, 1.0)] * len(x)
        if self._has_bound:
            scaled = self._weights * (self._initial - self._ideal) / self._objective_scales
            x, bounds = np.r_[x, scaled.max()], [*bounds, (None, None)]
            is_equality = np.r_[np.zeros(self._objective_count, dtype=bool), is_equality]
        constraints: Any = [
            {
                "type": kind,
                "fun": lambda x, k=k: self._constraints(x)[0][k],
                "jac": lambda x, k=k: self._constraints(x)[1][k],
            }
            for kind, k in (
                ("ineq", np.flatnonzero(~is_equality)),
                ("eq", np.flatnonzero(is_equality)),
            )
            if len(k)
        ]
        result = minimize(
            self._cost, x, jac=True, bounds=bounds, constraints=constraints, method="SLSQP",
            options={"ftol": _OBJECTIVE_TOLERANCE, "maxiter": _MAX_ITERATIONS},
        )  # fmt: skip
        values, scaled_values = self._parameters(result.x), self._scaled_values(result.x)
        if self._best is not None and not (
            scaled_values is not None and np.array_equal(self._best[1], values)
        ):
            shortfall = np.inf if scaled_values is None else self._shortfall(scaled_values[0])
            if shortfall > _REQUIREMENT_TOLERANCE and self._best[0][0] < shortfall:
                values = self._best[1]
        return self._problem.solution(self._start, values, str(result.message).lower())

    def _parameters(self, x: Array) -> Array:
        values = self._job.lower + x[: len(self._ranges)] * self._ranges
        return np.clip(values, self._job.lower, self._job.upper)

    def _shortfall(self, scaled_values: Array) -> float:
        """Return the largest violation of a requirement, as a share of its scale."""
        slacks = self._problem.signed_slacks(scaled_values[self._objective_count :])
        return max(0.0, -float(slacks.min(initial=0.0)))

    def _scaled_values(self, x: Array) -> tuple[Array, Array] | None:
        """Return scaled objectives, then requirements, and their derivatives by x."""
        values, count = self._parameters(x), self._objective_count
        try:
            duals = self._problem.evaluate(values)
        except CraneError:
            return None
        value = np.array([d.value for d in duals])
        derivatives = np.array([d.derivatives * self._ranges for d in duals])
        derivatives = derivatives.reshape(len(duals), len(self._ranges))
        value[:count] = self._weights * (value[:count] - self._ideal) / self._objective_scales
        derivatives[:count] *= (self._weights / self._objective_scales)[:, None]
        value[count:] /= self._requirement_scales
        derivatives[count:] /= np.array(self._requirement_scales).reshape(-1, 1)
        shortfall = self._shortfall(value)
        merit = (
            shortfall if shortfall > _REQUIREMENT_TOLERANCE else 0.0,
            float(value[:count].max() if self._has_bound else value[0]),
        )
        if self._best is None or merit < self._best[0]:
            self._best = merit, values
        return value, derivatives

    def _cost(self, x: Array) -> tuple[float, Array]:
        if self._has_bound:
            return float(x[-1]), np.r_[np.zeros(len(self._ranges)), 1.0]
        scaled = self._scaled_values(x)
        if scaled is None:
            worst = 1.0 + abs(self._initial[0]) / self._objective_scales[0]
            return _INFEASIBLE_COST * worst, np.zeros(len(x))
        return float(scaled[0][0]), scaled[1][0]

    def _constraints(self, x: Array) -> tuple[Array, Array]:
        """Return the slacks of several objectives to their bound, then of the requirements.

        Their derivatives by x are the second result.
        """
        scaled, count = self._scaled_values(x), self._objective_count
        if scaled is None:
            size = len(self._requirement_scales) + self._has_bound * count
            return np.full(size, -_INFEASIBLE_COST), np.zeros((size, len(x)))
        values, derivatives = scaled
        if not self._has_bound:
            return values[count:], derivatives[count:]
        jacobian = np.zeros((len(values), len(x)))
        jacobian[:, :-1] = np.vstack([-derivatives[:count], derivatives[count:]])
        jacobian[:count, -1] = 1.0
        return np.concatenate([x[-1] - values[:count], values[count:]]), jacobian
