"""Exact derivatives of rated loads and forces by parameters of the machine."""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import nnls
from scipy.spatial.transform import Rotation

from crane.common.errors import InputError
from crane.common.samples import Array
from crane.dynamics.quantity_evaluator import ConstantDerivatives
from crane.dynamics.statics import StaticQuantities
from crane.machine.machine import Machine
from crane.ratings.limiting_factors import (
    LimitBound,
    LoadLimits,
    RatingConditions,
    tipping_lines,
)
from crane.ratings.rating_rules import slew_angles
from crane.ratings.strokes import Strokes

SIMULTANEOUS_TOLERANCE = 1e-6  # share of a load within which factors limit it simultaneously
_LIMIT_TOLERANCE = 1e-6  # share of a stroke


def rating_derivatives(
    conditions: RatingConditions,
    q_a: Array,
    slews: Array,
    magnitudes: Array,
    parameter_names: Sequence[str],
) -> Array:
    """Compute the derivatives of rated loads or forces by parameters, at fixed positions.

    With a parameter p, the configuration of the largest value m is stationary under the position
    x(q_A, p) and under the limits of the strokes,

        sum mu_k dm_k/dq + lambda^T dx/dq + sum nu_j e_j = 0,    sum mu_k = 1,

    over the factors k that limit m simultaneously and the strokes j at their limits, so that

        dm/dp = sum mu_k dm_k/dp + lambda^T dx/dp,

    with the derivatives on the right at fixed q_A. The limits of the strokes are constant. If
    only two strokes move the frame, lambda follows from them alone.

    Args:
        conditions: Conditions of the rating.
        q_a: (N, n) active coordinates of the configurations of the largest load or force at N
            positions.
        slews: (N,) coordinates of the slewing joint [rad].
        magnitudes: (N,) rated loads or forces [kg], [N].
        parameter_names: Parameters of the machine, such as "boom_eye.x".

    Returns:
        (N, k) per unit of each parameter; NaN where a pin limits the value, whose derivatives are
        not computed.

    Raises:
        InputError: A parameter does not exist, or it moves a support.
    """
    parameter_names = list(parameter_names)
    constants = ConstantDerivatives(conditions.machine)

    def drive_forces(variant: Machine) -> Array:
        limits = conditions.drive_limits(variant)
        return np.array([[drive.max_force, drive.min_force] for drive in limits]).ravel()

    def tipping_line_values(variant: Machine) -> Array:
        lines = tipping_lines(variant, conditions.frame)
        return np.concatenate([[0.0], *(np.r_[x.ends.ravel(), x.origin] for x in lines)])

    by_drive = constants.jacobian(parameter_names, drive_forces)
    if np.any(constants.jacobian(parameter_names, tipping_line_values)):
        raise InputError("a parameter that moves the supports cannot be varied here, leave it out")
    out = np.full((len(q_a), len(parameter_names)), np.nan)
    if not len(q_a) or not parameter_names:
        return out
    statics = conditions.places.statics
    q = conditions.machine.closure.solve(np.ascontiguousarray(q_a))
    at_rest = statics.evaluate(q)
    by_coordinates = statics.coordinate_derivatives(q)
    by_parameters = statics.parameter_derivatives(q, parameter_names)
    angles = slew_angles(conditions.machine, conditions.section, slews)
    limits = conditions.load_limits()
    bound_magnitudes, by_q, by_p = _bound_derivatives(
        limits, (at_rest, by_coordinates, by_parameters), limits.pin_loads(at_rest, angles, q),
        angles, by_drive,
    )  # fmt: skip
    # the section stands at home: positions are turned back by the slew angles
    section, strokes = conditions.section, conditions.places.moving
    rotations = Rotation.from_rotvec(-angles[:, None] * section.second_direction).as_matrix()
    offsets = (rotations @ (at_rest.tip_positions - section.origin)[:, :, None])[:, :, 0]
    jacobian, by_position = (
        section.section_jacobian(section.origin + offsets, rotations @ derivatives)
        for derivatives in (at_rest.tip_jacobian, by_parameters.tip_positions)
    )
    jacobian = jacobian[:, :, strokes]
    for i, magnitude in enumerate(magnitudes):
        active = np.flatnonzero(
            bound_magnitudes[i] <= magnitude * (1 + SIMULTANEOUS_TOLERANCE)
        ).tolist()
        if not all(j in by_q for j in active):
            continue
        gradients = np.array([by_q[j][i, strokes] for j in active])
        if len(strokes) == 2:
            factor_multipliers = np.zeros(len(active))
            factor_multipliers[np.argmin(bound_magnitudes[i, active])] = 1.0
            position_multipliers = -np.linalg.solve(jacobian[i].T, factor_multipliers @ gradients)
        else:
            factor_multipliers, position_multipliers = _lagrange_multipliers(
                gradients, jacobian[i], conditions.places, q_a[i]
            )
        out[i] = factor_multipliers @ np.array([by_p[j][i] for j in active])
        out[i] += position_multipliers @ by_position[i]
    return out


def _bound_derivatives(
    limits: LoadLimits,
    statics: tuple[StaticQuantities, StaticQuantities, StaticQuantities],
    pin_forces: tuple[Array, Array] | None,
    angles: Array,
    by_drive: Array,
) -> tuple[Array, dict[int, Array], dict[int, Array]]:
    """Compute the magnitudes at which bounds are reached, and their derivatives.

    Args:
        limits: Limits of the load.
        statics: The machine at rest, its derivatives by coordinates and by parameters.
        pin_forces: Result of `LoadLimits.pin_loads`.
        angles: (N,) slew angles [rad].
        by_drive: (k, 2 d) derivatives of the drives' force limits by parameters.

    Returns:
        Rated magnitudes (N, bounds), and by bound, but for pins, their derivatives by active
        coordinates (N, n) and by parameters (N, k).
    """
    at_rest, by_coordinates, by_parameters = statics
    magnitudes = np.empty((len(angles), len(limits.bounds)))
    all_by_q, all_by_p = {}, {}
    for j, bound in enumerate(limits.bounds):
        coefficients = limits.bound_coefficients(bound, at_rest, angles, pin_forces)
        x = limits.bound_magnitude(bound, coefficients)
        share = limits.rated_shares[bound.factor_index]
        magnitudes[:, j] = x * share
        if bound.pin_index is not None:
            continue
        by_q, by_p = (
            _magnitude_derivatives(limits, bound, x, coefficients, at_rest, derivatives, angles)
            for derivatives in (by_coordinates, by_parameters)
        )
        if bound.drive is not None:  # the force limit depends on parameters, too
            k = 2 * bound.factor_index + (bound.sign < 0)
            slope = _slope(x, coefficients)[:, None]
            with np.errstate(divide="ignore", invalid="ignore"):
                by_p = by_p + bound.sign * by_drive[:, k] / slope
        all_by_q[j], all_by_p[j] = by_q * share, by_p * share
    return magnitudes, all_by_q, all_by_p


def _lagrange_multipliers(
    gradients: Array, jacobian: Array, strokes: Strokes, q_a: Array
) -> tuple[Array, Array]:
    """Return the multipliers mu (c,) and lambda (2,) of a configuration of the largest load.

    Args:
        gradients: (c, s) derivatives of the loads of the limiting factors by the strokes.
        jacobian: (2, s) derivatives of the position by the strokes.
        strokes: The strokes with their limits.
        q_a: (n,) active coordinates.
    """
    moving, span = strokes.moving, strokes.high - strokes.low
    stroke_lengths = span[moving]
    at_low = q_a[moving] <= (strokes.low + _LIMIT_TOLERANCE * span)[moving]
    at_high = q_a[moving] >= (strokes.high - _LIMIT_TOLERANCE * span)[moving]
    gradient_scale = np.abs(gradients * stroke_lengths).max() or 1.0
    position_scale = np.abs(jacobian * stroke_lengths).max()
    limits = np.vstack([np.diag(stroke_lengths)[at_low], -np.diag(stroke_lengths)[at_high]])
    rows = np.vstack(
        [
            gradients * stroke_lengths / gradient_scale,
            jacobian * stroke_lengths / position_scale,
            -jacobian * stroke_lengths / position_scale,
            limits / stroke_lengths,
        ]
    )
    count = len(gradients)
    normalization = (np.arange(len(rows)) < count).astype(float)[:, None]
    solution = nnls(np.hstack([rows, normalization]).T, np.r_[np.zeros(rows.shape[1]), 1.0])[0]
    position_multipliers = (
        (solution[count : count + 2] - solution[count + 2 : count + 4])
        * gradient_scale
        / position_scale
    )
    return solution[:count], position_multipliers


def _slope(x: Array, coefficients: tuple[Array, ...]) -> Array:
    """Return the derivative (N,) of a + b x + |c + d x| by x."""
    _, b, c, d = coefficients
    return np.asarray(b + (_unit_vector(x, c, d) * d).sum(axis=-1))


def _unit_vector(x: Array, c: Array, d: Array) -> Array:
    vector = c + d * np.where(np.isfinite(x), x, 0.0)[:, None]
    length = np.linalg.norm(vector, axis=-1, keepdims=True)
    return vector / np.where(length > 0, length, 1.0)


def _magnitude_derivatives(
    limits: LoadLimits,
    bound: LimitBound,
    x: Array,
    coefficients: tuple[Array, ...],
    statics: StaticQuantities,
    derivatives: StaticQuantities,
    angles: Array,
) -> Array:
    """Return the derivatives (N, k) of the load x at a bound by k parameters or coordinates."""
    unit_vector, slope = _unit_vector(x, *coefficients[2:]), _slope(x, coefficients)
    x = np.where(np.isfinite(x), x, 0.0)
    columns = []
    for k in range(derivatives.total_mass.shape[-1]):
        derivative = StaticQuantities(*(part[..., k] for part in derivatives))
        a, b, c, d = limits.coefficient_derivatives(bound, statics, derivative, angles)
        change = a + b * x + (unit_vector * (c + d * x[:, None])).sum(axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            columns.append(-change / slope)
    return np.stack(columns, axis=-1)
