"""Base parameters: identifiable combinations of the parameters of a machine."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from crane.closure.coordinates import Indices
from crane.common.errors import ClosureError, InputError
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array, independent_rows
from crane.identification.mechanics.identification_model import IdentificationModel
from crane.identification.mechanics.model_terms import MotionSamples
from crane.motion.workspaces.workspace_mapping import stroke_limits

_RANK_TOLERANCE = 1e-8  # independent part of a column, relative to its norm
_ZERO_TOLERANCE = 1e-10  # norm of a zero column, relative to the largest
HALF_TURN = 1.0  # [rad] from home to the limits of joints without limits
# order in which parameters are preferred as base parameters
_PREFERENCE_ORDER = {
    "Izz": 0,
    "mx": 1,
    "my": 1,
    "mz": 2,
    "Ixx": 3,
    "Ixy": 3,
    "Ixz": 3,
    "Iyz": 3,
    "Iyy": 4,
    "m": 5,
}


@dataclass(frozen=True, eq=False, repr=False)
class BaseParameters(OneLineRepr):
    """Smallest set of parameters with the same effect: W beta = W[:, independent] K beta.

    Attributes:
        names: (p,) names of all parameters.
        independent: (r,) columns of W of the base parameters.
        grouping: (r, p) matrix K: base parameters are K beta; identity in the independent columns.
        unobservable: Names of parameters without an effect.
        units: (p,) scales of the parameters: 1, l and l^2 for a body of 1 kg and the
            characteristic length l; for others the value with the same largest force.
    """

    names: tuple[str, ...]
    independent: Indices
    grouping: Array
    unobservable: tuple[str, ...]
    units: Array

    @property
    def rank(self) -> int:
        """Number of base parameters."""
        return len(self.independent)

    def identifiable_part(self, rows: Array) -> "BaseParameters":
        """Identifiable part of the base parameters for a motion with the rows (m, r).

        Columns with a large independent part are taken first: in another order many columns with a
        small independent part may together be dependent.
        """
        names, units = [self.names[i] for i in self.independent], self.units[self.independent]
        identifiable = group_parameters(names, rows, units, _pivot_order(rows).index)
        if identifiable.rank == self.rank:
            return self
        independent = self.independent[identifiable.independent]
        grouping = identifiable.grouping @ self.grouping
        return BaseParameters(self.names, independent, grouping, self.unobservable, self.units)

    @property
    def groups(self) -> tuple[str, ...]:
        """Text of each base parameter, such as "link7.mx + 0.22 payload.m"."""
        out = []
        for row, first in zip(self.grouping, self.independent, strict=True):
            text = self.names[first]
            for i in np.setdiff1d(np.flatnonzero(row), [first]):
                factor = "" if abs(abs(row[i]) - 1) < 1e-9 else f"{abs(row[i]):.6g} "
                text += f" {'-' if row[i] < 0 else '+'} {factor}{self.names[i]}"
            out.append(text)
        return tuple(out)

    def values(self, parameters: Array) -> Array:
        """Base parameters (r,) for parameters (p,)."""
        return self.grouping @ parameters


def random_samples(model: IdentificationModel, count: int, seed: int = 0) -> MotionSamples:
    """Random closed configurations within the strokes, with velocities and accelerations.

    Raises:
        InputError: The loops do not close within the limits.
    """
    machine, rng = model.machine, np.random.default_rng(seed)
    lower, upper = stroke_limits(machine, HALF_TURN)
    q_a: list[Array] = []
    for _ in range(20 * count):
        trial = rng.uniform(lower, upper)
        try:
            machine.closure.solve(trial)
        except ClosureError:
            continue
        q_a.append(trial)
        if len(q_a) == count:
            break
    if len(q_a) < count:
        raise InputError(
            f"the loops of '{machine.name}' close in {len(q_a)} of {20 * count} random "
            "configurations within its limits, narrow the limits"
        )
    # velocities are scaled by the ranges, so that columns are comparable
    span, characteristic_time = upper - lower, machine.closure.characteristic_time
    v_a, a_a = (
        size * span * rng.normal(size=(count, len(lower)))
        for size in (1.0 / characteristic_time, 3.0 / characteristic_time**2)
    )
    return model.samples(np.array(q_a), v_a, a_a, characteristic_time)


def base_parameters(
    model: IdentificationModel,
) -> BaseParameters:
    """Compute the base parameters of a model numerically (Gautier, 1991).

    The columns of W for random closed configurations are taken one by one, those of Izz, mx, my
    and of distal bodies first; a column that depends on those before it is grouped with them.

    Args:
        model: The model.
        samples: Samples of a motion; default random samples within the strokes.
        seed: Seed of the random samples.

    Raises:
        InputError: The loops do not close within the limits.
    """
    p, n = len(model.names), len(model.machine.active)
    samples = random_samples(model, max(60, 4 * p // n))
    closure, bodies = model.machine.closure, 10 * len(model.bodies)
    # forces as virtual work per 1 rad or characteristic length, to compare drives
    rows = (model.regressor(samples) * closure.units[closure.active, None]).reshape(-1, p)
    units = np.ones(p)
    body = [1.0, *[closure.characteristic_length] * 3, *[closure.characteristic_length**2] * 6]
    units[:bodies] = np.tile(body, len(model.bodies))
    norms = np.linalg.norm(rows, axis=0) * units
    if norms[bodies:].any():  # other parameters are compared among themselves
        units[bodies:] = norms[:bodies].max(initial=0.0) / norms[bodies:].max() or 1.0

    def preference(column: int) -> tuple[int, int, int]:
        if column >= bodies:  # after those of bodies, distal ones first
            return (1, 0, column)
        return (0, _PREFERENCE_ORDER[model.names[column].rpartition(".")[2]], -column)

    return group_parameters(model.names, rows, units, preference)


def group_parameters(
    names: Sequence[str],
    rows: Array,
    units: Array,
    preference: Callable[[int], Any] = lambda column: column,
) -> BaseParameters:
    """Base parameters of a regressor (m, p) with units (p,); small preference values first.

    A column is independent if its part orthogonal to the chosen ones exceeds 1e-8 of its norm.
    """
    norms = np.linalg.norm(rows, axis=0)
    zero = norms * units <= _ZERO_TOLERANCE * (norms * units).max(initial=0.0)
    scaled = rows / np.where(zero, 1.0, norms)
    order = np.array(sorted(np.flatnonzero(~zero).tolist(), key=preference), dtype=np.intp)
    independent = np.sort(order[independent_rows(scaled[:, order].T, _RANK_TOLERANCE)])
    q, r = np.linalg.qr(scaled[:, independent])
    share = np.linalg.solve(r, q.T @ scaled)
    share[np.abs(share) < 1e-9] = 0.0
    grouping = share * np.where(zero, 0.0, norms) / norms[independent][:, None]
    grouping[:, independent] = np.eye(len(independent))
    unobservable = tuple(name for name, nothing in zip(names, zero, strict=True) if nothing)
    return BaseParameters(tuple(names), independent, grouping, unobservable, units)


def _pivot_order(columns: Array) -> list[int]:
    """Order of the columns by their independent parts, for columns of length one.

    It is pivoting (Businger, Golub, 1965) that takes the first column with at least half of the
    largest independent part, so that rounding does not decide between equal ones.
    """
    norms = np.linalg.norm(columns, axis=0)
    rest, order = columns / np.where(norms, norms, 1.0), list[int]()
    for _ in norms:
        remaining = np.linalg.norm(rest, axis=0)
        remaining[order] = -1.0
        order.append(int(np.argmax(remaining >= 0.5 * remaining.max())))
        if length := remaining[order[-1]]:
            direction = rest[:, order[-1]] / length
            rest -= np.outer(direction, direction @ rest)
    return order
