"""crane: machines with closed kinematic chains, computed in their actuators."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from crane.batch import Batch, simulate_batch
    from crane.closure import Closure
    from crane.control import (
        PI,
        ComputedTorque,
        Sampled,
        Signals,
        TipVelocity,
        ValveDrive,
        ValvePD,
        joystick,
    )
    from crane.description import EndStop, ForceElement, Friction, GasSpring, PIGains
    from crane.dynamics import Dynamics
    from crane.errors import CraneError, CraneWarning
    from crane.formats import write_machine, write_mjcf, write_urdf_plus
    from crane.identification.cylinder_friction import cylinder_friction
    from crane.identification.identify import identify
    from crane.identification.orifices import identify_orifices
    from crane.identification.result import Identification
    from crane.identification.valve import identify_valve
    from crane.kinematics import Kinematics
    from crane.machine import Machine, Payload, load
    from crane.measured import read_measured
    from crane.paths import Path, point_to_point, polynomial, task_path, tip_path
    from crane.recording import Recording
    from crane.replays import Comparison, replay
    from crane.simulation import simulate
    from crane.studies import Study, study
    from crane.view.page import report
    from crane.view.sketch import sketch
    from crane.workspaces import Workspace, workspace

__version__ = "0.1.0"

_HOMES = {
    "crane.closure": ("Closure",),
    "crane.control": (
        "PI",
        "ComputedTorque",
        "Sampled",
        "Signals",
        "TipVelocity",
        "ValveDrive",
        "ValvePD",
        "joystick",
    ),
    "crane.description": ("EndStop", "ForceElement", "Friction", "GasSpring", "PIGains"),
    "crane.dynamics": ("Dynamics",),
    "crane.errors": ("CraneError", "CraneWarning"),
    "crane.formats": ("write_machine", "write_mjcf", "write_urdf_plus"),
    "crane.identification.cylinder_friction": ("cylinder_friction",),
    "crane.identification.identify": ("identify",),
    "crane.identification.orifices": ("identify_orifices",),
    "crane.identification.valve": ("identify_valve",),
    "crane.identification.result": ("Identification",),
    "crane.kinematics": ("Kinematics",),
    "crane.machine": ("Machine", "Payload", "load"),
    "crane.measured": ("read_measured",),
    "crane.paths": ("Path", "point_to_point", "polynomial", "task_path", "tip_path"),
    "crane.recording": ("Recording",),
    "crane.batch": ("Batch", "simulate_batch"),
    "crane.replays": ("Comparison", "replay"),
    "crane.simulation": ("simulate",),
    "crane.studies": ("Study", "study"),
    "crane.view.page": ("report",),
    "crane.workspaces": ("Workspace", "workspace"),
    "crane.view.sketch": ("sketch",),
}

__all__ = [
    "PI", "Batch", "Closure", "Comparison", "ComputedTorque", "CraneError", "CraneWarning",
    "Dynamics", "EndStop", "ForceElement", "Friction", "GasSpring", "Identification", "Kinematics",
    "Machine", "PIGains", "Path", "Payload", "Recording", "Sampled", "Signals", "Study",
    "TipVelocity", "ValveDrive", "ValvePD", "Workspace", "cylinder_friction", "identify",
    "identify_orifices", "identify_valve", "joystick", "load", "point_to_point", "polynomial",
    "read_measured", "replay", "report", "simulate", "simulate_batch", "sketch", "study",
    "task_path", "tip_path", "workspace", "write_machine", "write_mjcf", "write_urdf_plus",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    # imports run when a name is first used, so that `crane --help` answers at once
    for module, names in _HOMES.items():
        if name in names:
            return getattr(import_module(module), name)
    raise AttributeError(f"module 'crane' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
