"""Identification of the friction of a cylinder from its pressures at constant speeds.

The friction is the hydraulic force by equation (20) of the electro-hydraulic forwarder paper minus
the load:

    F - load = (coulomb + stiction e^-(v / stribeck)^2) sign(v) + coulomb_offset + viscous v,

with tanh(v / smoothing) for sign(v), as in `crane.description.Friction`.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crane.common.errors import RecordingError, check_name
from crane.common.result import Result
from crane.common.samples import Array
from crane.common.threads import with_single_threaded_blas
from crane.description.force_elements import Friction
from crane.description.sensors import VALVE_SIGNAL_PREFIX
from crane.dynamics.dynamics import Dynamics
from crane.identification.estimation.estimators import Estimate, EstimatedValues, least_squares
from crane.identification.mechanics.smoothed_motion import smoothed_motion
from crane.identification.signals.signal_processing import sampling_step
from crane.identification.signals.signal_quality import (
    steady_mask,
    steady_means,
)
from crane.machine.machine import Machine
from crane.recordings.recording import Recording

PARAMETER_NAMES = ("coulomb", "coulomb_offset", "viscous", "stiction", "stribeck")

_REST_SPEED_SHARE = 1e-3  # of the largest speed, below which a joint does not slide
_SLIDING_FACTOR = 3.0  # smoothing velocities, above which the sign of the speed is fully developed
_STEADY_SHARE = 0.05  # largest change of a steady speed
_MAX_SAMPLES = 4000  # samples
_STRIBECK_GRID_SIZE = 40  # stribeck velocities tried before the fit


@dataclass(frozen=True, eq=False, repr=False)
class CylinderFriction(EstimatedValues, Result):
    """Identified friction of one joint.

    Attributes:
        joint: Name of the joint.
        values: (3,) coulomb, coulomb_offset, viscous; or (5,) with stiction and stribeck.
        covariance: (3, 3) or (5, 5) covariance of the values.
        degrees_of_freedom: Degrees of freedom of the covariance.
        smoothing: Smoothing velocity of the sign [m/s] or [rad/s], which is not estimated.
        speed: (M,) speeds of the steady samples [m/s] or [rad/s].
        force: (M,) measured friction there [N] or [N m].
        noise: Standard deviation of the force about the fit.
        note: Reason for the omission of stiction, "" if it is estimated.
    """

    joint: str
    values: Array
    covariance: Array
    degrees_of_freedom: float
    smoothing: float
    speed: Array
    force: Array
    noise: float
    note: str = ""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the values."""
        return PARAMETER_NAMES[: len(self.values)]

    @property
    def friction(self) -> Friction:
        """Friction law for `Machine.replace`; negative coefficients are set to 0."""
        found = dict(zip(self.names, map(float, self.values), strict=True))
        for name in ("coulomb", "viscous", "stiction"):
            found[name] = max(found.get(name, 0.0), 0.0)
        return Friction(smoothing=self.smoothing, **found)

    def predict(self, speed: Array) -> Array:
        """Friction (N,) at speeds (N,)."""
        return _friction_law(self.values, speed, self.smoothing)

    def to_text(self, unit: str = "m") -> str:
        """Table of the parameters."""
        force = "N" if unit == "m" else "N m"
        units = (force, force, f"{force} s/{unit}", force, f"{unit}/s")
        lines = [
            f"friction of {self.joint}: {len(self.speed)} steady samples, "
            f"{self.noise:.3g} {force} about the fit",
            f"{'':<16}{'value':>12}{'std':>10}   95 % interval",
        ]
        rows = zip(
            self.names, self.values, self.std, self.confidence_interval(), units, strict=False
        )
        for name, value, std, (low, high), text in rows:
            lines.append(f"{name:<16}{value:>12.5g}{std:>10.2g}   {low:.5g} to {high:.5g} {text}")
        return "\n".join([*lines, *([self.note] if self.note else [])]) + "\n"


@with_single_threaded_blas
def identify_cylinder_friction(
    machine: Machine,
    recording: Recording,
    joint: str,
    settle: float = 0.3,
    stribeck: bool | None = None,
) -> CylinderFriction:
    """Identify the friction of one joint, with the load by the masses of the machine.

    The load is tau_A of `Dynamics.inverse` without friction for the smoothed motion. Samples are
    used where the speed was steady for `settle` seconds and the joint slides. If there are none at
    two speeds both ways, means over the period of a speed that rings at a constant valve signal
    are used as well. Stiction and its
    velocity are estimated if there are speeds below that velocity and the stiction is significant;
    otherwise they are 0 and the note of the result gives the reason.

    Args:
        machine: The machine, whose masses are taken as known; of the friction of this joint only
            the smoothing is used.
        recording: Recording of all active joints, with tau of this one by (20).
        joint: An active joint.
        settle: Duration of steady speed before a sample [s].
        stribeck: False never estimates stiction, True requires it; None decides by the data.

    Raises:
        InputError: The joint is not active.
        RecordingError: The recording is not suitable, or does not determine the parameters.
    """
    check_name(joint, machine.active, f"'{joint}' is not an active joint")
    index = machine.active.index(joint)
    motion = smoothed_motion(machine, recording)
    load = Dynamics(machine).inverse(motion.q, motion.v, motion.a)[:, index]
    described_friction = machine.friction.get(joint, Friction())
    v = motion.v[:, index]
    slow = max(
        _SLIDING_FACTOR * described_friction.smoothing, _REST_SPEED_SHARE * float(np.abs(v).max())
    )
    force = motion.tau[:, index] - load
    is_steady = steady_mask(motion.time, settle, v, share=_STEADY_SHARE, relative=True)
    signal = recording.channels.get(VALVE_SIGNAL_PREFIX + joint)
    if _sense_without_speeds(v[is_steady & (np.abs(v) > slow)]) and signal is not None:
        is_steady, v, force = _steady_means(motion.time, settle, signal, is_steady, v, force)
    if not is_steady.any():
        raise RecordingError(
            f"no speed of '{joint}' is steady for {settle:g} s, record longer constant speeds"
        )
    at = np.flatnonzero(is_steady & (np.abs(v) > slow))
    speed, force = v[at], force[at]
    if sense := _sense_without_speeds(speed):
        word = "extends" if sense > 0 else "retracts"
        raise RecordingError(
            f"'{joint}' never {word} steadily at two speeds above "
            f"{slow:.3g} {machine.unit(joint)}/s, record constant speeds both ways"
        )
    every = max(1, len(at) // _MAX_SAMPLES)
    at, speed, force = at[::every], speed[::every], force[::every]
    note, estimate = "", None
    if stribeck is not False:
        estimate, note = _fit_with_stiction(at, speed, force, described_friction.smoothing)
        if note and stribeck:
            raise RecordingError(f"stiction of '{joint}' cannot be determined: {note}")
    if estimate is None:
        W = _friction_columns(speed, described_friction.smoothing)
        estimate = least_squares(W, force, samples=at)
    return CylinderFriction(
        joint=joint,
        values=estimate.values,
        covariance=estimate.covariance,
        degrees_of_freedom=estimate.degrees_of_freedom,
        smoothing=described_friction.smoothing,
        speed=speed,
        force=force,
        noise=float(estimate.noise[0]),
        note=note and f"Coulomb and viscous friction only: {note}",
    )


def _sense_without_speeds(speed: Array) -> int:
    """Sense in which there are no two steady speeds, 0 if there are both ways."""
    for sense in (1, -1):
        sizes = np.abs(speed[sense * speed > 0])
        if len(sizes) < 2 or sizes.max() < 1.5 * sizes.min():
            return sense
    return 0


def _steady_means(
    time: Array, settle: float, signal: Array, plain: NDArray[np.bool_], v: Array, force: Array
) -> tuple[NDArray[np.bool_], Array, Array]:
    """Mask (N,) of samples with a steady speed, speeds and forces.

    They are means over the periods of a speed that rings, without a reversal, at a held valve
    signal. The sign of friction and the part that is linear in the speed have the same mean as
    the speed; stiction has not.
    """
    from scipy.ndimage import maximum_filter1d

    try:
        means = steady_means(time, settle, signal, v, force, share=_STEADY_SHARE, relative=True)
    except RecordingError:  # no held signal
        return plain, v, force
    period = 1.0 / means.frequency[0] if means.frequency else 0.0
    count = round((settle + period) / sampling_step(time)) + 1
    reverses = maximum_filter1d((v * means.answer <= 0).astype(np.int8), count, origin=count // 2)
    rings = means.kept & ~plain & (reverses == 0)
    return (
        plain | rings,
        np.where(rings, means.answer, v),
        np.where(rings, means.others[0], force),
    )


def _friction_law(values: Array, v: Array, smoothing: float) -> Array:
    return _friction_columns(v, smoothing, *values[4:]) @ values[:4]


def _friction_columns(v: Array, smoothing: float, stribeck: float | None = None) -> Array:
    """Columns (M, 3) or (M, 4) of the linear coefficients of the friction law."""
    sign = np.tanh(v / smoothing) if smoothing else np.sign(v)
    columns = [sign, np.ones_like(v), v]
    if stribeck is not None:
        columns.append(np.exp(-((v / stribeck) ** 2)) * sign)
    return np.column_stack(columns)


def _fit_with_stiction(
    at: np.ndarray, v: Array, force: Array, smoothing: float
) -> tuple[Estimate | None, str]:
    """Fit with stiction, None if it is not identifiable, and the reason for that, else ""."""
    from scipy.optimize import minimize_scalar

    sizes = np.abs(v)
    slowest, fastest = float(sizes.min()), float(sizes.max())

    def cost(log_stribeck: float) -> float:
        W = _friction_columns(v, smoothing, float(np.exp(log_stribeck)))
        rest = force - W @ np.linalg.lstsq(W, force, rcond=None)[0]
        return float(rest @ rest)

    # the other parameters are linear for every Stribeck velocity
    grid = np.linspace(np.log(0.3 * slowest), np.log(fastest), _STRIBECK_GRID_SIZE)
    best = int(np.argmin([cost(x) for x in grid]))
    ends = grid[max(best - 1, 0)], grid[min(best + 1, _STRIBECK_GRID_SIZE - 1)]
    found = minimize_scalar(cost, bounds=ends, method="bounded", options={"xatol": 1e-10})
    width = float(np.exp(found.x))
    W = _friction_columns(v, smoothing, width)
    linear = np.linalg.lstsq(W, force, rcond=None)[0]
    values = np.append(linear, width)
    stribeck_derivative = linear[3] * W[:, 3] * 2 * v**2 / width**3
    low = f"speeds from {slowest:.2g} to {fastest:.2g}"
    if best == 0 or width < slowest:
        return None, f"{low} hold none below the Stribeck velocity, record slower ones"
    if best == _STRIBECK_GRID_SIZE - 1 or width > 0.5 * fastest:
        return (
            None,
            f"{low} do not exceed the Stribeck velocity twofold, record faster ones",
        )
    J = np.column_stack([W, stribeck_derivative])
    if np.linalg.cond(J / np.maximum(np.linalg.norm(J, axis=0), 1e-300)) > 1e8:
        return None, f"{low} show no stiction"
    estimate = least_squares(
        J, force - _friction_law(values, v, smoothing) + J @ values, samples=at
    )
    if not linear[3] > 3 * estimate.std[3]:
        return None, f"{low} show no stiction"
    return dataclasses.replace(estimate, values=values), ""
