"""Multi-start search: a calibration from several starts, of which the better ones go on.

Over a whole motion, one oscillation more or less is a local minimum, and so is a crane that never
lifts. Therefore the search starts from the given values, and from the best of many points, those
of a Sobol sequence and of the machine's values, which are simulated only. In three rounds the
better half of the searches goes on. A search from the given values that leaves nothing but noise
needs no others. Two of the minima with smoothed friction are followed to the friction model, where
the lower score,

    sum_c n_c (ln s_c^2 + mean square of channel c / s_c^2) + sum (z / prior)^2,

with the number n_c of independent samples and the scale s_c of a channel, its RMS residual within
bounds, decides: smoothed friction hides what rings.
"""

from collections.abc import Mapping
from contextlib import suppress

import numpy as np

from crane.common.errors import SimulationError
from crane.common.samples import Array
from crane.identification.calibration.levenberg_marquardt import (
    INITIAL_COST_TOLERANCE,
    LevenbergMarquardt,
    SearchState,
)
from crane.identification.calibration.unknowns import Unknown

_CAUTIOUS_DAMPING = 1.0
_POINT_COUNT = 128  # points of the Sobol sequence
_ROUNDS = ((7, 3), (3, 4), (2, 40))  # searches and iterations of each round
_SAMPLE_DEVIATIONS = 2.0  # of a prior, within which points lie
_SAMPLE_FACTOR = 3.0  # of a start without a prior, likewise
_PRIOR_SHARE = 0.98  # of the normal distribution
_SAME_MINIMUM = 0.1  # distance of scaled unknowns, up to which minima are the same


def minimize_from_starts(search: LevenbergMarquardt) -> Array:
    """Minimum (p,) of a search from several starts, linearized there."""
    return search.nearest_minimum(lowest_minimum(search, smoothed_minimum(search)))


def lowest_minimum(search: LevenbergMarquardt, smoothed: Array) -> Array:
    """Minimum (p,) of the lowest score with the friction model.

    Args:
        search: Search with its minima of smoothed friction.
        smoothed: (p,) lowest of these.
    """
    starts = [
        smoothed,
        *(x.z for x in search.minima[1:2] if np.abs(x.z - smoothed).max() > _SAME_MINIMUM),
    ]
    scales = search.channel_scales, search.redundancies
    found: list[tuple[Array, dict[str, float], dict[str, float]]] = []
    for start in starts:
        search.channel_scales, search.redundancies = scales
        with suppress(*[SimulationError] * bool(found)):
            z = search.sharpen_friction(start)
            found.append((z, search.channel_scales, search.redundancies))
    search.redundancies = found[0][-1]
    scores = [simulated_score(search, z) for z, *_ in found]
    best = int(np.argmin(scores))
    search.minima.insert(0, search.minima.pop(best))
    z, search.channel_scales, search.redundancies = found[best]
    return z


def simulated_score(
    search: LevenbergMarquardt, z: Array, errors: Mapping[str, float] | None = None
) -> float:
    """Score of simulated unknowns, see the module.

    Args:
        search: The search.
        z: (p,) unknowns.
        errors: RMS errors of its channels, by default those of the training data.
    """
    counts = dict.fromkeys(search.channel_scales, 0.0)
    for case in search.training_cases:
        for name in case.sensors:
            counts[name] += float(case.train_mask.sum()) / search.redundancies[name]
    errors = search.training_errors(z) if errors is None else errors
    scales = {name: np.clip(x, *search.scale_bounds[name]) for name, x in errors.items()}
    likelihood = sum(
        counts[name] * (2.0 * np.log(scale) + (errors[name] / scale) ** 2)
        for name, scale in scales.items()
    )
    return float(likelihood + np.sum((search.prior * z) ** 2))


def smoothed_minimum(search: LevenbergMarquardt) -> Array:
    """Lowest minimum (p,) with smoothed friction, from several starts."""
    search.start_with_smoothed_friction()
    first = search.minimize(
        np.zeros(search.problem.unknown_count), INITIAL_COST_TOLERANCE, _CAUTIOUS_DAMPING,
        _ROUNDS[0][1],
    )  # fmt: skip
    search.minima = [first] if search.leaves_noise(first.z) else _race(search, first)
    search.update_scales(search.minima[0].z)
    return search.minimize(search.minima[0].z, INITIAL_COST_TOLERANCE).z


def _race(search: LevenbergMarquardt, first: SearchState) -> list[SearchState]:
    """Minima of the searches that were finished, the lowest first.

    Args:
        search: The search.
        first: State of the search from the given values after the first round.
    """
    starts = _sampled_points(search)
    points = [SearchState(z, search.cost(z), _CAUTIOUS_DAMPING) for z in starts]
    states = sorted((x for x in points if np.isfinite(x.cost)), key=lambda x: x.cost)
    others = [first]
    for count, iterations in _ROUNDS:
        found = []
        for x in states[:count]:
            with suppress(SimulationError):  # of a crane that none is: near a dead centre
                found.append(search.minimize(x.z, INITIAL_COST_TOLERANCE, x.damping, iterations))
        states = sorted([*others, *found], key=lambda x: x.cost)
        others = []
    return states


def _sampled_points(search: LevenbergMarquardt) -> list[Array]:
    """Machine parameters as the machine has them and by a Sobol sequence.

    Sensors are linear and start at 0.
    """
    from scipy.stats import qmc

    unknowns = search.problem.unknowns
    varied = [i for i, x in enumerate(unknowns) if not x.sensor]
    if not varied:
        return []
    points, z = [], np.zeros(search.problem.unknown_count)
    z[varied] = [
        (unknowns[i].machine_value - unknowns[i].start) / unknowns[i].scale for i in varied
    ]
    if np.any(z):
        points.append(np.clip(z, search.low, search.high))
    for shares in qmc.Sobol(len(varied), seed=0).random(_POINT_COUNT):
        z = np.zeros(search.problem.unknown_count)
        z[varied] = [sample(unknowns[i], x) for i, x in zip(varied, shares, strict=True)]
        points.append(np.clip(z, search.low, search.high))
    return points


def sample(unknown: Unknown, share: float) -> float:
    """Scaled value of an unknown where its distribution reaches a share.

    The distribution is that of its prior. Without a prior, it is uniform in the logarithm for
    positive parameters, else uniform.
    """
    from scipy.stats import norm

    if unknown.prior:
        return float(norm.ppf(0.5 + (share - 0.5) * _PRIOR_SHARE)) / unknown.prior
    start = unknown.start
    if start > 0 and unknown.low >= 0 and unknown.scale == start:
        value = start * _SAMPLE_FACTOR ** (2.0 * share - 1.0)
    elif np.isfinite(unknown.high - unknown.low):
        value = unknown.low + share * (unknown.high - unknown.low)
    else:
        value = start + _SAMPLE_DEVIATIONS * unknown.scale * (2.0 * share - 1.0)
    return (value - start) / unknown.scale
