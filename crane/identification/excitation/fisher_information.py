"""What a motion tells about base parameters: the information matrix and its figures."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import InputError
from crane.common.samples import Array, as_sample
from crane.identification.mechanics.base_parameters import BaseParameters
from crane.identification.mechanics.identification_model import IdentificationModel
from crane.identification.mechanics.model_term import MotionSamples


@dataclass(frozen=True, eq=False)
class InformationMeasures:
    """What a recording of a motion tells, see `FisherInformation`.

    Attributes:
        condition: Condition number of N^-1 W S, infinite where it has no inverse.
        logdet: ln det (1 + M).
        smallest_singular_value: Smallest singular value of N^-1 W S; below one, some combination
            of parameters is known no better after than before.
        std: (r,) standard deviations of the base parameters estimated by weighted least squares,
            with the prior where one is given; SI units, infinite for what is not told.
    """

    condition: float
    logdet: float
    smallest_singular_value: float
    std: Array


class FisherInformation:
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
        random_motions: Motions all over the limits.
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
        model: IdentificationModel,
        base: BaseParameters,
        noise: Array,
        force: Array,
        random_motions: MotionSamples,
        prior: ArrayLike | None = None,
    ):
        self.model, self.base, self.noise = model, base, noise
        self._prior_information = 0.0 if prior is None else 1.0
        if prior is None:
            squares = ((self._base_regressor(random_motions) / force[:, None]) ** 2).sum(axis=1)
            self.scale = np.diag(1 / np.sqrt(squares.mean(axis=0)))
        else:
            std = as_sample(prior, len(model.names), "the prior", model.names)
            if not (std > 0).all():
                name = model.names[int(np.argmin(std))]
                raise InputError(f"prior deviation of '{name}' is {std.min():g}, give one above 0")
            self.scale = np.linalg.cholesky((base.grouping * std**2) @ base.grouping.T)

    def singular_values(
        self, samples: MotionSamples, sample_count: float, motion_count: int = 1
    ) -> Array:
        """Singular values of N^-1 W S (sets, r) of motions one after the other.

        Args:
            samples: Their samples, the same number of each, evenly over a period.
            sample_count: Number of samples that a recording of each will have.
            motion_count: How many motions.
        """
        return np.asarray(
            np.linalg.svd(
                self._weighted_regressor(samples, sample_count, motion_count), compute_uv=False
            )
        )

    def measures(self, samples: MotionSamples, sample_count: float) -> InformationMeasures:
        """Figures of one motion, see `singular_values`."""
        return information_measures(
            self._weighted_regressor(samples, sample_count, 1)[0],
            self.scale,
            self._prior_information,
        )

    def _base_regressor(self, samples: MotionSamples) -> Array:
        return self.model.regressor(samples)[:, :, self.base.independent]

    def _weighted_regressor(
        self, samples: MotionSamples, sample_count: float, motion_count: int
    ) -> Array:
        """N^-1 W S (sets, samples n, r), each of a recording's weight."""
        W = self._base_regressor(samples) * (
            np.sqrt(sample_count * motion_count / len(samples.q_a)) / self.noise[:, None]
        )
        return W.reshape(motion_count, -1, self.base.rank) @ self.scale


def information_measures(
    rows: Array, scale: Array, prior_information: float
) -> InformationMeasures:
    """Figures of information M = R^T R.

    Args:
        rows: R (N, r), of parameters in their scales.
        scale: S (r, r), these scales.
        prior_information: 1 where S S^T is what is known beforehand and counts in the deviations,
            else 0.
    """
    _, singular_values, directions = np.linalg.svd(rows, full_matrices=False)
    with np.errstate(divide="ignore"):
        shares = (scale @ directions.T) ** 2 / (singular_values**2 + prior_information)
        condition = float(np.exp(_log_condition(singular_values)))
    std = np.sqrt(shares.sum(axis=1))
    return InformationMeasures(
        condition, -float(_negative_logdet(singular_values)), float(singular_values[-1]), std
    )


def _negative_logdet(singular_values: Array) -> Array:
    return np.asarray(-np.log1p(singular_values**2).sum(axis=-1))


def _log_condition(singular_values: Array) -> Array:
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(singular_values[..., 0]) - np.log(singular_values[..., -1]))


CRITERIA: Mapping[str, Callable[[Array], Array]] = {
    "logdet": _negative_logdet,
    "condition": _log_condition,
}
"""What is to be small, of singular values (..., r) of N^-1 W S: -ln det (1 + M), ln condition."""
