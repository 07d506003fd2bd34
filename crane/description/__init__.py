"""Reading and checking what the user wrote: machine files and URDFs."""

from crane.description.changes import changed, locked, parameters
from crane.description.inertia import inertia_problem
from crane.description.machine_file import read
from crane.description.sources import bundled, examples
from crane.description.spec import (
    LOOP_TYPES,
    Chain,
    EndStop,
    ForceElement,
    Friction,
    GasSpring,
    LoopSpec,
    MachineSpec,
    PIGains,
    Task,
)

__all__ = [
    "LOOP_TYPES", "Chain", "EndStop", "ForceElement", "Friction", "GasSpring", "LoopSpec",
    "MachineSpec", "PIGains", "Task", "bundled", "changed", "examples", "inertia_problem",
    "locked", "parameters", "read",
]  # fmt: skip
