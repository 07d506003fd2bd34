"""Parameters of bodies that can exist: a prior by the machine's description, and the estimate."""

import numpy as np

from crane.common.samples import Array, as_number
from crane.identification.estimation.estimators import Estimate, Prior, judged
from crane.identification.mechanics.base import Base
from crane.identification.mechanics.equations import Equations
from crane.identification.mechanics.feasible import (
    body_parameters,
    body_size,
    curvature,
    feasible,
    pseudo_inertia,
)
from crane.identification.mechanics.model import Model

_EXACT = 1e-4  # of the forces, noise that a feasible estimate counts with at least
_PRIORS = 1e-7, 1e6  # above and up to which a relative standard deviation lies
_PRIOR = 0.3  # relative standard deviation of a body towards which a feasible estimate is drawn
_THICKNESS = 0.05  # of a body's size, added to what is thinner in a prior


def prior_of_bodies(model: Model, relative: float) -> Prior:
    """Bodies as described, each known to a share of its mass and size; of others nothing.

    Returns:
        Means (p,) and standard deviations (p,), infinite for what is no body.

    Raises:
        InputError: The share is not from 1e-7 to 1e6.
    """
    relative = as_number(relative, "the prior's relative standard deviation", "", *_PRIORS)
    std = np.full(len(model.names), np.inf)
    for i in range(len(model.bodies)):
        mass, length = body_size(model.nominal[10 * i : 10 * i + 10])
        units = np.array([1.0, *[length] * 3, *[length**2] * 6])
        std[10 * i : 10 * i + 10] = relative * mass * units
    mean = np.where(np.isfinite(std), model.nominal, 0.0)
    return mean, std


def possible(
    model: Model,
    base: Base,
    rows: Equations,
    selection: Array,
    free: Estimate,
    prior: Prior | None,
) -> Estimate:
    """All parameters, with bodies that can exist and friction that is not negative.

    The covariance is that of the minimum of `feasible`'s own objective,

        H^-1 (W^T D C D W + P) H^-1,    H = W^T D W + P,    D = 1 / noise^2,

    with C the covariance of the residuals, P half of the second derivative of divergence and
    spread at the estimate, as if what they draw towards were as uncertain as they say. A bound at
    which friction ends is not counted as knowledge: there the interval is too wide rather than
    too narrow.

    Args:
        model: The model, with bodies.
        base: What of its base parameters the recording tells.
        rows: The recording.
        selection: Which columns of the rows they are (., r).
        free: Estimate of the base parameters that knows no bounds, for its noise.
        prior: Of all parameters; the described bodies if not given.

    Returns:
        All parameters (p,).
    """
    count = 10 * len(model.bodies)
    mean, weight = model.nominal.copy(), _PRIOR**-2
    spread = np.full(len(mean) - count, np.inf)
    if prior is not None:
        mean = prior[0].copy()
        spread = prior[1][count:]
        sizes = [body_size(mean[i : i + 10])[0] for i in range(0, count, 10)]
        weight = float(np.median(prior[1][:count:10] / sizes)) ** -2
    for i in range(0, count, 10):
        mean[i : i + 10] = thick(mean[i : i + 10])
    signs = [i for i, sign in enumerate(model.signs) if sign and i >= count]
    # the triangular factors of the joints' rows instead of the rows: their columns have the same
    # lengths and angles
    K = selection @ base.grouping
    W, y = np.vstack(list(rows.factors[:, :, :-1] @ K)), rows.factors[:, :, -1].ravel()
    size = np.linalg.norm(y) / np.sqrt(len(rows.y))
    noise = np.maximum(free.noise, _EXACT * size)
    # none of the others makes more than all of the force; without that, two that do the same in
    # this motion may grow without end
    alone = np.linalg.norm(W[:, count:], axis=0) / np.sqrt(len(rows.y))
    spread = np.minimum(spread, size / np.where(alone > 0, alone, size))
    weights = np.repeat(1 / noise, rows.factors.shape[1])
    found = feasible(W, y, weights, model.bodies, mean, weight, spread, signs)
    pull = np.zeros((16 * len(model.bodies) + len(spread), len(mean)))
    for i in range(len(model.bodies)):
        body = slice(10 * i, 10 * i + 10)
        pull[16 * i : 16 * i + 16, body] = curvature(found.values[body])
    pull *= np.sqrt(weight)
    pull[-len(spread) :, count:] = np.diag(1 / spread)
    return judged(rows.columns(K), rows.y, rows.groups, rows.samples, found.values, noise, pull)


def thick(body: Array) -> Array:
    """A body at least a share of its size thick in every direction.

    Rods and plates without thickness lie on the edge of what can exist.
    """
    P = pseudo_inertia(body)
    mass, length = body_size(body)
    com = P[:3, 3] / mass
    second = P[:3, :3] - mass * np.outer(com, com)
    values, axes = np.linalg.eigh(second)
    least = mass * (_THICKNESS * length) ** 2
    P[:3, :3] = axes @ np.diag(np.maximum(values, least)) @ axes.T + mass * np.outer(com, com)
    return body_parameters(P)
