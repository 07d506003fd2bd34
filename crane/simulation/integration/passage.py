"""Motion across postures in which a linkage could go on in several ways.

Where links come in line (a parallelogram folded flat, a slider crank of equal lengths) the loop
equations lose rank: several branches of motion cross, and no coordinates lead through. The motion
is smooth along its own branch, so state and observations are polynomials of time there: their
rates at instants before, and then at one behind the crossing, are integrated across it.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from crane.common.samples import Array
from crane.machine import Machine

NODES = 7  # instants before the crossing
BEFORE, BEHIND = 2, 4  # steps between the last of them and the crossing, and behind it
AFTER = 3  # nodes behind it
FINE = 1e-2  # way of the fastest joint in a step [rad], share of the machine's size
CROSSING = 0.05  # rank of the loop equations there, as a share of that at home
_CORRECTIONS = 6

Rate = Callable[[float, Array], tuple[Array, Array]]
"""(time, state) -> rate of the state, observations."""


def rank(machine: Machine, q: Array) -> float:
    """Least singular value of the loop equations at a posture (nq,), as a share of the largest."""
    equations, rows = machine.closure.equations, machine.closure.structure.rows
    scaled = equations.evaluate(q)[1][rows] * equations.scales
    values = np.linalg.svd(scaled, compute_uv=False)
    return float(values[-1] / values[0]) if len(values) else 1.0


@dataclass(frozen=True)
class Path:
    """State and observations as polynomials of time.

    Attributes:
        times: (k,) nodes [s].
        start: State at the last node before the crossing.
        rates: (k, size) of the state at the nodes.
        seen: (k, .) observations there.
        before: Number of nodes before the crossing.
    """

    times: Array
    start: Array
    rates: Array
    seen: Array
    before: int

    def state(self, time: float) -> Array:
        """The state at an instant [s]."""
        origin = self.times[self.before - 1]
        unit = self.times[self.before - 1] - self.times[self.before - 2]
        at, until = (self.times - origin) / unit, (time - origin) / unit
        powers = np.arange(len(at))
        weights = np.linalg.solve(
            (at[:, None] ** powers).T, until ** (powers + 1.0) / (powers + 1.0)
        )
        found: Array = self.start + unit * (weights @ self.rates)
        return found

    def observed(self, time: float) -> Array:
        """What is observed at an instant [s]."""
        unit = self.times[1] - self.times[0]
        at, until = (self.times - time) / unit, np.zeros(len(self.times))
        until[0] = 1.0
        found: Array = np.linalg.solve((at[:, None] ** np.arange(len(at))).T, until) @ self.seen
        return found


def ahead(times: Array, states: Array, rate: Rate) -> Path:
    """The path that goes on from states (k, size) at times (k,) [s]."""
    found = [rate(time, state) for time, state in zip(times, states, strict=True)]
    rates, seen = (np.array(part) for part in zip(*found, strict=True))
    return Path(times, states[-1], rates, seen, len(times))


def corrected(path: Path, time: float, rate: Rate) -> Path:
    """The path with the rates at an instant [s] behind the crossing and after it among its nodes.

    Then it is interpolation that leads across, not extrapolation, which errors grow in.
    """
    first, unit = path, path.times[1] - path.times[0]
    behind = time + unit * np.arange(AFTER)
    times = np.append(path.times, behind)
    for _ in range(_CORRECTIONS):
        found = [rate(one, path.state(one)) for one in behind]
        rates, seen = (np.array(part) for part in zip(*found, strict=True))
        path = Path(
            times, first.start, np.vstack([first.rates, rates]), np.vstack([first.seen, seen]),
            first.before,
        )  # fmt: skip
    return path
