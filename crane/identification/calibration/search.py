"""The search for a calibration: Levenberg and Marquardt's method within bounds."""

import warnings
from collections.abc import Callable, Sequence

import numpy as np

from crane.common.errors import CraneError
from crane.common.samples import Array
from crane.dynamics.joint_forces import sticking
from crane.identification.calibration.lacking import Lacking, lacking
from crane.identification.calibration.problem import ROUGH, Case, Problem, noise_of
from crane.identification.calibration.unknowns import Unknown

Progress = Callable[[float], None]

_ROUNDS = 3  # of weights
_SAME = 0.05  # change of a channel's size, as a share, that ends them
# shares of the smoothing of friction, and of that of derivatives: first, and in the end
_SMOOTHER, _AS_IT_IS = ((1.0, 1.0), (0.3, 0.3), (0.1, 0.1), (0.0, 0.3)), (0.0, 0.03)
_TOLD = 0.1  # of derivatives that tell how well all is known
_STEPS = 40  # of Gauss-Newton between them
_SETTLED, _BEGUN = 1e-4, 1e-2  # change of the cost, as a share, that ends them
_EXACT, _NOTHING = 1e-6, 1e-9  # of a channel's largest value, and of one that is zero [SI]
_FLOOR = 0.2  # of a channel's variation, that no channel may be off by for nothing
_DAMPED, _CAREFUL = 1e-3, 1.0  # Levenberg's damping at first, and far from the end
_GROWN, _SHRUNK, _STIFFEST = 10.0, 0.2, 1e8  # of it
_PART = 2.0  # [s] of recordings that are begun with
_CRUDE = 1e-2  # error of derivatives far from the end
_BLOCKS = 8, 40  # least and most blocks of a covariance


class Search:
    """Levenberg and Marquardt's method within bounds, and the channels' weights.

    Attributes:
        sizes: (k,) by sensor, what is left of its channel.
        jacobian: (M, p) weighted derivatives at the end, of what is fitted.
        residual: (M,) weighted, likewise.
        blocks: (M,) block of each row.
    """

    def __init__(self, problem: Problem, progress: Progress | None, done: int = 0):
        self._problem, self._progress = problem, progress
        unknowns = problem.unknowns
        rest = problem.size - len(unknowns)
        self.low = np.array([(x.low - x.start) / x.scale for x in unknowns] + [-np.inf] * rest)
        self.high = np.array([(x.high - x.start) / x.scale for x in unknowns] + [np.inf] * rest)
        self.prior = np.array([x.prior for x in unknowns] + [1.0] * rest)
        self.sizes: dict[str, float] = {}
        self.jacobian = self.residual = self.blocks = np.zeros(0)
        self._done = done
        self._begins: Array | None = None
        self._sticks = bool(sticking(problem.machine))

    def narrowed(self, problem: Problem, z: Array) -> "Search":
        """A search of fewer numbers that begins near where this one ended."""
        found = Search(problem, self._progress, self._done)
        found.sizes, found._begins = self.sizes, z
        return found

    def run(self) -> Array:
        """The unknowns."""
        problem = self._problem
        z = self.begun() if self._begins is None else self._begins
        problem.rough = ROUGH
        # what smoothed friction leaves is no measure of what is left in the end: it is taken anew
        for problem.smooth, problem.slopes in _SMOOTHER if self._sticks else ():
            z = self._minimum(z, _BEGUN)
            self.sizes = self._fresh(z)
        return self.onward(z)

    def begun(self) -> Array:
        """About the unknowns, with friction that is smoothed, and linearized there."""
        problem = self._problem
        self.sizes = self._most()
        problem.smooth, problem.rough = float(self._sticks), _CRUDE
        z = self._begun(np.zeros(problem.size))
        self.sizes = self._fresh(z)
        z = self._minimum(z, _BEGUN)
        self._linearize(z)
        return z

    def onward(self, z: Array) -> Array:
        """The unknowns of the minimum that is nearest to others, with its own weights."""
        problem = self._problem
        problem.smooth, problem.slopes = _AS_IT_IS
        for _ in range(_ROUNDS):
            z = self._minimum(z)
            before, self.sizes = self.sizes, self._fresh(z)
            if all(abs(np.log(x / before[name])) < _SAME for name, x in self.sizes.items()):
                break
        problem.slopes = _TOLD
        self._linearize(z)
        if self._progress is not None:
            self._progress(1.0)
        return z

    def _most(self) -> dict[str, float]:
        """The largest size of each channel, by its variation and its noise."""
        noise, spread = self._noise(), self._spread()
        return {name: max(noise[name], _FLOOR * spread[name]) for name in noise}

    def _fresh(self, z: Array) -> dict[str, float]:
        """Sizes of the channels by what is left of them."""
        noise, most = self._noise(), self._most()
        left = self._left([self._problem.residuals(case, z) for case in self._trained])
        return {name: min(max(noise[name], left[name]), most[name]) for name in left}

    def _begun(self, z: Array) -> Array:
        """The better one of two minima: from the file's numbers, and from those of short parts.

        Over long motions, one swing more or less is a minimum, too, and so is what never moves.
        """
        problem, count = self._problem, len(self._problem.unknowns)
        found = [self._minimum(z, _BEGUN, _CAREFUL)]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            parts = [x for case in self._trained for x in case.parts(problem.machine, _PART)]
        if parts:
            short = Problem(problem.machine, problem.unknowns, parts)
            short.smooth, short.rough = problem.smooth, problem.rough
            search = Search(short, self._progress, self._done)
            search.sizes = self.sizes
            there = search._minimum(np.zeros(short.size), _BEGUN, _CAREFUL)
            self._done = search._done
            problem.runs += short.runs
            z = z.copy()
            z[:count] = there[:count]
            if np.isfinite(self._cost(z)):
                found.append(self._minimum(z, _BEGUN, _CAREFUL))
        return min(found, key=self._cost)

    @property
    def _trained(self) -> list[Case]:
        return [case for case in self._problem.cases if case.train.any()]

    def _noise(self) -> dict[str, float]:
        """Of each channel, by its third differences, and no less than its digits."""
        found: dict[str, list[float]] = {}
        largest: dict[str, float] = {}
        for case in self._trained:
            for name, x in zip(case.sensors, case.measured.T, strict=True):
                said = case.known[name].noise if name in case.known else 0.0
                found.setdefault(name, []).append((said or noise_of(x)) ** 2)
                largest[name] = max(largest.get(name, 0.0), float(np.abs(x).max()))
        return {
            name: max(float(np.sqrt(np.mean(x))), _EXACT * largest[name], _NOTHING)
            for name, x in found.items()
        }

    def _spread(self) -> dict[str, float]:
        """Of each channel, the largest variation of those in its unit.

        How far a model is off depends on what moves, not on which channel does.
        """
        found: dict[str, float] = {}
        units: dict[str, str] = {}
        for case in self._trained:
            for name, x in zip(case.sensors, case.measured[case.train].T, strict=True):
                units[name] = case.table.units[name]
                found[units[name]] = max(found.get(units[name], 1e-12), float(np.std(x)))
        return {name: found[unit] for name, unit in units.items()}

    def _left(self, residuals: list[Array]) -> dict[str, float]:
        """Root mean square of each channel over what is fitted."""
        found: dict[str, list[Array]] = {}
        for case, residual in zip(self._trained, residuals, strict=True):
            for name, x in zip(case.sensors, residual[case.train].T, strict=True):
                found.setdefault(name, []).append(x)
        return {
            name: max(float(np.sqrt(np.mean(np.concatenate(x) ** 2))), _NOTHING)
            for name, x in found.items()
        }

    def _weights(self, case: Case) -> Array:
        """(N, k) one over the channels' sizes, 0 of what is held out."""
        return case.train[:, None] / np.array([self.sizes[name] for name in case.sensors])

    def left(self, z: Array) -> Array:
        """(M,) weighted residuals.

        Raises:
            CraneError: The machine cannot be, or its simulation fails.
        """
        every = [
            self._problem.residuals(case, z, fitted=True) * self._weights(case)
            for case in self._trained
        ]
        return np.concatenate([
            left[case.train].ravel() for left, case in zip(every, self._trained, strict=True)
        ])  # fmt: skip

    def _cost(self, z: Array) -> float:
        """Half the sum of squares, infinite where the machine cannot be."""
        total = float(np.sum((self.prior * z) ** 2))
        for case in self._trained:
            try:
                left = self._problem.residuals(case, z, fitted=True) * self._weights(case)
            except CraneError:
                return np.inf
            total += float(np.sum(left**2))
        return 0.5 * total

    def _linearize(self, z: Array) -> None:
        rows, left, blocks = [], [], []
        for number, case in enumerate(self._trained):
            residual, slopes = self._problem.linearized(case, z)
            weights = self._weights(case)
            some = case.train
            rows.append((slopes * weights[:, :, None])[some].reshape(-1, self._problem.size))
            left.append((residual * weights)[some].ravel())
            time = np.repeat(case.inputs.time[some], len(case.sensors))
            blocks.append(time + 1e9 * number)
        self.jacobian, self.residual = np.vstack(rows), np.concatenate(left)
        self.blocks = np.concatenate(blocks)

    def lacking(self, others: Sequence[Unknown], z: Array) -> list[Lacking]:
        """Numbers that are not fitted and would help, see `Lacking`."""
        problem = self._problem
        if not others:
            return []
        whole = Problem(problem.machine, [*problem.unknowns, *others], problem.cases)
        whole.smooth, whole.slopes = problem.smooth, problem.slopes
        count, more = len(problem.unknowns), len(others)
        there = np.concatenate([z[:count], np.zeros(more), z[count:]])
        rows = []
        for case, wider in zip(problem.cases, whole.cases, strict=True):
            if not case.train.any():
                continue
            try:
                _, slopes = whole.linearized(wider, there, set(range(count)))
            except CraneError:  # a hint is not worth what was found
                return []
            own = (slopes * self._weights(case)[:, :, None])[case.train]
            rows.append(own.reshape(-1, whole.size)[:, count : count + more])
        return lacking(others, self.jacobian, np.vstack(rows), self.residual, self.prior)

    def _minimum(self, z: Array, settled: float = _SETTLED, damping: float = _DAMPED) -> Array:
        """The nearest minimum for the present weights."""
        cost = self._cost(z)
        if not np.isfinite(cost):  # say why
            for case in self._trained:
                self._problem.residuals(case, z)
        for _ in range(_STEPS):
            self._linearize(z)
            hessian = self.jacobian.T @ self.jacobian + np.diag(self.prior**2)
            gradient = self.jacobian.T @ self.residual + self.prior**2 * z
            before = cost
            while True:
                there = self._step(z, hessian, gradient, damping)
                new = self._cost(there)
                self._report()
                if new < cost:
                    z, cost, damping = there, new, max(damping * _SHRUNK, 1e-9)
                    break
                damping *= _GROWN
                if damping > _STIFFEST:
                    return z
            if before - cost < settled * before:
                break
        return z

    def _step(self, z: Array, hessian: Array, gradient: Array, damping: float) -> Array:
        """A damped step, of which what would leave its bounds stays on them."""
        size = np.diag(hessian)
        scaled = hessian + damping * np.diag(np.maximum(size, 1e-12 * size.max()))
        free = np.ones(len(z), dtype=bool)
        step = np.zeros(len(z))
        for _ in range(len(z)):
            at = np.flatnonzero(free)
            right = -gradient[at] - scaled[np.ix_(at, ~free)] @ step[~free]
            step[at] = np.linalg.lstsq(scaled[np.ix_(at, at)], right, rcond=1e-12)[0]
            there = z + step
            out = free & ((there < self.low) | (there > self.high))
            if not out.any():
                break
            step[out] = np.clip(there, self.low, self.high)[out] - z[out]
            free &= ~out
        return np.clip(z + step, self.low, self.high)

    def _report(self) -> None:
        self._done += 1
        if self._progress is not None:
            self._progress(1.0 - 0.97**self._done)

    def covariance(self, z: Array) -> tuple[Array, int]:
        """(p, p) of the unknowns in their scales, and the number of blocks.

        H^-1 (sum_b g_b g_b^T) H^-1 with g_b the gradient of a block, and at least that of white
        noise; as if there were no bounds.
        """
        hessian = self.jacobian.T @ self.jacobian + np.diag(self.prior**2)
        inverse = np.linalg.pinv(hessian, rcond=1e-13, hermitian=True)
        length, count = self._length()
        numbers = np.unique(np.floor(self.blocks / length), return_inverse=True)[1]
        weighed = self.jacobian * self.residual[:, None]
        sums = np.zeros((numbers.max() + 1, len(z)))
        np.add.at(sums, numbers, weighed)
        count = len(sums)
        meat = sums.T @ sums * (count / max(count - 1, 1)) + np.diag(self.prior**2)
        robust = inverse @ meat @ inverse
        freedom = max(len(self.residual) - len(z), 1)
        white = inverse * float(self.residual @ self.residual) / freedom
        more = np.sqrt(np.maximum(np.diag(white) / np.maximum(np.diag(robust), 1e-300), 1.0))
        return robust * np.outer(more, more), count

    def _length(self) -> tuple[float, int]:
        """Of a block [s]: four times over which what is left remembers itself."""
        longest, whole = 0.0, 0.0
        for case in self._trained:
            time = case.inputs.time[case.train]
            whole += float(time[-1] - time[0])
        start = 0
        for case in self._trained:
            k, count = len(case.sensors), int(case.train.sum())
            rows = self.residual[start : start + k * count].reshape(count, k)
            start += k * count
            step = float(np.median(np.diff(case.inputs.time)))
            for x in rows.T:
                longest = max(longest, step * _memory(x))
        length = min(max(4.0 * longest, whole / _BLOCKS[1]), whole / _BLOCKS[0])
        return max(length, 1e-9), int(whole / length) if length else 1


def _memory(x: Array) -> float:
    """Samples over which a sequence remembers itself: its integral correlation time."""
    x = x - x.mean()
    power = float(x @ x)
    if not power:
        return 0.0
    size = 1 << (2 * len(x) - 1).bit_length()
    spectrum = np.fft.rfft(x, size)
    correlation = np.fft.irfft(spectrum * spectrum.conj(), size)[: len(x)] / power
    negative = np.flatnonzero(correlation < 0.05)
    return float(correlation[: negative[0] if len(negative) else len(x)].sum())
