"""Dependence of the residuals of a calibration on the motion.

An incomplete model leaves residuals that depend on the speed (viscous friction, orifices), on the
pressure (areas, moduli, leakage) or on the direction of motion (friction, one of four orifices).
The correlation ratio (Pearson 1905) measures this: with N samples of mean m, and groups g of n_g
samples with similar x and the mean m_g,

    ratio = sum_g n_g (m_g - m)^2 / sum_t (r_t - m)^2.

It is small by chance for many samples, but not for few motions.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array
from crane.description.sensors import PRESSURE_PREFIX, VELOCITY_SUFFIX, VELOCITY_UNITS
from crane.identification.calibration.calibration_result import Calibration, CalibrationChannel

_MAX_GROUPS = 8  # groups of about equal size
_REST_SPEED_SHARE = 0.02  # of the largest speed, below which a drive is at rest


@dataclass(frozen=True, eq=False, repr=False)
class ResidualDependence(OneLineRepr):
    """Residuals of a channel over the training data, and the motion of a drive.

    Attributes:
        name: Name of the channel.
        unit: Unit of the channel.
        residual: (N,) simulated minus measured.
        drive: Joint whose motion is compared.
        speed_unit: Unit of its speed.
        chamber: Chamber "a" or "b" of the pressure.
        motion: Speed, pressure and direction (-1, 0 at rest, 1), (N,) each.
        correlation_ratios: Correlation ratio of the residual with each of these.
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
    """Residual dependence of every fitted channel, over all recordings.

    A channel is compared with the drive in its name, else with the drive of the largest
    correlation ratio with the speed. The list is empty for a machine without valves.
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
    """Groups of samples (N,) by x, of about equal size, or one per value if x has few values."""
    values = np.unique(x)
    if len(values) <= _MAX_GROUPS:
        return [np.flatnonzero(x == value) for value in values]
    return list(np.array_split(np.argsort(x, kind="stable"), _MAX_GROUPS))


def correlation_ratio(residual: Array, x: Array) -> float:
    """Correlation ratio of a residual (N,) with x (N,), 0 to 1."""
    deviation = residual - residual.mean()
    total = float(deviation @ deviation)
    explained = sum(len(some) * float(deviation[some].mean()) ** 2 for some in group_samples(x))
    return explained / total if total else 0.0


def _residual_dependence(
    calibration: Calibration, channels: list[CalibrationChannel], drive: str
) -> ResidualDependence:
    """Dependence of channels of one name on the motion of a drive."""
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
