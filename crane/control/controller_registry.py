"""Built-in controllers by name."""

from collections.abc import Callable, Mapping

from crane.common.errors import check_name
from crane.control.control_law import PI, ComputedTorque, Controller
from crane.control.levers import TipVelocity
from crane.control.valve_commands import ValveCommand, ValvePD
from crane.control.valve_feedforward import ValveFeedforward
from crane.machine.machine import Machine
from crane.motion.trajectory import Trajectory, point_to_point

CONTROLLERS: Mapping[str, Callable[[Machine, Trajectory], Controller | ValveCommand]] = {
    "pi": PI,
    "computed-torque": ComputedTorque,
    "valve-pd": ValvePD,
    "valve-feedforward": ValveFeedforward,
    "tip-velocity": TipVelocity,
}


def default_controller_name(machine: Machine) -> str:
    """Name of the default controller for the tasks of a machine."""
    if machine.hydraulics is not None and machine.hydraulics.control:
        return "valve-pd"
    return "pi" if machine.control else "computed-torque"


def make_controller(
    name: str, machine: Machine, reference: Trajectory | None = None
) -> Controller | ValveCommand:
    """A built-in controller by name, by default of the home configuration.

    Raises:
        InputError: The name is unknown.
    """
    check_name(name, CONTROLLERS, f"controller '{name}' is unknown")
    if reference is None:
        home = machine.home[machine.closure.active]
        reference = point_to_point(home, home, 1.0)
    return CONTROLLERS[name](machine, reference)
