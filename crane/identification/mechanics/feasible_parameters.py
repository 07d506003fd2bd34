"""Least squares over physically feasible inertial parameters, a convex problem.

A mass m, first moment h and inertia I about the origin of a body's frame are physically feasible,
with positive mass density, if and only if the pseudo-inertia

    P = [[tr(I)/2 1 - I, h], [h^T, m]]   (4, 4)

is positive definite (Wensing, Kim, Slotine 2018, IEEE Robotics and Automation Letters 3(1)).
"""

import math
import warnings
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from crane.common.errors import CraneError, CraneWarning, InputError
from crane.common.optional_libraries import import_optional_library
from crane.common.samples import Array
from crane.identification.estimation.estimators import Estimate, Prior, RegressionProblem
from crane.identification.mechanics.base_parameters import BaseParameters
from crane.identification.mechanics.identification_model import IdentificationModel
from crane.identification.mechanics.regression_equations import (
    CombinedRegressor,
    RegressionEquations,
)

_MIN_EIGENVALUE = 1e-4  # smallest eigenvalue of X
_SOLVER_TOLERANCES = {
    "tol_gap_abs": 1e-10,
    "tol_gap_rel": 1e-10,
    "tol_feas": 1e-9,
}
_CAUTIOUS_OPTIONS = {"max_step_fraction": 0.9, "static_regularization_constant": 1e-7}
_SCS_OPTIONS = {"eps": 1e-7, "max_iters": 20000}
_MIN_NOISE_SHARE = 1e-4  # least noise of a feasible estimate, relative to the forces
_DEFAULT_RELATIVE_STD = 0.3  # default relative standard deviation of the prior of a body
_UNINFORMATIVE_STD = 1e3  # that of a body without a prior
_ROUNDING = 1e-9
_MIN_THICKNESS = 0.05  # least thickness of a body in a prior, relative to its size


def pseudo_inertia(parameters: Array) -> Array:
    """Pseudo-inertia P (..., 4, 4) of the ten parameters (..., 10) in Pinocchio's order."""
    m, hx, hy, hz, xx, xy, yy, xz, yz, zz = np.moveaxis(np.asarray(parameters), -1, 0)
    half = 0.5 * (xx + yy + zz)
    rows = [
        [half - xx, -xy, -xz, hx],
        [-xy, half - yy, -yz, hy],
        [-xz, -yz, half - zz, hz],
        [hx, hy, hz, m],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def body_size(body: Array) -> tuple[float, float]:
    """Mass [kg] and root mean square distance of the mass from the origin [m]."""
    P = pseudo_inertia(body)
    return float(body[0]), float(np.sqrt(max(np.trace(P[:3, :3]), 0.0) / body[0]))


def body_units(mass: float, length: float) -> Array:
    """Units m, m l and m l^2 (10,) of the parameters of a body."""
    return mass * np.array([1.0, *[length] * 3, *[length**2] * 6])


def body_parameters(P: Array) -> Array:
    """Ten parameters (..., 10) of P (..., 4, 4): the inverse of `pseudo_inertia`."""
    P = np.asarray(P)
    xx, yy, zz = (P[..., i, i] for i in range(3))
    columns = [P[..., 3, 3], P[..., 0, 3], P[..., 1, 3], P[..., 2, 3]]
    columns += [yy + zz, -P[..., 0, 1], xx + zz, -P[..., 0, 2], -P[..., 1, 2], xx + yy]
    return np.stack(columns, axis=-1)


def load_convex_solver() -> Any:
    """Import the convex solver CVXPY.

    Raises:
        InputError: It is not installed.
    """
    return import_optional_library("cvxpy", "a feasible estimate")


def solve_feasible(
    W: Array,
    y: Array,
    weights: Array,
    bodies: Sequence[str],
    prior: Array,
    prior_weight: Array,
    parameter_std: Array,
    nonnegative: Sequence[int] = (),
) -> Array:
    """Minimize misfit and divergence from a prior over physically feasible bodies.

        |weights (W theta - y)|^2 + sum_b prior_weight_b 2 d(P_b, P0_b)
            + sum_i ((theta_i - prior_i) / spread_i)^2

        d(P, P0) = tr(P0^-1 P) - log det(P0^-1 P) - 4,   L^-1 P_b L^-T >= 1e-4,  P0_b = L L^T.

    d is the divergence between normal distributions of mass: it is independent of frames and
    units, goes to infinity at the boundary of feasibility, and is |L^-1 P L^-T - 1|^2 / 2 near the
    prior, so that prior_weight is 1 / (relative standard deviation of a body)^2 if the weights are
    1 / (standard deviation of the forces). The unknown is X = L^-1 P L^-T, near 1 for bodies of
    any size. W may have dependent columns.

    Args:
        W: Regressor (m, p), ten columns per body, then others.
        y: Forces (m,).
        weights: One over the noise of each row (m,).
        bodies: Names of the bodies (nb,).
        prior: Prior means (p,), with feasible bodies.
        prior_weight: Positive weight of each body (nb,).
        parameter_std: Prior standard deviations (p - 10 nb,) of the other parameters; infinite
            without a prior.
        nonnegative: Columns of other parameters that must not be negative, such as friction.

    Returns:
        (p,) m, mcx, mcy, mcz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz of each body, then the others.

    Raises:
        InputError: A body of the prior is not feasible, or CVXPY is missing.
        CraneError: The solver fails.

    Source: Lee, Wensing, Park 2020, IEEE Transactions on Robotics 36(1).
    """
    cp = load_convex_solver()
    size, split = np.shape(W)[1], 10 * len(bodies)
    factors = [
        _prior_factor(body, p)
        for body, p in zip(bodies, prior[:split].reshape(-1, 10), strict=True)
    ]

    # triangular factor of the weighted [W y]
    weighted_factor = np.linalg.qr(np.column_stack([W, y]) * weights[:, None]).R
    R, d = weighted_factor[:size, :size], weighted_factor[:size, size]
    # from vec(X) to the ten parameters of L X L^T
    basis = np.eye(16).reshape(16, 4, 4)
    symmetric = 0.5 * (basis + np.swapaxes(basis, 1, 2))
    maps = [body_parameters(L @ symmetric @ L.T).T for L in factors]
    # The unknowns are near zero: X - 1, and the other parameters relative to their estimate for
    # the bodies of the prior, in units of the forces or of their prior.
    d = d - R[:, :split] @ prior[:split]
    is_known = np.isfinite(parameter_std)
    length = np.linalg.norm(R[:, split:], axis=0)
    unit = np.minimum(1 / np.where(length > 0, length, 1.0), parameter_std)
    prior_root = np.diag(1 / parameter_std)[is_known]
    system = np.vstack([R[:, split:], prior_root]) * unit
    start = unit * np.linalg.lstsq(system, np.append(d, prior_root @ prior[split:]))[0]
    bounded = np.asarray(nonnegative, dtype=int) - split
    start[bounded] = np.maximum(start[bounded], 0)
    d, prior_offset = d - R[:, split:] @ start, prior[split:] - start

    scale = 1 / np.sqrt(max(1.0, 2 * prior_weight.max()))
    X = [cp.Variable((4, 4), symmetric=True) for _ in bodies]
    z = cp.Variable(size - split)
    model = (R[:, split:] * unit) @ z - d
    cost = cp.sum_squares(scale * (prior_root * unit @ z - prior_root @ prior_offset))
    constraints = [z[bounded] >= -start[bounded] / unit[bounded]]
    for b, x in enumerate(X):
        model = model + R[:, 10 * b : 10 * b + 10] @ maps[b] @ cp.vec(x - np.eye(4), order="F")
        cost += 2 * prior_weight[b] * scale**2 * (cp.trace(x) - cp.log_det(x) - 4)
        constraints.append(x >> _MIN_EIGENVALUE * np.eye(4))
    _solve_convex_problem(
        cp.Problem(cp.Minimize(cp.sum_squares(scale * model) + cost), constraints)
    )
    others = start + unit * z.value
    others[bounded] = np.maximum(others[bounded], 0)  # rounding errors
    inertias = [L @ (0.5 * (x.value + x.value.T)) @ L.T for L, x in zip(factors, X, strict=True)]
    return np.concatenate([*map(body_parameters, inertias), others])


def _solve_convex_problem(problem: Any) -> None:
    """Solve a convex problem, with looser tolerances or another solver if necessary.

    Warnings of solvers, which refer to calls of CVXPY, become one line.

    Raises:
        CraneError: All solvers fail.
    """
    cp = load_convex_solver()
    # the last solver needs no factorization, for dependent columns
    solvers = (
        *((cp.CLARABEL, x) for x in (_SOLVER_TOLERANCES, {}, _CAUTIOUS_OPTIONS)),
        (cp.SCS, _SCS_OPTIONS),
    )
    inaccurate: list[Array] = []  # values of the first inaccurate solution
    for solver, options in solvers:
        if inaccurate and solver == cp.SCS:  # it is less accurate
            break
        status = cp.SOLVER_ERROR
        with warnings.catch_warnings(action="ignore"), suppress(cp.SolverError):  # reported below
            problem.solve(solver=solver, **options)
            status = problem.status
        if status == cp.OPTIMAL:
            return
        if status == cp.OPTIMAL_INACCURATE and not inaccurate:
            inaccurate = [variable.value for variable in problem.variables()]
    if not inaccurate:
        raise CraneError(
            f"no feasible estimate (solver: {status}), give a larger weight to the prior"
        )
    for variable, value in zip(problem.variables(), inaccurate, strict=True):
        variable.save_value(value)
    warnings.warn(
        "the feasible estimate is accurate to few digits only, as the recording hardly determines "
        "it: give a larger weight to the prior (--prior)",
        CraneWarning,
        stacklevel=4,
    )


def divergence_hessian_root(body: Array) -> Array:
    """Root L (16, 10) of the second derivative L^T L of d(P, P0) by the parameters of a body.

    For d = tr(P0^-1 P) - log det(P0^-1 P) - 4 it is d'' = |P^-1/2 dP P^-1/2|^2 for any P0.

    Args:
        body: Parameters (10,) of P.
    """
    cholesky_factor = np.linalg.cholesky(pseudo_inertia(body))
    first = np.linalg.solve(cholesky_factor, pseudo_inertia(np.eye(10)))
    return np.linalg.solve(cholesky_factor, np.swapaxes(first, 1, 2)).reshape(10, 16).T


def _prior_factor(body: str, parameters: Array) -> Array:
    """Cholesky factor L (4, 4) of the prior P0 = L L^T of a body.

    Raises:
        InputError: The body is not feasible, or flat.
    """
    try:
        return np.asarray(np.linalg.cholesky(pseudo_inertia(parameters)), dtype=np.float64)
    except np.linalg.LinAlgError:
        raise InputError(
            f"prior of '{body}' is flat or no possible body: give it a positive mass, possible "
            "moments of inertia, and some thickness"
        ) from None


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
    described = (model.nominal if prior is None else prior[0])[:count]
    for link, mass in zip(model.bodies, described[::10].tolist(), strict=True):
        if not mass > 0:
            raise InputError(
                f"'{link}' is described without mass, give it a rough one, or leave feasible out"
            )
    mean = np.array(model.nominal if prior is None else prior[0])
    body_weights = np.full(len(model.bodies), _DEFAULT_RELATIVE_STD**-2)
    parameter_std, parameter_weights = np.full(len(mean) - count, np.inf), np.zeros(count)
    if prior is not None:
        # the divergence takes the relative standard deviation of a body as prior, what single
        # parameters are known better by is beside it
        std, parameter_std = prior[1][:count], prior[1][count:]
        units = np.array([body_units(*body_size(body)) for body in mean[:count].reshape(-1, 10)])
        share = np.minimum((std.reshape(-1, 10) / units).max(axis=1), _UNINFORMATIVE_STD)
        excess = std**-2.0 - (share[:, None] * units).ravel() ** -2.0
        body_weights = share**-2.0
        parameter_weights = np.where(excess * std**2 > _ROUNDING, excess, 0.0)
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
    y = np.append(y, prior_rows @ described)
    weights = np.append(weights, np.ones(len(prior_rows)))
    solution = solve_feasible(
        W, y, weights, model.bodies, mean, body_weights, parameter_std, nonnegative
    )
    prior_root = np.zeros((16 * len(model.bodies) + len(mean), len(mean)))
    for i, each in enumerate(body_weights):
        body = slice(10 * i, 10 * i + 10)
        prior_root[16 * i : 16 * i + 16, body] = np.sqrt(each) * divergence_hessian_root(
            solution[body]
        )
    prior_root[-len(mean) :] = np.diag(np.append(np.sqrt(parameter_weights), 1 / parameter_std))
    # the covariance of weighted least squares for a prior with these rows
    rows = RegressionProblem(
        CombinedRegressor(equations, K),
        None,
        equations.y,
        equations.groups,
        equations.samples,
        None,
        prior_root,
    )
    return rows.evaluate_estimate(solution, rows.residuals(solution), noise, math.inf)


def thicken_body(body: Array) -> Array:
    """Body with a least thickness in every direction.

    Rods and plates without thickness are on the boundary of feasibility.
    """
    P = pseudo_inertia(body)
    mass, length = body_size(body)
    com = P[:3, 3] / mass
    values, axes = np.linalg.eigh(P[:3, :3] - mass * np.outer(com, com))
    least = mass * (_MIN_THICKNESS * length) ** 2
    P[:3, :3] = axes @ np.diag(np.maximum(values, least)) @ axes.T + mass * np.outer(com, com)
    return body_parameters(P)
