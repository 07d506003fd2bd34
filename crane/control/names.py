"""Controllers by name."""

from collections.abc import Callable, Mapping

from crane.common.errors import InputError, known
from crane.control.base import Controller
from crane.control.feedforward import ValveFeedforward
from crane.control.forces import PI, ComputedTorque
from crane.control.tip import TipVelocity
from crane.control.valves import Command, ValvePD
from crane.machine import Machine
from crane.motion.curves import Trajectory

CONTROLLERS: Mapping[str, Callable[[Machine, Trajectory], Controller | Command]] = {
    "pi": PI,
    "computed-torque": ComputedTorque,
    "valve-pd": ValvePD,
    "valve-feedforward": ValveFeedforward,
    "tip-velocity": TipVelocity,
}


def usual(machine: Machine) -> str:
    """The controller that follows a machine's tasks if none is named."""
    if machine.hydraulics is not None and machine.hydraulics.control:
        return "valve-pd"
    return "pi" if machine.control else "computed-torque"


def controller(name: str, machine: Machine, reference: Trajectory) -> Controller | Command:
    """A built-in controller by name.

    Raises:
        InputError: There is no such controller.
    """
    if name not in CONTROLLERS:
        raise InputError(f"controller '{name}' is unknown, {known(CONTROLLERS, name)}")
    return CONTROLLERS[name](machine, reference)
