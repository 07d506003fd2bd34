"""The forces that drives can exert and hold."""

from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from crane.common.errors import InputError, suggest_names
from crane.hydraulics.components import Cylinder
from crane.hydraulics.hydraulic_circuit import Hydraulics
from crane.machine import Machine

WORKING_PRESSURE, HOLDING_PRESSURE, MOTOR_EFFORT = "working pressure", "holding pressure", "effort"


class DriveForceLimits(NamedTuple):
    """What one drive can exert.

    Attributes:
        joint: Of the drive.
        active_index: Of the joint among the active ones.
        min_force: The most that it pulls, below 0 [N], [N m].
        max_force: The most that it pushes [N], [N m].
        limit_kind: What limits it: `WORKING_PRESSURE`, `HOLDING_PRESSURE` or `MOTOR_EFFORT`.
        chamber_pressures: Of chambers A and B at these ends [Pa]; none without hydraulics.
        chamber_areas: What a pressure more in A and in B adds to them [m2], [m3/rad].
    """

    joint: str
    active_index: int
    min_force: float
    max_force: float
    limit_kind: str
    chamber_pressures: tuple[float, ...] = ()
    chamber_areas: tuple[float, ...] = ()


def drive_force_limits(
    machine: Machine, raising_joints: Collection[str], with_friction: bool = False
) -> list[DriveForceLimits]:
    """Of all drives that have a limit.

    A drive that raises pushes with p_S A - p_T B and pulls with p_S B - p_T A, with A and B its
    areas, p_S the pressure of its pump (or of a relief valve below it) and p_T of the tank. One
    that holds behind its closed valve has the pressure of its port relief or load-holding valve in
    place of p_S, or p_S if it has none. A motor without hydraulics has the `effort` of its URDF.

    Args:
        machine: The machine.
        raising_joints: Joints whose drives raise; all others hold.
        with_friction: Whether drives that raise have to overcome their joints' friction from rest.

    Raises:
        InputError: A joint is no driven one, or no drive has a limit.
    """
    for joint in raising_joints:
        if joint not in machine.driven_joints:
            raise InputError(
                f"'{joint}' drives nothing, {suggest_names(machine.driven_joints, joint)}"
            )
    limits, circuit = [], machine.hydraulics
    for joint in machine.driven_joints:
        column = machine.active.index(joint)
        is_raising, max_pressures, areas, seal_friction = (
            joint in raising_joints,
            [],
            np.zeros(2),
            0.0,
        )
        if circuit is not None and joint in circuit.joints:
            cylinder, tank = circuit.cylinders[joint], circuit.supply.tank
            max_pressures = [
                _max_chamber_pressure(circuit, cylinder, side, is_raising) for side in "ab"
            ]
            areas = np.array([cylinder.area_a, cylinder.area_b])
            max_force = max_pressures[0] * cylinder.area_a - tank * cylinder.area_b
            min_force = tank * cylinder.area_a - max_pressures[1] * cylinder.area_b
            seal_friction = cylinder.seal_friction
            seal_forces = seal_friction * (np.array(max_pressures) - tank)
            limit_kind = WORKING_PRESSURE if is_raising else HOLDING_PRESSURE
        else:
            effort = float(machine.model.effortLimit[machine.column(joint)])
            if not (np.isfinite(effort) and effort > 0):
                continue
            max_force, min_force, seal_forces, limit_kind = (
                effort,
                -effort,
                np.zeros(2),
                MOTOR_EFFORT,
            )
        if with_friction and is_raising and joint in machine.friction:
            law = machine.friction[joint]
            max_force -= law.breakaway_force + law.coulomb_offset + seal_forces[0]
            min_force += law.breakaway_force - law.coulomb_offset + seal_forces[1]
            areas = areas - seal_friction
        chamber_values = (
            (tuple(max_pressures), tuple(areas.tolist())) if max_pressures else ((), ())
        )
        limits.append(
            DriveForceLimits(joint, column, min_force, max_force, limit_kind, *chamber_values)
        )
    if not limits:
        raise InputError(
            f"nothing limits the drives of '{machine.name}', give it hydraulics, or its joints an "
            "effort in <limit>"
        )
    return limits


def _max_chamber_pressure(
    circuit: Hydraulics, cylinder: Cylinder, side: str, is_raising: bool
) -> float:
    """The most that a chamber can have under load [Pa]."""
    supply, tank = circuit.pumps[circuit.valves[cylinder.joint].supply], circuit.supply.tank
    supply_pressures = [supply.pressure, *([supply.relief] if supply.relief else [])]
    valve_pressures = [cylinder.relief] if cylinder.relief else []
    if cylinder.cross_relief:
        valve_pressures.append(cylinder.cross_relief + tank)
    counterbalance_valve = getattr(cylinder, f"counterbalance_{side}")
    if counterbalance_valve is not None and not is_raising:
        valve_pressures.append(
            counterbalance_valve.pressure - counterbalance_valve.pilot_ratio * tank
        )
    if is_raising:
        return min(*supply_pressures, *valve_pressures, np.inf)
    return min(valve_pressures) if valve_pressures else min(supply_pressures)
