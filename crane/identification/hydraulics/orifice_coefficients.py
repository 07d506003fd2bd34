"""Identification of bulk modulus and orifice coefficients by equations (29) to (32).

Equations are those of the electro-hydraulic forwarder paper (IROS 2012); see
`crane.identification.hydraulics.cylinder_equations` for them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from crane.common.errors import InputError, check_name
from crane.common.result import Result
from crane.common.samples import Array
from crane.common.threads import with_single_threaded_blas
from crane.identification.estimation.estimators import (
    EstimatedValues,
    instrumental_variables,
    least_squares,
)
from crane.identification.hydraulics.cylinder_equations import (
    SIGNAL_NAMES,
    CylinderSignals,
    EquationSides,
    OrificeEquations,
    chamber_terms,
    cylinder_and_valve,
    cylinder_signals,
    noise_std,
)
from crane.identification.signals.signal_processing import differentiate
from crane.machine.machine import Machine
from crane.recordings.recording import Recording

PARAMETER_NAMES = ("1/beta", "c1", "c2", "c3", "c4")
PARAMETER_UNITS = ("1/Pa",) + 4 * ("m3/(s Pa^0.5)",)
METHODS = ("weak", "chambers", "ls")

_WINDOW_LENGTH = 0.1  # [s]
# of the halves of a column, see `_check_identifiable`
_MIN_CORRELATION, _MIN_SIGNIFICANCE = 0.5, 10.0
_MAX_SAMPLES = 20000  # samples of method "ls"
_UNIDENTIFIABLE_REASONS = {
    0: (
        "1/beta",
        "its pressures change less than their noise, record faster motion or changing load",
    ),
    1: (
        "c1 and c2",
        "its valve hardly opens to extend for a whole window, record extending motion",
    ),
    3: (
        "c3 and c4",
        "its valve hardly opens to retract for a whole window, record retracting motion",
    ),
}


@dataclass(frozen=True, eq=False, repr=False)
class OrificeCoefficients(EstimatedValues, Result):
    """Identified bulk modulus and orifice coefficients of one cylinder.

    Attributes:
        machine: The machine, whose areas and volumes are taken as known.
        joint: The cylinder's.
        method: Method of `identify_orifices`.
        values: (5,) 1/beta [1/Pa], c1 to c4 [m3/(s Pa^0.5)].
        covariance: (5, 5) covariance of the values.
        degrees_of_freedom: (5,) degrees of freedom of the standard errors.
        condition: Condition number of A with columns of length one.
        misfit: Mean square of the residuals over that expected from the sensor noise; far above 1
            if the model is wrong, or the noise is stronger or not white; nan for "ls".
        window: Length of the test functions [s].
        training_sides: Both sides of (29), one entry per recording.
    """

    machine: Machine
    joint: str
    method: str
    values: Array
    covariance: Array
    degrees_of_freedom: Array
    condition: float
    misfit: float
    window: float
    training_sides: tuple[EquationSides, ...] = ()

    @property
    def bulk_modulus(self) -> float:
        """Bulk modulus beta [Pa]; infinite if the estimate of 1/beta is negative."""
        return 1 / float(self.values[0]) if self.values[0] > 0 else np.inf

    def predict(self, recording: Recording, period: float | None = None) -> EquationSides:
        """Both sides of (29) on another recording, as means over windows.

        Args:
            recording: As for `identify_orifices`.
            period: As for `identify_orifices`.
        """
        return OrificeEquations(
            self.machine,
            self.joint,
            cylinder_signals(self.machine, recording, self.joint, period),
            self.window,
            False,
        ).sides(self.values)

    def to_text(self) -> str:
        """A table of the parameters."""
        lines = [
            f"cylinder of {self.joint}, method {self.method}: condition number "
            f"{self.condition:.3g} with columns scaled"
            + ("" if np.isnan(self.misfit) else f", misfit {self.misfit:.3g}"),
            f"{'parameter':<10}{'value':>12}{'std':>10}{'rel. std':>10}   95 % interval",
        ]
        for name, unit, value, std, (low, high) in zip(
            PARAMETER_NAMES,
            PARAMETER_UNITS,
            self.values,
            self.std,
            self.confidence_interval(),
            strict=True,
        ):
            share = f"{100 * std / abs(value):.2g} %"
            lines.append(
                f"{name:<10}{value:>12.5g}{std:>10.2g}{share:>10}   {low:.5g} to {high:.5g} {unit}"
            )
        for i, both in enumerate(self.training_sides):
            error = f"{100 * both.relative_error:.3g} %"
            lines.append(f"recording {i + 1}: relative error of (29) {error}")
        return "\n".join(lines) + "\n"


@with_single_threaded_blas
def identify_orifices(
    machine: Machine,
    recordings: Recording | Sequence[Recording],
    joint: str,
    method: str = "weak",
    window: float = _WINDOW_LENGTH,
    period: float | None = None,
    noise: Mapping[str, float] | None = None,
) -> OrificeCoefficients:
    """Identify X = [1/beta, c1, c2, c3, c4] of one cylinder with known areas and hose volumes.

    "weak": (29) times test functions phi, integrated by parts,

        -int phi' F dt / beta + sum_j c_j int phi z_j dt = int phi' (A_A ln V_A - A_B ln V_B) dt,

    as Y = -(A_A ln V_A - A_B ln V_B)': no measured signal is differentiated. Windows in which the
    opening crosses zero or its end are omitted, as the integrands have kinks there. Rows use every
    other sample, with the samples between them as instruments, so that white noise does not bias
    X. Standard errors propagate the white noise of the sensors to X; residuals beyond that noise
    add the covariance of `instrumental_variables`, with its correlation in time.

    "chambers": the same with the two equations of (23) instead of their difference (29). In (29)
    c1 and c2 (and c3, c4) differ only by the change of V_A / V_B along the stroke; here each has
    its own equation.

    "ls": equation (36) of the paper with F' and x' by the Kalman smoother, at every sample. Force
    and stroke are filtered differently by their own noise: oscillations below the noise of the
    stroke remain on one side only, which biases 1/beta towards zero beyond its interval.

    The equations neglect leakage, entrapped gas, relief and check valves, cushioning, and the
    compliance of boom and mountings, which then bias X.

    Args:
        machine: Machine with hydraulics; of its valve only the opening and the margin are used.
        recordings: One or several recordings, see `cylinder_signals`.
        joint: The cylinder's.
        method: "weak", "chambers" or "ls".
        window: Length of the test functions [s], at least 64 steps; about a period of the oil's
            oscillation if that is excited.
        period: Period of a periodic motion [s], whose periods are averaged first.
        noise: Standard deviations of some of x, opening, p_a, p_b, p_s, p_r after averaging; the
            others are estimated.

    Raises:
        InputError: The method, joint or sensor is unknown, or parameters are not identifiable.
        RecordingError: Columns are missing, or samples are not suitable.
    """
    check_name(method, METHODS, f"method '{method}' is unknown")
    for name in noise or ():
        check_name(name, SIGNAL_NAMES, f"sensor '{name}' is unknown")
    cylinder, valve = cylinder_and_valve(machine, joint)
    if cylinder.counterbalance_a or cylinder.counterbalance_b:
        raise InputError(
            f"the cylinder of '{joint}' has a counterbalance valve, for which (21), (22) do not "
            "hold: choose another cylinder"
        )
    if isinstance(recordings, Recording):
        recordings = [recordings]
    if not recordings:
        raise InputError("no recordings, give at least one")
    runs = [cylinder_signals(machine, one, joint, period) for one in recordings]
    sets = [OrificeEquations(machine, joint, run, window, method == "chambers") for run in runs]
    _check_identifiable(sets, joint)
    levels = []
    for one, run in zip(recordings, runs, strict=True):
        level = {name: noise_std(getattr(run, name)) for name in SIGNAL_NAMES}
        if f"spool_{joint}" not in one.channels and valve.bandwidth:
            # the spool dynamics keep the noise of the signal at the low frequencies of the
            # windows, and remove it from differences between samples
            volts = noise_std(one.channels[f"voltage_{joint}"])
            scale = abs(valve.full - valve.neutral) * (1 - valve.dead_band)
            periods = max(len(one.time) // len(run.time), 1)
            level["opening"] = volts / scale / np.sqrt(periods)
        levels.append(level | dict(noise or {}))
    if method == "ls":
        values, covariance, freedom, condition, misfit = _pointwise_estimate(machine, joint, runs)
    else:
        values, covariance, freedom, condition, misfit = _weak_form_estimate(sets, levels, joint)
    _check_values(values, covariance, joint, method, runs)
    training = tuple(rows.sides(values) for rows in sets)
    return OrificeCoefficients(
        machine, joint, method, values, covariance, freedom, condition, misfit, window, training
    )


def _weak_form_estimate(
    sets: list[OrificeEquations], noise: list[dict[str, float]], joint: str
) -> tuple[Array, Array, Array, float, float]:
    """X, covariance, degrees of freedom, condition number and misfit of the weak form."""
    count = len(sets[0].combination)
    start, W, Z, y, groups, samples = 0, [], [], [], [], []
    for rows in sets:
        at = np.flatnonzero(rows.is_smooth)
        for e in range(count):
            for half in range(2):
                W.append(rows.W[e, half, at])
                Z.append(rows.W[e, 1 - half, at])
                y.append(rows.y[e, half, at])
                groups.append(np.full(len(at), 2 * e + half))
                samples.append(start + at)
        start += len(rows.is_smooth) + 100
    group = np.concatenate(groups)
    W_all, Z_all, y_all = (np.concatenate(part) for part in (W, Z, y))
    try:
        estimate = instrumental_variables(W_all, y_all, Z_all, group, np.concatenate(samples))
    except InputError as error:
        raise InputError(f"the cylinder of '{joint}': {error}") from None
    X, scale = estimate.values, estimate.noise**2
    A = sum(Z_all[group == g].T @ W_all[group == g] / scale[g] for g in range(len(scale)))
    middle, explained = np.zeros((5, 5)), 0.0
    for rows, levels in zip(sets, noise, strict=True):
        w, N = rows.windows, len(rows.signals.time)
        Z_rows = rows.W[:, ::-1] * rows.is_smooth[:, None]
        for sensor, level in levels.items():
            df, dg = rows.noise_sensitivity(X, sensor, level)
            total = np.zeros((N, 5))
            for e in range(count):
                share = scale[2 * e : 2 * e + 2]
                weighted = Z_rows[e] / share[:, None, None]
                total += df[e][:, None] * w.apply_transpose(w.phi_derivative, weighted, N)
                total += dg[e][:, None] * w.apply_transpose(w.phi, weighted, N)
                variance = (
                    w.integrate(w.phi_derivative**2, df[e] ** 2)
                    + w.integrate(w.phi**2, dg[e] ** 2)
                    + 2 * w.integrate(w.phi_derivative * w.phi, df[e] * dg[e])
                )
                explained += float((variance[:, rows.is_smooth] / share[:, None]).sum())
            middle += total.T @ total
    inverse = np.linalg.inv(A)
    propagated = inverse @ middle @ inverse.T
    misfit = float(np.sum(estimate.residuals**2 / scale[group])) / max(explained, 1e-300)
    other = max(0.0, 1 - 1 / misfit) * estimate.covariance
    both = np.diag(propagated + other)
    # Welch-Satterthwaite: the propagated part is taken as exactly known
    freedom = estimate.degrees_of_freedom * (both / np.maximum(np.diag(other), 1e-9 * both)) ** 2
    return X, propagated + other, freedom, estimate.scaled_condition, misfit


def _pointwise_estimate(
    machine: Machine, joint: str, runs: list[CylinderSignals]
) -> tuple[Array, Array, Array, float, float]:
    """X, covariance, degrees of freedom, condition number and misfit by (36), per sample."""
    cylinder, _ = cylinder_and_valve(machine, joint)
    areas = np.array([cylinder.area_a, -cylinder.area_b])
    start, W, y, samples = 0, [], [], []
    for run in runs:
        force = cylinder.area_a * run.p_a - cylinder.area_b * run.p_b
        found = differentiate(run.time, np.column_stack([force, run.x]))
        columns = np.tensordot(areas, chamber_terms(machine, joint, run)[1], 1)
        volumes = (
            cylinder.hose_a + cylinder.area_a * run.x,
            cylinder.hose_b + cylinder.area_b * (run.stroke - run.x),
        )
        stiff = cylinder.area_a**2 / volumes[0] + cylinder.area_b**2 / volumes[1]
        every = -(-len(run.time) // _MAX_SAMPLES)
        W.append(np.column_stack([found.v[:, 0], columns.T])[::every])
        y.append((-found.v[:, 1] * stiff)[::every])
        samples.append(start + np.arange(len(y[-1])))
        start += len(y[-1]) + 100
    estimate = least_squares(np.concatenate(W), np.concatenate(y), samples=np.concatenate(samples))
    freedom = np.full(5, estimate.degrees_of_freedom)
    return estimate.values, estimate.covariance, freedom, estimate.scaled_condition, np.nan


def _check_identifiable(sets: list[OrificeEquations], joint: str) -> None:
    """Reject parameters that a motion does not determine.

    A column is accepted if its halves correlate, or if the sum of their products is many times its
    standard deviation for pure noise.
    """
    for j, (name, reason) in _UNIDENTIFIABLE_REASONS.items():
        total = energy = spread = 0.0
        for rows in sets:
            halves = rows.W[:, :, rows.is_smooth, j]
            products = halves[:, 0] * halves[:, 1]
            total += float(products.sum())
            energy += 0.5 * float((halves**2).sum())
            spread += float((products**2).sum())
        if not (total > _MIN_CORRELATION * energy or total > _MIN_SIGNIFICANCE * np.sqrt(spread)):
            raise InputError(f"{name} of '{joint}' cannot be determined: {reason}")


def _check_values(
    values: Array, covariance: Array, joint: str, method: str, runs: list[CylinderSignals]
) -> None:
    std = np.sqrt(np.diag(covariance))
    for j in range(1, 5):
        if not 0.5 * values[j] > std[j]:
            pair = "c1 and c2" if j < 3 else "c3 and c4"
            low, high = (min(r.x.min() for r in runs), max(r.x.max() for r in runs))
            other = "" if method == "chambers" else ", or take method 'chambers'"
            raise InputError(
                f"{pair} of '{joint}' cannot be separated along {low:.3g} to {high:.3g} of its "
                f"stroke ({PARAMETER_NAMES[j]} = {values[j]:.3g} +- {std[j]:.2g}): record longer "
                f"strokes{other}"
            )
