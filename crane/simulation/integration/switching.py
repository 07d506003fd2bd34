"""Steps that end where a joint starts to slip or comes to rest, in any method."""

from typing import Protocol

import numpy as np

from crane.common.samples import Array
from crane.control import Controller
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.halt import HaltedError
from crane.simulation.integration.stepwise import PythonStepper
from crane.simulation.integration.sticking import NEAR, located

_SAME = 1e-9  # of a recorded step, between instants that are one
_MOST = 2000  # starts and stops within a recorded step


class Compiled(Protocol):
    """A method in machine code."""

    bounds: Array

    @property
    def event(self) -> float:
        """Not 0 where a joint has started or stopped."""

    def adopt(self) -> None:
        """See `Stepper.adopt`."""

    def observe(self, time: float, state: Array) -> tuple[Array, float]:
        """See `Stepper.observe`."""


class Switching:
    """What all methods have in common.

    A method that makes steps of a given length writes `_step`.

    Args:
        chart: The machine.
        control: Its controller.
        own: Number of the controller's states.
        fast: The method in machine code, if it is.

    Attributes:
        slow: Observes, and makes a step with care, or says why it cannot.
        done: Number of instants that have their row, after a run or where it halted.
        reached: The first instant that is not before the state.
        offset: When the state is, after the next instant without a row [s].
    """

    _most = _MOST

    def __init__(self, chart: Chart, control: Controller, own: int, fast: Compiled | None):
        self.slow = PythonStepper(chart, control, own)
        self.done = self.reached = 0
        self.offset = 0.0
        self._sticking, self._code = chart.sticking, fast
        self._dynamics, self._switches, self._since = chart.dynamics, 0, -np.inf

    def limit(self, limits: Array) -> None:
        """Look for other coordinates from there on, see `Chart.limits`."""
        self.slow.limits = limits
        if self._code is not None:
            self._code.bounds[3:5] = limits

    def last(self, time: float, state: Array) -> Array:
        """A row without a step after it.

        Args:
            time: [s].
            state: There.

        Raises:
            HaltedError: It cannot be observed.
        """
        return np.concatenate([state, self._look(time, state)[0]])

    def finer(self, times: Array, rows: Array, step: float) -> float:
        """A step [s] with which the motion goes on where it halted; 0 if none was found.

        Arguments as those of the run that halted. A method that chooses its steps has found none.
        """
        return 0.0

    def _step(self, time: float, state: Array, length: float) -> tuple[Array, float]:
        """The state after one step of some length, and the margin there.

        Not needed of methods that find events within their steps.
        """
        raise NotImplementedError

    def _look(self, time: float, state: Array) -> tuple[Array, float]:
        """What is seen at a state, and its margin."""
        if self._code is not None:
            return self._code.observe(time, state)
        return self.slow.observe(time, state)[1], self.slow.margin

    def _begin(self, time: float, state: Array) -> None:
        """Know what sticks before the first step, and in a chart that was left meanwhile."""
        if not self._sticking.columns:
            return
        if not self._sticking.settled:
            self._settle(time, state)
            return
        self._sticking.tell(self._dynamics)
        if self._code is not None:
            self._code.adopt()

    def _settle(self, time: float, state: Array) -> None:
        """Find anew what sticks at a state."""
        if self._code is None:
            self.slow.settle(time, state)
        else:
            self._code.adopt()
            self.slow.settle(time, state, self._code.observe(time, state)[0])
            self._code.adopt()
        self._sticking.note(time, state)

    def _switched(self, time: float, state: Array, length: float, step: float) -> float:
        """Go on to where a joint starts or stops within a step.

        Args:
            time: [s].
            state: Then; replaced by that at the event, with the joints' new modes.
            length: Of the step [s].
            step: Between instants [s].

        Returns:
            How much later that is [s].

        Raises:
            HaltedError: Joints start and stop without end.
        """
        self._count(time, state, step)
        before, (_, behind) = self._look(time, state)[1], self._step(time, state, length)
        if before < -NEAR:
            later = 0.0
        else:
            later, state[:] = located(
                lambda part: self._step(time, state, part), before, length, behind
            )
        self._settle(time + later, state)
        return later

    def _count(self, time: float, state: Array, step: float) -> None:
        """Count a joint that starts or stops.

        Raises:
            HaltedError: Joints start and stop without end.
        """
        if time > self._since + step:
            self._since, self._switches = time, 0
        self._switches += 1
        if self._switches > self._most:
            raise HaltedError(
                time,
                self.slow.here(state),
                f" joints stick and slip more than {self._most} times within {step:g} s",
                ": forces that jump with the sign of a velocity fight their friction, smooth them",
            )

    def _left(self, offset: float, step: float) -> float:
        """An offset, zero if it is next to nothing."""
        return offset if offset < -_SAME * step else 0.0

    def _completed(self, now: float, state: Array, step: float) -> None:
        """Go on to the next instant, or to where a joint starts or stops before it.

        Args:
            now: The next instant [s].
            state: At `offset`.
            step: Between instants [s].
        """
        after, margin = self._step(now + self.offset, state, -self.offset)
        if margin >= -NEAR:
            state[:], self.offset = after, 0.0
            return
        later = self._switched(now + self.offset, state, -self.offset, step)
        self.offset = self._left(self.offset + later, step)
