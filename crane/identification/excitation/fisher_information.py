"""Fisher information of a motion about base parameters, and its measures."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import InputError
from crane.common.samples import Array, as_sample
from crane.identification.mechanics.base_parameters import BaseParameters
from crane.identification.mechanics.identification_model import IdentificationModel
from crane.identification.mechanics.model_terms import MotionSamples


@dataclass(frozen=True, eq=False)
class InformationMeasures:
    """Information measures of a recording, see `FisherInformation`.

    Attributes:
        condition: Condition number of N^-1 W S, infinite if it is singular.
        logdet: ln det (1 + M).
        smallest_singular_value: Smallest singular value of N^-1 W S; below one, the recording adds
            little to the prior of a combination of parameters.
        std: (r,) expected standard deviations of the base parameters by weighted least squares,
            with the prior if one is given, in SI units; infinite if not identifiable.
    """

    condition: float
    logdet: float
    smallest_singular_value: float
    std: Array


class FisherInformation:
    """Fisher information matrix of base parameters.

        M = S^T (sum_t W_t^T N^-2 W_t) S,    N = diag(noise),

    with the columns W_t of the base parameters in the regressor at instant t, and their prior
    covariance S S^T: ln det (1 + M) is twice the gained information [nat], and parameters below
    the noise in all motions do not contribute (Chaloner, Verdinelli 1995). Without a prior, the
    standard deviation of a base parameter is the value that needs the whole force of the drives,
    as a root mean square over motions within the limits. Scaling by the motion itself would hide
    that it excites a parameter too little. The condition number has the same scales S, since it is
    meaningful only for comparable parameters (Gautier, Khalil 1992).

    Args:
        model: The model.
        base: Base parameters of the model.
        noise: (n,) standard deviations of the white noise of the drive forces [N], [N m].
        force: (n,) largest drive forces [N], [N m].
        random_motions: Motions over the whole limits.
        prior: (p,) prior standard deviations of the parameters of the model.

    Attributes:
        scale: (r, r) scales S.

    Raises:
        InputError: The prior has a wrong shape or is not positive.

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
        """Singular values (motions, r) of N^-1 W S of several motions.

        Args:
            samples: Samples of the motions one after the other, the same number each, evenly over
                a period.
            sample_count: Number of samples in a recording of each motion.
            motion_count: Number of motions.
        """
        return np.asarray(
            np.linalg.svd(
                self._weighted_regressor(samples, sample_count, motion_count), compute_uv=False
            )
        )

    def measures(self, samples: MotionSamples, sample_count: float) -> InformationMeasures:
        """Measures of one motion, see `singular_values`."""
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
        """N^-1 W S (motions, samples n, r), weighted as a recording."""
        W = self._base_regressor(samples) * (
            np.sqrt(sample_count * motion_count / len(samples.q_a)) / self.noise[:, None]
        )
        return W.reshape(motion_count, -1, self.base.rank) @ self.scale


def information_measures(
    rows: Array, scale: Array, prior_information: float
) -> InformationMeasures:
    """Measures of the information matrix M = R^T R.

    Args:
        rows: (N, r) root R, for parameters in their scales.
        scale: (r, r) scales S.
        prior_information: 1 if S S^T is a prior covariance that reduces the standard deviations,
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
    return -np.log1p(singular_values**2).sum(axis=-1)


def _log_condition(singular_values: Array) -> Array:
    with np.errstate(divide="ignore"):
        return np.log(singular_values[..., 0]) - np.log(singular_values[..., -1])


CRITERIA: Mapping[str, Callable[[Array], Array]] = {
    "logdet": _negative_logdet,
    "condition": _log_condition,
}
"""Criteria to be minimized, by singular values (..., r): -ln det (1 + M), ln condition."""
