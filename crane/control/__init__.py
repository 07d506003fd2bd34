"""Controllers: forces of the active joints, or signals of valves, from time and motion."""

from crane.control.base import (
    Controller,
    Feedback,
    Free,
    StiffController,
    Traced,
    TracedController,
)
from crane.control.drive import ValveDrive
from crane.control.forces import PI, ComputedTorque
from crane.control.names import CONTROLLERS, controller, usual
from crane.control.tip import TipVelocity
from crane.control.valves import Command, Sampled, Signals, ValvePD, joystick

__all__ = [
    "CONTROLLERS", "PI", "Command", "ComputedTorque", "Controller", "Feedback", "Free", "Sampled",
    "Signals", "StiffController", "TipVelocity", "Traced", "TracedController", "ValveDrive",
    "ValvePD", "controller", "joystick", "usual",
]  # fmt: skip
