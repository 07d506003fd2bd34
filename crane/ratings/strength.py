"""The forces that drives can exert and hold."""

from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from crane.common.errors import InputError, known
from crane.hydraulics.components import Cylinder, Hydraulics
from crane.machine import Machine

RAISES, HOLDS, MOTOR = "working pressure", "holding pressure", "effort"


class Strength(NamedTuple):
    """What one drive can exert.

    Attributes:
        joint: Of the drive.
        column: Of the joint among the active ones.
        least: The most that it pulls, below 0 [N], [N m].
        most: The most that it pushes [N], [N m].
        why: What limits it: `RAISES`, `HOLDS` or `MOTOR`.
        pressures: Of chambers A and B at these ends [Pa]; none without hydraulics.
        areas: What a pressure more in A and in B adds to them [m2], [m3/rad].
    """

    joint: str
    column: int
    least: float
    most: float
    why: str
    pressures: tuple[float, ...] = ()
    areas: tuple[float, ...] = ()


def strengths(
    machine: Machine, raising: Collection[str], friction: bool = False
) -> list[Strength]:
    """Of all drives that have a limit.

    A drive that raises pushes with p_S A - p_T B and pulls with p_S B - p_T A, with A and B its
    areas, p_S the pressure of its pump (or of a relief valve below it) and p_T of the tank. One
    that holds behind its closed valve has the pressure of its port relief or load-holding valve in
    place of p_S, or p_S if it has none. A motor without hydraulics has the `effort` of its URDF.

    Args:
        machine: The machine.
        raising: Joints whose drives raise; all others hold.
        friction: Whether drives that raise have to overcome their joints' friction from rest.

    Raises:
        InputError: A joint is no driven one, or no drive has a limit.
    """
    for joint in raising:
        if joint not in machine.driven_joints:
            raise InputError(f"'{joint}' drives nothing, {known(machine.driven_joints, joint)}")
    found, circuit = [], machine.hydraulics
    for joint in machine.driven_joints:
        column = machine.active.index(joint)
        works, both, areas, seals = joint in raising, [], np.zeros(2), 0.0
        if circuit is not None and joint in circuit.joints:
            cylinder, tank = circuit.cylinders[joint], circuit.supply.tank
            both = [_pressure(circuit, cylinder, side, works) for side in "ab"]
            areas = np.array([cylinder.area_a, cylinder.area_b])
            most = both[0] * cylinder.area_a - tank * cylinder.area_b
            least = tank * cylinder.area_a - both[1] * cylinder.area_b
            seals = cylinder.seal_friction
            grip = seals * (np.array(both) - tank)
            why = RAISES if works else HOLDS
        else:
            effort = float(machine.model.effortLimit[machine.column(joint)])
            if not (np.isfinite(effort) and effort > 0):
                continue
            most, least, grip, why = effort, -effort, np.zeros(2), MOTOR
        if friction and works and joint in machine.friction:
            law = machine.friction[joint]
            most -= law.breakaway + law.coulomb_offset + grip[0]
            least += law.breakaway - law.coulomb_offset + grip[1]
            areas = areas - seals
        ends = (tuple(both), tuple(areas.tolist())) if both else ((), ())
        found.append(Strength(joint, column, least, most, why, *ends))
    if not found:
        raise InputError(
            f"nothing limits the drives of '{machine.name}', give it hydraulics, or its joints an "
            "effort in <limit>"
        )
    return found


def _pressure(circuit: Hydraulics, cylinder: Cylinder, side: str, works: bool) -> float:
    """The most that a chamber can have under load [Pa]."""
    supply, tank = circuit.sources[circuit.valves[cylinder.joint].supply], circuit.supply.tank
    pumped = [supply.pressure, *([supply.relief] if supply.relief else [])]
    valves = [cylinder.relief] if cylinder.relief else []
    if cylinder.cross_relief:
        valves.append(cylinder.cross_relief + tank)
    holding = getattr(cylinder, f"counterbalance_{side}")
    if holding is not None and not works:
        valves.append(holding.pressure - holding.pilot_ratio * tank)
    if works:
        return min(*pumped, *valves, np.inf)
    return min(valves) if valves else min(pumped)
