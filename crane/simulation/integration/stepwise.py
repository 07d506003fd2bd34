"""Steps of the classical Runge-Kutta method in Python."""

from collections.abc import Callable

import numpy as np

from crane.codegen import Parts
from crane.common.errors import ClosureError, InputError
from crane.common.samples import Array
from crane.control import Controller, ValveDrive
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.halt import HaltedError
from crane.simulation.integration.state import state_layout

_AHEAD = 1e-3  # of `Closure.pace`: how far a machine is thought on that stops

Progress = Callable[[int], None] | None
"""What is told the number of finished steps."""


class PythonStepper:
    """One step at a time, for any controller and on any backend of `Dynamics`.

    Args:
        chart: The machine.
        control: Its controller.
        own: Number of the controller's states.

    Attributes:
        layout: Parts of the state.
        limits: Where other coordinates are looked for, see `Chart.limits`.
        margin: See `Moved.margin`, at the state whose rate was computed last.
    """

    def __init__(self, chart: Chart, control: Controller, own: int):
        self._chart, self._dynamics, self._control = chart, chart.dynamics, control
        self.layout = state_layout(chart.machine, own)
        self.limits, self.margin = chart.limits, 1.0

    def settle(self, time: float, state: Array, seen: Array | None = None) -> None:
        """Find which joints stick at a state, whose velocities are made those of rest.

        Args:
            time: [s].
            state: Then.
            seen: What is observed there, if that is known.

        Raises:
            HaltedError: The loops cannot be closed, or the passive joints are not determined.
        """
        at, chart = self.layout.view(state), self._chart
        try:
            tau = np.zeros(0) if seen is None else seen[: len(chart.seen)]
            if seen is None:
                tau, _ = self._asked(time, at, chart.velocities(at.q, at.v_a))
            self._grip(time, at, chart.velocities(at.q, at.v_a))
            forces = chart.forces(at.q, tau)
            forces += chart.outside(time, at.q, at.v_a, at.shear).forces
            at.v_a[:] = chart.sticking.settle(self._dynamics, at.q, at.v_a, forces)
        except ClosureError as error:
            raise HaltedError(time, self.here(state), f": {error}") from None

    def steep(self, state: Array) -> bool:
        """Whether a state is beyond the limits."""
        closure, q = self._chart.machine.closure, self.layout.view(state).q
        if self._chart.steepest(q) > self.limits[0]:
            return True
        return closure.compiled and closure.fast.edge(q) < self.limits[1]

    def here(self, state: Array) -> Array:
        """(n,) coordinates of the user's."""
        return self.layout.view(state).q[self._chart.seen]

    def observe(self, time: float, state: Array) -> tuple[Array, Array]:
        """Rate of the state, and [tau, friction, kinetic, potential, its channels].

        Raises:
            HaltedError: The loops cannot be closed, or the passive joints are not determined.
        """
        rate, tau = self._rate(time, state)
        at = self.layout.view(state)
        outside = self._chart.outside(time, at.q, at.v_a, at.shear)
        forces = self._chart.forces(at.q, tau) + outside.forces
        seen = self._dynamics.at("observation", at.q, at.v_a, forces)
        more: Array = np.zeros(0)
        a: Array = np.zeros(0)
        closure = self._chart.machine.closure
        if self._chart.machine.supports:
            gamma = closure.gamma(at.q)
            a = gamma @ self.layout.view(rate).v_a + closure.drift(at.q, gamma @ at.v_a)
        if isinstance(self._control, ValveDrive):
            control = self._control
            v_a = self._chart.velocities(at.q, at.v_a)
            where = control.at(time, self.here(state), v_a, at.own)
            more = np.array(control.look(where), dtype=np.float64)
        return rate, np.concatenate([tau, seen, outside.seen, a, more])

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
                otherwise = (
                    ", and with steps an eighth as long, too: let method DOP853 choose them, or "
                    "look at its forces and gains"
                )
                raise HaltedError(time, self.here(state), what, otherwise)
            rate, _ = self._rate(time + share * step, state + share * step * rate)
            total = total + weight * rate
        after = state + step / 6 * total
        machine, q = self._dynamics.machine, self.layout.view(after).q
        try:
            closed = machine.closure.solve(q[machine.closure.active], guess=q)
        except ClosureError as error:
            raise HaltedError(time + step, self.here(after), f": {error}") from None
        q[:] = machine.coordinates.wrapped(closed)
        return after

    def stopped(self, time: float, state: Array) -> HaltedError:
        """Why the machine cannot go on, whatever the step."""
        at, closure = self.layout.view(state), self._chart.machine.closure
        try:
            closure.solve(at.q[closure.active] + _AHEAD * closure.pace * at.v_a, guess=at.q)
        except ClosureError as error:
            return HaltedError(time, self.here(state), f": {error}")
        speed = np.abs(at.v_a).max()
        return HaltedError(
            time,
            self.here(state),
            f" the motion cannot be followed, the fastest joint moves at {speed:.3g} m/s or rad/s",
            ": look at its forces and gains, or give end stops damping",
        )

    def _rate(self, time: float, state: Array) -> tuple[Array, Array]:
        at, chart = self.layout.view(state), self._chart
        try:
            v_a = chart.velocities(at.q, at.v_a)
            tau, own_rate = self._asked(time, at, v_a)
            self._grip(time, at, v_a)
            outside = chart.outside(time, at.q, at.v_a, at.shear)
            forces = chart.forces(at.q, tau) + outside.forces
            rates = self._dynamics.at("rates", at.q, at.v_a, forces)
        except ClosureError as error:
            raise HaltedError(time, self.here(state), f": {error}") from None
        self.margin = float(rates[-1])
        energies = [tau @ v_a, *outside.powers, rates[-2]]
        return np.concatenate([rates[:-2], outside.rates, own_rate, energies]), tau

    def _grip(self, time: float, at: Parts, v_a: Array) -> None:
        """Tell the dynamics what seals and brakes of a circuit add to friction."""
        control = self._control
        if self._dynamics.forces.gripped and isinstance(control, ValveDrive):
            where = control.at(time, at.q[self._chart.seen], v_a, at.own)
            self._dynamics.set_grip(np.array(control.grip(where), dtype=np.float64))

    def _asked(self, time: float, at: Parts, v_a: Array) -> tuple[Array, Array]:
        """What the controller answers, (n,) and (k,)."""
        tau, rate = self._control(time, at.q[self._chart.seen], v_a, at.own)
        if np.shape(tau) != v_a.shape or np.shape(rate) != at.own.shape:
            raise InputError(
                f"{type(self._control).__name__} gives forces of the shape {np.shape(tau)} and "
                f"rates of the shape {np.shape(rate)}, give {v_a.shape} and {at.own.shape}: "
                "one per active joint, one per state"
            )
        if self._chart.free:
            self._chart.check_free(np.asarray(tau).tolist(), f" at t = {time:g} s")
        return np.asarray(tau), rate
