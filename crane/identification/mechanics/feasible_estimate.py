"""Estimate of all parameters with physically feasible bodies, and its covariance."""

import numpy as np

from crane.common.errors import InputError
from crane.common.samples import Array
from crane.identification.estimation.estimators import estimate_from_minimum
from crane.identification.estimation.regression_problem import Estimate, Prior
from crane.identification.mechanics.base_parameters import BaseParameters
from crane.identification.mechanics.feasible_parameters import (
    body_parameters,
    body_size,
    divergence_hessian_root,
    pseudo_inertia,
    solve_feasible,
)
from crane.identification.mechanics.identification_model import IdentificationModel
from crane.identification.mechanics.regression_equations import RegressionEquations

_MIN_NOISE_SHARE = 1e-4  # least noise of a feasible estimate, relative to the forces
_DEFAULT_RELATIVE_STD = 0.3  # default relative standard deviation of the prior of a body
_UNINFORMATIVE_STD = 1e3  # that of a body without a prior
_ROUNDING = 1e-9
_MIN_THICKNESS = 0.05  # least thickness of a body in a prior, relative to its size


def feasible_estimate(
    model: IdentificationModel,
    base: BaseParameters,
    equations: RegressionEquations,
    selection: Array,
    unconstrained: Estimate,
    prior: Prior | None,
) -> Estimate:
    """Estimate all parameters with feasible bodies and nonnegative friction.

    The covariance is that of the minimum of the cost of `solve_feasible`,

        H^-1 (W^T D C D W + P) H^-1,    H = W^T D W + P,    D = 1 / noise^2,

    with the covariance C of the residuals, and P half of the second derivative of the prior terms
    at the estimate. Active bounds of friction are not used as information, so intervals there are
    rather too wide.

    Args:
        model: The model, with bodies.
        base: Base parameters that the recording determines.
        equations: Regression equations of the recording.
        selection: (., r) selection of their columns in the equations.
        unconstrained: Unconstrained estimate of the base parameters, for its noise.
        prior: Prior of all parameters; default the described bodies.

    Returns:
        Estimate of all parameters (p,).

    Raises:
        InputError: A body is described without mass.
    """
    count = 10 * len(model.bodies)
    described_values = model.nominal if prior is None else prior[0]
    for link, mass in zip(model.bodies, described_values[:count:10].tolist(), strict=True):
        if not mass > 0:
            raise InputError(
                f"'{link}' is described without mass, give it a rough one, or leave feasible out"
            )
    mean, body_weights = (
        model.nominal.copy(),
        np.full(len(model.bodies), _DEFAULT_RELATIVE_STD**-2),
    )
    parameter_std, parameter_weights = np.full(len(mean) - count, np.inf), np.zeros(count)
    if prior is not None:
        mean = prior[0].copy()
        parameter_std = prior[1][count:]
        body_weights, parameter_weights = _body_prior_weights(mean[:count], prior[1][:count])
    for i in range(0, count, 10):
        mean[i : i + 10] = thicken_body(mean[i : i + 10])
    nonnegative = [i for i, sign in enumerate(model.nonnegative) if sign and i >= count]
    # the triangular factors have the same column norms and products as the rows
    K = selection @ base.grouping
    W, y = (
        equations.stacked_factors(K),
        equations.triangular_factors[:, :, -1].ravel(),
    )
    size = np.linalg.norm(y) / np.sqrt(len(equations.y))
    noise = np.maximum(unconstrained.noise, _MIN_NOISE_SHARE * size)
    # no other parameter exceeds the whole force; without this, two parameters with the same effect
    # could grow without bound
    single_forces = np.linalg.norm(W[:, count:], axis=0) / np.sqrt(len(equations.y))
    parameter_std = np.minimum(
        parameter_std, size / np.where(single_forces > 0, single_forces, size)
    )
    weights = np.repeat(1 / noise, equations.triangular_factors.shape[1])
    # prior of single parameters of a body beyond that of the body
    prior_rows = np.diag(np.sqrt(parameter_weights))[parameter_weights > 0]
    W = np.vstack(
        [W, np.column_stack([prior_rows, np.zeros((len(prior_rows), len(parameter_std)))])]
    )
    y = np.append(y, prior_rows @ (mean if prior is None else prior[0])[:count])
    weights = np.append(weights, np.ones(len(prior_rows)))
    solution = solve_feasible(
        W, y, weights, model.bodies, mean, body_weights, parameter_std, nonnegative
    )
    prior_root = np.zeros((16 * len(model.bodies) + len(mean), len(mean)))
    for i, each in enumerate(body_weights):
        body = slice(10 * i, 10 * i + 10)
        prior_root[16 * i : 16 * i + 16, body] = np.sqrt(each) * divergence_hessian_root(
            solution.values[body]
        )
    prior_root[-len(mean) :] = np.diag(np.append(np.sqrt(parameter_weights), 1 / parameter_std))
    return estimate_from_minimum(
        equations.projected_regressor(K),
        equations.y,
        equations.groups,
        equations.samples,
        solution.values,
        noise,
        prior_root,
    )


def _body_prior_weights(mean: Array, std: Array) -> tuple[Array, Array]:
    """Weights of a prior of bodies (10 nb,) in the divergence, and of single parameters.

    Returns:
        Per body (nb,) one over the square of its relative standard deviation; and per parameter
        (10 nb,) the remaining information, one over a variance.
    """
    units = np.array([_body_units(mean[i : i + 10]) for i in range(0, len(mean), 10)])
    share = np.minimum((std.reshape(-1, 10) / units).max(axis=1), _UNINFORMATIVE_STD)
    excess = std**-2.0 - (share[:, None] * units).ravel() ** -2.0
    return share**-2.0, np.where(excess * std**2 > _ROUNDING, excess, 0.0)


def _body_units(body: Array) -> Array:
    """Units m, m l and m l^2 (10,) of the parameters of a body."""
    mass, length = body_size(body)
    return mass * np.array([1.0, *[length] * 3, *[length**2] * 6])


def thicken_body(body: Array) -> Array:
    """Body with a least thickness in every direction.

    Rods and plates without thickness are on the boundary of feasibility.
    """
    P = pseudo_inertia(body)
    mass, length = body_size(body)
    com = P[:3, 3] / mass
    second = P[:3, :3] - mass * np.outer(com, com)
    values, axes = np.linalg.eigh(second)
    least = mass * (_MIN_THICKNESS * length) ** 2
    P[:3, :3] = axes @ np.diag(np.maximum(values, least)) @ axes.T + mass * np.outer(com, com)
    return body_parameters(P)
