"""Parameters of bodies that can exist."""

import numpy as np

from crane.common.errors import InputError
from crane.common.samples import Array
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
_PRIOR = 0.3  # relative standard deviation of a body towards which a feasible estimate is drawn
_UNKNOWN = 1e3  # that of a body of which a prior says nothing
_ROUNDING = 1e-9
_THICKNESS = 0.05  # of a body's size, added to what is thinner in a prior


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

    Raises:
        InputError: A body has no mass.
    """
    count = 10 * len(model.bodies)
    about = model.nominal if prior is None else prior[0]
    for link, mass in zip(model.bodies, about[:count:10].tolist(), strict=True):
        if not mass > 0:
            raise InputError(
                f"'{link}' is described without mass, give it a rough one, or leave feasible out"
            )
    mean, weight = model.nominal.copy(), np.full(len(model.bodies), _PRIOR**-2)
    spread, single = np.full(len(mean) - count, np.inf), np.zeros(count)
    if prior is not None:
        mean = prior[0].copy()
        spread = prior[1][count:]
        weight, single = _of_bodies(mean[:count], prior[1][:count])
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
    # what is known of one parameter of a body beyond what is of the whole body
    more = np.diag(np.sqrt(single))[single > 0]
    W = np.vstack([W, np.column_stack([more, np.zeros((len(more), len(spread)))])])
    y = np.append(y, more @ (mean if prior is None else prior[0])[:count])
    weights = np.append(weights, np.ones(len(more)))
    found = feasible(W, y, weights, model.bodies, mean, weight, spread, signs)
    pull = np.zeros((16 * len(model.bodies) + len(mean), len(mean)))
    for i, each in enumerate(weight):
        body = slice(10 * i, 10 * i + 10)
        pull[16 * i : 16 * i + 16, body] = np.sqrt(each) * curvature(found.values[body])
    pull[-len(mean) :] = np.diag(np.append(np.sqrt(single), 1 / spread))
    return judged(rows.columns(K), rows.y, rows.groups, rows.samples, found.values, noise, pull)


def _of_bodies(mean: Array, std: Array) -> tuple[Array, Array]:
    """What a prior of bodies (10 nb,) is in the divergence, and beyond it.

    Returns:
        Per body (nb,) one over the square of the share of mass and size to which all of it is
        known at least; and per parameter (10 nb,) what is known beyond that, one over a variance.
    """
    units = np.array([_units(mean[i : i + 10]) for i in range(0, len(mean), 10)])
    share = np.minimum((std.reshape(-1, 10) / units).max(axis=1), _UNKNOWN)
    beyond = std**-2.0 - (share[:, None] * units).ravel() ** -2.0
    return share**-2.0, np.where(beyond * std**2 > _ROUNDING, beyond, 0.0)


def _units(body: Array) -> Array:
    """m, m l, m l^2 (10,) of a body."""
    mass, length = body_size(body)
    return mass * np.array([1.0, *[length] * 3, *[length**2] * 6])


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
