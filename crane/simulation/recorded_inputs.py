"""Inputs of a run from a recording: references of a controller, and the force at the tip."""

import numpy as np

from crane.common.samples import Array
from crane.control.control_law import ControlLaw
from crane.control.controller_registry import make_controller
from crane.control.force_inputs import ForceInputs
from crane.control.reference_samples import interpolate_references
from crane.control.valve_commands import ValveCommand
from crane.description.external_forces import TIP_WRENCH_NAME, Wrench
from crane.description.sensors import FORCE_SUFFIX, FORCE_UNITS
from crane.machine.machine import Machine
from crane.recordings.measured_configurations import joint_motion
from crane.recordings.timeseries import TIME, Table, check_columns_present, table_column
from crane.simulation.simulation_setup import resolve_controller

_TIP_FORCE = tuple(f"load_{TIP_WRENCH_NAME}_force_{axis}" for axis in "xyz")


def add_recorded_tip_force(machine: Machine, table: Table) -> Machine:
    """The machine with the force at its tip that a recording has, linear between its samples.

    Its columns are load_tip_force_x, _y, _z [N], in the axes of the world. The machine is
    unchanged without them, or where it has a load of this name.
    """
    known = {force.name for force in machine.external_forces}
    if not {*_TIP_FORCE} <= {*table.units} or machine.tip is None or TIP_WRENCH_NAME in known:
        return machine
    force = np.column_stack([table_column(table, name, "N") for name in _TIP_FORCE])
    time = table_column(table, TIME)
    return machine.with_external_forces(
        Wrench(machine.tip, force, times=time - time[0], name=TIP_WRENCH_NAME)
    )


def recorded_references(
    machine: Machine, table: Table, name: str | None
) -> tuple[Array, ControlLaw, tuple[Array, Array]]:
    """Instants (N,) [s] from zero, a control law with recorded references, and the start.

    Args:
        machine: The machine.
        table: A recording with a column of each reference, such as reference_X1 [m], or of the
            force of each drive.
        name: Name of the controller, see `make_controller`; None for forces.

    Raises:
        RecordingError: Columns are missing.
        InputError: The controller is unknown.
    """
    controller = ForceInputs(machine) if name is None else make_controller(name, machine)
    assert isinstance(controller, ControlLaw | ValveCommand)  # as all in the registry
    columns = dict(controller.reference_units)
    if name is None:
        columns = {x + FORCE_SUFFIX: FORCE_UNITS[machine.unit(x)] for x in machine.driven_joints}
    check_columns_present([[column] for column in columns], table.units)
    rows = np.column_stack([table_column(table, column, unit) for column, unit in columns.items()])
    q_a, v_a = joint_motion(machine, table)
    time = table_column(table, TIME)
    time = time - time[0]
    control = resolve_controller(interpolate_references(controller, time, rows), machine)
    assert isinstance(control, ControlLaw)
    return time, control, (q_a[0], v_a[0])
