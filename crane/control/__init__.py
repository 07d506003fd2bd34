"""Controllers: active forces, or signals of valves, from time and motion."""

from crane.control.control_law import (
    PI,
    ComputedTorque,
    ControlLaw,
    Controller,
    ControllerInputs,
    FunctionController,
    TracedController,
    ZeroForce,
    controller_reference,
)
from crane.control.controller_registry import CONTROLLERS, default_controller_name, make_controller
from crane.control.levers import LeverPhases, joystick
from crane.control.tip_velocity import TipVelocity
from crane.control.valve_commands import SampledCommand, ValveCommand, ValvePD, ValveSignals
from crane.control.valve_drive import ValveDrive
from crane.control.valve_feedforward import (
    ValveFeedforward,
    fastest_trajectory,
    largest_flow_share,
)

__all__ = [
    "CONTROLLERS",
    "PI",
    "ControllerInputs",
    "ValveCommand",
    "ComputedTorque",
    "Controller",
    "FunctionController",
    "ZeroForce",
    "ControlLaw",
    "LeverPhases",
    "SampledCommand",
    "ValveSignals",
    "TipVelocity",
    "TracedController",
    "ValveDrive",
    "ValveFeedforward",
    "ValvePD",
    "make_controller",
    "fastest_trajectory",
    "largest_flow_share",
    "joystick",
    "controller_reference",
    "default_controller_name",
]
