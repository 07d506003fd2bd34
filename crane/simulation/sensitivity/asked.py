"""A motion that is asked to be differentiated."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from numpy.typing import ArrayLike

from crane.codegen import Parts
from crane.common.errors import InputError
from crane.common.samples import Array
from crane.control import Command, Controller, TracedController, ValveDrive
from crane.dynamics import Dynamics
from crane.formats import load
from crane.machine import Machine
from crane.recordings.recording import Recording
from crane.simulation.recorded import recorded
from crane.simulation.run import Force, as_controller, count_steps, start_of
from crane.simulation.sensitivity.directions import Directions
from crane.simulation.sensitivity.rate import frames_of
from crane.simulation.sensitivity.track import Motion


class Asked(NamedTuple):
    """What is simulated and observed, and what it depends on.

    Attributes:
        motion: What is simulated.
        outputs: Names of what is observed.
        directions: What it depends on.
    """

    motion: Motion
    outputs: tuple[str, ...]
    directions: Directions

    @classmethod
    def of(
        cls,
        machine: Machine | str | Path,
        controller: Controller | Command | Force | None,
        initial: ArrayLike | tuple[ArrayLike, ArrayLike] | None,
        duration: float | None,
        step: float,
        outputs: Sequence[str] | None,
        method: str | None,
        tolerance: float | None,
    ) -> "Asked":
        """From what `sensitivities` takes; see there for arguments and errors."""
        if not isinstance(machine, Machine):
            machine = load(machine)
        control = as_controller(controller, machine)
        count = count_steps(control, duration, step)
        start = start_of(machine, initial, control)
        programmed = isinstance(control, ValveDrive) and control.period
        if programmed or not isinstance(control, TracedController):
            raise InputError(
                "a controller in Python has no formulas, write it as a crane.control.Law"
            )
        dynamics = Dynamics(machine)
        names = tuple(_usual(machine) if outputs is None else outputs)
        links = [link for link, _ in frames_of(machine, names)]
        motion = Motion(dynamics, control, start, count, step, method, tolerance)
        return cls(motion, names, Directions(dynamics, control, start, links))

    def recorded(self, time: Array, parts: Parts) -> Recording:
        """The motion, of its rows; see `integrate`."""
        return recorded(self.motion.dynamics.machine, self.motion.control, time, parts, "")


def _usual(machine: Machine) -> list[str]:
    joints = machine.hydraulics.joints if machine.hydraulics is not None else ()
    return [*machine.active, *(f"pressure_{joint}_{side}" for joint in joints for side in "ab")]
