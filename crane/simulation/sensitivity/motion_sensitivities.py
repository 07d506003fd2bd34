"""Sensitivities of a simulated motion, and gradients of functionals of it, by parameters."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import CraneWarning, InputError, check_name
from crane.common.one_line_repr import OneLineRepr
from crane.common.progress import progress_reporter
from crane.common.result import Result
from crane.common.samples import Array
from crane.common.units import display_unit
from crane.control.control_law import ControlLaw, Controller
from crane.control.valve_commands import ValveCommand
from crane.control.valve_drive import ValveDrive
from crane.description.sensors import (
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
from crane.simulation.recorded_run import read_simulation, record_run
from crane.simulation.sensitivity.adjoint_integration import AdjointIntegrator
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


def follow_motion(
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
) -> tuple[SimulatedMotion, Recording, tuple[str, ...], ParameterDirections]:
    """Simulate the motion that is differentiated; for the arguments see `sensitivities`.

    Returns:
        The motion, its recording, names of the outputs, constants and their derivatives.
    """
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
    motion = SimulatedMotion(dynamics, control, start, count, step, method, tolerance, progress)
    recording = record_run(machine, control, motion.time[::2], motion.parts, "")
    return motion, recording, tuple(outputs), directions


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
            check_name(name, names, f"'{name}' is not among them")
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
        if output.startswith(INCLINATION_PREFIX):
            return "rad/s" if output.endswith(VELOCITY_SUFFIX) else "rad"
        rates = {
            name + VELOCITY_SUFFIX: VELOCITY_UNITS[unit]  # of passive joints
            for name, unit in self.recording.channel_units.items()
            if unit in VELOCITY_UNITS
        }
        return (rates | self.recording.column_units()).get(output, "")

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
    motion, recording, names, directions = follow_motion(
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


Functional = Callable[[Array, Array], tuple[ArrayLike, ArrayLike]]
"""Times (N + 1,), outputs (N + 1, k) -> J, dJ/dy (N + 1, k); of several, with an axis first."""


@dataclass(frozen=True, eq=False, repr=False)
class Gradient(OneLineRepr):
    """A motion, a functional J of it, and the gradient of J by parameters of the machine.

    Attributes:
        recording: The motion.
        outputs: Names (k,) of the outputs.
        output_values: (N + 1, k) values of the outputs, SI units.
        parameters: Names (p,) of the parameters.
        values: (p,) values of the parameters.
        functional_value: J; (K,) of several.
        derivatives: (p,) dJ/dp, SI units; (K, p) of several.
    """

    recording: Recording
    outputs: tuple[str, ...]
    output_values: Array
    parameters: tuple[str, ...]
    values: Array
    functional_value: Array
    derivatives: Array

    def _one_line(self) -> str:
        return f"Gradient of {', '.join(self.outputs)} by {len(self.parameters)} numbers"

    def derivative(self, parameter: str) -> Array:
        """Derivative of J by a parameter; (K,) of several.

        Raises:
            InputError: The parameter is unknown.
        """
        check_name(parameter, self.parameters, f"'{parameter}' is not among them")
        return self.derivatives[..., self.parameters.index(parameter)]

    def to_text(self, max_rows: int = 20) -> str:
        """A table in Markdown: the parameters with the largest effects of a change by 1 % on J."""
        slopes, total = np.atleast_2d(self.derivatives), np.atleast_1d(self.functional_value)
        order = np.argsort(-np.abs(slopes * 0.01 * self.values).max(axis=0), kind="stable")[
            :max_rows
        ].tolist()
        heads = (
            ["J"] if self.functional_value.ndim == 0 else [f"J{i + 1}" for i in range(len(total))]
        )
        lines = [f"| number | value | {' | '.join(f'1 % does to {head}' for head in heads)} |"]
        lines += ["| --- | ---: |" + " ---: |" * len(heads)]
        for i in order:
            cells = " | ".join(f"{x:.3g}" for x in 0.01 * self.values[i] * slopes[:, i])
            lines.append(f"| {self.parameters[i]} | {self.values[i]:.6g} | {cells} |")
        values = ", ".join(f"{head} = {x:.6g}" for head, x in zip(heads, total, strict=True))
        return "\n".join(
            [*lines, "", f"{values}; {len(order)} of {len(self.parameters)} numbers."]
        )


def gradient(
    machine: Machine | str | Path,
    controller: Controller | ValveCommand | Force | None = None,
    initial: ArrayLike | tuple[ArrayLike, ArrayLike] | None = None,
    duration: float | None = None,
    step: float = 1e-3,
    *,
    functional: Functional | ArrayLike,
    parameters: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    method: str | None = None,
    tolerance: float | None = None,
    progress: Progress | None = None,
) -> Gradient:
    """Simulate a machine, with the exact gradient of a functional of its motion.

    For J = sum over instants of w_i . y_i, or of any J(y) with dJ/dy_i = w_i, with the slopes that
    `sensitivities` gives as S,

        dJ/dp = sum_i w_i . (dy_i/dp),

    is computed without S, by integrating the adjoint equations backward along the motion. The cost
    does not depend on the number of parameters; see
    `crane.simulation.sensitivity.adjoint_integration`. The derivatives of the constants of the
    simulation by each parameter are computed beforehand.

    Args:
        machine: The machine, or an argument of `crane.load`.
        controller: See `sensitivities`.
        initial: See `simulate`.
        duration: See `simulate`.
        step: See `simulate`.
        functional: J: weights w (N + 1, k) of the outputs at N + 1 instants; or a function of
            their times (N + 1,) and of the outputs (N + 1, k) that gives J and w. Several at once
            have an axis more, (K,) and (K, N + 1, k).
        parameters: Parameters, see `sensitivities`; by default all that have an effect.
        outputs: See `sensitivities`.
        method: See `simulate`.
        tolerance: See `simulate`.
        progress: See `simulate`.

    Raises:
        InputError: As `sensitivities`, or weights have a wrong shape.
        SimulationError: As `sensitivities`.
    """
    parameters = None if parameters is None else list(dict.fromkeys(parameters))
    motion, recording, names, directions = follow_motion(
        machine, controller, initial, duration, step, outputs, parameters or (), method, tolerance,
        progress,
    )  # fmt: skip
    directions_by_name = directions.derivatives(parameters, motion.time)
    for name in [x for x, direction in directions_by_name.items() if direction.references.any()]:
        if parameters is not None:
            raise InputError(
                f"'{name}' changes when signals arrive, which a gradient takes as they are: ask "
                "`sensitivities` for it"
            )
        del directions_by_name[name]
    if not directions_by_name:
        raise InputError("no number is named that changes anything, give `by`")
    changes = _largest_changes(
        directions_by_name, {name: directions.typical_change(name) for name in directions_by_name}
    )
    nominal_constants = directions.nominal_constants(motion.time)
    integrator = AdjointIntegrator(motion, names, nominal_constants, changes)
    observed = read_simulation(motion.chart.machine, recording, list(names))
    total, weights = _functional_and_weights(functional, recording.time, observed)
    gradients = integrator.integrate_backward(weights.reshape(-1, *observed.shape))
    # no parameter changes the references of the controller
    derivatives = sum(
        (
            getattr(gradients, part)
            @ np.array([getattr(x, part) for x in directions_by_name.values()]).T
            for part in SimulationConstants._fields
            if part != "references"
        ),
        np.zeros(()),
    )
    for note in motion.notes:
        warnings.warn(note, CraneWarning, stacklevel=2)
    return Gradient(
        recording,
        names,
        observed,
        tuple(directions_by_name),
        np.array([directions.parameter_value(name) for name in directions_by_name]),
        total,
        derivatives.reshape(*total.shape, -1),
    )


def _largest_changes(
    directions: Mapping[str, SimulationConstants], sizes: Mapping[str, float]
) -> SimulationConstants:
    """By how much numbers of a simulation change that do, see `AdjointIntegrator`."""
    total: list[Array] = []
    for name, direction in directions.items():
        still = direction._replace(references=np.zeros(direction.references.shape[-1]))
        rows = [sizes[name] * np.abs(part) for part in still]
        total = [*map(np.maximum, total, rows)] if total else rows
    return SimulationConstants(*total)


def _functional_and_weights(
    functional: Functional | ArrayLike, time: Array, output_values: Array
) -> tuple[Array, Array]:
    """J and dJ/dy (N + 1, k); of several functionals with a leading axis.

    Raises:
        InputError: They have a wrong shape, or are not finite.
    """
    if callable(functional):
        total, weights = (np.asarray(x, dtype=np.float64) for x in functional(time, output_values))
    else:
        weights = np.asarray(functional, dtype=np.float64)
        if weights.shape[-2:] == output_values.shape:
            total = np.asarray(np.tensordot(weights, output_values, 2))
        else:
            total = np.zeros(weights.shape[:-2])
    if weights.shape != (*total.shape, *output_values.shape) or total.ndim > 1:
        count, k = output_values.shape
        raise InputError(
            f"weights of outputs have the shape {weights.shape}, give ({count}, {k}): {count} "
            f"instants, {k} outputs"
        )
    if not (np.isfinite(weights).all() and np.isfinite(total).all()):
        raise InputError("weights of outputs are not finite, look at the function")
    return total, weights
