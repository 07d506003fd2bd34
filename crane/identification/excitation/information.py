"""What a motion tells about base parameters: the information matrix and its figures."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import InputError
from crane.common.samples import Array, as_sample
from crane.identification.mechanics.base import Base
from crane.identification.mechanics.model import Model
from crane.identification.mechanics.term import Samples


@dataclass(frozen=True, eq=False)
class Quality:
    """What a recording of a motion tells, see `Information`.

    Attributes:
        condition: Condition number of N^-1 W S, infinite where it has no inverse.
        logdet: ln det (1 + M).
        smallest: Smallest singular value of N^-1 W S; below one, some combination of parameters
            is known no better after than before.
        std: (r,) standard deviations of the base parameters estimated by weighted least squares,
            with the prior where one is given; SI units, infinite for what is not told.
    """

    condition: float
    logdet: float
    smallest: float
    std: Array


class Information:
    """The information matrix of base parameters.

        M = S^T (sum_t W_t^T N^-2 W_t) S,    N = diag(noise),

    W_t the regressor's columns of the base parameters at instant t, and S S^T their covariance
    beforehand: ln det (1 + M) is twice the information gained [nat], and a parameter that no
    motion of the machine can tell from noise counts nothing (Chaloner, Verdinelli 1995). Where
    no prior is given, a base parameter's deviation is what would take the whole force of the
    drives, as a root mean square over motions all over the limits. Columns scaled over the
    motion in question instead would hide that it moves a parameter too little; that the
    condition number means something only with columns of comparable parameters is why it has
    the same S (Gautier, Khalil 1992).

    Args:
        model: The model.
        base: Its base parameters.
        noise: (n,) standard deviation of the noise of each drive's force [N], [N m], white.
        force: (n,) of each drive [N], [N m].
        anywhere: Motions all over the limits.
        prior: (p,) standard deviations of the model's parameters before.

    Attributes:
        scale: S (r, r).

    Raises:
        InputError: The prior is not what it should be.

    Source: Gautier, Khalil 1992, Int. J. Robotics Research 11(4), exciting trajectories;
    Swevers et al. 1997, IEEE Trans. Robotics and Automation 13(5), for det M; Chaloner,
    Verdinelli 1995, Statistical Science 10(3).
    """

    def __init__(
        self,
        model: Model,
        base: Base,
        noise: Array,
        force: Array,
        anywhere: Samples,
        prior: ArrayLike | None = None,
    ):
        self.model, self.base, self.noise = model, base, noise
        self._known = 0.0 if prior is None else 1.0
        if prior is None:
            squares = ((self._columns(anywhere) / force[:, None]) ** 2).sum(axis=1)
            self.scale = np.diag(1 / np.sqrt(squares.mean(axis=0)))
        else:
            std = as_sample(prior, len(model.names), "the prior", model.names)
            if not (std > 0).all():
                name = model.names[int(np.argmin(std))]
                raise InputError(f"prior deviation of '{name}' is {std.min():g}, give one above 0")
            self.scale = np.linalg.cholesky((base.grouping * std**2) @ base.grouping.T)

    def sizes(self, at: Samples, count: float, sets: int = 1) -> Array:
        """Singular values of N^-1 W S (sets, r) of motions one after the other.

        Args:
            at: Their samples, the same number of each, evenly over a period.
            count: Number of samples that a recording of each will have.
            sets: How many motions.
        """
        return np.asarray(np.linalg.svd(self._rows(at, count, sets), compute_uv=False))

    def quality(self, at: Samples, count: float) -> Quality:
        """Figures of one motion, see `sizes`."""
        return quality(self._rows(at, count, 1)[0], self.scale, self._known)

    def _columns(self, at: Samples) -> Array:
        return self.model.regressor(at)[:, :, self.base.independent]

    def _rows(self, at: Samples, count: float, sets: int) -> Array:
        """N^-1 W S (sets, samples n, r), each of a recording's weight."""
        W = self._columns(at) * (np.sqrt(count * sets / len(at.q_a)) / self.noise[:, None])
        return W.reshape(sets, -1, self.base.rank) @ self.scale


def quality(rows: Array, scale: Array, known: float) -> Quality:
    """Figures of information M = R^T R.

    Args:
        rows: R (N, r), of parameters in their scales.
        scale: S (r, r), these scales.
        known: 1 where S S^T is what is known beforehand and counts in the deviations, else 0.
    """
    _, sizes, directions = np.linalg.svd(rows, full_matrices=False)
    with np.errstate(divide="ignore"):
        shares = (scale @ directions.T) ** 2 / (sizes**2 + known)
        condition = float(np.exp(_by_condition(sizes)))
    std = np.sqrt(shares.sum(axis=1))
    return Quality(condition, -float(_by_logdet(sizes)), float(sizes[-1]), std)


def _by_logdet(sizes: Array) -> Array:
    return np.asarray(-np.log1p(sizes**2).sum(axis=-1))


def _by_condition(sizes: Array) -> Array:
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(sizes[..., 0]) - np.log(sizes[..., -1]))


CRITERIA: Mapping[str, Callable[[Array], Array]] = {
    "logdet": _by_logdet,
    "condition": _by_condition,
}
"""What is to be small, of singular values (..., r) of N^-1 W S: -ln det (1 + M), ln condition."""
