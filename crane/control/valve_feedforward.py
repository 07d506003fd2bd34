"""Valves opened as far as a reference's flows need, with feedback of position and of sway."""

from collections.abc import Mapping, Sequence

import numpy as np

from crane.codegen import Scalar
from crane.codegen.symbolic import add_vectors, apply_function
from crane.common.errors import InputError
from crane.common.samples import Array, as_number
from crane.control.control_law import ControllerInputs
from crane.control.valve_commands import ValvePD, require_circuit
from crane.control.valve_openings import check_invertible, openings_per_velocity, required_openings
from crane.dynamics import Dynamics
from crane.hydraulics import Hydraulics, PDGains
from crane.machine import Machine
from crane.motion.sway import Sway, suppress_sway
from crane.motion.trajectory import Trajectory

_KNOTS_PER_SECOND = 50  # of forces and gains
_STEPS_PER_SECOND = 1000  # of openings
_DEAD_BAND_SMOOTHING = 0.003  # of the valve's flow, over which the dead band is jumped
_REVERSAL_SMOOTHING = 0.02  # likewise, over which openings and friction change with the direction


class ValveFeedforward(ValvePD):
    """Valves opened for the reference's velocities, corrected by position and by sway.

    With y the openings that the reference demands of the circuit (`demanded`), tau the lag
    2 zeta / omega of the spool, g the opening per velocity of `openings` under the reference's
    forces,

        w = y + tau y' + K_p (q_ref - q) + K_d (q_ref' - q') + g(v) K theta,
        u = (1 - d) w + d tanh(w / 0.003).

    theta is the sway against the reference's: what two inclinometers on the grapple tell, less
    what is planned, theta = (q_f - q_f,ref) - E (q_d - q_d,ref) with E as in `crane.motion.sway`.
    A motion B u of the drives, B of `Sway.pivoting_motions`, makes theta'' + Omega^2 theta = u''.
    With u'' = -2 zeta Omega theta' all modes have the damping ratio zeta more, and velocities do
    that:

        K = -2 zeta B Omega,    Omega = Phi diag(omega) Phi^T M_ff,

    with the modes Phi of unit modal mass. A spool of 5 Hz delays that by 0.06 s, 10 to 16 degrees
    of a grapple's sway, and position control counteracts it at frequencies below kp x the speed at
    full flow. What limits zeta is what gives way between valve and tip: above the sway's frequency
    the load stands, and the feedback is one of position, with 2 zeta omega more of loop gain.

    Args:
        machine: The machine, with its payload.
        reference: Of the driven joints or of all; free joints that it has not hang still.
        gains: By joint; those of the machine file if not given.
        sway: Damping ratio zeta that is asked for; 0 for no feedback of sway.

    Raises:
        InputError: As `ValvePD`; or sway is to be damped, and nothing sways.
    """

    def __init__(
        self,
        machine: Machine,
        reference: Trajectory,
        gains: Mapping[str, PDGains] | None = None,
        sway: float = 0.0,
    ):
        damping = as_number(sway, "the damping ratio of sway", "", max_magnitude=1.0)
        if damping < 0:
            raise InputError(f"the damping ratio of sway is {damping:g}, give 0 to 1")
        if damping and not machine.free:
            raise InputError(f"nothing sways on '{machine.name}': it has no free joints")
        if machine.free and len(reference.position(0.0)) < len(machine.active):
            reference = suppress_sway(machine, reference, "none")
        super().__init__(machine, reference, gains)
        circuit = require_circuit(machine)
        check_invertible(circuit)
        self.planned_trajectory, self._free_indices = reference, np.flatnonzero(~machine.is_driven)
        valves = circuit.valves.values()
        lags = [2.0 * x.damping / x.bandwidth if x.bandwidth else 0.0 for x in valves]
        self._damps_sway = damping > 0
        count = max(8, int(np.ceil(reference.duration * _KNOTS_PER_SECOND)) + 1)
        self._knot_times = np.linspace(0.0, reference.duration, count)
        q_a, v_a, a_a = reference(self._knot_times)
        forces = Dynamics(machine).inverse(q_a, v_a, a_a)[:, self._active_indices]
        forces += self._friction(machine, circuit, v_a[:, self._active_indices])
        self._opening_times, opening = self._feedforward_openings(machine, reference, forces)
        self._opening_table = opening + np.array(lags) * np.gradient(
            opening, self._opening_times, axis=0
        )
        if self._damps_sway:
            pairs = [
                openings_per_velocity(
                    x, circuit.cylinders[x.joint], circuit.supply.pressure, forces[:, i]
                )
                for i, x in enumerate(valves)
            ]
            columns = [x for pair in zip(*pairs, strict=True) for x in pair]
            self._gain_table = np.column_stack(
                columns + self._sway_feedback_gains(machine, q_a, damping)
            )

    def _friction(self, machine: Machine, circuit: Hydraulics, v: Array) -> Array:
        """Friction (N, m) of the cylinders' joints; dry friction turns smoothly."""
        friction = np.zeros_like(v)
        for i, joint in enumerate(circuit.joints):
            if (law := machine.friction.get(joint)) is not None:
                valve, cylinder = circuit.valves[joint], circuit.cylinders[joint]
                max_flow = valve.c1 * np.sqrt(valve.margin or circuit.supply.pressure)
                direction = np.tanh(v[:, i] * cylinder.area_a / (_REVERSAL_SMOOTHING * max_flow))
                friction[:, i] = (
                    law.viscous * v[:, i] + law.coulomb * direction + law.coulomb_offset
                )
        return friction

    def _feedforward_openings(
        self, machine: Machine, reference: Trajectory, force: Array
    ) -> tuple[Array, Array]:
        """Times (N,) and the openings (N, m) that the reference demands."""
        from scipy.interpolate import make_interp_spline  # slow to import

        count = int(np.ceil(reference.duration * _STEPS_PER_SECOND)) + 1
        time = np.linspace(0.0, reference.duration, count)
        q_a, v_a, _ = reference(time)
        lower, upper = machine.lower[self._active_indices], machine.upper[self._active_indices]
        forces = make_interp_spline(self._knot_times, force)(time)
        x = q_a[:, self._active_indices] - lower
        circuit = require_circuit(machine)
        return time, required_openings(
            circuit, time, x, v_a[:, self._active_indices], forces, upper - lower
        )

    def _sway_feedback_gains(self, machine: Machine, q_a: Array, damping: float) -> list[Array]:
        """K (m, f), then E (f, m), as columns (N,)."""
        sway, free = Sway(machine), self._free_indices
        configurations = sway.hanging_equilibrium(q_a)
        shifts = sway.pivoting_motions(configurations)
        roots = np.array([sway.frequency_matrix(posture) for posture in configurations])
        driven = np.flatnonzero(machine.is_driven).tolist()
        driven_indices = [driven.index(i) for i in self._active_indices]
        gains = -2.0 * damping * (shifts @ roots)[:, driven_indices]
        stiffness = sway.stiffness(configurations)
        coupling = -np.linalg.solve(stiffness[:, :, free], stiffness[:, :, self._active_indices])
        return [*gains.reshape(len(q_a), -1).T, *coupling.reshape(len(q_a), -1).T]

    def references(self, times: Array) -> Array:
        """See `ValveCommand`."""
        q, v, last = (
            self.planned_trajectory.position(times),
            self.planned_trajectory.velocity(times),
            self._knot_times[-1],
        )
        opening = _interpolate_even(times, last, self._opening_table)
        opening[(times < 0) | (times > last)] = 0.0
        columns = [q[:, self._active_indices], v[:, self._active_indices], opening]
        if self._damps_sway:
            columns += [_interpolate_even(times, last, self._gain_table), q[:, self._free_indices]]
        return np.hstack(columns)

    def signals(self, inputs: ControllerInputs) -> Sequence[Scalar]:
        """See `ValveCommand`."""
        m = len(self._active_indices)
        kp, kd, dead_bands, neutral, span = (
            inputs.settings[i * m : (i + 1) * m] for i in range(5)
        )
        q, v, opening = (inputs.reference[i * m : (i + 1) * m] for i in range(3))
        error = [q[i] - inputs.q_a[joint] for i, joint in enumerate(self._active_indices)]
        if self._damps_sway:
            opening = add_vectors(opening, self._sway_damping_openings(inputs, error))
        signals: list[Scalar] = []
        for i, joint in enumerate(self._active_indices):
            opening_command = opening[i] + kp[i] * error[i] + kd[i] * (v[i] - inputs.v_a[joint])
            dead_band_jump = dead_bands[i] * apply_function(
                "tanh", opening_command * (1.0 / _DEAD_BAND_SMOOTHING)
            )
            signals.append(
                neutral[i] + span[i] * ((1.0 - dead_bands[i]) * opening_command + dead_band_jump)
            )
        return signals

    def _sway_damping_openings(
        self, inputs: ControllerInputs, error: list[Scalar]
    ) -> list[Scalar]:
        """What the valves open for the velocity that damps sway (m,)."""
        m, f = len(self._active_indices), len(self._free_indices)
        positive_openings, negative_openings = (
            inputs.reference[i * m : (i + 1) * m] for i in (3, 4)
        )
        gains, coupling = (
            inputs.reference[(5 + i * f) * m : (5 + (i + 1) * f) * m] for i in (0, 1)
        )
        theta: list[Scalar] = []
        for k, joint in enumerate(self._free_indices):
            sway = inputs.q_a[joint] - inputs.reference[(5 + 2 * f) * m + k]
            theta.append(sway + sum(coupling[k * m + i] * error[i] for i in range(m)))
        openings: list[Scalar] = []
        for i in range(m):
            speed = sum(gains[i * f + k] * theta[k] for k in range(f))
            mean, half = (
                0.5 * (positive_openings[i] + negative_openings[i]),
                0.5 * (positive_openings[i] - negative_openings[i]),
            )
            direction = apply_function("tanh", speed * mean * (1.0 / _REVERSAL_SMOOTHING))
            openings.append((mean + half * direction) * speed)
        return openings


def _interpolate_even(times: Array, end_time: float, table: Array) -> Array:
    """Rows (N, c) straight between those of a table, at even times from 0 to the last [s]."""
    position = np.clip(times / end_time, 0.0, 1.0) * (len(table) - 1)
    before = np.minimum(position.astype(int), len(table) - 2)
    share = (position - before)[:, None]
    rows: Array = (1.0 - share) * table[before] + share * table[before + 1]
    return rows
