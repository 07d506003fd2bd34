"""Mass and centre of mass of a load from a recording of a machine that is known."""

import math
from dataclasses import dataclass, replace
from typing import NoReturn

import numpy as np

from crane.common.errors import InputError, RecordingError, known
from crane.common.samples import Array, Brief
from crane.dynamics import Dynamics
from crane.identification.estimation.regressor import triangular
from crane.identification.mechanics.against import check_forces
from crane.identification.mechanics.base import Base
from crane.identification.mechanics.equations import Equations, Progress
from crane.identification.mechanics.feasible import body_parameters, pseudo_inertia
from crane.identification.mechanics.friction import friction
from crane.identification.mechanics.identify import METHODS, equations_of, in_parts
from crane.identification.mechanics.inertias import PER_BODY, inertial_columns
from crane.identification.mechanics.model import Model
from crane.identification.mechanics.reading import smoothed_motion
from crane.identification.mechanics.result import ForceComparison, aligned
from crane.identification.mechanics.term import Samples
from crane.identification.signals.motion import Motion, moving
from crane.machine import Machine
from crane.recordings.recording import Recording

_TOLD = 1e-6  # what of a direction may be missing from those that forces tell
_SEGMENTS = 10  # of a recording, that are left out one by one
_ONE_WAY = 0.1  # of a drive's way, that it goes back at least
_VAGUE = 0.1  # of the machine's moving mass, that half of an interval may be at most
_REST = 0.05  # of a joint's largest velocity, below which it rests
_RESTS = 0.25  # s of rest, that tell a mass
_LEAST_BAND = 0.01  # of a drive's force, that its friction and its sensor may hide at rest


class Load:
    """A rigid body on a frame: its ten parameters about the frame's origin.

    Args:
        machine: The machine.
        frame: A link of it, which moves.
        inertia: Whether with the six of its inertia, or with mass and first moments only.
    """

    def __init__(self, machine: Machine, frame: str, inertia: bool = True):
        place = machine.model.frames[machine.frame(frame)]
        if place.parentJoint == 0:
            raise InputError(f"frame '{frame}' does not move, choose another")
        first = 10 * (place.parentJoint - 1)
        count = 10 if inertia else 4
        A = place.placement.homogeneous  # P about the joint is A P A^T
        self._turn = body_parameters(A @ pseudo_inertia(np.eye(10)) @ A.T)[:count].T
        self._columns = slice(first, first + 10)
        self._dynamics = Dynamics(machine)
        self.names = tuple(f"load.{key}" for key in PER_BODY[:count])
        self.nominal, self.signs = np.zeros(count), (False,) * count

    def columns(self, at: Samples) -> Array:
        """See `model.Term`."""
        return inertial_columns(self._dynamics, at)[:, :, self._columns] @ self._turn


@dataclass(frozen=True, eq=False, repr=False)
class PayloadEstimate(Brief):
    """A load on a frame.

    Attributes:
        frame: A link of the machine.
        mass: [kg].
        com: (3,) centre of mass in the frame [m]; nan along axes that the motion does not tell.
        covariance: (4, 4) of mass and com, to first order; nan as `com`. The larger of what the
            noise makes and of what leaving out a tenth of the recording changes (jackknife).
        freedom: (4,) degrees of freedom behind each.
        directions: (k, 3) orthonormal directions of the frame along which the motion tells where
            the centre of mass is.
        friction: By drive, Coulomb friction that the machine's own lacks [N], [N m], of those
            that moved both ways.
        static: Mass that the forces at rest tell with that centre of mass, and by how much
            friction may be in it [kg]; None where nothing rests, or the centre is not told.
        fit: What of the forces is not the machine's, and what the load explains.
    """

    frame: str
    mass: float
    com: Array
    covariance: Array
    freedom: Array
    directions: Array
    friction: dict[str, float]
    static: tuple[float, float] | None
    fit: ForceComparison

    @property
    def std_mass(self) -> float:
        """Standard deviation of the mass [kg]."""
        return float(np.sqrt(self.covariance[0, 0]))

    @property
    def std_com(self) -> Array:
        """(3,) standard deviations of the centre of mass [m]."""
        return np.sqrt(np.diag(self.covariance)[1:])

    def interval(self, level: float = 0.95) -> Array:
        """(4, 2) ends of what covers mass and centre of mass with this probability each."""
        from scipy.stats import t

        half = t.ppf(0.5 + 0.5 * level, self.freedom) * np.sqrt(np.diag(self.covariance))
        values = np.append(self.mass, self.com)
        return np.column_stack([values - half, values + half])

    @property
    def doubt(self) -> str:
        """Why the mass should not be believed, "" where nothing is against it."""
        low, high = self.interval()[0].tolist()
        if self.static is None:
            return ""
        mass, band = self.static
        if low - band <= mass <= high + band:
            return ""
        return (
            f"the forces at rest say {mass:.4g} +- {band:.2g} kg (friction): the machine is not "
            "as described, identify it without the load first"
        )

    def to_text(self) -> str:
        """A table of mass and centre of mass."""
        rows = [["", "value", "std", "95 % interval", ""]]
        values, names = np.append(self.mass, self.com), ("mass", "com x", "com y", "com z")
        units = ("kg", "m", "m", "m")
        std = np.sqrt(np.diag(self.covariance))
        table = zip(names, units, values, std, self.interval(), strict=True)
        for name, unit, value, deviation, (low, high) in table:
            if np.isnan(value):
                rows.append([name, "-", "", "not told by this motion", ""])
                continue
            told = f"{low:.5g} to {high:.5g} {unit}"
            rows.append([name, f"{value:.5g}", f"{deviation:.2g}", told, ""])
        lines = [f"load on {self.frame}", *aligned(rows, (0, 3))]
        if self.interval()[0, 0] <= 0:
            lines.append("the mass may be zero: do not trust its centre")
        if self.static is not None:
            lines.append("mass by the forces at rest: {:.5g} +- {:.2g} kg".format(*self.static))
        if self.doubt:
            lines.append(f"do not trust this: {self.doubt}")
        lines.append(
            f"forces left unexplained: {100 * self.fit.stacked:.3g} % of the load's share"
        )
        return "\n".join(lines) + "\n"


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
            tenth of the machine's own and to itself.

    Source: Efron, Stein 1981, Annals of Statistics 9(3), the jackknife.
    """
    if method not in METHODS:
        raise InputError(f"method '{method}' is unknown, {known(METHODS, method)}")
    if frame is None and machine.tip is None:
        raise InputError(f"'{machine.name}' has no tip, give the frame that holds the load")
    frame = frame or str(machine.tip)
    motion, progress = recording, in_parts(progress)
    if not isinstance(motion, Motion):
        motion = smoothed_motion(machine, motion, trust=trust, progress=progress)
    load = Load(machine, frame, inertia)
    moves = np.ptp(motion.v, axis=0) > 0
    names = [joint for joint, moved in zip(machine.active, moves, strict=True) if moved]
    dynamics = Dynamics(machine)

    def own(at: Samples) -> Array:
        """Forces (N, n) of the machine without the load."""
        return dynamics.at("inverse with friction", at.q, at.v_a, at.a_a)

    bare = machine.replace(friction={}, forces=(), gas_springs=(), ropes=(), end_stops=())
    extra = [friction(bare, joint, ("coulomb",), smoothing=0.0) for joint in names]
    model = Model(bare, [load, *extra], own)
    # weight tells a load: what smoothing takes from the accelerations bounds no bandwidth
    rows, base = equations_of(model, [replace(motion, passed=math.inf)], progress=progress)
    (thinned,) = rows.thinned()
    q, v, a, tau = (x[:, moves] for x in (thinned.q, thinned.v, thinned.a, thinned.tau))
    moved = Motion(thinned.time, q, v, a, tau)
    check_forces(moved, rows.offset[:, moves], names, trust=trust)
    columns = rows.selection(base)
    found = METHODS[method](rows.columns(columns), rows.y, rows.groups, rows.samples)
    told, directions = _told(base)
    if not told[:, 0].any():
        raise RecordingError("this motion does not tell the mass, move all joints")
    mass, *first = (told.T @ found.values).tolist()
    com = np.where(told[:, 1:].any(axis=0), np.array(first) / mass, np.nan)
    change = np.eye(4)  # derivatives of mass and com by mass and first moments
    change[1:] /= mass
    change[1:, 0] = -np.nan_to_num(com) / mass
    change = change @ told.T
    covariance = change @ found.covariance @ change.T
    parts = np.diag(change @ _left_out(rows, columns, found.noise) @ change.T)
    more = parts / np.maximum(np.diag(covariance), np.finfo(float).tiny)
    scale = np.sqrt(np.maximum(more, 1.0))
    covariance *= np.outer(scale, scale)
    unknown = np.append(False, np.isnan(com))
    covariance[unknown] = covariance[:, unknown] = np.nan
    freedom = np.where(more > 1, _SEGMENTS - 1, found.freedom)
    there = {base.names[i]: float(x) for i, x in zip(base.independent, found.values, strict=True)}
    one_way = [joint for joint, v in zip(names, motion.v.T[moves], strict=True) if _one_way(v)]
    corrections = {
        joint: there[f"{joint}.coulomb"]
        for joint in names
        if f"{joint}.coulomb" in there and joint not in one_way
    }
    estimate = PayloadEstimate(
        frame, mass, com, covariance, freedom, directions, corrections, None,
        ForceComparison(
            rows.time, rows.forces - rows.offset, rows.modelled(columns @ found.values),
            rows.moving, machine.active,
        ),
    )  # fmt: skip
    low, high = estimate.interval()[0].tolist()
    own_mass = sum(inertia.mass for inertia in list(machine.model.inertias)[1:])
    if not high - low <= 2 * max(abs(mass), _VAGUE * own_mass):
        _refuse(one_way, estimate, _static(machine, load, motion, corrections, np.zeros(3)))
    if low <= 0 <= high:
        return estimate
    static = _static(machine, load, motion, corrections, np.nan_to_num(com))
    return replace(estimate, static=static)


def _refuse(
    one_way: list[str], estimate: PayloadEstimate, static: tuple[float, float] | None
) -> NoReturn:
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


def _static(
    machine: Machine, load: Load, motion: Motion, friction: dict[str, float], com: Array
) -> tuple[float, float] | None:
    """Mass by the forces at rest, and how much friction may hold of it; None if nothing rests.

    Each drive counts by its friction, described and found, as by a standard deviation.
    """
    step = float(motion.time[1] - motion.time[0])
    still = ~moving(motion.v, _REST * np.abs(motion.v).max(axis=0)).any(axis=1)
    edges = np.flatnonzero(np.diff(still.astype(np.int8), prepend=0, append=0))
    runs = [(i, j) for i, j in edges.reshape(-1, 2).tolist() if (j - i) * step >= _RESTS]
    if not runs:
        return None
    q = np.array([motion.q[i:j].mean(axis=0) for i, j in runs])
    tau = np.array([motion.tau[i:j].mean(axis=0) for i, j in runs])
    zero = np.zeros_like(q)
    tau = tau - Dynamics(machine).inverse(q, zero, zero)
    at = Model(machine, [load]).samples(q, zero, zero)
    each = load.columns(at)[:, :, :4] @ np.append(1.0, com)
    band = np.array([_sticking(machine, joint) for joint in machine.active])
    band += [abs(friction.get(joint, 0.0)) for joint in machine.active]
    band = np.maximum(band, _LEAST_BAND * np.sqrt(np.mean(motion.tau**2, axis=0)))
    information = ((each / band) ** 2).sum()
    if not information > 0:
        return None
    mass = float((each * tau / band**2).sum() / information)
    # where drives disagree by more than their friction, what they say is worth less
    misfit = float((((tau - each * mass) / band) ** 2).sum()) / max(each.size - 1, 1)
    return mass, float(np.sqrt(max(misfit, 1.0) * len(runs) / information))


def _sticking(machine: Machine, joint: str) -> float:
    """Largest friction of a joint at rest [N], [N m]."""
    law = machine.friction.get(joint)
    return 0.0 if law is None else law.coulomb + law.stiction + abs(law.coulomb_offset)


def _left_out(rows: Equations, columns: Array, noise: Array) -> Array:
    """Covariance (s, s) of parameters by what leaving out each part of the recording changes."""
    size = columns.shape[1]
    T = np.zeros((len(columns) + 1, size + 1))
    T[:-1, :-1], T[-1, -1] = columns, 1.0
    parts = rows.segments(_SEGMENTS) @ T / noise[:, None, None]
    found = []
    for i in range(_SEGMENTS):
        R = triangular(np.delete(parts, i, axis=0).reshape(-1, size + 1))
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
