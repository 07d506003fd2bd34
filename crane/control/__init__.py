"""Controllers: forces of the active joints, or signals of valves, from time and motion."""

from crane.control.base import At, Controller, Feedback, Free, Law, TracedController, reference_of
from crane.control.drive import ValveDrive
from crane.control.feedforward import ValveFeedforward
from crane.control.forces import PI, ComputedTorque
from crane.control.levers import joystick
from crane.control.names import CONTROLLERS, controller, usual
from crane.control.openings import fastest, flow_share
from crane.control.phases import Phases
from crane.control.tip import TipVelocity
from crane.control.valves import Command, Sampled, Signals, ValvePD

__all__ = [
    "CONTROLLERS", "PI", "At", "Command", "ComputedTorque", "Controller", "Feedback", "Free",
    "Law", "Phases", "Sampled", "Signals", "TipVelocity", "TracedController", "ValveDrive",
    "ValveFeedforward", "ValvePD", "controller", "fastest", "flow_share", "joystick",
    "reference_of", "usual",
]  # fmt: skip
