"""Feedforward control of valves, with feedback of position and sway."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from crane.codegen.symbolic import Scalar, add_vectors, apply_function
from crane.common.errors import InputError
from crane.common.samples import Array, as_number
from crane.control.control_law import ControllerInputs
from crane.control.valve_commands import (
    MIN_PRESSURE_DROP,
    ValvePD,
    opening_per_velocity,
    require_circuit,
)
from crane.dynamics.dynamics import Dynamics
from crane.hydraulics.flow_equations import LAMINAR_PRESSURE_DROP
from crane.hydraulics.hydraulic_circuit import Hydraulics, PDGains
from crane.machine.machine import Machine
from crane.motion.sway import Sway, suppress_sway
from crane.motion.task_trajectories import add_free_joints
from crane.motion.trajectory import Trajectory, retime

_PRESSURE_DIFFERENCE = 1e3  # pressure step of difference quotients [Pa]
_SAMPLES_PER_SECOND = 100  # samples of the flows of a trajectory
_SHARE_TOLERANCE = 1e-3  # share of the shortest time
_MAX_ITERATIONS = 30


def check_invertible(circuit: Hydraulics) -> None:
    """Check that a circuit has components that `required_openings` supports alone.

    Raises:
        InputError: It has a motor, or a valve with flow sharing, two spools or curves.
    """
    for joint, valve in circuit.valves.items():
        unknown = {
            "a motor": circuit.cylinders[joint].motor,
            "a valve that shares its flow": valve.sharing,
            "a valve with two spools": valve.spool_b is not None,
            "a valve with curves": bool(valve.curves),
        }
        for component in (name for name, is_present in unknown.items() if is_present):
            raise InputError(
                f"the feedforward of valves knows cylinders and valves without curves, "
                f"'{joint}' has {component}: take valve-pd"
            )


def required_openings(
    circuit: Hydraulics, time: Array, x: Array, v: Array, force: Array, strokes: Array
) -> Array:
    """Openings of all valves that move their cylinders along a motion with its forces.

    This is the inverse of the circuit. With C = V / K of the chambers, r the flow of suction
    valves, and Q = q y through the open edges, the third of the equations

        C_a p_a' = q_a y + r_a - A_a v,   C_b p_b' = A_b v - q_b y + r_b,   A_a p_a - A_b p_b = F,

    is differentiated once, which gives y; one pressure is integrated. Where a chamber cavitates,
    the other one sets the velocity alone. Leakage, cushions, relief and load-holding valves, and
    the decrease of the supply pressure are neglected.

    Args:
        circuit: The circuit.
        time: (N,) instants [s], about a millisecond apart.
        x: (N, m) strokes above the lower limits [m], [rad].
        v: (N, m) velocities [m/s], [rad/s].
        force: (N, m) forces of the cylinders [N], [N m].
        strokes: (m,) distances between the limits.

    Returns:
        (N, m) openings y; within -1 and 1 where the valve has that flow.
    """

    def of(items: Mapping[str, Any], *names: str) -> list[Array]:
        return [np.array([getattr(items[joint], x) for joint in circuit.joints]) for x in names]

    oil, tank, pump = circuit.oil, circuit.supply.tank, circuit.supply.pressure
    area_a, area_b, hose_a, hose_b, stiffness = of(
        circuit.cylinders, "area_a", "area_b", "hose_a", "hose_b", "stiffness"
    )
    c1, c2, c3, c4, margin = of(circuit.valves, "c1", "c2", "c3", "c4", "margin")
    margin = np.where(margin > 0, margin, pump)
    hose, steel = (1.0 / k if k else 0.0 for k in (oil.hose_modulus, oil.steel_modulus))
    force_rate = np.gradient(force, time, axis=0)
    # the spring between cylinder and joint is compressed
    compliance = np.where(stiffness > 0, 1.0 / np.where(stiffness > 0, stiffness, 1.0), 0.0)
    x, v = x + compliance * force, v + compliance * force_rate
    inside_a, inside_b = area_a * x, area_b * (strokes - x)
    compliance_a = hose_a * hose + inside_a * steel + (hose_a + inside_a) / oil.bulk_modulus
    compliance_b = hose_b * hose + inside_b * steel + (hose_b + inside_b) / oil.bulk_modulus
    min_pressure = 0.5 * tank

    def openings_and_rate(i: int, p_b: Array) -> tuple[Array, Array]:
        """Openings, and the rate of the pressure in B."""
        f, w, ca, cb = force[i], v[i], compliance_a[i], compliance_b[i]
        p_a = (f + area_b * p_b) / area_a
        demand = force_rate[i] + (area_a**2 / ca + area_b**2 / cb) * w
        out = demand > 0
        fed_a = c1 * np.sqrt(np.clip(pump - p_a, MIN_PRESSURE_DROP, margin))
        fed_b = c4 * np.sqrt(np.clip(pump - p_b, MIN_PRESSURE_DROP, margin))
        q_a = np.where(out, fed_a, c3 * np.sqrt(np.maximum(p_a - tank, LAMINAR_PRESSURE_DROP)))
        q_b = np.where(out, c2 * np.sqrt(np.maximum(p_b - tank, LAMINAR_PRESSURE_DROP)), fed_b)
        y = demand / (area_a * q_a / ca + area_b * q_b / cb)
        # a chamber cavitates and is not filled yet: the loaded chamber sets the velocity alone
        by_b = (area_b * w + cb * force_rate[i] / area_b) / q_b
        by_a = (area_a * w + ca * force_rate[i] / area_a) / q_a
        y = np.where(out & (p_a < tank) & (q_a * by_b < area_a * w), by_b, y)
        y = np.where(~out & (p_b < tank) & (q_b * by_a > area_b * w), by_a, y)
        return y, (area_b * w - q_b * y) / cb

    openings = np.empty_like(v)
    p_b = tank + np.maximum(-(force[0] - tank * (area_a - area_b)), 0.0) / area_b
    steps = np.diff(time, append=2.0 * time[-1] - time[-2])
    for i in range(len(time)):
        p_b = np.maximum(
            p_b, np.maximum(min_pressure, (area_a * min_pressure - force[i]) / area_b)
        )
        openings[i], pressure_rate = openings_and_rate(i, p_b)
        _, perturbed_rate = openings_and_rate(i, p_b + _PRESSURE_DIFFERENCE)
        # linearly implicit Euler method: at low pressures the flow of the outlet is stiff
        rate_derivative = np.minimum((perturbed_rate - pressure_rate) / _PRESSURE_DIFFERENCE, 0.0)
        p_b = p_b + steps[i] * pressure_rate / (1.0 - steps[i] * rate_derivative)
    return openings


def largest_flow_share(machine: Machine, reference: Trajectory) -> float:
    """Largest share of the flow of a valve or of the pump that a trajectory requires.

    For a valve it is A |v| over the flow at full stroke, with A the area of the filled chamber.
    That flow is c sqrt(margin) of a compensated valve; for others, half of the supply pressure is
    the drop at either edge. For the pump it is the sum of A |v| over its largest flow, if limited.

    Args:
        machine: A machine with a circuit.
        reference: Trajectory of its active joints.
    """
    circuit = require_circuit(machine)
    check_invertible(circuit)
    time = np.linspace(0.0, reference.duration, int(_SAMPLES_PER_SECOND * reference.duration) + 2)
    v = reference.velocity(time)
    largest_share, total_flow = 0.0, np.zeros(len(time))
    for joint in circuit.joints:
        cylinder, valve = circuit.cylinders[joint], circuit.valves[joint]
        rate = v[:, machine.active.index(joint)]
        drop = valve.margin or 0.5 * (circuit.supply.pressure - circuit.supply.tank)
        out = np.maximum(rate, 0.0) * cylinder.area_a
        back = np.maximum(-rate, 0.0) * cylinder.area_b
        largest_share = max(
            largest_share, float((out / valve.c1 + back / valve.c4).max()) / np.sqrt(drop)
        )
        total_flow = total_flow + out + back
    pump = circuit.supply.flow
    return max(largest_share, float(total_flow.max()) / pump) if pump else largest_share


def fastest_trajectory(
    machine: Machine, reference: Trajectory, method: str = "none"
) -> Trajectory:
    """The fastest trajectory along a reference that the flow of valves and pump permits.

    Flows are proportional to 1 / T, so the shortest duration of the reference is T times its
    `largest_flow_share`. The methods of `suppress_sway` change the trajectory differently for each
    T, so this is iterated until the share is 1.

    Args:
        machine: A machine with free joints and a circuit.
        reference: Trajectory from rest to rest.
        method: Method of `suppress_sway`.

    Returns:
        The trajectory of `suppress_sway`.

    Raises:
        InputError: As `suppress_sway`, or the reference needs no flow.
    """
    original = add_free_joints(machine, reference)
    duration = original.duration * largest_flow_share(machine, original)
    if duration == 0:
        raise InputError("the reference moves no cylinder, its time has no least")
    for _ in range(_MAX_ITERATIONS):
        trajectory = suppress_sway(machine, retime(original, duration), method)
        share = largest_flow_share(machine, trajectory)
        if abs(share - 1.0) < _SHARE_TOLERANCE:
            break
        duration *= share
    return trajectory


_KNOTS_PER_SECOND = 50  # knots of forces and gains
_STEPS_PER_SECOND = 1000  # steps of openings
_DEAD_BAND_SMOOTHING = 0.003  # share of the flow over which signals cross the dead band
_REVERSAL_SMOOTHING = 0.02  # share of the flow over which openings and friction reverse


class ValveFeedforward(ValvePD):
    """Valve command by feedforward of the openings, and feedback of position and sway.

    With y the openings that the trajectory requires (`required_openings`), tau = 2 zeta / omega
    the lag of the spool, and g the opening per velocity (`opening_per_velocity`) under the forces
    of the trajectory,

        w = y + tau y' + K_p (q_ref - q) + K_d (q_ref' - q') + g(v) K theta,
        u = (1 - d) w + d tanh(w / 0.003).

    theta is the sway relative to the trajectory, which two inclinometers on the grapple measure:
    theta = (q_f - q_f,ref) - E (q_d - q_d,ref) with E as in `crane.motion.sway`. A motion B u of
    the drives, with B of `Sway.pivoting_motions`, gives theta'' + Omega^2 theta = u''. With
    u'' = -2 zeta Omega theta', zeta is added to the damping ratio of all modes, by the velocities

        K = -2 zeta B Omega,    Omega = Phi diag(omega) Phi^T M_ff,

    with the modes Phi of unit modal mass. A spool of 5 Hz delays this by 0.06 s, 10 to 16 degrees
    of the sway of a grapple, and position control counteracts it at frequencies below kp times the
    velocity at full flow. The compliance between valve and tip limits zeta: above the frequency of
    the sway the load does not move, and the feedback is that of a position, which increases the
    loop gain by 2 zeta omega.

    Args:
        machine: The machine with its payload.
        reference: Trajectory of the driven joints or of all joints; free joints that it does not
            have hang still.
        gains: Gains by joint; those of the machine file if not given.
        sway: Damping ratio zeta; 0 for no feedback of sway.

    Raises:
        InputError: As `ValvePD`; or there is no sway to be damped.
    """

    def __init__(
        self,
        machine: Machine,
        reference: Trajectory,
        gains: Mapping[str, PDGains] | None = None,
        sway: float = 0.0,
    ):
        from scipy.interpolate import make_interp_spline  # slow to import

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
        self.planned_trajectory = reference
        self._free_indices = np.setdiff1d(np.flatnonzero(~machine.is_driven), machine.held)
        valves = circuit.valves.values()
        lags = [2.0 * x.damping / x.bandwidth if x.bandwidth else 0.0 for x in valves]
        self._damps_sway = damping > 0
        openings = {f"opening_{name}": "" for name in circuit.spools}
        self.reference_units = {} if self._damps_sway else {**self.reference_units, **openings}
        count = max(8, int(np.ceil(reference.duration * _KNOTS_PER_SECOND)) + 1)
        self._knot_times = np.linspace(0.0, reference.duration, count)
        q_a, v_a, a_a = reference(self._knot_times)
        forces = Dynamics(machine).inverse(q_a, v_a, a_a)[:, self._active_indices]
        for i, joint in enumerate(circuit.joints):
            if (law := machine.friction.get(joint)) is not None:  # reversals are smoothed
                valve, v = circuit.valves[joint], v_a[:, self._active_indices[i]]
                max_flow = valve.c1 * np.sqrt(valve.margin or circuit.supply.pressure)
                flow = v * circuit.cylinders[joint].area_a
                direction = np.tanh(flow / (_REVERSAL_SMOOTHING * max_flow))
                forces[:, i] += (
                    law.viscous * v + law.sliding_force * direction + law.coulomb_offset
                )
        count = int(np.ceil(reference.duration * _STEPS_PER_SECOND)) + 1
        self._opening_times = np.linspace(0.0, reference.duration, count)
        q, v, _ = (x[:, self._active_indices] for x in reference(self._opening_times))
        lower, upper = machine.lower[self._active_indices], machine.upper[self._active_indices]
        force = make_interp_spline(self._knot_times, forces)(self._opening_times)
        opening = required_openings(
            circuit, self._opening_times, q - lower, v, force, upper - lower
        )
        self._opening_table = opening + np.array(lags) * np.gradient(
            opening, self._opening_times, axis=0
        )
        if self._damps_sway:
            pump, columns = circuit.supply.pressure, []
            for is_positive, x, force in (
                (sign, *pair)
                for sign in (True, False)
                for pair in zip(valves, forces.T, strict=True)
            ):
                cylinder = circuit.cylinders[x.joint]
                load, area = (force, cylinder.area_a) if is_positive else (-force, cylinder.area_b)
                drop = pump - np.maximum(load, 0.0) / area
                columns.append(opening_per_velocity(x, cylinder, is_positive, force, drop))
            self._gain_table = np.column_stack(
                columns + self._sway_feedback_gains(machine, q_a, damping)
            )

    def _sway_feedback_gains(self, machine: Machine, q_a: Array, damping: float) -> list[Array]:
        """Elements of K (m, f), then of E (f, m), as columns (N,)."""
        sway, free = Sway(machine), self._free_indices
        configurations = sway.hanging_equilibrium(q_a)
        shifts = sway.pivoting_motions(configurations)
        roots = np.array([sway.frequency_matrix(q) for q in configurations])
        driven = np.flatnonzero(machine.is_driven).tolist()
        gains = (
            -2.0 * damping * (shifts @ roots)[:, [driven.index(i) for i in self._active_indices]]
        )
        stiffness = sway.stiffness(configurations)
        coupling = -np.linalg.solve(stiffness[:, :, free], stiffness[:, :, self._active_indices])
        return [*gains.reshape(len(q_a), -1).T, *coupling.reshape(len(q_a), -1).T]

    def references(self, times: Array) -> Array:
        """See `ValveCommand`."""
        q, v = self.planned_trajectory.position(times), self.planned_trajectory.velocity(times)
        opening = [
            np.interp(times, self._opening_times, x, 0.0, 0.0) for x in self._opening_table.T
        ]
        columns = [*q[:, self._active_indices].T, *v[:, self._active_indices].T, *opening]
        if self._damps_sway:
            columns += [np.interp(times, self._knot_times, x) for x in self._gain_table.T]
            columns += [*q[:, self._free_indices].T]
        return np.column_stack(columns)

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
        """Openings (m,) for the velocities that damp sway."""
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
            mean = 0.5 * (positive_openings[i] + negative_openings[i])
            direction = apply_function("tanh", speed * mean * (1.0 / _REVERSAL_SMOOTHING))
            openings.append(
                (mean + (0.5 * (positive_openings[i] - negative_openings[i])) * direction) * speed
            )
        return openings
