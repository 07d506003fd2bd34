"""A motion that is asked to be differentiated."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from numpy.typing import ArrayLike

from crane.codegen import LayoutView
from crane.common.errors import InputError
from crane.common.samples import Array
from crane.control import Controller, TracedController, ValveCommand, ValveDrive
from crane.dynamics import Dynamics
from crane.formats import load
from crane.machine import Machine
from crane.recordings.recording import Recording
from crane.simulation.recorded_run import record_run
from crane.simulation.sensitivity.parameter_directions import ParameterDirections
from crane.simulation.sensitivity.rate_formulas import observed_frames
from crane.simulation.sensitivity.simulated_motion import SimulationProblem
from crane.simulation.simulation_run import Force, count_steps, initial_motion, resolve_controller


class SensitivityProblem(NamedTuple):
    """What is simulated and observed, and what it depends on.

    Attributes:
        simulation: What is simulated.
        outputs: Names of what is observed.
        directions: What it depends on.
    """

    simulation: SimulationProblem
    outputs: tuple[str, ...]
    directions: ParameterDirections

    @classmethod
    def from_arguments(
        cls,
        machine: Machine | str | Path,
        controller: Controller | ValveCommand | Force | None,
        initial: ArrayLike | tuple[ArrayLike, ArrayLike] | None,
        duration: float | None,
        step: float,
        outputs: Sequence[str] | None,
        method: str | None,
        tolerance: float | None,
    ) -> "SensitivityProblem":
        """From what `sensitivities` takes; see there for arguments and errors."""
        if not isinstance(machine, Machine):
            machine = load(machine)
        control = resolve_controller(controller, machine)
        count = count_steps(control, duration, step)
        start = initial_motion(machine, initial, control)
        is_sampled = isinstance(control, ValveDrive) and control.period
        if is_sampled or not isinstance(control, TracedController):
            raise InputError(
                "a controller in Python has no formulas, write it as a crane.control.ControlLaw"
            )
        dynamics = Dynamics(machine)
        names = tuple(_default_outputs(machine) if outputs is None else outputs)
        links = [link for link, _ in observed_frames(machine, names)]
        motion = SimulationProblem(dynamics, control, start, count, step, method, tolerance)
        return cls(motion, names, ParameterDirections(dynamics, control, start, links))

    def record_motion(self, time: Array, parts: LayoutView) -> Recording:
        """The motion, of its rows; see `integrate`."""
        return record_run(
            self.simulation.dynamics.machine, self.simulation.control, time, parts, ""
        )


def _default_outputs(machine: Machine) -> list[str]:
    joints = machine.hydraulics.joints if machine.hydraulics is not None else ()
    return [*machine.active, *(f"pressure_{joint}_{side}" for joint in joints for side in "ab")]
