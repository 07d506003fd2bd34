"""Observation and steps of a controlled machine in Python, and halts of an integration."""

from collections.abc import Callable
from typing import Any

import numpy as np

from crane.codegen import LayoutView
from crane.common.errors import (
    ClosureError,
    CraneError,
    InputError,
    SimulationError,
    SingularMassMatrixError,
)
from crane.common.samples import Array
from crane.control.valve_drive import ValveDrive
from crane.dynamics.external_forces import ExternalForceValues
from crane.machine.machine import Machine
from crane.motion.limit_violations import limit_tolerances
from crane.motion.trajectory import Trajectory
from crane.simulation.integration.charts import Chart


class IntegrationHaltError(SimulationError):
    """A halt: the integration cannot continue.

    Args:
        time: Time of the halt [s].
        q_a: (n,) active coordinates of the user.
        description: The cause, a continuation of the message after the time.
        default_remedy: Remedy if no joint passed a limit and no shorter step helps; empty where
            the cause names the remedy.
        explain: Finds the cause, which takes long, where the motion does not go on in another way.

    Attributes:
        time: Time of the halt [s].
        q_a: (n,) active coordinates of the user.
        default_remedy: See the arguments.
    """

    def __init__(
        self,
        time: float,
        q_a: Array,
        description: str,
        default_remedy: str = ", with all active joints within their limits: keep away "
        "from there, 'crane workspace' shows where the loops close",
        explain: "Callable[[], IntegrationHaltError] | None" = None,
    ):
        super().__init__(f"at t = {time:.6g} s{description}")
        self.time, self.q_a, self.default_remedy = time, np.array(q_a), default_remedy
        self._explain = explain

    def explained(self) -> "IntegrationHaltError":
        """The halt with its cause."""
        return self if self._explain is None else self._explain()


def explain_halt(
    machine: Machine,
    halt: IntegrationHaltError,
    times: Array,
    q_a: Array,
    reference: Trajectory | None = None,
    finer_step: float = 0.0,
) -> SimulationError:
    """Error of a run that halted, with the probable cause and a remedy.

    Args:
        machine: The machine.
        halt: The halt.
        times: (N,) instants of the motion up to the halt [s]; may be empty.
        q_a: (N, n) active coordinates at these instants.
        reference: The reference trajectory, or None.
        finer_step: A step size with which the motion continues [s]; 0 if unknown.
    """
    hint = f"; with a step of {finer_step:g} s it goes on: shorten the step"
    if not halt.default_remedy:
        return SimulationError(str(halt))
    if not finer_step:
        hint = _passed_limit_text(machine, halt, times, q_a, reference) or halt.default_remedy
    return SimulationError(f"{halt}{hint}")


def _passed_limit_text(
    machine: Machine,
    halt: IntegrationHaltError,
    times: Array,
    q_a: Array,
    reference: Trajectory | None,
) -> str:
    """Text about the active joint farthest beyond its limit; empty if none is."""
    lower, upper = machine.lower, machine.upper
    excess = np.maximum(lower - halt.q_a, halt.q_a - upper)
    active = machine.closure.active
    i = int(
        np.argmax(
            excess
            / np.where(np.isfinite(upper - lower), upper - lower, machine.closure.units[active])
        )
    )
    slack = limit_tolerances(machine)[active[i]]
    if not excess[i] > slack:
        return ""
    joint, unit, value = machine.active[i], machine.unit(machine.active[i]), halt.q_a[i]
    limit = lower[i] if value < lower[i] else upper[i]
    text = f"; '{joint}' is at {value:.6g} {unit}, beyond its limit {limit:.6g} {unit}"
    if len(times):
        inside = np.flatnonzero(~((q_a[:, i] < lower[i] - slack) | (q_a[:, i] > upper[i] + slack)))
        first = int(inside[-1]) + 1 if len(inside) else 0
        passed_time = times[first] if first < len(times) else halt.time
        text += f" since t = {passed_time:.4g} s"
    has_end_stop = any(stop.joint == joint for stop in machine.end_stops)
    remedy = "stiffen its end stop" if has_end_stop else "give it an end stop"
    if reference is not None:
        reference_value = float(reference.position(halt.time)[i])
        if not lower[i] - slack <= reference_value <= upper[i] + slack:
            remedy = (
                f"keep its reference ({reference_value:.6g} {unit}) within the limits, or {remedy}"
            )
    return f"{text}: {remedy}"


_EXTRAPOLATION_TIME = 1e-3  # extrapolation of a halted motion [characteristic times]

StepProgress = Callable[[int], None]
"""Called with the number of finished steps."""


class PythonStepper:
    """Single steps in Python, for any controller and any backend of `Dynamics`.

    Args:
        chart: The machine in a chart.

    Attributes:
        state_layout: Layout of the state.
        chart_limits: See `Chart.chart_limits`.
        transition_margin: See `StickSlipAccelerations.transition_margin`, at the state whose rate
            was computed last.
    """

    def __init__(self, chart: Chart):
        self._chart, self._dynamics, self._control = chart, chart.dynamics, chart.control
        self.state_layout = chart.state_layout
        self.chart_limits, self.transition_margin = chart.chart_limits, 1.0

    def find_modes(self, time: float, state: Array, outputs: Array | None = None) -> None:
        """Determine the stick-slip modes at a state; sets the velocities of joints at rest to 0.

        Args:
            time: [s].
            state: State at this time.
            outputs: Its outputs, if they are known.

        Raises:
            IntegrationHaltError: The loops do not close, or the configuration is singular.
        """
        at, chart = self.state_layout.view(state), self._chart
        try:
            v_a = chart.user_velocities(at.q, at.v_a)
            tau = np.zeros(0) if outputs is None else outputs[: len(chart.user_columns)]
            if outputs is None:
                tau, _ = self._controller_output(time, at, v_a)
            forces, _ = self._applied_forces(time, at, v_a, tau)
            at.v_a[:] = chart.stick_slip.find_modes(self._dynamics, at.q, at.v_a, forces)
        except (ClosureError, SingularMassMatrixError) as error:
            raise self._closure_halt(time, state, error) from None

    def exceeds_chart_limits(self, state: Array) -> bool:
        """Whether a state is outside of the limits of the chart."""
        closure, q = self._chart.machine.closure, self.state_layout.view(state).q
        if self._chart.largest_gamma_entry(q) > self.chart_limits[0]:
            return True
        return (
            closure.is_compiled
            and closure.compiled_closure.least_determinant(q) < self.chart_limits[1]
        )

    def user_coordinates(self, state: Array) -> Array:
        """(n,) active coordinates of the user."""
        return self.state_layout.view(state).q[self._chart.user_columns]

    def observe(self, time: float, state: Array) -> tuple[Array, Array]:
        """Rate of the state, and outputs (see `output_layout`).

        Raises:
            IntegrationHaltError: The loops do not close, or the configuration is singular.
        """
        rate, tau, forces, external_values = self.state_rate(time, state)
        at = self.state_layout.view(state)
        observation = self._dynamics.evaluate_closed("observation", at.q, at.v_a, forces)
        outputs = [tau, observation, external_values.outputs]
        closure, control = self._chart.machine.closure, self._control
        if self._chart.machine.supports:
            gamma = closure.gamma(at.q)
            a = gamma @ self.state_layout.view(rate).v_a + closure.drift(at.q, gamma @ at.v_a)
            outputs.append(a)
        if isinstance(control, ValveDrive):
            v_a = self._chart.user_velocities(at.q, at.v_a)
            inputs = control.inputs_at(time, self.user_coordinates(state), v_a, at.controller)
            outputs.append(np.array(control.channel_values(inputs), dtype=np.float64))
        return rate, np.concatenate(outputs)

    def advance(self, time: float, state: Array, start_rate: Array, step: float) -> Array:
        """The state after one step of the classical Runge-Kutta method.

        Args:
            time: [s].
            state: State at this time.
            start_rate: Its rate.
            step: Step size [s].

        Raises:
            IntegrationHaltError: The motion diverges, or the loops do not close.
        """
        rate_sum = rate = start_rate
        units = self._dynamics.machine.closure.units
        for share, weight in ((0.5, 2.0), (0.5, 2.0), (1.0, 1.0)):
            if not np.abs(self.state_layout.view(rate).q / units).max() * step < 1:  # also NaN
                size = self._dynamics.machine.closure.characteristic_length
                raise IntegrationHaltError(
                    time,
                    self.user_coordinates(state),
                    f" the motion explodes (over 1 rad or {size:.3g} m in a step of {step:g} s)",
                    ", and with steps an eighth as long, too: let method DOP853 choose them, or "
                    "look at its forces and gains",
                )
            rate, *_ = self.state_rate(time + share * step, state + share * step * rate)
            rate_sum = rate_sum + weight * rate
        after = state + step / 6 * rate_sum
        self.close_loops(time + step, after)
        return after

    def close_loops(self, time: float, state: Array) -> None:
        """Close the loops of a state on the branch of the chart.

        Raises:
            IntegrationHaltError: They do not close, or pass a change point.
        """
        machine, q = self._dynamics.machine, self.state_layout.view(state).q
        closure = machine.closure
        try:
            closed = closure.solve(q[closure.active], initial_guess=q)
        except (ClosureError, SingularMassMatrixError) as error:
            raise self._closure_halt(time, state, error) from None
        if closure.is_compiled and closure.compiled_closure.least_determinant(closed) <= 0:
            raise IntegrationHaltError(
                time, self.user_coordinates(state), ": the loops come to a change point"
            )
        q[:] = machine.coordinates.wrap_rotations(closed)

    def halt_error(self, time: float, state: Array) -> IntegrationHaltError:
        """The halt of a machine that cannot continue with any step size."""
        at, closure = self.state_layout.view(state), self._chart.machine.closure
        try:
            closure.solve(
                at.q[closure.active] + _EXTRAPOLATION_TIME * closure.characteristic_time * at.v_a,
                initial_guess=at.q,
            )
        except (ClosureError, SingularMassMatrixError) as error:
            return self._closure_halt(time, state, error)
        speed = np.abs(at.v_a).max()
        return IntegrationHaltError(
            time,
            self.user_coordinates(state),
            f" the motion cannot be followed, the fastest joint moves at {speed:.3g} m/s or rad/s",
            ": look at its forces and gains, or give end stops damping",
        )

    def _closure_halt(self, time: float, state: Array, error: CraneError) -> IntegrationHaltError:
        """The halt of a machine that does not close there, or whose mass matrix is singular."""
        remedy: Any = {"default_remedy": ""} if isinstance(error, SingularMassMatrixError) else {}
        return IntegrationHaltError(time, self.user_coordinates(state), f": {error}", **remedy)

    def state_rate(
        self, time: float, state: Array
    ) -> tuple[Array, Array, Array, ExternalForceValues]:
        """Rate of the state, forces of the controller, all forces and external ones.

        Raises:
            IntegrationHaltError: The loops do not close, or the configuration is singular.
        """
        at = self.state_layout.view(state)
        try:
            v_a = self._chart.user_velocities(at.q, at.v_a)
            tau, controller_rate = self._controller_output(time, at, v_a)
            forces, external_values = self._applied_forces(time, at, v_a, tau)
            rates = self._dynamics.evaluate_closed("rates", at.q, at.v_a, forces)
        except (ClosureError, SingularMassMatrixError) as error:
            raise self._closure_halt(time, state, error) from None
        self.transition_margin = float(rates[-1])
        energies = [tau @ v_a, *external_values.powers, rates[-2]]
        rate = np.concatenate([rates[:-2], external_values.state_rates, controller_rate, energies])
        return rate, tau, forces, external_values

    def _applied_forces(
        self, time: float, state: LayoutView, v_a: Array, tau: Array
    ) -> tuple[Array, ExternalForceValues]:
        """Forces along the coordinates of the chart, and external ones; sets circuit friction."""
        control, chart = self._control, self._chart
        if self._dynamics.forces.circuit_friction_columns and isinstance(control, ValveDrive):
            inputs = control.inputs_at(time, state.q[chart.user_columns], v_a, state.controller)
            self._dynamics.set_circuit_friction(
                np.array(control.circuit_friction(inputs), dtype=np.float64)
            )
        external_values = chart.external_forces(time, state.q, state.v_a, state.contacts)
        forces = chart.chart_forces(state.q, tau) + external_values.generalized_forces
        return forces, external_values

    def _controller_output(
        self, time: float, state: LayoutView, v_a: Array
    ) -> tuple[Array, Array]:
        """Forces (n,) and state rates (k,) of the controller."""
        tau, rate = self._control(time, state.q[self._chart.user_columns], v_a, state.controller)
        if np.shape(tau) != v_a.shape or np.shape(rate) != state.controller.shape:
            raise InputError(
                f"{type(self._control).__name__} gives forces of the shape {np.shape(tau)} and "
                f"rates of the shape {np.shape(rate)}, give {v_a.shape} and "
                f"{state.controller.shape}: one per active joint, one per state"
            )
        if self._chart.free_joints:
            self._chart.check_free_joints(np.asarray(tau).tolist(), f" at t = {time:g} s")
        return np.asarray(tau), rate
