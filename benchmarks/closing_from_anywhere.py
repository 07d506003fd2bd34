"""Part: close random mechanisms from random starts; compare with scipy.optimize.least_squares.

Each mechanism of `mechanisms.py` is written as a file with a random home configuration within
limits, in which the driven joints have a value at which it closes. The search of the package is
compared with scipy's trust region method with bounds, on the same residual from the same start.
"""

import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mechanisms
import numpy as np
from report import table
from scipy.optimize import least_squares

from crane.closure.constraint_tolerances import FILE_PRECISION
from crane.closure.home_search import find_home
from crane.closure.loop_equations import LoopEquations
from crane.closure.multi_start_search import ClosureResidual, MultiStartSearch
from crane.common.errors import MechanismError
from crane.formats.machine_file.machine_reader import read_machine_spec
from crane.machine.machine_assembly import assemble_tree

CLOSED = 1e-9  # [rad], or share of the machine's size: largest residual of what scipy closes


class Task:
    """A mechanism to be closed from a start.

    Args:
        kind: Of the mechanism.
        seed: Of its dimensions and of the start.
    """

    def __init__(self, kind: str, seed: int):
        self.mechanism = mechanisms.drawn(kind, seed)
        self.said = self.mechanism.start(np.random.default_rng([seed, 1]))
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "mechanism.urdf"
            path.write_text(self.mechanism.urdf(self.said))
            spec = read_machine_spec(path)
        self.equations = LoopEquations(assemble_tree(spec), spec.loops)
        coordinates = self.equations.coordinates
        self.start = np.array([self.said[name] for name in coordinates.names])
        driven = [name in self.mechanism.active for name in coordinates.names]
        self.active, self.passive = np.flatnonzero(driven), np.flatnonzero(~np.array(driven))
        self.lower, self.upper = coordinates.lower, coordinates.upper
        self.residual = ClosureResidual(self.equations)

    def within(self, q: np.ndarray) -> bool:
        """Whether a posture keeps the limits."""
        return bool(((q > self.lower - 1e-9) & (q < self.upper + 1e-9)).all())

    def by_search(self) -> np.ndarray | None:
        """Home as a file gets it; None where it is refused or outside of limits."""
        try:
            structure, _ = find_home(
                self.equations, self.active, self.passive, self.start, range(len(self.start))
            )
        except MechanismError:
            return None
        return structure.home if self.within(structure.home) else None

    def by_descent(self) -> np.ndarray | None:
        """One descent of the search, without a second start."""
        search = MultiStartSearch(self.equations, self.start, np.arange(len(self.start)))
        q, gap = search.minimize_residual(self.start, self.passive, self.passive[:0])
        return q if gap <= FILE_PRECISION * 1e-4 else None

    def by_scipy(self, start: np.ndarray | None = None) -> np.ndarray | None:
        """Scipy's trust region method on the passive joints, within limits."""
        q = (self.start if start is None else start).copy()

        def evaluate(passive: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            q[self.passive] = passive
            gap, slope = self.residual.evaluate(q)
            return gap, slope[:, self.passive]

        found = least_squares(
            lambda passive: evaluate(passive)[0],
            q[self.passive],
            lambda passive: evaluate(passive)[1],
            (self.lower[self.passive], self.upper[self.passive]),
            "trf",
            ftol=None,
            xtol=1e-14,
            gtol=1e-14,
            max_nfev=400,
        )
        q[self.passive] = found.x
        return q if np.abs(found.fun).max() < CLOSED else None

    def open_by(self, q: np.ndarray) -> float:
        """Largest residual of the loop equations [m], [rad]."""
        return float(np.abs(self.equations.evaluate(q)[0]).max())


WAYS = {"search": Task.by_search, "one descent": Task.by_descent, "scipy": Task.by_scipy}


@dataclass(frozen=True)
class Row:
    """What became of one mechanism.

    Attributes:
        kind: Of the mechanism.
        seed: Its number.
        closed: Whether it closed, by way.
        seconds: What that took, by way.
        gap: Largest residual of the loop equations at the home found [m], [rad].
    """

    kind: str
    seed: int
    closed: dict[str, bool]
    seconds: dict[str, float]
    gap: float


def row(kind: str, seed: int) -> Row:
    """Close one mechanism every way."""
    task = Task(kind, seed)
    closed, seconds, gap = {}, {}, 0.0
    for name, way in WAYS.items():
        begun = time.process_time()
        q = way(task)
        seconds[name] = time.process_time() - begun
        closed[name] = q is not None
        if name == "search" and q is not None:
            gap = task.open_by(q)
    return Row(kind, seed, closed, seconds, gap)


def rows(count: int) -> list[Row]:
    """Every kind in turn, so many mechanisms in all."""
    kinds = list(mechanisms.KINDS)
    return [row(kinds[i % len(kinds)], i // len(kinds)) for i in range(count)]


def measure(quick: bool) -> list[Row]:
    """200 mechanisms, or one of each kind."""
    return rows(len(mechanisms.KINDS) if quick else 200)


def tables(results: Sequence[Row]) -> list[str]:
    """Numbers that closed and median times, by kind and in all."""
    kinds = {row.kind: [one for one in results if one.kind == row.kind] for row in results}
    lines = []
    for kind, some in (kinds | {"all": list(results)}).items():
        cells = [f"{sum(one.closed[way] for one in some)}" for way in WAYS]
        cells += [f"{1e3 * np.median([one.seconds[way] for one in some]):.0f}" for way in WAYS]
        gap = max(one.gap for one in some)
        lines.append([kind.replace("_", " "), f"{len(some)}", *cells, f"{gap:.0e}"])
    head = [
        "mechanism", "number", *(f"{way} closed" for way in WAYS),
        *(f"{way} [ms]" for way in WAYS), "open by [m], [rad]",
    ]  # fmt: skip
    return [table(head, lines)]
