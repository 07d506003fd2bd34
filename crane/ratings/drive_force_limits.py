"""Forces that drives exert and hold, and forces in the pins under a load."""

from collections.abc import Collection, Iterable
from typing import NamedTuple

import numpy as np

from crane.common.errors import InputError, check_name
from crane.common.samples import Array
from crane.dynamics.reactions import Reactions
from crane.hydraulics.components import Cylinder
from crane.hydraulics.hydraulic_circuit import Hydraulics
from crane.machine.machine import Machine

WORKING_PRESSURE, HOLDING_PRESSURE, MOTOR_EFFORT = "working pressure", "holding pressure", "effort"


class DriveForceLimits(NamedTuple):
    """Limits of the force of one drive.

    Attributes:
        joint: Joint of the drive.
        active_index: Index of the joint among the active joints.
        min_force: Largest pulling force, negative [N], [N m].
        max_force: Largest pushing force [N], [N m].
        limit_kind: `WORKING_PRESSURE`, `HOLDING_PRESSURE` or `MOTOR_EFFORT`.
        chamber_pressures: Pressures of chambers A and B at these limits [Pa]; empty without
            hydraulics.
        chamber_areas: Derivatives of these limits by the pressures in A and in B [m2], [m3/rad].
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
    """Compute the force limits of all drives that have some.

    A drive that raises pushes with p_S A - p_T B and pulls with p_S B - p_T A, with the areas A
    and B, the pressure p_S of its pump (or of a relief valve below it) and p_T of the tank. A
    drive that holds behind its closed valve has the pressure of its port relief or counterbalance
    valve in place of p_S, or p_S if it has neither. A motor without hydraulics has the `effort`
    of its URDF.

    Args:
        machine: The machine.
        raising_joints: Joints whose drives raise; all others hold.
        with_friction: Whether drives that raise have to overcome their joints' friction from rest.

    Raises:
        InputError: A joint is not driven, or no drive has a limit.
    """
    for joint in raising_joints:
        check_name(joint, machine.driven_joints, f"'{joint}' drives nothing")
    limits, circuit = [], machine.hydraulics
    for joint in machine.driven_joints:
        column, is_raising = machine.active.index(joint), joint in raising_joints
        pressures: list[float] = []
        areas, seal_friction = np.zeros(2), 0.0
        max_force = float(machine.model.effortLimit[machine.column(joint)])
        min_force, seal_forces, limit_kind = -max_force, np.zeros(2), MOTOR_EFFORT
        if circuit is not None and joint in circuit.joints:
            cylinder, tank = circuit.cylinders[joint], circuit.supply.tank
            pressures = [_max_pressure(circuit, cylinder, side, is_raising) for side in "ab"]
            areas = np.array([cylinder.area_a, cylinder.area_b])
            max_force = pressures[0] * cylinder.area_a - tank * cylinder.area_b
            min_force = tank * cylinder.area_a - pressures[1] * cylinder.area_b
            seal_friction = cylinder.seal_friction
            seal_forces = seal_friction * (np.array(pressures) - tank)
            limit_kind = WORKING_PRESSURE if is_raising else HOLDING_PRESSURE
        if not pressures and not (np.isfinite(max_force) and max_force > 0):
            continue
        if with_friction and is_raising and joint in machine.friction:
            law = machine.friction[joint]
            max_force -= law.breakaway_force + law.coulomb_offset + seal_forces[0]
            min_force += law.breakaway_force - law.coulomb_offset + seal_forces[1]
            areas = areas - seal_friction
        chambers = (tuple(pressures), tuple(areas.tolist())) if pressures else ((), ())
        limits.append(DriveForceLimits(joint, column, min_force, max_force, limit_kind, *chambers))
    if not limits:
        raise InputError(
            f"nothing limits the drives of '{machine.name}', give it hydraulics, or its joints an "
            "effort in <limit>"
        )
    return limits


def _max_pressure(circuit: Hydraulics, cylinder: Cylinder, side: str, is_raising: bool) -> float:
    supply, tank = circuit.pumps[circuit.valves[cylinder.joint].supply], circuit.supply.tank
    supply_pressures = [supply.pressure, *([supply.relief] if supply.relief else [])]
    valve_pressures = [cylinder.relief] if cylinder.relief else []
    if cylinder.cross_relief:
        valve_pressures.append(cylinder.cross_relief + tank)
    counterbalance = getattr(cylinder, f"counterbalance_{side}")
    if counterbalance is not None and not is_raising:
        valve_pressures.append(counterbalance.pressure - counterbalance.pilot_ratio * tank)
    if is_raising:
        return min(*supply_pressures, *valve_pressures, np.inf)
    return min(valve_pressures) if valve_pressures else min(supply_pressures)


class PinForces:
    """Pin forces at rest on level ground, affine in a force F at a frame: R_0 + R_F F.

    The components of a pin force are those that statics determines at home, in the joint's own
    axes: those across the pin, and the one along it unless loops hold a planar linkage in its
    plane more often than needed, see `Reactions`.

    Args:
        machine: The machine.
        frame: Link at which the force acts.
        pin_names: Joints of the tree and loops; by default all whose forces statics determines.

    Attributes:
        names: (p,) names of the pins.

    Raises:
        InputError: A name is unknown, or statics does not determine the force of a named pin.
    """

    def __init__(self, machine: Machine, frame: str, pin_names: Iterable[str] | None = None):
        self._reactions = reactions = Reactions(machine)
        self._frame = frame
        determined = reactions.statically_determined(machine.home)[:, :3]
        known = [reactions.names[k] for k in np.flatnonzero(determined.any(axis=1))]
        self.names = tuple(known if pin_names is None else pin_names)
        for name in self.names:
            check_name(name, reactions.names, f"pin '{name}' is no joint or loop")
            if name not in known:
                raise InputError(
                    f"statics does not determine the force in pin '{name}', leave it out of 'pins'"
                )
        self._pin_indices = [reactions.names.index(name) for name in self.names]
        self._is_determined = determined[self._pin_indices]

    def load_forces(self, q: Array, unit_forces: Array) -> tuple[Array, Array]:
        """Return the pin forces without load, and their increase by a force at the frame.

        Args:
            q: (N, nq) closed configurations.
            unit_forces: (N, 3) force at the frame, in the world.

        Returns:
            Two arrays (N, p, 3) in the joints' own axes [N]; components that statics does not
            determine are 0.
        """
        if not len(q):
            return np.zeros((0, len(self.names), 3)), np.zeros((0, len(self.names), 3))
        reactions, pins = self._reactions, self._pin_indices
        axes = reactions.joint_axes(q)[:, pins]
        unloaded = reactions.joint_wrenches(q)[:, pins, :3]
        unit_wrenches = reactions.unit_load_wrenches(q, self._frame)[:, pins, :3]
        increments = unit_wrenches @ unit_forces[:, None, :, None]
        forces = np.einsum(
            "npij,npix->npjx", axes, np.stack([unloaded, increments[..., 0]], axis=-1)
        )
        forces *= self._is_determined[:, :, None]
        return forces[..., 0], forces[..., 1]
