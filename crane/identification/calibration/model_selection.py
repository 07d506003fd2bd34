"""Selection of the parameters of a calibration by the prediction of blocks that are left out.

All candidates are fitted with their priors first, those in reserve only if the others leave more
than noise: where all of them leave no more, the others alone are fitted. The linearization there,
with residual r and Jacobian J by the scaled unknowns z, predicts the residuals of every other set
S of parameters, the others at the values of the machine: r(z_S) = r - J z + J_S z_S. A fit of S
without block b of contiguous instants is a Gauss-Newton step of normal equations, its error in
block b follows from their matrices. The set grows by the parameter that reduces

    score = sum_c n_c ln(mean square of channel c over all blocks left out) + sum_S (z / prior)^2
            + 2 k

most, with the number n_c of independent samples, deviations z of priors and k parameters, up to
all candidates. The set of the lowest score is kept, without parameters whose deviation is that of
their prior, or that correlate with another one, if they cost nothing.

A linearization does not hold as far as the values of the machine. Therefore the set is fitted by
simulation, and replaces the larger one only if its score (see `multi_start`) over the
training data with the same penalties, is not higher; else the half of what it lacks joins that
was moved farthest. If it is higher by little, simulated fits without each block decide; a fit that
cannot come near the cost of the larger set any more is given up. The set is selected again by the
linearization at its minimum, until nothing is left out any more. At the end it is searched once
more with smoothed friction, from which the lower minimum is kept.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from crane.common.errors import SimulationError
from crane.common.samples import Array
from crane.identification.calibration.levenberg_marquardt import (
    COMPARED_COST_TOLERANCE,
    FINAL_SMOOTHING,
    INITIAL_COST_TOLERANCE,
    LevenbergMarquardt,
)
from crane.identification.calibration.multi_start import (
    lowest_minimum,
    simulated_score,
    smoothed_minimum,
)
from crane.identification.calibration.normal_equations import bounded_step, scaled_inverse
from crane.identification.calibration.unknowns import Unknown

MAX_CORRELATION = 0.98  # of parameters that are both kept
MAX_PRIOR_SHARE = 0.7  # of the deviation of a prior, up to which recordings determine a parameter
BLOCK_DURATION = 3.0  # [s] of a block that is left out
_BLOCK_RANGE = 3, 8  # number of blocks of a recording
_MAX_COST = 4.0  # of the score, of a parameter that the recordings do not determine: chi-square
_SMOOTHED_NOISE_LEVEL = 10.0  # residuals per noise that are of more than smoothed friction
_WEIGHT_ROUNDS = 3  # of weights by redundancies of all candidates
# iterations of the fit of a selected set, and cost per cost of the larger set that it has to reach
_MAX_ITERATIONS, _MAX_COST_RATIO = 12, 1.05
_SCORE_TOLERANCE = 30.0  # difference of scores of one minimum; more is another one
_BLOCK_ITERATIONS = 3  # of the fits without a block
# smoothing and tolerances of the way out of a minimum that may be a kink of friction
_RELEASE_SCHEDULE = (
    ((0.1, 0.1), INITIAL_COST_TOLERANCE),
    ((0.03, 0.03), INITIAL_COST_TOLERANCE),
    (FINAL_SMOOTHING, COMPARED_COST_TOLERANCE),
)


@dataclass(frozen=True)
class SelectionStep:
    """Step of a selection.

    Attributes:
        name: Parameter that was added, or removed.
        is_removal: Whether it was removed.
        score: Score of the set after it, by blocks left out; see the module.
        information_criterion: Bayesian information criterion of the set, n ln(mean square of the
            residual) + k ln(n).
        errors: RMS errors of the channels in the blocks left out, in their units.
    """

    name: str
    is_removal: bool
    score: float
    information_criterion: float
    errors: dict[str, float]


@dataclass(frozen=True, eq=False)
class SelectedModel:
    """Result of a selection.

    Attributes:
        first: Search from several starts.
        search: Search of the selected parameters.
        minimum: (p,) its minimum, where it is linearized.
        steps: Steps of the selection.
        left_out: Parameters that were left out.
    """

    first: LevenbergMarquardt
    search: LevenbergMarquardt
    minimum: Array
    steps: tuple[SelectionStep, ...] = ()
    left_out: tuple[Unknown, ...] = ()


class LinearizedSelection:
    """Sets of unknowns by a linearization.

    Args:
        search: Search of all candidates, linearized at z.
        z: (p,) unknowns.
        kept: Indices of unknowns that all sets contain.
    """

    def __init__(self, search: LevenbergMarquardt, z: Array, kept: Sequence[int]):
        J, self._search, self._z = search.jacobian, search, z
        self._kept, self._count = list(kept), len(search.problem.unknowns)
        residual = search.residual - J @ z
        blocks = training_blocks(search.blocks)
        names = list(search.channel_scales)
        redundancies = np.array([search.redundancies[x] for x in names])
        self._counts = np.bincount(search.channels, minlength=len(names)) / redundancies
        shape = len(np.unique(blocks)), len(names), len(z) + 1, len(z) + 1
        extended = np.column_stack([J, residual])
        self._products = np.zeros(shape)  # by block and channel
        for b in range(shape[0]):
            for c in range(shape[1]):
                rows = extended[(blocks == b) & (search.channels == c)]
                self._products[b, c] = rows.T @ rows
        self._rows = np.bincount(search.channels, minlength=len(names))
        self._by_block = self._products.sum(axis=1)
        self._prior = np.diag(search.prior**2)

    def fit(self, unknowns: Sequence[int], without_block: int | None = None) -> Array:
        """Unknowns (p,) of a set, the others 0.

        Args:
            unknowns: Indices of the set.
            without_block: Block that is left out.
        """
        products = self._by_block.sum(axis=0)
        if without_block is not None:
            products = products - self._by_block[without_block]
        i = np.asarray(unknowns, dtype=int)
        z, search = np.zeros(len(self._z)), self._search
        z[i] = bounded_step(
            (products[:-1, :-1] + self._prior)[np.ix_(i, i)], products[i, -1],
            search.low[i], search.high[i],
        )  # fmt: skip
        return z

    def mean_squares(self, unknowns: Sequence[int], left_out: bool) -> Array:
        """Mean squares (c,) of the weighted residuals, fitted or where blocks are left out."""
        total = np.zeros(len(self._rows))
        for b, products in enumerate(self._products):
            z = np.append(self.fit(unknowns, b if left_out else None), 1.0)
            total += np.einsum("i,cij,j->c", z, products, z)
        return np.maximum(total / self._rows, 1e-12)

    def score(self, parameters: Sequence[int]) -> float:
        """Score of a set of parameters, by blocks left out."""
        unknowns = self.with_starts(parameters)
        squares, z = self.mean_squares(unknowns, True), self.fit(unknowns)
        penalty = float(z @ self._prior @ z)
        return float(self._counts @ np.log(squares)) + penalty + 2.0 * len(parameters)

    def with_starts(self, parameters: Sequence[int]) -> list[int]:
        """Parameters and all starts of recordings."""
        return [*parameters, *range(self._count, len(self._z))]

    def step(self, name: str, is_removal: bool, parameters: Sequence[int]) -> SelectionStep:
        """Step that leads to a set of parameters."""
        unknowns = self.with_starts(parameters)
        fitted, errors = (self.mean_squares(unknowns, x) for x in (False, True))
        total = float(self._counts.sum())
        criterion = float(self._counts @ np.log(fitted)) + len(parameters) * np.log(total)
        sizes = self._search.weight_divisors.items()
        by_name = {c: s * float(np.sqrt(x)) for (c, s), x in zip(sizes, errors, strict=True)}
        return SelectionStep(name, is_removal, self.score(parameters), criterion, by_name)

    def undetermined(self, parameters: Sequence[int]) -> list[int]:
        """Parameters of a set that are known by their prior alone, or correlate with others."""
        unknowns = self.with_starts(parameters)
        hessian = (self._by_block.sum(axis=0)[:-1, :-1] + self._prior)[np.ix_(unknowns, unknowns)]
        covariance = scaled_inverse(hessian)[: len(parameters), : len(parameters)]
        deviations = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
        prior = np.sqrt(np.diag(self._prior))[list(parameters)]
        correlation = covariance / np.outer(deviations, deviations) - np.eye(len(parameters))
        loose = (deviations * prior > MAX_PRIOR_SHARE) | (
            np.abs(correlation) > MAX_CORRELATION
        ).any(axis=1)
        return [p for p, x in zip(parameters, loose, strict=True) if x]

    def path(self) -> tuple[list[int], list[SelectionStep]]:
        """Indices of the selected parameters, and the steps that lead there."""
        unknowns, chosen, steps = self._search.problem.unknowns, list(self._kept), []
        candidates = [i for i in range(self._count) if i not in chosen]
        steps.append(self.step("", False, chosen))
        sets = [list(chosen)]
        while candidates:
            best = min(candidates, key=lambda i: self.score([*chosen, i]))
            candidates.remove(best)
            chosen.append(best)
            sets.append(list(chosen))
            steps.append(self.step(unknowns[best].name, False, chosen))
        size = min(range(len(steps)), key=lambda i: steps[i].score)
        chosen, steps = sets[size], steps[: size + 1]
        while (worst := self.dispensable(chosen)) is not None:
            chosen.remove(worst)
            steps.append(self.step(unknowns[worst].name, True, chosen))
        return chosen, steps

    def dispensable(self, parameters: Sequence[int]) -> int | None:
        """Parameter to remove next from a set, None if there is none.

        One that the recordings do not determine may cost a little of the score, others nothing.
        """
        score, undetermined = self.score(parameters), self.undetermined(parameters)
        costs = {
            i: self.score([x for x in parameters if x != i])
            - score - _MAX_COST * (i in undetermined)
            for i in parameters if i not in self._kept
        }  # fmt: skip
        worst = min(costs, key=costs.__getitem__, default=None)
        return worst if worst is not None and costs[worst] < 0.0 else None


def training_blocks(times: Array) -> Array:
    """Numbers (M,) of the blocks of contiguous instants that are left out, one after another.

    Args:
        times: (M,) time of each row, unique over recordings.
    """
    recordings = np.unique(np.floor(times / 1e8 + 0.5), return_inverse=True)[1]
    numbers, first = np.zeros(len(times), dtype=int), 0
    for i in range(recordings.max() + 1):
        rows = recordings == i
        time = times[rows] - times[rows].min()
        count = int(np.clip(round(time.max() / BLOCK_DURATION), *_BLOCK_RANGE))
        numbers[rows] = first + np.minimum(time / (time.max() + 1e-9) * count, count - 1)
        first += count
    return numbers


def select_parameters(
    search: LevenbergMarquardt, kept_names: Sequence[str], reserve: Mapping[str, Collection[str]]
) -> SelectedModel:
    """Select parameters, see the module.

    Args:
        search: Search of all candidates.
        kept_names: Parameters that are kept in any case.
        reserve: Channels by parameters that are candidates only if the others leave more than
            noise in one of these channels.

    Returns:
        The selected model.
    """
    candidates = search.problem.unknowns
    first, z = _candidates_minimum(search, reserve)
    search = first
    steps, rejected, count = list[SelectionStep](), list[set[str]](), len(candidates) + 1
    while len(search.problem.unknowns) < count:
        count = len(search.problem.unknowns)
        search.update_scales(z)
        search.linearize_for_covariance(z)
        search, z, last = _fewer_parameters(search, z, kept_names, rejected)
        steps = steps or last
    z = search.nearest_minimum(_released_minimum(search, z))
    return SelectedModel(
        first, search, z, tuple(steps),
        tuple(x for x in candidates if x not in search.problem.unknowns),
    )  # fmt: skip


def _candidates_minimum(
    search: LevenbergMarquardt, reserve: Mapping[str, Collection[str]]
) -> tuple[LevenbergMarquardt, Array]:
    """Search of the candidates that are needed, and its minimum (p,).

    Args:
        search: Search of all candidates.
        reserve: See `select_parameters`.
    """
    unknowns = search.problem.unknowns
    channels = {name for x in unknowns for name in reserve.get(x.name, ())}
    reduced = search.restricted_search(
        search.problem.variant([x for x in unknowns if x.name not in reserve])
    )
    z = smoothed_minimum(search)
    if channels and search.leaves_noise(z, channels, _SMOOTHED_NOISE_LEVEL):
        minimum = smoothed_minimum(reduced)
        if reduced.leaves_noise(minimum, channels, _SMOOTHED_NOISE_LEVEL) and reduced.leaves_noise(
            minimum := _weighted_minimum(reduced, lowest_minimum(reduced, minimum)), channels
        ):
            return reduced, minimum
    return search, _weighted_minimum(search, lowest_minimum(search, z))


def _weighted_minimum(search: LevenbergMarquardt, z: Array) -> Array:
    """Minimum (p,) from a start, with weights by the residuals of the channels.

    Before its end a search leaves what looks like errors of the model.
    """
    for _ in range(_WEIGHT_ROUNDS):
        search.update_scales(z)
        search.has_equal_channels = False
        search.problem.smooth, search.problem.slopes = FINAL_SMOOTHING
        z = search.minimize(z, COMPARED_COST_TOLERANCE).z
    return z


def _released_minimum(search: LevenbergMarquardt, z: Array) -> Array:
    """Minimum z (p,), or the one that smoothed friction leads to from there, by the lower cost.

    A search may end at a kink of its cost, where the simulation begins or ceases to stick.
    """
    problem, released = search.problem, z
    with suppress(SimulationError):  # with smoothed friction: the minimum remains
        for smoothing, tolerance in _RELEASE_SCHEDULE if search.has_stiction else ():
            problem.smooth, problem.slopes = smoothing
            released = search.minimize(released, tolerance).z
    problem.smooth, problem.slopes = FINAL_SMOOTHING
    return min((z, released), key=search.cost)


def _fewer_parameters(
    search: LevenbergMarquardt,
    z: Array,
    kept_names: Sequence[str],
    rejected: list[set[str]],
) -> tuple[LevenbergMarquardt, Array, list[SelectionStep]]:
    """Search and minimum of fewer parameters, or of these, and the steps that lead there.

    A linearization does not hold as far as the machine's values. So the selected set is fitted by
    simulation; if that is worse than with all parameters, the half of the others joins that the
    recordings moved farthest, in deviations of their priors. Sets within a rejected one are not
    fitted, until another minimum is found.

    Args:
        search: Search, linearized at its minimum.
        z: (p,) minimum.
        kept_names: Parameters that are kept in any case.
        rejected: Names of sets that were fitted and worse, to which those found here are added.
    """
    parameters = search.problem.unknowns
    selection = LinearizedSelection(
        search, z, [i for i, x in enumerate(parameters) if x.name in kept_names]
    )
    chosen, steps = selection.path()
    others = sorted(set(range(len(parameters))) - set(chosen), key=lambda i: -abs(z[i]))
    score, cost, large = (
        simulated_score(search, z) + 2.0 * len(parameters), search.cost(z), 0.0,
    )  # fmt: skip
    for removed in _last_halves(others):
        remaining = [i for i in range(len(parameters)) if i not in removed]
        kept = [parameters[i] for i in remaining]
        names = {x.name for x in kept}
        if any(names <= x for x in rejected):
            continue
        unknowns = selection.with_starts(remaining)
        fewer = search.restricted_search(search.problem.variant(kept))
        minimum = fewer.minimize(
            min((z[unknowns], selection.fit(unknowns)[unknowns]), key=fewer.cost),
            COMPARED_COST_TOLERANCE,
            max_iterations=_MAX_ITERATIONS,
            highest_cost=_MAX_COST_RATIO * cost,
        ).z
        reduction = score - simulated_score(fewer, minimum) - 2.0 * len(names)
        if -_SCORE_TOLERANCE < reduction < 0.0:
            large = large or _block_score(search, z)
            reduction = large - _block_score(fewer, minimum)
        if reduction >= 0.0:
            rejected[:] = rejected if reduction < _SCORE_TOLERANCE else []
            return fewer, minimum, steps
        rejected.append(names)
    return search, z, steps


def _block_score(search: LevenbergMarquardt, z: Array) -> float:
    """Score of simulated blocks that are left out."""
    return 2.0 * len(search.problem.unknowns) + simulated_score(
        search, z, {name: total for name, (total, _) in block_errors(search, z).items()}
    )


def _last_halves(items: list[int]) -> Iterator[list[int]]:
    """Items, their last half, the last half of this, and so on."""
    while items:
        yield items
        items = items[(len(items) + 1) // 2 :]


def block_errors(search: LevenbergMarquardt, z: Array) -> dict[str, tuple[float, float]]:
    """RMS errors of each channel in blocks that are left out of the fit: of all, and of the worst.

    Args:
        search: Search at its minimum, linearized there.
        z: (p,) minimum.
    """
    problem, squares = search.problem, dict[str, list[tuple[int, float]]]()
    numbers, row = training_blocks(search.blocks), 0
    for k, case in enumerate(problem.cases):
        count = int(case.train_mask.sum()) * len(case.sensors)
        blocks = np.full(len(case.train_mask), -1)
        blocks[case.train_mask] = numbers[row : row + count : len(case.sensors)]
        row += count
        for b in np.unique(blocks[case.train_mask]):
            cases = list(problem.cases)
            cases[k] = replace(case, train_mask=case.train_mask & (blocks != b))
            part = problem.variant(problem.unknowns, cases)
            found = search.restricted_search(part).minimize(
                z, INITIAL_COST_TOLERANCE, max_iterations=_BLOCK_ITERATIONS
            )
            residual = part.residuals(part.cases[k], found.z)[blocks == b]
            for name, x in zip(case.sensors, residual.T, strict=True):
                squares.setdefault(name, []).append((len(x), float(x @ x)))
    return {
        name: (
            float(np.sqrt(sum(x for _, x in parts) / sum(n for n, _ in parts))),
            float(np.sqrt(max(x / n for n, x in parts))),
        )
        for name, parts in squares.items()
    }
