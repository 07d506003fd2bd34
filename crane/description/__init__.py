"""What a machine is described by, whatever file it comes from, and changes of it."""

from crane.description.changes import changed, driven, locked, parameters
from crane.description.inertia import inertia_problem
from crane.description.sensors import Sensor
from crane.description.sources import bundled, examples
from crane.description.spec import (
    LOOP_TYPES,
    Chain,
    Coupling,
    Drive,
    Element,
    EndStop,
    ForceElement,
    Friction,
    GasSpring,
    LoopSpec,
    MachineSpec,
    PIGains,
    Rope,
    Task,
)

__all__ = [
    "LOOP_TYPES", "Chain", "Coupling", "Drive", "Element", "EndStop", "ForceElement", "Friction",
    "GasSpring", "LoopSpec", "MachineSpec", "PIGains", "Rope", "Sensor", "Task", "bundled",
    "changed", "driven", "examples", "inertia_problem", "locked", "parameters",
]  # fmt: skip
