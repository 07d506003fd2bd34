"""The description of a machine, independent of file formats, and changes of it."""

from crane.description.inertia_feasibility import inertia_problem
from crane.description.machine_lookup import bundled_machines, example_robots
from crane.description.machine_parameters import parameters
from crane.description.parameter_changes import (
    apply_parameter_changes,
    lock_joints,
    set_active_joints,
)
from crane.description.sensors import Sensor
from crane.description.specification import (
    LOOP_TYPES,
    AnyForceElement,
    Chain,
    Coupling,
    Drive,
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
    "LOOP_TYPES",
    "Chain",
    "Coupling",
    "Drive",
    "AnyForceElement",
    "EndStop",
    "ForceElement",
    "Friction",
    "GasSpring",
    "LoopSpec",
    "MachineSpec",
    "PIGains",
    "Rope",
    "Sensor",
    "Task",
    "bundled_machines",
    "apply_parameter_changes",
    "set_active_joints",
    "example_robots",
    "inertia_problem",
    "lock_joints",
    "parameters",
]
