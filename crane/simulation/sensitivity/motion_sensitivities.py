"""Sensitivities of a simulated motion by parameters of the machine."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import CraneWarning, InputError, suggest_names
from crane.common.progress import progress_reporter
from crane.common.result import Result
from crane.common.samples import Array
from crane.common.units import display_unit
from crane.control.control_law import ControlLaw, Controller
from crane.control.valve_commands import ValveCommand
from crane.control.valve_drive import ValveDrive
from crane.description.sensors import (
    FORCE_SUFFIX,
    FORCE_UNITS,
    INCLINATION_PREFIX,
    VELOCITY_SUFFIX,
    VELOCITY_UNITS,
)
from crane.dynamics.dynamics import Dynamics
from crane.formats.machine_loading import load
from crane.machine.machine import Machine
from crane.recordings import timeseries
from crane.recordings.recording import Recording
from crane.recordings.timeseries import Table
from crane.simulation.recorded_run import record_run
from crane.simulation.sensitivity.rate_formulas import observed_frames
from crane.simulation.sensitivity.simulated_motion import SimulatedMotion
from crane.simulation.sensitivity.simulation_constants import (
    START_PREFIX,
    ParameterDirections,
    SimulationConstants,
)
from crane.simulation.sensitivity.variational_integration import VariationalIntegrator
from crane.simulation.simulation_run import Progress
from crane.simulation.simulation_setup import (
    Force,
    count_steps,
    initial_motion,
    resolve_controller,
)


class SensitivityProblem(NamedTuple):
    """A simulated motion with its outputs and parameters.

    Attributes:
        motion: The motion.
        recording: Its recording.
        outputs: Names of the outputs.
        directions: Constants and their derivatives by parameters.
    """

    motion: SimulatedMotion
    recording: Recording
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
        parameters: Sequence[str],
        method: str | None,
        tolerance: float | None,
        progress: Progress | None,
    ) -> "SensitivityProblem":
        """The problem from the arguments of `sensitivities`; see there."""
        progress = progress_reporter(progress)
        if not isinstance(machine, Machine):
            machine = load(machine)
        control = resolve_controller(controller, machine)
        count = count_steps(control, duration, step)
        start = initial_motion(machine, initial, control)
        is_sampled = isinstance(control, ValveDrive) and control.period
        if is_sampled or not isinstance(control, ControlLaw):
            raise InputError(
                "a controller in Python has no formulas, write it as a crane.control.ControlLaw"
            )
        dynamics = Dynamics(machine)
        if outputs is None:
            joints = machine.hydraulics.joints if machine.hydraulics is not None else ()
            pressures = [f"pressure_{joint}_{side}" for joint in joints for side in "ab"]
            outputs = [*machine.active, *pressures]
        links = [link for link, _ in observed_frames(machine, outputs)]
        directions = ParameterDirections(dynamics, control, start, links)
        for name in parameters:
            directions.parameter_value(name)  # an unknown one is refused before the simulation
        motion = SimulatedMotion(
            dynamics, control, start, count, step, method, tolerance, progress
        )
        recording = record_run(machine, control, motion.time[::2], motion.parts, "")
        return cls(motion, recording, tuple(outputs), directions)


ZERO_TOLERANCE = 1e-9  # of an output, in the unit that it is read in


@dataclass(frozen=True, eq=False, repr=False)
class Sensitivities(Result):
    """A motion, and its derivatives by numbers.

    Attributes:
        recording: The motion.
        outputs: Names (k,) of the outputs.
        parameters: Names (p,) of the numbers.
        values: (p,) of these.
        derivatives: (N, k, p) derivatives of the outputs, SI units.
    """

    recording: Recording
    outputs: tuple[str, ...]
    parameters: tuple[str, ...]
    values: Array
    derivatives: Array

    def _one_line(self) -> str:
        return f"Sensitivities of {', '.join(self.outputs)} by {', '.join(self.parameters)}"

    def derivative(self, output: str, parameter: str) -> Array:
        """Derivative (N,) of an output by a parameter over time.

        Raises:
            InputError: There is no such output or number.
        """
        for name, names in ((output, self.outputs), (parameter, self.parameters)):
            if name not in names:
                raise InputError(f"'{name}' is not among them, {suggest_names(names, name)}")
        index = self.outputs.index(output), self.parameters.index(parameter)
        return np.asarray(self.derivatives[:, index[0], index[1]])

    @property
    def typical_changes(self) -> Array:
        """(p,) small changes: 1 % of parameters; 0.001 [SI] of zeros and initial values."""
        is_parameter = [not name.startswith(START_PREFIX) for name in self.parameters]
        is_zero = ~np.array(is_parameter) | (self.values == 0)
        return np.where(is_zero, 1e-3, 0.01 * np.abs(self.values))

    def unit(self, output: str) -> str:
        """SI unit of an output."""
        units = self.recording.units | self.recording.channel_units
        if output in units:
            return units[output]
        if output.startswith(INCLINATION_PREFIX):
            return "rad/s" if output.endswith(VELOCITY_SUFFIX) else "rad"
        for end, kinds in ((VELOCITY_SUFFIX, VELOCITY_UNITS), (FORCE_SUFFIX, FORCE_UNITS)):
            if (joint := output.removesuffix(end)) != output and joint in units:
                return kinds[units[joint]]
        return ""

    def to_text(self) -> str:
        """A table in Markdown: effects of a small change of each parameter on each output."""
        effects = self.derivatives * self.typical_changes
        units = [
            display_unit(self.unit(output), float(np.abs(effects[:, k]).max()))
            for k, output in enumerate(self.outputs)
        ]
        head = [f"{x} [{unit}]" for x, (unit, _) in zip(self.outputs, units, strict=True)]
        lines = [f"| number | value | more by | {' | '.join(head)} |"]
        lines += ["| --- | ---: | ---: |" + " ---: |" * len(head)]
        for i, (name, value) in enumerate(zip(self.parameters, self.values, strict=True)):
            sizes = np.sqrt(np.mean(effects[:, :, i] ** 2, axis=0))
            shown = [scale * x for x, (_, scale) in zip(sizes, units, strict=True)]
            cells = [f"{x:.3g}" if x > ZERO_TOLERANCE else "0" for x in shown]
            lines.append(
                f"| {name} | {value:.6g} | {self.typical_changes[i]:.3g} | {' | '.join(cells)} |"
            )
        return "\n".join([*lines, "", "Root mean square of the change over the motion."])

    def to_csv(self, path: str | Path) -> None:
        """Write all derivatives over time to a CSV file, in columns "OUTPUT by PARAMETER".

        Raises:
            OutputError: It cannot be written.
        """
        names = [f"{output} by {name}" for output in self.outputs for name in self.parameters]
        values = np.column_stack(
            [self.recording.time, self.derivatives.reshape(len(self.derivatives), -1)]
        )
        units = {"time": "s"} | dict.fromkeys(names, "")
        timeseries.write_table(path, Table(units, values, {"machine": self.recording.machine}))


def sensitivities(
    machine: Machine | str | Path,
    controller: Controller | ValveCommand | Force | None = None,
    initial: ArrayLike | tuple[ArrayLike, ArrayLike] | None = None,
    duration: float | None = None,
    step: float = 1e-3,
    *,
    parameters: Sequence[str],
    outputs: Sequence[str] | None = None,
    method: str | None = None,
    tolerance: float | None = None,
    progress: Progress | None = None,
) -> Sensitivities:
    """Simulate a machine, with the exact derivatives of its motion by parameters.

    With the minimal state s = (q_A, v_A, controller), s' = r(s, t, p), and S = ds/dp,

        S' = dr/ds S + dr/dp,    S(0) = ds(0)/dp,

    between stick-slip transitions, at which S jumps by (r - r_+) dt/dp. The rate r is
    differentiated operation by operation through the closed loops. The equations are solved along
    the states of the simulation by the method of Lobatto IIIC, extrapolated to order 5, over the
    recorded steps; these are divided into up to 4,096 parts where the rate is not smooth.

    Args:
        machine: The machine, or an argument of `crane.load`.
        controller: See `simulate`; controller and initial coordinates do not depend on the
            parameters of the machine.
        initial: See `simulate`.
        duration: See `simulate`.
        step: See `simulate`.
        parameters: Parameters of the machine as `crane.description.parameters` lists them, such as
            "payload.mass" or "oil.bulk_modulus", and `start.JOINT`, `start.JOINT_velocity`
            of active joints.
        outputs: Names of outputs: joints, `JOINT_velocity`, `JOINT_force` of active ones,
            channels of the circuit such as `pressure_JOINT_a`, "kinetic", "potential", `tip_x`,
            `inclination_LINK` and `inclination_LINK_velocity`. If not given, the active joints,
            and with valves the chambers' pressures.
        method: See `simulate`.
        tolerance: See `simulate`.
        progress: See `simulate`.

    Raises:
        InputError: Unknown names, or a machine without formulas.
        SimulationError: The motion reaches a dead centre; else as `simulate`.
    """
    if not parameters:
        raise InputError("no number is named, give `by` such as ['payload.mass']")
    motion, recording, names, directions = SensitivityProblem.from_arguments(
        machine, controller, initial, duration, step, outputs, parameters, method, tolerance,
        progress,
    )  # fmt: skip
    values = np.array([directions.parameter_value(name) for name in parameters])
    sizes = np.array([directions.typical_change(name) for name in parameters])
    every = directions.derivatives(list(dict.fromkeys(parameters)), motion.time)
    parts = zip(*(every[name] for name in parameters), strict=True)
    integrator = VariationalIntegrator(
        motion,
        names,
        directions.nominal_constants(motion.time),
        SimulationConstants(*map(np.array, parts)),
        sizes,
    )
    derivatives = integrator.integrate()
    for note in motion.notes:
        warnings.warn(note, CraneWarning, stacklevel=2)
    return Sensitivities(recording, names, tuple(parameters), values, derivatives)
