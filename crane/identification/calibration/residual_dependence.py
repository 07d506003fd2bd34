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

from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array
from crane.description.sensors import PRESSURE_PREFIX, VELOCITY_SUFFIX, VELOCITY_UNITS
from crane.identification.calibration.calibration_result import Calibration, CalibrationChannel

_MAX_GROUPS = 8  # of about as many samples each
_REST_SPEED_SHARE = 0.02  # of the largest speed, below which a drive stands


@dataclass(frozen=True, eq=False, repr=False)
class ResidualDependence(OneLineRepr):
    """What is left of a channel over what was fitted, and the motion of a drive.

    Attributes:
        name: Of the channel.
        unit: Its unit.
        residual: (N,) simulated less measured.
        drive: Joint whose motion it is held against.
        speed_unit: Unit of its speed.
        chamber: "a" or "b", whose pressure that is.
        motion: (N,) each: speed, pressure, direction (-1, 0 at rest, 1).
        correlation_ratios: Of the residual's variance that goes with each of these.
    """

    name: str
    unit: str
    residual: Array
    drive: str
    speed_unit: str
    chamber: str
    motion: Mapping[str, Array]
    correlation_ratios: Mapping[str, float]


def residual_dependences(calibration: Calibration) -> list[ResidualDependence]:
    """What is left of every channel that was fitted, recordings together.

    A channel is held against the drive that its name has, else against that with whose speed it
    goes best. Empty for a machine without valves.
    """
    channels: dict[str, list[CalibrationChannel]] = {}
    for channel in calibration.channels:
        if channel.train_mask.any() and channel.recording in calibration.states:
            channels.setdefault(channel.name, []).append(channel)
    dependences = []
    for name, same_name in channels.items():
        drives = [
            x.removesuffix(VELOCITY_SUFFIX)
            for x in calibration.states[same_name[0].recording]
            if x.endswith(VELOCITY_SUFFIX)
        ]
        named_drives = [drive for drive in drives if f"_{drive}_" in f"_{name}_"]
        options = [
            _residual_dependence(calibration, same_name, x)
            for x in ([max(named_drives, key=len)] if named_drives else drives)
        ]
        dependences += (
            [max(options, key=lambda one: one.correlation_ratios["speed"])] if options else []
        )
    return dependences


def group_samples(x: Array) -> list[NDArray[np.intp]]:
    """Samples (N,) by x: groups of about the same size; where x has few values, one each."""
    values = np.unique(x)
    if len(values) <= _MAX_GROUPS:
        return [np.flatnonzero(x == value) for value in values]
    return list(np.array_split(np.argsort(x, kind="stable"), _MAX_GROUPS))


def correlation_ratio(residual: Array, x: Array) -> float:
    """Of the variance of a residual (N,) that goes with x (N,), 0 to 1."""
    deviation = residual - residual.mean()
    total = float(deviation @ deviation)
    explained = sum(len(some) * float(deviation[some].mean()) ** 2 for some in group_samples(x))
    return explained / total if total else 0.0


def _residual_dependence(
    calibration: Calibration, channels: list[CalibrationChannel], drive: str
) -> ResidualDependence:
    """Channels of one name, held against the motion of a drive."""
    name, unit = channels[0].name, channels[0].unit
    chamber = "b" if name == f"{PRESSURE_PREFIX}{drive}_b" else "a"

    def joined(column: str) -> Array:
        return np.concatenate(
            [calibration.states[x.recording][column][x.train_mask] for x in channels]
        )

    residual = np.concatenate([(x.simulated_after - x.measured)[x.train_mask] for x in channels])
    speed, pressure = (
        joined(drive + VELOCITY_SUFFIX),
        joined(f"{PRESSURE_PREFIX}{drive}_{chamber}"),
    )
    is_moving = np.abs(speed) > _REST_SPEED_SHARE * np.abs(speed).max()
    motion = {"speed": speed, "pressure": pressure, "direction": np.sign(speed) * is_moving}
    correlation_ratios = {what: correlation_ratio(residual, x) for what, x in motion.items()}
    speed_unit = VELOCITY_UNITS[calibration.machine.unit(drive)]
    return ResidualDependence(
        name, unit, residual, drive, speed_unit, chamber, motion, correlation_ratios
    )
