"""What acts on a frame: a unit of a load, or of a force in a direction."""

from dataclasses import dataclass

import numpy as np

from crane.common.errors import InputError
from crane.common.samples import Array
from crane.dynamics.frames import FrameJacobians
from crane.dynamics.statics import AtRest
from crane.machine import Machine
from crane.motion.workspaces.section import Section, upwards


@dataclass(frozen=True)
class Fixed:
    """A unit e that does not depend on the posture, but turns with the slewing joint.

    Attributes:
        way: (3,) e where the slewing joint is at home, in the world: a direction [1] of a force
            [N]; gravity [m/s2] of a load [kg].
        up: (3,) about which it slews.
        weight: Whether it is one, which leans with the ground.
    """

    way: Array
    up: Array
    weight: bool = False

    def unit(self, at: AtRest, angles: Array) -> Array:
        """What acts per magnitude (N, 3), with the machine slewed by angles (N,) from home."""
        return turned(np.broadcast_to(self.way, at.tip.shape), self.up, angles)

    def change(self, at: AtRest, by: AtRest, angles: Array) -> Array:
        """Its derivatives (N, 3), with those of the machine."""
        return np.zeros_like(at.tip)


@dataclass(frozen=True)
class Along:
    """The unit force along the frame's path as one stroke moves alone, or across it.

        e = sign u / |u|,   u = dp/dq_i;   across: e = sign n x u / |u|,

    with n across the section. Where the stroke turns the frame about a pin, u is the tangent of
    the circle about it.

    Attributes:
        stroke: Among the active joints.
        sign: 1 or -1.
        up: (3,) about which it slews.
        across: (3,) n where the slewing joint is at home; none along the path.
    """

    stroke: int
    sign: float
    up: Array
    across: Array | None = None
    weight = False

    def unit(self, at: AtRest, angles: Array) -> Array:
        """See `Fixed`; not a number where the frame does not move."""
        way = at.ways[:, :, self.stroke]
        with np.errstate(invalid="ignore", divide="ignore"):
            return self._out(way / np.linalg.norm(way, axis=1, keepdims=True), angles)

    def change(self, at: AtRest, by: AtRest, angles: Array) -> Array:
        """See `Fixed`."""
        way, moved = at.ways[:, :, self.stroke], by.ways[:, :, self.stroke]
        length = np.linalg.norm(way, axis=1, keepdims=True)
        with np.errstate(invalid="ignore", divide="ignore"):
            way = way / length
            return self._out((moved - (way * moved).sum(1, keepdims=True) * way) / length, angles)

    def _out(self, way: Array, angles: Array) -> Array:
        if self.across is not None:
            normal = turned(np.broadcast_to(self.across, way.shape), self.up, angles)
            way = np.cross(normal, way)
        return self.sign * way


Action = Fixed | Along


def load_on(machine: Machine) -> Fixed:
    """A load: what acts per kilogram is gravity.

    Raises:
        InputError: There is none.
    """
    gravity = np.array(machine.model.gravity.linear)
    if not gravity.any():
        raise InputError(f"'{machine.name}' has no gravity, a load has no weight there")
    return Fixed(gravity, upwards(machine), weight=True)


def turned(vectors: Array, up: Array, angles: Array) -> Array:
    """Vectors (N, 3) turned by angles (N,) about a unit vector."""
    cosine, sine = np.cos(angles)[:, None], np.sin(angles)[:, None]
    along = (vectors @ up)[:, None] * up
    return np.asarray(along + cosine * (vectors - along) + sine * np.cross(up, vectors))


def slewed(machine: Machine, frame: str, section: Section, slews: Array) -> Array:
    """Angles (N,) about the vertical from home, of values of the slewing joint; 0 without one."""
    if section.slew is None:
        return np.zeros(len(slews))
    frames, column = FrameJacobians(machine), machine.closure.active[section.slew]
    frames.place(machine.home)
    sense = np.sign(frames.of(frame)[3:, column] @ upwards(machine))
    return np.asarray(sense * (slews - machine.home[column]))
