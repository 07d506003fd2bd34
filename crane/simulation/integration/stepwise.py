"""Steps of the classical Runge-Kutta method in Python."""

from collections.abc import Callable

import numpy as np

from crane.codegen import Parts
from crane.common.errors import ClosureError, InputError
from crane.common.samples import Array
from crane.control import Controller, ValveDrive
from crane.dynamics import Dynamics
from crane.simulation.integration.halt import HaltedError
from crane.simulation.integration.state import state_layout

Progress = Callable[[int], None] | None
"""What is told the number of finished steps."""


class PythonStepper:
    """One step at a time, for any controller and on any backend of `Dynamics`.

    Args:
        dynamics: The machine.
        control: Its controller.
        own: Number of the controller's states.

    Attributes:
        layout: Parts of the state.
    """

    def __init__(self, dynamics: Dynamics, control: Controller, own: int):
        self._dynamics, self._control = dynamics, control
        self._active = dynamics.machine.closure.active
        self.layout = state_layout(dynamics.machine, own)

    def observe(self, time: float, state: Array) -> tuple[Array, Array]:
        """Rate of the state, and [tau, friction, kinetic, potential, its channels].

        Raises:
            HaltedError: The loops cannot be closed, or the passive joints are not determined.
        """
        rate, tau = self._rate(time, state)
        at = self.layout.view(state)
        seen = self._dynamics.at("observation", at.q, at.v_a, tau)
        more: Array = np.zeros(0)
        if isinstance(self._control, ValveDrive):
            control = self._control
            where = control.at(time, at.q[self._active], at.v_a, at.own)
            more = np.array(control.look(where), dtype=np.float64)
        return rate, np.concatenate([tau, seen, more])

    def advance(self, time: float, state: Array, first: Array, step: float) -> Array:
        """The state one step later, its rate at the start given.

        Raises:
            HaltedError: The motion explodes, or the loops cannot be closed any more.
        """
        total = rate = first
        units = self._dynamics.machine.closure.units
        for share, weight in ((0.5, 2.0), (0.5, 2.0), (1.0, 1.0)):
            if not np.abs(self.layout.view(rate).q / units).max() * step < 1:  # also NaN
                size = self._dynamics.machine.closure.size
                what = f" the motion explodes (over 1 rad or {size:.3g} m in a step of {step:g} s)"
                otherwise = ", and with shorter steps, too: look at its forces and gains"
                here = self.layout.view(state).q[self._active]
                raise HaltedError(time, here, what, otherwise)
            rate, _ = self._rate(time + share * step, state + share * step * rate)
            total = total + weight * rate
        after = state + step / 6 * total
        machine, q = self._dynamics.machine, self.layout.view(after).q
        try:
            closed = machine.closure.solve(q[self._active], guess=q)
        except ClosureError as error:
            raise HaltedError(time + step, q[self._active], f": {error}") from None
        q[:] = machine.coordinates.wrapped(closed)
        return after

    def _rate(self, time: float, state: Array) -> tuple[Array, Array]:
        at = self.layout.view(state)
        try:
            tau, own_rate = self._asked(time, at)
            rates = self._dynamics.at("rates", at.q, at.v_a, tau)
        except ClosureError as error:
            raise HaltedError(time, at.q[self._active], f": {error}") from None
        return np.concatenate([rates[:-1], own_rate, [tau @ at.v_a, rates[-1]]]), tau

    def _asked(self, time: float, at: Parts) -> tuple[Array, Array]:
        """What the controller answers, (n,) and (k,)."""
        tau, rate = self._control(time, at.q[self._active], at.v_a, at.own)
        if np.shape(tau) != at.v_a.shape or np.shape(rate) != at.own.shape:
            raise InputError(
                f"{type(self._control).__name__} gives forces of the shape {np.shape(tau)} and "
                f"rates of the shape {np.shape(rate)}, give {at.v_a.shape} and {at.own.shape}: "
                "one per active joint, one per state"
            )
        return np.asarray(tau), rate
