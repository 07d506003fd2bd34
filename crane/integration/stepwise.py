"""Steps of the classical Runge-Kutta method in Python."""

import numpy as np

from crane.control import Controller, StiffController
from crane.dynamics import Dynamics
from crane.errors import ClosureError
from crane.integration.halt import HaltedError
from crane.samples import Array


class PythonStepper:
    """One step at a time, for any controller and on any path of `Dynamics`.

    Args:
        dynamics: The machine.
        control: Its controller.
    """

    def __init__(self, dynamics: Dynamics, control: Controller):
        self._dynamics, self._control = dynamics, control
        machine = dynamics.machine
        self._nq, self._active = machine.model.nq, machine.closure.active
        self._speeds = slice(self._nq, self._nq + len(machine.active))

    def observe(self, time: float, state: Array) -> tuple[Array, Array]:
        """Rate of the state, and [tau, friction, kinetic, potential, its channels].

        Raises:
            HaltedError: The loops cannot be closed, or the passive joints are not determined.
        """
        rate, tau = self._rate(time, state)
        q, v_a = state[: self._nq], state[self._speeds]
        seen = self._dynamics.at("observation", q, v_a, tau)
        own: Array = np.zeros(0)
        if isinstance(self._control, StiffController):
            own = self._control.observe(time, q[self._active], v_a, state[self._speeds.stop : -2])
        return rate, np.concatenate([tau, seen, own])

    def advance(self, time: float, state: Array, first: Array, step: float) -> Array:
        """The state one step later, its rate at the start given.

        Raises:
            HaltedError: The motion explodes, or the loops cannot be closed any more.
        """
        total = rate = first
        for share, weight in ((0.5, 2.0), (0.5, 2.0), (1.0, 1.0)):
            if not np.abs(rate[: self._nq]).max() * step < 1:  # also NaN
                what = f" the motion explodes (over 1 m or rad in a step of {step:g} s)"
                otherwise = ", and with shorter steps, too: look at its forces and gains"
                raise HaltedError(time, state[: self._nq][self._active], what, otherwise)
            rate, _ = self._rate(time + share * step, state + share * step * rate)
            total = total + weight * rate
        after = state + step / 6 * total
        q = after[: self._nq]
        try:
            closed = self._dynamics.machine.closure.solve(q[self._active], guess=q)
        except ClosureError as error:
            raise HaltedError(time + step, q[self._active], f": {error}") from None
        after[: self._nq] = closed
        return after

    def _rate(self, time: float, state: Array) -> tuple[Array, Array]:
        q, v_a = state[: self._nq], state[self._speeds]
        own = state[self._speeds.stop : -2]
        try:
            tau, own_rate = self._control(time, q[self._active], v_a, own)
            rates = self._dynamics.at("rates", q, v_a, tau)
        except ClosureError as error:
            raise HaltedError(time, q[self._active], f": {error}") from None
        return np.concatenate([rates[:-1], own_rate, [tau @ v_a, rates[-1]]]), tau
