"""Where a machine was, and how fast, by whichever of its joints were measured.

Coordinates of active joints are taken where they are measured. The others follow from other joints
by closing the machine's loops, velocities by v_A = gamma_A v_B with q_B what was measured.
"""

import re
from collections.abc import Sequence
from functools import cached_property

import numpy as np

from crane.closure import Closure
from crane.common.errors import ClosureError, MechanismError, RecordingError
from crane.common.samples import Array
from crane.description.sensors import VELOCITY, VELOCITY_UNITS
from crane.machine import Machine
from crane.recordings.missing import MissingError
from crane.recordings.pins import pin_slopes
from crane.recordings.recording import derivative
from crane.recordings.sensed import sensed
from crane.recordings.timeseries import TIME, Table, column

_TELLS = 1e-6  # least share of a joint's motion that others do not tell
_SAME = 1e-6  # [rad], [machine's size]
_COMPARED, _SMOOTH = 2000, 200  # samples that are compared, and enough for slopes
_AT_ONCE = 1 << 16  # samples whose postures are held
_SAMPLE = re.compile(r"\(sample (\d+)\)")  # of an error of the closure
_SLACK = 0.1  # of a range, by which sensors may be off


def drives_of(machine: Machine, names: Sequence[str]) -> tuple[str, ...]:
    """Measured joints that determine all others: active ones, then such as tell something new.

    Raises:
        MissingError: They do not determine all.
    """
    drives = telling(machine, names)
    if len(drives) == len(machine.active):
        return drives
    missing = telling(machine, [*drives, *machine.active], first=drives)[len(drives) :]
    others = [x for x in machine.joints if x not in machine.active]
    others = [x for x in others if len(telling(machine, [x], first=drives)) > len(drives)]
    it, are = ("it", "is") if len(missing) == 1 else ("them", "are")
    given = ", ".join(repr(f"{x} [{machine.unit(x)}]") for x in missing)
    also = f", or a joint that moves with {it} ({', '.join(others)})" if others else ""
    text = f"nothing tells where {', '.join(map(repr, missing))} {are}, give {given}{also}"
    raise MissingError(text, missing)


def telling(machine: Machine, names: Sequence[str], first: Sequence[str] = ()) -> tuple[str, ...]:
    """Joints that each tell something that those before do not: the first, active ones, others.

    A joint tells what its row of gamma = dq/dq_A at home has in the directions that the rows
    before it leave open.
    """
    gamma = machine.closure.gamma(machine.home) * _span(machine)
    told = np.zeros((0, len(machine.active)))
    found = []
    measured = [x for x in names if x in machine.joints and x not in first]
    for joint in (*first, *sorted(measured, key=lambda x: x not in machine.active)):
        row = gamma[machine.column(joint)]
        rest = row - told.T @ (told @ row)
        rest -= told.T @ (told @ rest)  # once more for rounding
        size = np.linalg.norm(rest)
        if size > _TELLS * np.linalg.norm(row):
            told = np.vstack([told, rest / size])
            found.append(joint)
    return tuple(found)


def _span(machine: Machine) -> Array:
    """Ranges (n,) of the active coordinates, 1 where they are endless."""
    span = machine.upper - machine.lower
    return np.where(np.isfinite(span), span, 1.0)


class Postures:
    """Where the joints that are used put a machine, at some samples.

    Args:
        machine: What was recorded.
        table: Its quantities.

    Attributes:
        machine: Driven by them.
        drives: Their names.
        chosen: Which samples.
        time: (N,) [s].
    """

    def __init__(self, machine: Machine, table: Table):
        self.table, self.drives = table, drives_of(machine, list(table.units))
        self.chosen = slice(None, None, max(1, len(table.values) // _COMPARED))
        self.time = column(table, TIME)[self.chosen]
        self._measured = machine

    @cached_property
    def machine(self) -> Machine:
        """Driven by what is used."""
        same = set(self.drives) == set(self._measured.active)
        return self._measured if same else self._measured.driven_by(self.drives)

    @cached_property
    def q_b(self) -> Array:
        """(N, n) as measured."""
        machine = self.machine
        columns = [column(self.table, x, machine.unit(x))[self.chosen] for x in machine.active]
        return np.column_stack(columns)

    @cached_property
    def q(self) -> Array:
        """(N, nv) closed."""
        return self.machine.closure.solve(self.q_b)

    def said(self, name: str, q: Array | None = None) -> Array:
        """(N,) of a joint or an inclination in these postures, or in others."""
        q = self.q if q is None else q
        return sensed(self.machine, q, np.zeros_like(q), [name])[name]

    def slope(self, name: str, q: Array, dq: Array) -> Array:
        """(N,) of the same along changes (N, nv) of postures."""
        return sensed(self.machine, q, dq, [name + VELOCITY])[name + VELOCITY]

    @cached_property
    def few(self) -> slice:
        """Samples enough for slopes, which are smooth."""
        return slice(None, None, max(1, len(self.time) // _SMOOTH))

    @cached_property
    def places(self) -> dict[str, tuple[float, float, float]]:
        """Of links on those that carry them [m]."""
        return {joint.child: joint.xyz for joint in self.machine.tree.joints.values()}

    @cached_property
    def pins(self) -> dict[str, Array]:
        """Derivatives of a few postures by the places of pins, see `pin_slopes`."""
        return pin_slopes(self.machine, self.q[self.few])


def joint_motion(machine: Machine, table: Table) -> tuple[Array, Array]:
    """Active coordinates and velocities (N, n) of what a table tells of the machine's joints.

    Raises:
        RecordingError: It does not tell all of them, or what the machine cannot do.
    """
    return motion_by(machine, drives_of(machine, list(table.units)), table)


def motion_by(machine: Machine, drives: tuple[str, ...], table: Table) -> tuple[Array, Array]:
    """Active coordinates and velocities (N, n) from those of the joints that were measured."""
    time = column(table, TIME)
    q_b = np.column_stack([column(table, x, machine.unit(x)) for x in drives])
    v_b = np.empty_like(q_b)
    for x, v, joint in zip(q_b.T, v_b.T, drives, strict=True):
        v[:] = (
            derivative(x, time) if (told := velocity_of(machine, joint, table)) is None else told
        )
    if set(drives) == set(machine.active):
        order = [drives.index(x) for x in machine.active]
        return q_b[:, order], v_b[:, order]
    angles = ", ".join(x for x in drives if x not in machine.active)
    hint = (
        f"see that zero and sign of {angles} are the machine's, and that none of them counts from "
        "the horizon (inclination_LINK)"
    )
    q_a, v_a = np.empty_like(q_b), np.empty_like(v_b)
    try:
        closure = machine.driven_by(drives).closure
    except MechanismError as error:
        raise RecordingError(f"{error}; {hint}") from None
    for start in range(0, len(time), _AT_ONCE):
        some = slice(start, start + _AT_ONCE)
        try:
            q_a[some], v_a[some], off = _driven(machine, closure, q_b[some], v_b[some])
        except ClosureError as error:
            raise RecordingError(f"{_counted_from(start, error)}; {hint}") from None
        if (off > _SAME).any():
            raise RecordingError(
                f"sample {start + int(np.argmax(off > _SAME))} is beyond a dead centre, where "
                f"{', '.join(machine.active)} do not tell the posture: {hint}, or cut the "
                "recording"
            )
    low, high = q_a.min(axis=0), q_a.max(axis=0)
    slack = _SLACK * _span(machine)
    computed = np.array([x not in drives for x in machine.active])
    outside = (low < machine.lower - slack) | (high > machine.upper + slack)
    for i in np.flatnonzero(computed & outside):
        raise RecordingError(
            f"by {angles} '{machine.active[i]}' goes from {low[i]:.4g} to {high[i]:.4g} "
            f"{machine.unit(machine.active[i])}, its limits are {machine.lower[i]:.4g} and "
            f"{machine.upper[i]:.4g}: {hint}"
        )
    for v, joint in zip(v_a.T, machine.active, strict=True):
        if (told := velocity_of(machine, joint, table)) is not None:
            v[:] = told
    return q_a, v_a


def _driven(
    machine: Machine, closure: Closure, q_b: Array, v_b: Array
) -> tuple[Array, Array, Array]:
    """q_A and v_A = gamma_A v_B, and how far from the posture q_A leads (N,).

    Args:
        machine: Driven by q_A.
        closure: Of the same machine driven by q_B.
        q_b: (N, n).
        v_b: (N, n).

    Raises:
        ClosureError: No posture has these coordinates.
    """
    q = closure.solve(q_b)
    gamma = closure.gamma(q)[:, machine.closure.active]
    q_a = q[:, machine.closure.active]
    off = np.abs(machine.closure.solve(q_a) - q).max(axis=1)
    return q_a, np.einsum("nij,nj->ni", gamma, v_b), off


def _counted_from(start: int, error: ClosureError) -> str:
    """What an error says of a block of samples, its samples counted from the first of all."""
    return _SAMPLE.sub(lambda found: f"(sample {start + int(found[1])})", str(error))


def velocity_of(machine: Machine, joint: str, table: Table) -> Array | None:
    """A joint's velocity (N,) where it is recorded."""
    if joint + VELOCITY not in table.units:
        return None
    return column(table, joint + VELOCITY, VELOCITY_UNITS[machine.unit(joint)])
