"""Mass and centre of mass of a load from a recording of a machine that is known."""

from dataclasses import dataclass

import numpy as np

from crane.dynamics import Dynamics
from crane.errors import InputError, RecordingError
from crane.identification.base import Base
from crane.identification.checks import check_forces
from crane.identification.feasible import body_parameters, pseudo_inertia
from crane.identification.identify import identify, motion_of
from crane.identification.model import PER_BODY, Samples
from crane.identification.result import Comparison
from crane.identification.signals import Motion
from crane.machine import Machine
from crane.recording import Recording
from crane.samples import Array, Brief

_TOLD = 1e-6  # what of a direction may be missing from those that forces tell


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
        rows = self._dynamics.regressor(at.q_a, at.v_a, at.a_a)
        return rows[:, :, self._columns] @ self._turn


@dataclass(frozen=True, eq=False, repr=False)
class PayloadEstimate(Brief):
    """A load on a frame.

    Attributes:
        frame: A link of the machine.
        mass: [kg].
        com: (3,) centre of mass in the frame [m]; nan along axes that the motion does not tell.
        covariance: (4, 4) of mass and com, to first order; nan as `com`.
        freedom: Degrees of freedom behind it.
        directions: (k, 3) orthonormal directions of the frame along which the motion tells where
            the centre of mass is.
        fit: What of the forces is not the machine's, and what the load explains.
    """

    frame: str
    mass: float
    com: Array
    covariance: Array
    freedom: float
    directions: Array
    fit: Comparison

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

    def to_text(self) -> str:
        """A table of mass and centre of mass."""
        lines = [f"load on {self.frame}", f"{'':<8}{'value':>12}{'std':>11}   95 % interval"]
        values, names = np.append(self.mass, self.com), ("mass", "com x", "com y", "com z")
        units = ("kg", "m", "m", "m")
        std = np.sqrt(np.diag(self.covariance))
        rows = zip(names, units, values, std, self.interval(), strict=True)
        for name, unit, value, deviation, (low, high) in rows:
            if np.isnan(value):
                lines.append(f"{name:<8}{'-':>12}   not told by this motion")
                continue
            lines.append(
                f"{name:<8}{value:>12.5g}{deviation:>11.2g}   {low:.5g} to {high:.5g} {unit}"
            )
        if self.interval()[0, 0] <= 0:
            lines.append("the mass may be zero: do not trust its centre")
        lines.append(
            f"forces left unexplained: {100 * self.fit.stacked:.3g} % of the load's share"
        )
        return "\n".join(lines) + "\n"


def estimate_payload(
    machine: Machine,
    recording: Recording | Motion,
    frame: str | None = None,
    method: str = "wls",
    inertia: bool = True,
    trust: bool = False,
) -> PayloadEstimate:
    """What a machine carries, from the forces that are not its own.

    tau_A - (M_A a_A + bias + friction) = Y_b T phi, with Y_b the columns of the body that the
    frame is on, phi the load's ten parameters about the frame, T their change of frame. The
    machine counts as known: its errors are not in the standard deviations.

    Args:
        machine: Without the load, identified.
        recording: With the load, moving.
        frame: What it is fixed to; the tip if not given.
        method: As of `identify`.
        inertia: Whether the load's inertia about the frame is estimated too, or neglected.
        trust: As of `identify`.

    Raises:
        InputError: An unknown frame or method, or one that does not move.
        RecordingError: A recording that cannot serve, or does not tell the mass.
    """
    if frame is None and machine.tip is None:
        raise InputError(f"'{machine.name}' has no tip, give the frame that holds the load")
    frame = frame or str(machine.tip)
    if isinstance(recording, Motion):
        motion = recording
    else:
        motion = motion_of(machine, recording, trust=trust)
    load = Load(machine, frame, inertia)
    own = Dynamics(machine).inverse(motion.q, motion.v, motion.a, friction=True)
    moves = np.flatnonzero(np.ptp(motion.v, axis=0) > 0)
    names = [machine.active[i] for i in moves]
    parts = (x[:, moves] for x in (motion.q, motion.v, motion.a, motion.tau))
    check_forces(Motion(motion.time, *parts), own[:, moves], names, trust=trust)
    rest = Motion(motion.time, motion.q, motion.v, motion.a, motion.tau - own)
    bare = machine.replace(friction={}, forces=(), gas_springs=(), end_stops=())
    result = identify(bare, rest, method=method, terms=[load])
    told, directions = _told(result.base)
    if not told[:, 0].any():
        raise RecordingError("this motion does not tell the mass, move all joints")
    mass, *first = (told.T @ result.values).tolist()
    com = np.where(told[:, 1:].any(axis=0), np.array(first) / mass, np.nan)
    change = np.eye(4)  # derivatives of mass and com by mass and first moments
    change[1:] /= mass
    change[1:, 0] = -np.nan_to_num(com) / mass
    covariance = change @ (told.T @ result.covariance @ told) @ change.T
    unknown = np.append(False, np.isnan(com))
    covariance[unknown] = covariance[:, unknown] = np.nan
    return PayloadEstimate(
        frame, mass, com, covariance, result.estimate.freedom, directions, result.training
    )


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
