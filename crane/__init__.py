"""crane: machines with closed kinematic chains, computed in their actuators."""

import sys
import time
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from crane.closure import Closure
    from crane.common.errors import CraneError, CraneWarning
    from crane.control import (
        PI,
        ComputedTorque,
        ControlLaw,
        Controller,
        LeverPhases,
        SampledCommand,
        TipVelocity,
        ValveCommand,
        ValveDrive,
        ValveFeedforward,
        ValvePD,
        ValveSignals,
        fastest_trajectory,
        joystick,
    )
    from crane.description import (
        EndStop,
        ForceElement,
        Friction,
        GasSpring,
        PIGains,
        Rope,
        Sensor,
    )
    from crane.description.external_forces import (
        ExternalForce,
        PhasedWrench,
        Wrench,
        WrenchFunction,
    )
    from crane.description.ground_contact import Contact, Ground
    from crane.description.soil_cutting import SOILS, Soil, SoilCutting
    from crane.description.task_phases import Phase
    from crane.dynamics import Dynamics
    from crane.dynamics.buckling import Buckling
    from crane.dynamics.reactions import Reactions
    from crane.formats import (
        load,
        robot_description,
        write_machine,
        write_mjcf,
        write_urdf_plus,
    )
    from crane.formats.additions import add_cylinder, add_loops
    from crane.formats.checks import check
    from crane.hydraulics import PDGains
    from crane.identification.calibration.calibrate import calibrate
    from crane.identification.calibration.calibration_result import Calibration
    from crane.identification.excitation.periodic_excitation import Excitation, excite
    from crane.identification.excitation.signal_excitation import SignalExcitation, excite_valves
    from crane.identification.hydraulics.cylinder_friction import identify_cylinder_friction
    from crane.identification.hydraulics.orifice_coefficients import identify_orifices
    from crane.identification.hydraulics.valve_curve import identify_valve
    from crane.identification.mechanics.cross_validation import cross_validate
    from crane.identification.mechanics.identification_result import Identification
    from crane.identification.mechanics.identify import identify
    from crane.identification.mechanics.identify_payload import identify_payload
    from crane.identification.mechanics.write_identified import write_identified
    from crane.machine import Machine, Payload
    from crane.motion import (
        AttitudeTrajectory,
        Kinematics,
        Sway,
        Trajectory,
        Transmission,
        point_to_point,
        polynomial,
        read_path,
        retime,
        suppress_sway,
        task_trajectory,
        tip_trajectory,
        via_attitudes,
        via_points,
    )
    from crane.motion.workspaces import Workspace, workspace
    from crane.ratings import (
        Breakout,
        Capacity,
        Rule,
        ToolForce,
        Torques,
        WorkingRange,
        breakout,
        capacity,
        tool_force,
        torques,
        working_range,
    )
    from crane.recordings import Recording
    from crane.recordings.limit_cycle_detection import limit_cycles
    from crane.recordings.measured_recordings import read_measured
    from crane.simulation import InterruptedRun, simulate
    from crane.simulation.batch import Batch, simulate_batch
    from crane.simulation.casadi_functions import casadi_function
    from crane.simulation.linear import LinearModel, linear_models, linearize
    from crane.simulation.recording_replay import Comparison, replay
    from crane.simulation.sensitivity import Gradient, Sensitivities, gradient, sensitivities
    from crane.studies import (
        PowerBalance,
        PowerComparison,
        Study,
        SwayStudy,
        power_balance,
        study,
        sway_study,
    )
    from crane.studies.optimization import Design, design
    from crane.view.page import report
    from crane.view.page.identification_page import identification_report
    from crane.view.sketches import sketch, sketch_circuit

__version__ = "0.2.0"
LOADED = time.time()  # before any other file of the package was read

from crane.common import one_line_repr as _shown  # noqa: E402
from crane.common import result as _result  # noqa: E402

_HOMES = {
    "crane.closure": "Closure",
    "crane.common.errors": "CraneError CraneWarning",
    "crane.control": "PI ValveCommand ComputedTorque Controller ControlLaw LeverPhases "
    "SampledCommand ValveSignals TipVelocity ValveDrive ValveFeedforward ValvePD "
    "fastest_trajectory joystick",
    "crane.description": "EndStop ForceElement Friction GasSpring PIGains Rope Sensor",
    "crane.description.task_phases": "Phase",
    "crane.description.external_forces": "ExternalForce PhasedWrench WrenchFunction Wrench",
    "crane.description.ground_contact": "Contact Ground",
    "crane.description.soil_cutting": "SOILS SoilCutting Soil",
    "crane.dynamics": "Dynamics",
    "crane.dynamics.buckling": "Buckling",
    "crane.dynamics.reactions": "Reactions",
    "crane.formats": "load robot_description write_machine write_mjcf write_urdf_plus",
    "crane.formats.additions": "add_cylinder add_loops",
    "crane.formats.checks": "check",
    "crane.hydraulics": "PDGains",
    "crane.identification.calibration.calibrate": "calibrate",
    "crane.identification.calibration.calibration_result": "Calibration",
    "crane.identification.excitation.periodic_excitation": "Excitation excite",
    "crane.identification.excitation.signal_excitation": "SignalExcitation excite_valves",
    "crane.identification.hydraulics.cylinder_friction": "identify_cylinder_friction",
    "crane.identification.hydraulics.orifice_coefficients": "identify_orifices",
    "crane.identification.hydraulics.valve_curve": "identify_valve",
    "crane.identification.mechanics.cross_validation": "cross_validate",
    "crane.identification.mechanics.identify": "identify",
    "crane.identification.mechanics.identify_payload": "identify_payload",
    "crane.identification.mechanics.identification_result": "Identification",
    "crane.identification.mechanics.write_identified": "write_identified",
    "crane.machine": "Machine Payload",
    "crane.motion": "Kinematics Sway Trajectory Transmission AttitudeTrajectory point_to_point "
    "polynomial read_path retime task_trajectory tip_trajectory via_attitudes via_points "
    "suppress_sway",
    "crane.motion.workspaces": "Workspace workspace",
    "crane.ratings": "Breakout Capacity Rule ToolForce Torques WorkingRange breakout capacity "
    "tool_force torques working_range",
    "crane.recordings": "Recording",
    "crane.recordings.limit_cycle_detection": "limit_cycles",
    "crane.recordings.measured_recordings": "read_measured",
    "crane.simulation": "InterruptedRun simulate",
    "crane.simulation.batch": "Batch simulate_batch",
    "crane.simulation.linear": "LinearModel linear_models linearize",
    "crane.simulation.recording_replay": "Comparison replay",
    "crane.simulation.sensitivity": "Gradient Sensitivities gradient sensitivities",
    "crane.simulation.casadi_functions": "casadi_function",
    "crane.studies": "PowerBalance PowerComparison Study SwayStudy power_balance study sway_study",
    "crane.studies.optimization": "Design design",
    "crane.view.page": "report",
    "crane.view.page.identification_page": "identification_report",
    "crane.view.sketches": "sketch sketch_circuit",
}

__all__ = [
    "Batch",
    "Breakout",
    "Buckling",
    "Calibration",
    "Capacity",
    "Closure",
    "ValveCommand",
    "Comparison",
    "ComputedTorque",
    "Contact",
    "Controller",
    "CraneError",
    "CraneWarning",
    "SoilCutting",
    "Design",
    "Dynamics",
    "EndStop",
    "Excitation",
    "ExternalForce",
    "ForceElement",
    "Friction",
    "GasSpring",
    "Gradient",
    "Ground",
    "Identification",
    "InterruptedRun",
    "Kinematics",
    "ControlLaw",
    "LinearModel",
    "Machine",
    "PDGains",
    "PI",
    "PIGains",
    "Payload",
    "Phase",
    "PhasedWrench",
    "LeverPhases",
    "PowerBalance",
    "PowerComparison",
    "WrenchFunction",
    "Reactions",
    "Recording",
    "Rope",
    "Rule",
    "SOILS",
    "SampledCommand",
    "Sensitivities",
    "Sensor",
    "SignalExcitation",
    "ValveSignals",
    "Soil",
    "Study",
    "Sway",
    "SwayStudy",
    "TipVelocity",
    "ToolForce",
    "Torques",
    "Trajectory",
    "Transmission",
    "AttitudeTrajectory",
    "ValveDrive",
    "ValveFeedforward",
    "ValvePD",
    "WorkingRange",
    "Workspace",
    "Wrench",
    "add_cylinder",
    "add_loops",
    "breakout",
    "calibrate",
    "capacity",
    "casadi_function",
    "check",
    "cross_validate",
    "design",
    "excite",
    "excite_valves",
    "fastest_trajectory",
    "gradient",
    "identification_report",
    "identify",
    "identify_cylinder_friction",
    "identify_orifices",
    "identify_payload",
    "identify_valve",
    "joystick",
    "limit_cycles",
    "linear_models",
    "linearize",
    "load",
    "point_to_point",
    "polynomial",
    "power_balance",
    "read_measured",
    "read_path",
    "replay",
    "report",
    "retime",
    "robot_description",
    "sensitivities",
    "simulate",
    "simulate_batch",
    "sketch",
    "sketch_circuit",
    "study",
    "sway_study",
    "task_trajectory",
    "tip_trajectory",
    "tool_force",
    "torques",
    "via_attitudes",
    "via_points",
    "suppress_sway",
    "working_range",
    "workspace",
    "write_identified",
    "write_machine",
    "write_mjcf",
    "write_urdf_plus",
]


def __getattr__(name: str) -> Any:
    # imports run when a name is first used, so that `crane --help` answers at once
    for module, names in _HOMES.items():
        if name in names.split():
            return getattr(import_module(module), name)
    raise AttributeError(f"module 'crane' has no attribute '{name}'")


def _to_html(what: Any) -> str | None:
    from crane.view.notebook import to_html

    return to_html(what)


def _watch_cells() -> None:
    """In a notebook, tell what goes on in cells that take long."""
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    if hasattr(shell, "kernel"):
        from crane.view.notebook_progress import show_cell_progress

        show_cell_progress(shell)


def _write_result(*arguments: Any, **options: Any) -> str:
    from crane.view.result_files import write_result

    return write_result(*arguments, **options)


_shown.to_html = _to_html
_result.write_result = _write_result
_watch_cells()


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
