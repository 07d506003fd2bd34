"""What a motion asks of a circuit: openings of its valves, flow of its pump, the shortest time."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from crane.common.errors import InputError
from crane.common.samples import Array
from crane.control.valve_commands import require_circuit
from crane.hydraulics import Hydraulics
from crane.hydraulics.components import Cylinder, Valve
from crane.hydraulics.orifice_flow import LAMINAR_PRESSURE_DROP
from crane.machine import Machine
from crane.motion.sway_suppression import retime, suppress_sway
from crane.motion.task_trajectories import add_free_joints
from crane.motion.trajectory import Trajectory

_MIN_PRESSURE_DROP = 1e5  # [Pa] that an edge is taken to have
_PRESSURE_DIFFERENCE = 1e3  # [Pa] of difference quotients
_SAMPLES_PER_SECOND = 100  # samples of a motion's flows
_SHARE_TOLERANCE = 1e-3  # of the shortest time
_MAX_ITERATIONS = 30


def openings_per_velocity(
    valve: Valve, cylinder: Cylinder, supply: float, force: Array
) -> tuple[Array, Array]:
    """Opening of a valve that one metre (radian) per second takes, out and in.

    Flow comes through the inlet Q = c y sqrt(dp), with dp the compensator's margin or what the
    supply leaves; where the load pulls the piston along, through the outlet, which sets the speed.

    Args:
        valve: The valve.
        cylinder: Its cylinder.
        supply: Pressure of the supply [Pa].
        force: (N,) that the cylinder exerts [N], [N m].

    Returns:
        Two arrays (N,) [s/m], [s/rad], both positive.
    """
    openings_by_direction = []
    directions = (
        (1.0, valve.c1, cylinder.area_a, valve.c2, cylinder.area_b),
        (-1.0, valve.c4, cylinder.area_b, valve.c3, cylinder.area_a),
    )
    for sign, inlet, inlet_area, outlet, outlet_area in directions:
        drop = supply - np.maximum(sign * force, 0.0) / inlet_area
        if valve.margin:
            drop = np.minimum(drop, valve.margin)
        inlet_opening = inlet_area / (inlet * np.sqrt(np.maximum(drop, _MIN_PRESSURE_DROP)))
        load_pressure = np.maximum(-sign * force, 0.0) / outlet_area
        outlet_opening = outlet_area / (
            outlet * np.sqrt(np.maximum(load_pressure, _MIN_PRESSURE_DROP))
        )
        openings_by_direction.append(
            np.where(sign * force < 0, np.minimum(inlet_opening, outlet_opening), inlet_opening)
        )
    return openings_by_direction[0], openings_by_direction[1]


def check_invertible(circuit: Hydraulics) -> None:
    """Raise for parts that a circuit turned round does not know.

    Raises:
        InputError: A motor, a valve that shares its flow, has two spools, or curves.
    """
    for joint, valve in circuit.valves.items():
        for is_present, component in (
            (circuit.cylinders[joint].motor, "a motor"),
            (valve.sharing, "a valve that shares its flow"),
            (valve.spool_b is not None, "a valve with two spools"),
            (bool(valve.curves), "a valve with curves"),
        ):
            if is_present:
                raise InputError(
                    f"the feedforward of valves knows cylinders and valves without curves, "
                    f"'{joint}' has {component}: take valve-pd"
                )


def required_openings(
    circuit: Hydraulics, time: Array, x: Array, v: Array, force: Array, strokes: Array
) -> Array:
    """Openings of all valves that move their cylinders as is said, under the forces that takes.

    The circuit turned round: with C = V / K of the chambers, r what suction valves let in, and
    Q = q y through the edges that are open,

        C_a p_a' = q_a y + r_a - A_a v,   C_b p_b' = A_b v - q_b y + r_b,   A_a p_a - A_b p_b = F,

    differentiated once gives y, and one pressure is left to be integrated. Where a chamber is
    sucked empty the other one sets the speed alone. Left out: leaks, cushions, relief and
    load-holding valves, and that the supply's pressure falls.

    Args:
        circuit: The circuit.
        time: (N,) [s], a millisecond or so apart.
        x: (N, m) strokes above the lower limits [m], [rad].
        v: (N, m) [m/s], [rad/s].
        force: (N, m) of the cylinders [N], [N m].
        strokes: (m,) distances between the limits.

    Returns:
        (N, m) openings y, -1 to 1 where the valve has that flow.
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
    # the spring between cylinder and joint gives way
    compliance = np.where(stiffness > 0, 1.0 / np.where(stiffness > 0, stiffness, 1.0), 0.0)
    x, v = x + compliance * force, v + compliance * force_rate
    inside_a, inside_b = area_a * x, area_b * (strokes - x)
    compliance_a = hose_a * hose + inside_a * steel + (hose_a + inside_a) / oil.bulk_modulus
    compliance_b = hose_b * hose + inside_b * steel + (hose_b + inside_b) / oil.bulk_modulus
    min_pressure = 0.5 * tank

    def at(i: int, p_b: Array) -> tuple[Array, Array]:
        """Openings, and the rate of the pressure in B."""
        f, w, ca, cb = force[i], v[i], compliance_a[i], compliance_b[i]
        p_a = (f + area_b * p_b) / area_a
        asked = force_rate[i] + (area_a**2 / ca + area_b**2 / cb) * w
        out = asked > 0
        fed_a = c1 * np.sqrt(np.clip(pump - p_a, _MIN_PRESSURE_DROP, margin))
        fed_b = c4 * np.sqrt(np.clip(pump - p_b, _MIN_PRESSURE_DROP, margin))
        q_a = np.where(out, fed_a, c3 * np.sqrt(np.maximum(p_a - tank, LAMINAR_PRESSURE_DROP)))
        q_b = np.where(out, c2 * np.sqrt(np.maximum(p_b - tank, LAMINAR_PRESSURE_DROP)), fed_b)
        y = asked / (area_a * q_a / ca + area_b * q_b / cb)
        # sucked empty, and not filled yet: the side that the load presses on sets the speed alone
        by_b = (area_b * w + cb * force_rate[i] / area_b) / q_b
        by_a = (area_a * w + ca * force_rate[i] / area_a) / q_a
        y = np.where(out & (p_a < tank) & (q_a * by_b < area_a * w), by_b, y)
        y = np.where(~out & (p_b < tank) & (q_b * by_a > area_b * w), by_a, y)
        return y, (area_b * w - q_b * y) / cb

    openings = np.empty_like(v)
    holding_force = force[0] - tank * (area_a - area_b)
    p_b = tank + np.maximum(-holding_force, 0.0) / area_b
    steps = np.diff(time, append=2.0 * time[-1] - time[-2])
    for i in range(len(time)):
        p_b = np.maximum(
            p_b, np.maximum(min_pressure, (area_a * min_pressure - force[i]) / area_b)
        )
        openings[i], pressure_rate = at(i, p_b)
        _, perturbed_rate = at(i, p_b + _PRESSURE_DIFFERENCE)
        # linearly implicit Euler: at low pressures the outlet's flow stiffens
        rate_derivative = np.minimum((perturbed_rate - pressure_rate) / _PRESSURE_DIFFERENCE, 0.0)
        p_b = p_b + steps[i] * pressure_rate / (1.0 - steps[i] * rate_derivative)
    return openings


def largest_flow_share(machine: Machine, reference: Trajectory) -> float:
    """The largest share of its flow that a motion asks of a valve or of the pump.

    Of a valve A |v| over the flow at full stroke, A the area that oil flows onto: c sqrt(margin)
    of a compensated one, and half of the supply's pressure at either edge of another; of the pump
    the sum of A |v| over its most, where it has one.

    Args:
        machine: The machine, with a circuit.
        reference: Of its active joints.
    """
    circuit = require_circuit(machine)
    check_invertible(circuit)
    time = np.linspace(0.0, reference.duration, int(_SAMPLES_PER_SECOND * reference.duration) + 2)
    v = reference.velocity(time)
    largest_valve_share, total_flow = 0.0, np.zeros(len(time))
    for joint in circuit.joints:
        cylinder, valve = circuit.cylinders[joint], circuit.valves[joint]
        rate = v[:, machine.active.index(joint)]
        drop = valve.margin or 0.5 * (circuit.supply.pressure - circuit.supply.tank)
        out = np.maximum(rate, 0.0) * cylinder.area_a
        back = np.maximum(-rate, 0.0) * cylinder.area_b
        shares = out / valve.c1 + back / valve.c4
        largest_valve_share, total_flow = (
            max(largest_valve_share, float(shares.max()) / np.sqrt(drop)),
            total_flow + out + back,
        )
    pump = circuit.supply.flow
    return (
        max(largest_valve_share, float(total_flow.max()) / pump) if pump else largest_valve_share
    )


def fastest_trajectory(
    machine: Machine, reference: Trajectory, method: str = "none"
) -> Trajectory:
    """The fastest motion along a reference that valves and pump have the flow for.

    Flows are as 1 / T, so the reference itself takes T times its `largest_flow_share`; where a
    method of `suppress_sway` changes it in another way for each T, that is repeated until the
    share is 1.

    Args:
        machine: The machine, with free joints and a circuit.
        reference: From rest to rest.
        method: Of `suppress_sway`.

    Returns:
        What `suppress_sway` makes of it.

    Raises:
        InputError: As `suppress_sway`, or the reference asks for no flow.
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
