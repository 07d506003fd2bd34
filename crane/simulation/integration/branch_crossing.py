"""Extrapolation of a motion across a configuration in which branches of motion cross.

Where links become collinear (a folded parallelogram, a slider crank of equal lengths) the loop
equations lose rank: several branches of motion cross, and no chart is regular. The motion is
smooth along its own branch, so state and outputs are polynomials of time: their rates at instants
before the crossing, and then also behind it, are integrated across it.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from crane.common.samples import Array
from crane.machine.machine import Machine

NODES_BEFORE = 7  # nodes before the crossing
STEPS_BEFORE, STEPS_BEHIND = 2, 4  # steps from the last node to the crossing, and from there
NODES_BEHIND = 3  # nodes behind the crossing
MAX_MOTION_PER_STEP = 1e-2  # displacement of the fastest joint in coordinate units
MAX_RELATIVE_RANK = 0.05  # `relative_rank` at a crossing, as a share of that at home
_CORRECTOR_ITERATIONS = 6

RateFunction = Callable[[float, Array], tuple[Array, Array]]
"""(time, state) -> rate of the state, outputs."""


def relative_rank(machine: Machine, q: Array) -> float:
    """Least over largest singular value of the loop equations at a configuration (nq,)."""
    equations, rows = machine.closure.equations, machine.closure.structure.independent_rows
    values = np.linalg.svd(
        equations.evaluate(q)[1][rows] * equations.motion_scales, compute_uv=False
    )
    return float(values[-1] / values[0]) if len(values) else 1.0


@dataclass(frozen=True)
class CrossingPolynomial:
    """State and outputs as polynomials of time.

    Attributes:
        times: (k,) nodes [s].
        start_state: State at the last node before the crossing.
        rates: (k, size) rates of the state at the nodes.
        outputs: (k, .) outputs at the nodes.
        nodes_before: Number of nodes before the crossing.
    """

    times: Array
    start_state: Array
    rates: Array
    outputs: Array
    nodes_before: int

    def state_at(self, time: float) -> Array:
        """The state at an instant [s]."""
        origin = self.times[self.nodes_before - 1]
        unit = self.times[self.nodes_before - 1] - self.times[self.nodes_before - 2]
        at, until = (self.times - origin) / unit, (time - origin) / unit
        powers = np.arange(len(at))
        weights = np.linalg.solve(
            (at[:, None] ** powers).T, until ** (powers + 1.0) / (powers + 1.0)
        )
        return self.start_state + unit * (weights @ self.rates)

    def outputs_at(self, time: float) -> Array:
        """The outputs at an instant [s]."""
        unit = self.times[1] - self.times[0]
        at, until = (self.times - time) / unit, np.zeros(len(self.times))
        until[0] = 1.0
        return np.linalg.solve((at[:, None] ** np.arange(len(at))).T, until) @ self.outputs


def extrapolate_states(times: Array, states: Array, rate: RateFunction) -> CrossingPolynomial:
    """Extrapolation from states (k, size) at times (k,) [s]."""
    rates_and_outputs = [rate(time, state) for time, state in zip(times, states, strict=True)]
    rates, outputs = (np.array(part) for part in zip(*rates_and_outputs, strict=True))
    return CrossingPolynomial(times, states[-1], rates, outputs, len(times))


def correct_polynomial(
    polynomial: CrossingPolynomial, time: float, rate: RateFunction
) -> CrossingPolynomial:
    """The polynomial with further nodes from an instant [s] behind the crossing on.

    It interpolates across the crossing; errors of an extrapolation would grow.
    """
    original, unit = polynomial, polynomial.times[1] - polynomial.times[0]
    node_times_behind = time + unit * np.arange(NODES_BEHIND)
    times = np.append(polynomial.times, node_times_behind)
    for _ in range(_CORRECTOR_ITERATIONS):
        rates_and_outputs = [rate(one, polynomial.state_at(one)) for one in node_times_behind]
        rates, outputs = (np.array(part) for part in zip(*rates_and_outputs, strict=True))
        polynomial = CrossingPolynomial(
            times,
            original.start_state,
            np.vstack([original.rates, rates]),
            np.vstack([original.outputs, outputs]),
            original.nodes_before,
        )
    return polynomial
