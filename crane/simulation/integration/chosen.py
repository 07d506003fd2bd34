"""Recorded instants of methods in machine code that choose their steps themselves."""

from typing import Generic, Protocol, TypeVar

import numpy as np

from crane.common.samples import Array
from crane.control import Controller
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.stepwise import PythonStepper


class _Stepper(Protocol):
    bounds: Array

    def observe(self, time: float, state: Array) -> Array: ...


Fast = TypeVar("Fast", bound=_Stepper)


class ChosenSteps(Generic[Fast]):
    """What such methods have in common.

    Args:
        chart: The machine.
        control: Its controller.
        own: Number of the controller's states.
        fast: The method.

    Attributes:
        slow: Observes.
        done: Number of instants that have their row, after a run or where it halted.
        offset: When the state is, after the next instant without a row [s].
    """

    def __init__(self, chart: Chart, control: Controller, own: int, fast: Fast):
        self._fast, self.slow = fast, PythonStepper(chart, control, own)
        self.done, self.offset = 0, 0.0

    @property
    def reached(self) -> int:
        """The first instant that is not before the state."""
        return self.done

    def limit(self, limits: Array) -> None:
        """See `Steps.limit`."""
        self.slow.limits = self._fast.bounds[-2:] = limits

    def last(self, time: float, state: Array) -> Array:
        """See `Steps.last`."""
        return np.concatenate([state, self._fast.observe(time, state)])

    def finer(self, times: Array, rows: Array, step: float) -> float:
        """No step: the method has found the finest itself."""
        return 0.0
