"""States of the searches of a calibration, from which an interrupted one goes on."""

from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from crane.common.checkpoint import Checkpoint
from crane.common.samples import Array

LOG_COLUMNS = (
    "search", "iteration", "cost", "damping", "ended", "all iterations", "simulations", "unknowns",
)  # fmt: skip


@dataclass(frozen=True)
class SearchState:
    """State of a search after an iteration.

    Attributes:
        z: (p,) scaled unknowns.
        cost: Cost there.
        damping: Damping of the next step.
        iteration: Number of iterations.
        has_ended: Whether this is the minimum.
        total_iterations: Number of iterations of all searches so far.
        simulations: Number of simulations so far.
    """

    z: Array
    cost: float
    damping: float
    iteration: int = 0
    has_ended: bool = False
    total_iterations: int = 0
    simulations: int = 0


class SearchLog:
    """States of successive searches of a calibration.

    A search depends on nothing but the searches before it and its last state, so that it goes on
    from there as it would have.

    Args:
        checkpoint: Where states are kept; None if they are not.
    """

    def __init__(self, checkpoint: Checkpoint | None):
        self._checkpoint, self._number = checkpoint, 0

    def begin(self) -> SearchState | None:
        """Begin the next search; returns its last state if one is kept."""
        self._number += 1
        with suppress(KeyError, ValueError):  # none, or damaged: it is searched again
            rows = {} if self._checkpoint is None else self._checkpoint.rows
            *numbers, unknowns = rows[(str(self._number),)]
            iteration, cost, damping, has_ended, total, simulations = map(float, numbers)
            return SearchState(
                np.array([float(x) for x in unknowns.split()]), cost, damping, int(iteration),
                bool(has_ended), int(total), int(simulations),
            )  # fmt: skip
        return None

    def add(self, state: SearchState) -> None:
        """Keep a state of the present search.

        Raises:
            OutputError: It cannot be written.
        """
        if self._checkpoint is not None:
            cells = (
                state.iteration, repr(float(state.cost)), repr(float(state.damping)),
                int(state.has_ended), state.total_iterations, state.simulations,
                " ".join(map(repr, state.z.tolist())),
            )  # fmt: skip
            self._checkpoint.append((str(self._number),), cells)
