"""Reading and checking what the user wrote: machine files and URDFs."""

from crane.description.changes import changed, locked, parameters
from crane.description.hydraulics import (
    Counterbalance,
    Cylinder,
    Hydraulics,
    Oil,
    PDGains,
    Supply,
    Valve,
)
from crane.description.inertia import inertia_problem
from crane.description.machine_file import read
from crane.description.sources import bundled, examples
from crane.description.spec import (
    LOOP_TYPES,
    Chain,
    Coupling,
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
    "LOOP_TYPES", "Chain", "Counterbalance", "Coupling", "Cylinder", "EndStop", "ForceElement",
    "Friction", "GasSpring", "Hydraulics", "LoopSpec", "MachineSpec", "Oil", "PDGains", "PIGains",
    "Supply", "Task", "Valve", "bundled", "changed", "examples", "inertia_problem", "locked",
    "parameters", "read",
]  # fmt: skip
