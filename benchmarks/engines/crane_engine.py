"""This package."""

from collections.abc import Callable, Sequence

import numpy as np
from multibody import Array
from problem import Problem

import crane
from engines.engine import TOLERANCES, Engine, TreeSimulator

PINOCCHIO_BUDGET = 3.0  # CPU time of the runs of a problem [s]


class Crane(Engine):
    """`crane.simulate`, the whole call with its recording.

    Args:
        method: See `crane.simulate`.
        backend: See `crane.simulate`; with "pinocchio", the methods with a tolerance are scipy's.
    """

    package, module = "crane-dynamics", "crane"

    def __init__(self, method: str, backend: str = "compiled"):
        self.name, self._method, self._backend = f"crane {method}", method, backend
        if backend == "pinocchio":
            self.name, self.budget = f"scipy {method} on pin", PINOCCHIO_BUDGET

    def settings(self, problem: Problem) -> Sequence[float]:
        """See `Engine.settings`."""
        return problem.steps if self._method == "rk4" else TOLERANCES

    def build(self, problem: Problem, setting: float) -> "CraneSimulator":
        """See `Engine.build`."""
        return CraneSimulator(problem, self._method, setting, self._backend)


class CraneSimulator(TreeSimulator):
    """Outputs are those of the recording."""

    def __init__(self, problem: Problem, method: str, setting: float, backend: str = "compiled"):
        super().__init__(problem.system)
        self._arguments = {"duration": problem.duration, "method": method, "backend": backend}
        interval = float(problem.times[1])
        if method == "rk4":
            self._arguments["step"] = setting
            self._stride = round(interval / setting)
        else:
            self._arguments |= {"step": interval, "tolerance": setting}
            self._stride = 1
        machine = self.system.machine
        active = machine.closure.active
        self._start = self.system.q[active], self.system.v[active]
        if backend == "compiled":
            self.run()  # compiles, or reads the machine code

    def run(self) -> crane.Recording:
        """See `Simulator.run`."""
        return crane.simulate(self.system.machine, None, self._start, **self._arguments)

    def single_call(self) -> Callable[[], Array]:
        """Accelerations of the active joints; the loops are closed in the call."""
        forward = crane.Dynamics(self.system.machine).forward
        q, v = self._start
        return lambda: forward(q, v, np.zeros_like(v))

    def states(self, result: crane.Recording) -> list:
        """See `Simulator.states`."""
        machine = self.system.machine
        columns = [
            result.q[:, machine.active.index(joint)]
            if joint in machine.active
            else result.channels[joint]
            for joint in machine.joints
        ]
        q = np.column_stack(columns)[self._stride :: self._stride]
        v_a = result.v[self._stride :: self._stride]
        pairs: list[tuple[Array, Array]] = [
            (one, machine.closure.gamma(one) @ rate) for one, rate in zip(q, v_a, strict=True)
        ]
        return super().states(pairs)
