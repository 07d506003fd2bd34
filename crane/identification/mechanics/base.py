"""Base parameters: what of a machine's parameters can be told from its drives' forces."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from crane.closure.structure import Indices
from crane.common.errors import ClosureError, InputError
from crane.common.samples import Array
from crane.common.shown import Brief
from crane.identification.mechanics.model import Model
from crane.identification.mechanics.term import Samples
from crane.machine import Machine

_RANK = 1e-8  # of a column's norm, what of it must be new
_NOTHING = 1e-10  # of the largest norm, below which a column is zero
_SPAN = 1.0  # [rad], [machine's size] of joints without limits
# Preferred as base parameters, first: what is told from one axis before what needs many.
_ORDER = {
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
class Base(Brief):
    """The smallest set of parameters with the same effect: W beta = W[:, independent] K beta.

    Attributes:
        names: (p,) of all parameters.
        independent: (r,) columns of W that carry the base parameters.
        grouping: K (r, p): base parameters are K beta; identity in the independent columns.
        unobservable: Names of parameters without any effect.
        units: (p,) to compare parameters with: of a body of 1 kg in a machine of size l 1, l and
            l^2; of friction and the like what makes as much force at most.
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

    def narrowed(self, rows: Array) -> "Base":
        """What of the base parameters a motion tells, rows (m, r) of their columns.

        Of the columns those are taken first of which much is new: taken in another order, many
        of which a little is new may together hold nothing new.
        """
        names, units = [self.names[i] for i in self.independent], self.units[self.independent]
        order = _newest_first(rows)
        told = group(names, rows, units, order.index)
        if told.rank == self.rank:
            return self
        independent = self.independent[told.independent]
        grouping = told.grouping @ self.grouping
        return Base(self.names, independent, grouping, self.unobservable, self.units)

    @property
    def groups(self) -> tuple[str, ...]:
        """Each base parameter in words, such as "link7.mx + 0.22 payload.m"."""
        out = []
        for row, first in zip(self.grouping, self.independent, strict=True):
            others = []
            for i, (share, name) in enumerate(zip(row, self.names, strict=True)):
                if share != 0 and i != first:
                    factor = "" if abs(abs(share) - 1) < 1e-9 else f"{abs(share):.6g} "
                    others.append(f"{'-' if share < 0 else '+'} {factor}{name}")
            out.append(" ".join([self.names[first], *others]))
        return tuple(out)

    def values(self, parameters: Array) -> Array:
        """Base parameters (r,) of parameters (p,)."""
        return self.grouping @ parameters


def random_samples(model: Model, count: int, seed: int = 0) -> Samples:
    """Closed postures all over the strokes, with random velocities and accelerations.

    Raises:
        InputError: The loops close nowhere within the limits.
    """
    machine, rng = model.machine, np.random.default_rng(seed)
    lower, upper = strokes(machine)
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
            f"the loops of '{machine.name}' close in {len(q_a)} of {20 * count} random postures "
            "within its limits, narrow the limits"
        )
    # joints that move little per coordinate are moved faster, so that all columns are alike
    span, pace = upper - lower, machine.closure.pace
    v_a, a_a = (
        size * span * rng.normal(size=(count, len(lower))) for size in (1.0 / pace, 3.0 / pace**2)
    )
    return model.samples(np.array(q_a), v_a, a_a, pace)


def strokes(machine: Machine) -> tuple[Array, Array]:
    """Limits of the active joints; those without are taken around home."""
    home = machine.home[machine.closure.active]
    span = machine.upper - machine.lower
    endless, around = ~np.isfinite(span), _SPAN * machine.closure.units[machine.closure.active]
    return (
        np.where(endless, home - around, machine.lower),
        np.where(endless, home + around, machine.upper),
    )


def base_parameters(model: Model, samples: Samples | None = None, seed: int = 0) -> Base:
    """Base parameters of a model, numerically (Gautier, 1991).

    The columns of W over random closed postures are taken one by one, those of Izz, mx, my and
    of the last bodies first; one that is a combination of those before it joins their groups.

    Args:
        model: The model.
        samples: A motion, if what it can tell is asked for; all of the strokes if not given.
        seed: Of the random postures.

    Raises:
        InputError: The loops close nowhere within the limits.
    """
    p, n = len(model.names), len(model.machine.active)
    if samples is None:
        samples = random_samples(model, max(60, 4 * p // n), seed)
    closure, bodies = model.machine.closure, 10 * len(model.bodies)
    # forces as virtual work per 1 rad and the machine's size, so that drives compare
    rows = (model.regressor(samples) * closure.units[closure.active, None]).reshape(-1, p)
    units = np.ones(p)
    body = [1.0, *[closure.size] * 3, *[closure.size**2] * 6]
    units[:bodies] = np.tile(body, len(model.bodies))
    norms = np.linalg.norm(rows, axis=0) * units
    if norms[bodies:].any():  # friction and the like compare among themselves
        units[bodies:] = norms[:bodies].max(initial=0.0) / norms[bodies:].max() or 1.0
    return group(model.names, rows, units, lambda column: _preference(model, column))


def group(
    names: Sequence[str],
    rows: Array,
    units: Array,
    preference: Callable[[int], Any] = lambda column: column,
) -> Base:
    """Base parameters of a regressor (m, p) and units (p,), columns of small preference first.

    A column counts if what is new of it exceeds 1e-8 of its norm.
    """
    norms = np.linalg.norm(rows, axis=0)
    zero = norms * units <= _NOTHING * (norms * units).max(initial=0.0)
    scaled = rows / np.where(zero, 1.0, norms)
    chosen: list[int] = []
    directions = np.empty((len(rows), 0))
    for i in sorted(np.flatnonzero(~zero).tolist(), key=preference):
        rest = scaled[:, i]
        for _ in range(2):  # twice is enough (Kahan, Parlett)
            rest = rest - directions @ (directions.T @ rest)
        length = np.linalg.norm(rest)
        if length > _RANK:
            chosen.append(i)
            directions = np.column_stack([directions, rest / length])
    independent = np.array(sorted(chosen), dtype=np.intp)
    q, r = np.linalg.qr(scaled[:, independent])
    share = np.linalg.solve(r, q.T @ scaled)
    share[np.abs(share) < 1e-9] = 0.0
    grouping = share * np.where(zero, 0.0, norms) / norms[independent][:, None]
    grouping[:, independent] = np.eye(len(independent))
    gone = tuple(name for name, nothing in zip(names, zero, strict=True) if nothing)
    return Base(tuple(names), independent, grouping, gone, units)


def _newest_first(columns: Array) -> list[int]:
    """Columns in the order of what is new of them, as of columns of length one.

    As with pivoting (Businger, Golub, 1965), but the first of those of which at least half as
    much is new as of any, so that rounding does not choose among those of which as much is.
    """
    norms = np.linalg.norm(columns, axis=0)
    rest, order = columns / np.where(norms, norms, 1.0), list[int]()
    for _ in norms:
        new = np.linalg.norm(rest, axis=0)
        new[order] = -1.0
        order.append(int(np.argmax(new >= 0.5 * new.max())))
        if length := new[order[-1]]:
            direction = rest[:, order[-1]] / length
            rest -= np.outer(direction, direction @ rest)
    return order


def _preference(model: Model, column: int) -> tuple[int, int, int]:
    """Bodies before other parameters of the same effect, distal ones first."""
    bodies = 10 * len(model.bodies)
    if column >= bodies:
        return (1, 0, column)
    kind = model.names[column].rpartition(".")[2]
    return (0, _ORDER[kind], -column)
