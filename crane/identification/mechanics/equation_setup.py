"""Regression equations of recordings: prepared motions, bandwidth, and standstill velocities."""

import fnmatch
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import InputError, RecordingError, suggest_names
from crane.common.samples import Array, as_number, as_sample
from crane.identification.mechanics.base_parameters import BaseParameters, base_parameters
from crane.identification.mechanics.force_terms import FrictionTerm
from crane.identification.mechanics.identification_model import IdentificationModel
from crane.identification.mechanics.regression_equations import (
    Progress,
    RegressionEquations,
)
from crane.identification.mechanics.smoothed_motion import smoothed_motion
from crane.identification.signals.signal_processing import Motion
from crane.identification.signals.signal_quality import spectral_edge_frequency
from crane.machine.machine import Machine
from crane.recordings.recording import Recording

RecordingOrMotion = Recording | Motion
_SLOW_SPEED_SHARE = 0.02  # of a joint's largest velocity, below which its rows are omitted
# [rad/s], [m/s] default end of stiction
_DEFAULT_STICTION_SPEED = {"rad": 1e-2, "m": 1e-3}
_SMOOTHING_FACTOR = 4.0  # times the smoothing velocity, tanh 4 = 0.9993
_MAX_SLOW_SHARE = 0.5  # of a joint's largest velocity, above which rows are always used
_PASSBAND_SHARE = 0.75  # of the passband of a smoother: there it passes 91 %
_MIN_BANDWIDTH_FACTOR = 3.0  # least bandwidth, times the spectral edge frequency of the velocities
_POWER_SHARE = 0.99
_MAX_BANDWIDTH_FACTOR = 40.0  # times the spectral edge frequency of the accelerations
_SPEED_SAMPLES = 500  # samples for ranges of speeds
_PASS_SHARE = 0.3  # of the remaining progress, per pass over a recording


def build_equations(
    model: IdentificationModel,
    motions: Sequence[Motion],
    bandwidth: float | None = None,
    slow: Mapping[str, float] | ArrayLike | None = None,
    progress: Progress | None = None,
) -> tuple[RegressionEquations, BaseParameters]:
    """Regression equations of motions, and the identifiable part of the base parameters.

    Arguments and errors as for `identify`.
    """
    if bandwidth is None:
        bandwidth = model.machine.estimation.bandwidth or min(map(_default_bandwidth, motions))
    bandwidth = as_number(bandwidth, "the bandwidth", "Hz", greater_than=0)
    fastest = np.max([np.abs(motion.v).max(axis=0) for motion in motions], axis=0)
    slow_speeds = _slow_speeds(model.machine, slow, fastest)
    equations = RegressionEquations(
        model, base_parameters(model), motions, bandwidth, slow_speeds, progress
    )
    if not equations.is_moving.any():
        raise RecordingError("no joint moves faster than what counts as standstill, move it more")
    for joint, count in zip(model.machine.active, equations.is_moving.sum(axis=0), strict=True):
        if count == 1:  # one row does not determine the noise
            raise RecordingError(
                f"'{joint}' is in one sample only faster than what counts as standstill, move it "
                "more, or raise its slow"
            )
    # the triangular factors have the column dependences of all rows
    return equations, equations.base.identifiable_part(
        np.vstack(list(equations.triangular_factors[:, :, :-1]))
    )


def prepare_motions(
    machine: Machine,
    recordings: RecordingOrMotion | Sequence[RecordingOrMotion],
    trust: bool,
    progress: Progress | None,
    role: str = "",
) -> list[Motion]:
    """Motions of recordings, with velocities and accelerations.

    Raises:
        InputError: There are no recordings.
        RecordingError: A recording is not suitable; the message names it if there are several.
    """
    sources = as_list(recordings)
    if not sources:
        raise InputError("no recording is given, give at least one")
    motions = []
    for number, one in enumerate(sources, start=1):
        try:
            if not isinstance(one, Motion):
                one = smoothed_motion(machine, one, trust=trust, progress=progress)
        except RecordingError as error:
            if not role and len(sources) == 1:
                raise
            which = f"{role or 'recording'} {number} of {len(sources)}"
            raise RecordingError(f"{which}: {error}") from None
        motions.append(one)
    return motions


def as_list(
    recordings: RecordingOrMotion | Sequence[RecordingOrMotion] | None,
) -> list[RecordingOrMotion]:
    """List of one or several recordings; empty for None."""
    if recordings is None:
        return []
    return [recordings] if isinstance(recordings, Recording | Motion) else list(recordings)


def speed_ranges(
    model: IdentificationModel, motions: Sequence[Motion], slow: Array
) -> dict[str, tuple[float, float]]:
    """Least and largest speed along each direction of friction."""
    directions = {
        x.direction.name: x.direction for x in model.terms if isinstance(x, FrictionTerm)
    }
    fastest = dict.fromkeys(directions, 0.0)
    for motion in motions:
        sample_slice = slice(None, None, max(1, len(motion.time) // _SPEED_SAMPLES))
        at = model.samples(motion.q[sample_slice], motion.v[sample_slice], motion.a[sample_slice])
        for name, direction in directions.items():
            speed = np.einsum("ij,ij->i", direction.jacobian(model.machine, at), at.v_a)
            fastest[name] = max(fastest[name], float(np.abs(speed).max()))
    lowest = dict(zip(model.machine.active, slow.tolist(), strict=True))
    return {
        name: (lowest.get(name, _SLOW_SPEED_SHARE * most), most) for name, most in fastest.items()
    }


def multi_pass_progress(progress: Progress | None) -> Progress | None:
    """Progress over an unknown number of passes: each takes a share of the remainder."""
    if progress is None:
        return None
    done = 0.0

    def report(share: float) -> None:
        nonlocal done
        now = done + _PASS_SHARE * (1 - done) * share
        progress(now)
        if share >= 1:
            done = now

    return report


def _slow_speeds(
    machine: Machine, slow: Mapping[str, float] | ArrayLike | None, fastest: Array
) -> Array:
    """Standstill velocities (n,), below which rows are omitted.

    The default is a share of the largest velocity, or the velocity at which the described friction
    is fully developed.
    """
    out = _SLOW_SPEED_SHARE * fastest
    for i, joint in enumerate(machine.active):
        law = machine.friction.get(joint)
        if law is not None:
            smoothing_speed = law.smoothing or (
                _DEFAULT_STICTION_SPEED[machine.unit(joint)] if law.has_stick_slip else 0.0
            )
            stiction_speed = _SMOOTHING_FACTOR * (
                max(law.stribeck, law.smoothing) if law.stiction else smoothing_speed
            )
            out[i] = max(out[i], min(stiction_speed, _MAX_SLOW_SHARE * fastest[i]))
    if slow is not None and not isinstance(slow, Mapping):
        each = np.full(out.shape, slow) if np.ndim(slow) == 0 else slow
        each = as_sample(each, len(out), "slow", machine.active)
        slow = dict(zip(machine.active, each.tolist(), strict=True))
    for name, value in (*machine.estimation.slow.items(), *(slow or {}).items()):
        joints = fnmatch.filter(machine.active, name)
        if not joints and name not in machine.locked_joints:
            raise InputError(f"slow is for '{name}', {suggest_names(machine.active, name)}")
        if (limit := as_number(value, f"slow of '{name}'", "")) < 0:
            raise InputError(f"slow of '{name}' is {limit:g}, it must not be negative")
        out[[machine.active.index(joint) for joint in joints]] = limit
    return out


def _default_bandwidth(motion: Motion) -> float:
    """Default bandwidth [Hz] of the low-pass, far above the frequencies of the motion.

    The band above the motion contains the noise to be estimated. But smoothing removes parts of
    the accelerations from the regressor, not from the forces, mostly at reversals, where friction
    jumps: so the bandwidth is at most the passband of smoothing, unless that is close to the
    motion.
    """
    step = float(motion.time[1] - motion.time[0])
    highest = max(
        _PASSBAND_SHARE * motion.passband,
        _MIN_BANDWIDTH_FACTOR * _highest_frequency(motion.v, step),
    )
    return min(_MAX_BANDWIDTH_FACTOR * _highest_frequency(motion.a, step), highest, 0.24 / step)


def _highest_frequency(x: Array, step: float) -> float:
    """Largest frequency [Hz] below which 99 % of the power of a signal of (N, n) lies."""
    found = [
        spectral_edge_frequency(_POWER_SHARE, column / max(column.std(), 1e-300), step)
        for column in x.T
        if np.ptp(column) > 0
    ]
    return max(found, default=1 / (len(x) * step))
