"""Mass and centre of mass of a load from a recording of a machine that is known."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NoReturn

import numpy as np

from crane.common.errors import InputError, RecordingError, known
from crane.common.samples import Array
from crane.common.threads import on_one_thread
from crane.common.waiting import telling
from crane.dynamics import Dynamics
from crane.identification.estimation.estimators import Estimate, Prior
from crane.identification.estimation.regressor import triangular
from crane.identification.mechanics.against import check_forces
from crane.identification.mechanics.base import Base
from crane.identification.mechanics.checks import doubt
from crane.identification.mechanics.comparison import ForceComparison
from crane.identification.mechanics.equations import Equations, Progress
from crane.identification.mechanics.friction import friction
from crane.identification.mechanics.identify import METHODS, equations_of, in_parts
from crane.identification.mechanics.load import Load, PayloadEstimate
from crane.identification.mechanics.model import Model
from crane.identification.mechanics.reading import smoothed_motion
from crane.identification.mechanics.statics import (
    LEAST_BAND,
    slowed,
    static_mass,
    sticking,
    weights_cutoff,
)
from crane.identification.mechanics.term import Samples
from crane.identification.mechanics.undriven import settled
from crane.identification.signals.motion import Motion
from crane.machine import Machine
from crane.recordings.recording import Recording

_TOLD = 1e-6  # what of a direction may be missing from those that forces tell
_SEGMENTS = 10  # of a recording, that are left out one by one
_ONE_WAY = 0.1  # of a drive's way, that it goes back at least
_VAGUE = 0.1  # of the machine's moving mass, that half of an interval may be at most
_GRAVITY = 9.81  # [m/s^2]


@on_one_thread
def identify_payload(
    machine: Machine,
    recording: Recording | Motion,
    frame: str | None = None,
    method: str = "wls",
    inertia: bool = True,
    trust: bool = False,
    progress: Progress | None = None,
) -> PayloadEstimate:
    """What a machine carries, from the forces that are not its own.

    tau_A - (M_A a_A + bias + friction) = Y_b T phi + sum_j c_j sign(v_j), with Y_b the columns of
    the body that the frame is on, phi the load's ten parameters about the frame, T their change of
    frame, and c_j what Coulomb friction of drive j differs from the described one: it depends on
    load, temperature and wear, and looks like weight where a drive moves one way only. Else the
    machine counts as known; what it is not as described shows as parts of the recording that tell
    different loads, which widens the intervals (delete-one jackknife over ten parts).

    Where that does not tell the mass, the load counts as a point at the frame's origin: one number
    beside friction, by its weight, all low-passed at ten times the motion's frequency.
    Friction of a drive that moved one way only is known there to what the machine describes, or a
    hundredth of the drive's force if that is more. What the forces at rest say otherwise widens
    the interval.

    Args:
        machine: Without the load, identified.
        recording: With the load, moving.
        frame: What it is fixed to; the tip if not given.
        method: As of `identify`.
        inertia: Whether the load's inertia about the frame is estimated too, or neglected.
        trust: As of `identify`.
        progress: Takes the finished share.

    Raises:
        InputError: An unknown frame or method, or one that does not move.
        RecordingError: A recording that cannot serve, or does not tell the mass, or not even to a
            tenth of the machine's own and to itself; or a mass that is surely negative.

    Source: Efron, Stein 1981, Annals of Statistics 9(3), the jackknife.
    """
    progress = telling(progress)
    if method not in METHODS:
        raise InputError(f"method '{method}' is unknown, {known(METHODS, method)}")
    if frame is None and machine.tip is None:
        raise InputError(f"'{machine.name}' has no tip, give the frame that holds the load")
    frame = frame or str(machine.tip)
    motion, progress = recording, in_parts(progress)
    if not isinstance(motion, Motion):
        motion = smoothed_motion(machine, motion, trust=trust, progress=progress)
    moves = np.ptp(motion.v, axis=0) > 0
    names = [joint for joint, moved in zip(machine.active, moves, strict=True) if moved]
    v = slowed(motion).v.T
    one_way = [joint for joint, v in zip(names, v[moves], strict=True) if _one_way(v)]
    case = _Case(machine, frame, motion, method, names, one_way)
    first, why = None, ""
    try:
        first = case.body(10 if inertia else 4, trust, progress)
        if not case.vague(first):
            low, high = first.interval()[0].tolist()
            told = not low <= 0 <= high
            com = np.nan_to_num(first.com)
            _check_mass(first, trust)
            return replace(first, static=case.static(first.friction, com) if told else None)
    except _NotToldError as error:
        why = str(error)
    point = case.point(progress)
    if point is None or case.vague(point):
        _refuse(one_way, first or point, why, case.static({}, np.zeros(3)))
    _check_mass(point, trust)
    return point


class _NotToldError(RecordingError):
    """A motion does not tell the mass."""


@dataclass(frozen=True)
class _Case:
    """A recording of a machine with a load.

    Attributes:
        machine: Without the load.
        frame: That carries it.
        motion: Recorded.
        method: Of the estimate.
        names: Drives that moved.
        one_way: Those that hardly moved back.
    """

    machine: Machine
    frame: str
    motion: Motion
    method: str
    names: Sequence[str]
    one_way: Sequence[str]

    def model(self, count: int) -> Model:
        """The load of so many parameters, and what Coulomb friction is beyond the described."""
        machine, dynamics = self.machine, Dynamics(self.machine)

        def own(at: Samples) -> Array:
            """Forces (N, n) of the machine without the load."""
            return dynamics.at("inverse with friction", at.q, at.v_a, at.a_a)

        bare = machine.replace(friction={}, forces=(), gas_springs=(), ropes=(), end_stops=())
        extra = [friction(bare, joint, ("coulomb",), smoothing=0.0) for joint in self.names]
        return Model(bare, [Load(machine, self.frame, count), *extra], own)

    def body(self, count: int, trust: bool, progress: Progress | None) -> PayloadEstimate:
        """A load of 10 or 4 parameters.

        Raises:
            _NotToldError: The motion does not tell its mass.
        """
        model = self.model(count)
        # weight tells a load: what smoothing takes from the accelerations bounds no bandwidth
        motion = replace(self.motion, passed=math.inf)
        rows, base = equations_of(model, [motion], progress=progress)
        (thinned,) = rows.thinned()
        moves = [self.machine.active.index(joint) for joint in self.names]
        q, v, a, tau = (x[:, moves] for x in (thinned.q, thinned.v, thinned.a, thinned.tau))
        moved = Motion(thinned.time, q, v, a, tau)
        check_forces(moved, rows.offset[:, moves], self.names, trust=trust)
        columns = rows.selection(base)
        rows, found = self._estimated(rows, columns, None)
        told, directions = _told(base)
        if not told[:, 0].any():
            raise _NotToldError("this motion does not tell the mass, move all joints")
        mass, *first = (told.T @ found.values).tolist()
        com = np.where(told[:, 1:].any(axis=0), np.array(first) / mass, np.nan)
        change = np.eye(4)  # derivatives of mass and com by mass and first moments
        change[1:] /= mass
        change[1:, 0] = -np.nan_to_num(com) / mass
        change = change @ told.T
        covariance, freedom = _widened(rows, columns, found, change)
        unknown = np.append(False, np.isnan(com))
        covariance[unknown] = covariance[:, unknown] = np.nan
        names = [base.names[i] for i in base.independent]
        corrections = {
            joint: float(found.values[names.index(f"{joint}.coulomb")])
            for joint in self.names
            if f"{joint}.coulomb" in names and joint not in self.one_way
        }
        fit = self._fit(rows, columns @ found.values)
        return PayloadEstimate(
            self.frame, mass, com, covariance, freedom, directions, corrections, None, fit
        )

    def point(self, progress: Progress | None) -> PayloadEstimate | None:
        """A mass at the frame's origin; None where its weight loads no drive that moved."""
        motion, model = slowed(self.motion), self.model(1)
        if not self._weighs(motion):
            return None
        try:
            rows, base = equations_of(model, [motion], weights_cutoff(motion), progress=progress)
        except RecordingError:  # no row is far enough from standstill
            return None
        columns = rows.selection(base) @ base.grouping
        std = [math.inf]
        for joint in self.names:
            i = self.machine.active.index(joint)
            least = LEAST_BAND * float(np.sqrt(np.mean(motion.tau[:, i] ** 2)))
            band = max(sticking(self.machine, joint), least)
            std.append(band if joint in self.one_way else math.inf)
        prior = np.zeros(len(std)), np.array(std)
        rows, found = self._estimated(rows, columns, prior)
        change = np.zeros((4, len(std)))
        change[0, 0] = 1.0
        covariance, freedom = _widened(rows, columns, found, change, np.diag(1 / prior[1]))
        covariance[1:] = covariance[:, 1:] = np.nan
        nowhere = np.full(3, np.nan)
        corrections = {
            joint: float(value)
            for joint, value in zip(self.names, found.values[1:], strict=True)
            if joint not in self.one_way
        }
        estimate = PayloadEstimate(
            self.frame, float(found.values[0]), nowhere, covariance, freedom, np.zeros((0, 3)),
            corrections, self.static(corrections, np.zeros(3)),
            self._fit(rows, columns @ found.values),
        )  # fmt: skip
        if estimate.static is not None:  # two answers are as uncertain as they are apart
            covariance[0, 0] += (estimate.static[0] - estimate.mass) ** 2
        return estimate

    def _estimated(
        self, rows: Equations, columns: Array, prior: Prior | None
    ) -> tuple[Equations, Estimate]:
        """What rows tell, and they as they tell it."""

        def estimated(values: Array) -> tuple[Estimate, Array]:
            nonlocal rows
            rows = rows.at(values) if self.machine.free else rows
            found = METHODS[self.method](
                rows.columns(columns), rows.y, rows.groups, rows.samples, prior
            )
            return found, columns @ found.values

        nothing = np.zeros(len(columns))
        found = settled(estimated, nothing) if self.machine.free else estimated(nothing)[0]
        return rows, found

    def _weighs(self, motion: Motion) -> bool:
        """Whether the weight of a point loads a drive that moves."""
        load, q = Load(self.machine, self.frame, 1), motion.q[:: max(1, len(motion.q) // 100)]
        at = Model(self.machine, [load]).samples(q, 0 * q, 0 * q)
        moves = [self.machine.active.index(joint) for joint in self.names]
        weight = np.abs(load.columns(at)[:, moves, 0])
        return bool(weight.max(initial=0.0) > _TOLD * _GRAVITY * self.machine.closure.size)

    def _fit(self, rows: Equations, values: Array) -> ForceComparison:
        left = rows.forces - rows.offset
        joints = self.machine.active
        return ForceComparison(rows.time, left, rows.modelled(values), rows.moving, joints)

    def vague(self, estimate: PayloadEstimate) -> bool:
        """Whether an interval is wider than the mass, and than a share of the machine's own."""
        low, high = estimate.interval()[0].tolist()
        own = sum(inertia.mass for inertia in list(self.machine.model.inertias)[1:])
        return not high - low <= 2 * max(abs(estimate.mass), _VAGUE * own)

    def static(self, friction: dict[str, float], com: Array) -> tuple[float, float] | None:
        """See `static_mass`."""
        load = Load(self.machine, self.frame, 4)
        return static_mass(self.machine, load, self.motion, friction, com)


def _widened(
    rows: Equations, columns: Array, found: Estimate, change: Array, pull: Array | None = None
) -> tuple[Array, Array]:
    """Covariance (4, 4) by noise, or by what leaving parts out changes, and its freedom (4,)."""
    covariance = change @ found.covariance @ change.T
    parts = np.diag(change @ _left_out(rows, columns, found.noise, pull) @ change.T)
    more = parts / np.maximum(np.diag(covariance), np.finfo(float).tiny)
    scale = np.sqrt(np.maximum(more, 1.0))
    freedom = np.where(more > 1, _SEGMENTS - 1, found.freedom)
    return covariance * np.outer(scale, scale), freedom


def _check_mass(estimate: PayloadEstimate, trust: bool) -> None:
    """Doubt a mass whose whole interval is negative: something else is wrong.

    Raises:
        RecordingError: It is not trusted.
    """
    low, high = estimate.interval()[0].tolist()
    if high < 0:
        text = (
            f"the mass comes out as {low:.3g} to {high:.3g} kg, and no load weighs less than "
            "nothing: look at signs and units of forces or pressures, and identify the machine "
            "without a load first"
        )
        doubt(text, trust)


def _refuse(
    one_way: Sequence[str],
    estimate: PayloadEstimate | None,
    why: str,
    static: tuple[float, float] | None,
) -> NoReturn:
    if estimate is None:
        raise RecordingError(why)
    low, high = estimate.interval()[0].tolist()
    text = f"this recording does not tell the mass ({low:.3g} to {high:.3g} kg): "
    if one_way:
        names = ", ".join(f"'{joint}'" for joint in one_way)
        text += f"{names} moved one way only, where friction looks like weight, record both ways"
    else:
        text += "its parts tell different loads, identify the machine without a load first"
    if static is not None:
        text += (
            f"; with its centre at '{estimate.frame}' the forces at rest hold {static[0]:.4g} +- "
            f"{static[1]:.2g} kg, by the described friction"
        )
    raise RecordingError(text)


def _left_out(rows: Equations, columns: Array, noise: Array, pull: Array | None) -> Array:
    """Covariance (s, s) of parameters by what leaving out each part of the recording changes.

    Rows of a prior about zero (k, s) belong to all parts.
    """
    size = columns.shape[1]
    known = np.zeros((0, size)) if pull is None else pull
    known = np.column_stack([known, np.zeros(len(known))])
    T = np.zeros((len(columns) + 1, size + 1))
    T[:-1, :-1], T[-1, -1] = columns, 1.0
    parts = rows.segments(_SEGMENTS) @ T / noise[:, None, None]
    found = []
    for i in range(_SEGMENTS):
        R = triangular(np.vstack([np.delete(parts, i, axis=0).reshape(-1, size + 1), known]))
        found.append(np.linalg.lstsq(R[:-1, :-1], R[:-1, -1])[0])
    spread = np.array(found) - np.mean(found, axis=0)
    return np.asarray((_SEGMENTS - 1) / _SEGMENTS * spread.T @ spread)


def _one_way(v: Array) -> bool:
    """Whether a drive of velocity (N,) goes hardly any way back."""
    ways = np.maximum(v, 0).sum(), np.maximum(-v, 0).sum()
    return bool(min(ways) < _ONE_WAY * max(ways))


def _told(base: Base) -> tuple[Array, Array]:
    """Mass and first moments as combinations (r, 4) of base parameters, zero where not told.

    And the directions (k, 3) of first moments that are told. A combination w of parameters is
    told if it is one of the rows of K, so at right angles to all that K does not see.
    """
    K = base.grouping
    share = np.array(np.linalg.lstsq(K.T, np.eye(K.shape[1])[:, :4], rcond=None)[0])
    missing = np.abs(K.T @ share - np.eye(K.shape[1])[:, :4]).max(axis=0)
    share[:, missing > _TOLD] = 0.0
    unseen = np.linalg.svd(K)[2][len(K) :]
    _, sizes, axes = np.linalg.svd(unseen[:, 1:4]) if len(unseen) else (0, np.zeros(3), np.eye(3))
    sizes = np.append(sizes, np.zeros(3 - len(sizes)))
    return share, np.asarray(axes[sizes <= _TOLD])
