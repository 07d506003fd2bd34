"""How rated loads and forces change with numbers of the machine, exactly."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.spatial.transform import Rotation

from crane.common.errors import InputError
from crane.common.samples import Array
from crane.dynamics.constant_derivatives import ConstantDerivatives
from crane.dynamics.statics import StaticQuantities
from crane.machine import Machine
from crane.ratings.drive_force_limits import drive_force_limits
from crane.ratings.limiting_factors import LoadLimits, tipping_lines
from crane.ratings.unit_actions import slew_angles

if TYPE_CHECKING:
    from crane.ratings.rating_chart import RatingChart

EQUAL = 1e-6  # of a load: causes that end it together
_LIMIT_TOLERANCE = 1e-6  # of a stroke


def chart_derivatives(chart: "RatingChart", parameter_names: Sequence[str]) -> Array:
    """Derivatives of a field's values by numbers of the machine, places held still.

    With p a number, a posture of the largest value m is stationary under the place x(q_A, p) and
    under limits of the strokes,

        sum mu_k dm_k/dq + lambda^T dx/dq + sum nu_j e_j = 0,    sum mu_k = 1,

    over causes k that end it together and strokes j at their limits, so that

        dm/dp = sum mu_k dm_k/dp + lambda^T dx/dp,

    derivatives on the right at the same q_A; limits of strokes stay. Where just two strokes move
    the frame, lambda follows from them alone.

    Args:
        chart: See `crane.capacity`, `crane.tool_force`.
        parameter_names: Numbers of the machine, such as "boom_eye.x".

    Returns:
        (s, b, a, k) per unit of each number; NaN where there is no value or no end to it, or where
        a pin's limit ends it, whose derivatives are not computed.

    Raises:
        InputError: There is no such number, or it moves a support.
    """
    machine, parameter_names = chart.machine, list(parameter_names)
    search, statics = chart.places, chart.places.statics
    drives = drive_force_limits(machine, chart.working_joints, chart.with_friction)
    load_limits = LoadLimits(
        statics, drives, chart.rule, chart.action, chart.ground_slope, chart.with_weight
    )
    constant_derivatives = ConstantDerivatives(machine)
    drive_derivatives = constant_derivatives.jacobian(
        parameter_names, lambda variant: _drive_force_values(variant, chart)
    )
    if np.any(constant_derivatives.jacobian(parameter_names, _tipping_line_values)):
        raise InputError("a number that moves the supports cannot be varied here, leave it out")
    out = np.full((*chart.values.shape, len(parameter_names)), np.nan)
    chart_indices = np.argwhere(np.isfinite(chart.values) & (chart.values > 0))
    if not len(chart_indices) or not parameter_names:
        return out
    s, b, a = chart_indices.T
    q_a = np.ascontiguousarray(chart.q_a[s, b, a])
    q = machine.closure.solve(q_a)
    statics_values, coordinate_derivatives, parameter_derivatives = (
        statics.evaluate(q),
        statics.coordinate_derivatives(q),
        statics.parameter_derivatives(q, parameter_names),
    )
    angles = slew_angles(machine, chart.frame, search.section, chart.slews[s])
    loads = chart.values[s, b, a]
    unit, pin_forces = (
        chart.action.unit_vectors(statics_values, angles),
        load_limits.pin_loads(statics_values, angles, q),
    )
    # by bound but pins: derivatives of its load by q_A (N, n) and by numbers (N, k)
    derivatives_by_bound = {}
    bound_magnitudes = np.empty((len(chart_indices), len(load_limits.bounds)))
    for j, bound in enumerate(load_limits.bounds):
        coefficients = load_limits.bound_coefficients(bound, statics_values, unit, pin_forces)
        x = load_limits.bound_magnitude(bound, coefficients)
        bound_magnitudes[:, j] = x * load_limits.rated_shares[bound.factor_index]
        if bound.pin_index is not None:
            continue
        magnitude_by_coordinates, magnitude_by_parameters = (
            _bound_derivatives(
                load_limits, j, x, coefficients, statics_values, derivatives, angles
            )
            for derivatives in (coordinate_derivatives, parameter_derivatives)
        )
        if bound.drive is not None:  # what its strength changes by
            k = 2 * drives.index(bound.drive) + (bound.sign < 0)
            with np.errstate(divide="ignore", invalid="ignore"):
                magnitude_by_parameters = (
                    magnitude_by_parameters
                    + bound.sign
                    * drive_derivatives[:, k]
                    / _magnitude_derivative(x, coefficients)[:, None]
                )
        derivatives_by_bound[j] = (
            magnitude_by_coordinates * load_limits.rated_shares[bound.factor_index],
            magnitude_by_parameters * load_limits.rated_shares[bound.factor_index],
        )
    strokes = search.moving
    section = search.section  # it stands at home: seen from there, what slews is turned back
    slew_back_rotations = Rotation.from_rotvec(
        -angles[:, None] * section.second_direction
    ).as_matrix()
    home_plane_positions = (
        section.origin
        + (slew_back_rotations @ (statics_values.tip_positions - section.origin)[:, :, None])[
            :, :, 0
        ]
    )
    position_jacobian = section.section_jacobian(
        home_plane_positions, slew_back_rotations @ statics_values.tip_jacobian
    )[:, :, strokes]
    position_by_parameters = section.section_jacobian(
        home_plane_positions, slew_back_rotations @ parameter_derivatives.tip_positions
    )
    span = search.high - search.low
    for i in range(len(chart_indices)):
        active_bounds = np.flatnonzero(bound_magnitudes[i] <= loads[i] * (1 + EQUAL)).tolist()
        if not all(j in derivatives_by_bound for j in active_bounds):
            continue
        factor_gradients = np.array(
            [derivatives_by_bound[j][0][i, strokes] for j in active_bounds]
        )
        if len(strokes) == 2:
            factor_multipliers = np.zeros(len(active_bounds))
            factor_multipliers[np.argmin(bound_magnitudes[i, active_bounds])] = 1.0
            position_multipliers = -np.linalg.solve(
                position_jacobian[i].T, factor_multipliers @ factor_gradients
            )
        else:
            at_low = q_a[i, strokes] <= (search.low + _LIMIT_TOLERANCE * span)[strokes]
            at_high = q_a[i, strokes] >= (search.high - _LIMIT_TOLERANCE * span)[strokes]
            factor_multipliers, position_multipliers = _lagrange_multipliers(
                factor_gradients, position_jacobian[i], at_low, at_high, span[strokes]
            )
        out[s[i], b[i], a[i]] = factor_multipliers @ np.array(
            [derivatives_by_bound[j][1][i] for j in active_bounds]
        )
        out[s[i], b[i], a[i]] += position_multipliers @ position_by_parameters[i]
    return out


def _lagrange_multipliers(
    factor_gradients: Array,
    position_jacobian: Array,
    at_low: NDArray[np.bool_],
    at_high: NDArray[np.bool_],
    stroke_lengths: Array,
) -> tuple[Array, Array]:
    """Shares mu (c,) of causes and forces lambda (2,) that hold a posture of the most load.

    Args:
        factor_gradients: (c, k) of the causes' loads by the strokes.
        position_jacobian: (2, k) of the place by the strokes.
        at_low: (k,) which strokes are at their lower limit.
        at_high: (k,) at their upper one.
        stroke_lengths: (k,) of the strokes.
    """
    gradient_scale = np.abs(factor_gradients * stroke_lengths).max() or 1.0
    position_scale = np.abs(position_jacobian * stroke_lengths).max()
    limits = np.vstack([np.diag(stroke_lengths)[at_low], -np.diag(stroke_lengths)[at_high]])
    stationarity_rows = np.vstack(
        [
            factor_gradients * stroke_lengths / gradient_scale,
            position_jacobian * stroke_lengths / position_scale,
            -position_jacobian * stroke_lengths / position_scale,
            limits / stroke_lengths,
        ]
    )
    factor_count = len(factor_gradients)
    normalization = np.zeros((len(stationarity_rows), 1))
    normalization[:factor_count] = 1.0
    solution = nnls(
        np.hstack([stationarity_rows, normalization]).T,
        np.r_[np.zeros(stationarity_rows.shape[1]), 1.0],
    )[0]
    position_multipliers = (
        (solution[factor_count : factor_count + 2] - solution[factor_count + 2 : factor_count + 4])
        * gradient_scale
        / position_scale
    )
    return solution[:factor_count], position_multipliers


def _magnitude_derivative(x: Array, coefficients: tuple[Array, ...]) -> Array:
    """How fast a + b x + |c + d x| rises with x (N,)."""
    _, b, c, d = coefficients
    return np.asarray(b + (_unit_vector(x, c, d) * d).sum(axis=-1))


def _unit_vector(x: Array, c: Array, d: Array) -> Array:
    vector = c + d * np.where(np.isfinite(x), x, 0.0)[:, None]
    length = np.linalg.norm(vector, axis=-1, keepdims=True)
    return vector / np.where(length > 0, length, 1.0)


def _bound_derivatives(
    load_limits: LoadLimits,
    j: int,
    x: Array,
    coefficients: tuple[Array, ...],
    statics: StaticQuantities,
    derivatives: StaticQuantities,
    angles: Array,
) -> Array:
    """Derivatives (N, k) of the load at which bound j ends, by k numbers or strokes."""
    unit_vector, magnitude_derivative = (
        _unit_vector(x, *coefficients[2:]),
        _magnitude_derivative(x, coefficients),
    )
    x = np.where(np.isfinite(x), x, 0.0)
    columns = []
    for k in range(derivatives.total_mass.shape[-1]):
        parameter_derivative = StaticQuantities(*(part[..., k] for part in derivatives))
        a, b, c, d = load_limits.coefficient_derivatives(
            load_limits.bounds[j], statics, parameter_derivative, angles
        )
        bound_change = a + b * x + (unit_vector * (c + d * x[:, None])).sum(axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            columns.append(-bound_change / magnitude_derivative)
    return np.stack(columns, axis=-1)


def _drive_force_values(machine: Machine, chart: "RatingChart") -> Array:
    """What its drives push and pull at most."""
    force_limits = drive_force_limits(machine, chart.working_joints, chart.with_friction)
    return np.array([x for drive in force_limits for x in (drive.max_force, drive.min_force)])


def _tipping_line_values(machine: Machine) -> Array:
    """Places of the tipping lines."""
    return np.concatenate(
        [np.zeros(1), *(np.r_[x.point, x.direction] for x in tipping_lines(machine))]
    )
