"""What an engine has to do: build a system, simulate it, and compute forward dynamics."""

import importlib.metadata
import importlib.util
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

from multibody import Array, Multibody, State
from problem import Problem

TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11, 1e-12)


class UnsupportedError(Exception):
    """The engine cannot do this problem; the text says why."""


class Engine(ABC):
    """An engine with one method of integration, used as its documentation advises.

    Attributes:
        name: In tables and figures.
        package: Distribution that it comes with.
        module: Module to import.
        advice: Where its documentation says how to use it for closed loops.
        budget: CPU time of all runs of a problem [s], after which no further setting is tried;
            without one, the sweep ends with the first run that is long.
    """

    name: str
    package: ClassVar[str]
    module: ClassVar[str]
    advice: ClassVar[str] = ""
    budget: float = 0.0

    @classmethod
    def version(cls) -> str:
        """Version of the distribution, empty if it is not installed."""
        if importlib.util.find_spec(cls.module) is None:
            return ""
        return importlib.metadata.version(cls.package)

    def settings(self, problem: Problem) -> Sequence[float]:
        """Step lengths [s] or tolerances to sweep, from coarse to fine."""
        return problem.steps

    @abstractmethod
    def build(self, problem: Problem, setting: float) -> "Simulator":
        """A simulator of a problem.

        Raises:
            UnsupportedError: The engine has no way to simulate it.
        """


class Simulator(ABC):
    """A problem that is built in an engine."""

    @abstractmethod
    def run(self) -> Any:
        """Simulate from the start to the end; only this is timed."""

    def single_call(self) -> Callable[[], object]:
        """A call from Python of the least that the engine computes: a step, or accelerations.

        Raises:
            UnsupportedError: It has none.
        """
        raise UnsupportedError("no single steps")

    @abstractmethod
    def states(self, result: Any) -> list[State]:
        """States at the outputs after the start, as far as the run got."""


class TreeSimulator(Simulator):
    """A simulator whose result is (q, v) of the spanning tree at each output."""

    def __init__(self, system: Multibody):
        self.system = system

    def states(self, result: Sequence[tuple[Array, Array]]) -> list[State]:
        """See `Simulator.states`."""
        data = self.system.model.createData()
        return [self.system.state(q, v, data) for q, v in result]
