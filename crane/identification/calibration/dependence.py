"""What is left of a calibration, and what of the motion it depends on.

A model that lacks something leaves a residual that goes with the speed (viscous, orifices), with
the pressure (areas, moduli, leakage) or with the direction of motion (friction, one orifice of
four). How much of it does is the correlation ratio (Pearson 1905): with the samples in groups g of
about the same x, n_g of mean m_g, of N of mean m,

    share = sum_g n_g (m_g - m)^2 / sum_t (r_t - m)^2.

As many samples as a recording has make it small by chance; few motions do not: eight groups of
one stroke each are eight numbers.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crane.common.samples import Array
from crane.common.shown import Brief
from crane.description.sensors import PRESSURE, VELOCITY, VELOCITY_UNITS
from crane.identification.calibration.result import Calibration, Channel

_GROUPS = 8  # of about as many samples each
_RESTS = 0.02  # of the largest speed, below which a drive stands


@dataclass(frozen=True, eq=False, repr=False)
class Left(Brief):
    """What is left of a channel over what was fitted, and the motion of a drive.

    Attributes:
        name: Of the channel.
        unit: Its unit.
        residual: (N,) simulated less measured.
        drive: Joint whose motion it is held against.
        rate: Unit of its speed.
        chamber: "a" or "b", whose pressure that is.
        motion: (N,) each: speed, pressure, direction (-1, 0 at rest, 1).
        shares: Of the residual's variance that goes with each of these.
    """

    name: str
    unit: str
    residual: Array
    drive: str
    rate: str
    chamber: str
    motion: Mapping[str, Array]
    shares: Mapping[str, float]


def left_over(found: Calibration) -> list[Left]:
    """What is left of every channel that was fitted, recordings together.

    A channel is held against the drive that its name has, else against that with whose speed it
    goes best. Empty for a machine without valves.
    """
    channels: dict[str, list[Channel]] = {}
    for channel in found.sensors:
        if channel.train.any() and channel.recording in found.states:
            channels.setdefault(channel.name, []).append(channel)
    every = []
    for name, some in channels.items():
        drives = [x.removesuffix(VELOCITY) for x in found.states[some[0].recording]
                  if x.endswith(VELOCITY)]  # fmt: skip
        own = [drive for drive in drives if f"_{drive}_" in f"_{name}_"]
        tried = [_against(found, some, x) for x in ([max(own, key=len)] if own else drives)]
        every += [max(tried, key=lambda one: one.shares["speed"])] if tried else []
    return every


def groups(x: Array) -> list[NDArray[np.intp]]:
    """Samples (N,) by x: groups of about the same size; where x has few values, one each."""
    values = np.unique(x)
    if len(values) <= _GROUPS:
        return [np.flatnonzero(x == value) for value in values]
    return list(np.array_split(np.argsort(x, kind="stable"), _GROUPS))


def share(residual: Array, x: Array) -> float:
    """Of the variance of a residual (N,) that goes with x (N,), 0 to 1."""
    off = residual - residual.mean()
    whole = float(off @ off)
    part = sum(len(some) * float(off[some].mean()) ** 2 for some in groups(x))
    return part / whole if whole else 0.0


def _against(found: Calibration, some: list[Channel], drive: str) -> Left:
    """Channels of one name, held against the motion of a drive."""
    name, unit = some[0].name, some[0].unit
    chamber = "b" if name == f"{PRESSURE}{drive}_b" else "a"

    def joined(column: str) -> Array:
        return np.concatenate([found.states[x.recording][column][x.train] for x in some])

    residual = np.concatenate([(x.after - x.measured)[x.train] for x in some])
    speed, pressure = joined(drive + VELOCITY), joined(f"{PRESSURE}{drive}_{chamber}")
    moves = np.abs(speed) > _RESTS * np.abs(speed).max()
    motion = {"speed": speed, "pressure": pressure, "direction": np.sign(speed) * moves}
    shares = {what: share(residual, x) for what, x in motion.items()}
    rate = VELOCITY_UNITS[found.machine.unit(drive)]
    return Left(name, unit, residual, drive, rate, chamber, motion, shares)
