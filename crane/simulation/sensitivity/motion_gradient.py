"""Gradient of a functional of a motion by the parameters of a machine."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import CraneWarning, InputError, suggest_names
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array
from crane.control.control_law import Controller
from crane.control.valve_commands import ValveCommand
from crane.description.sensors import VELOCITY_SUFFIX
from crane.machine.machine import Machine
from crane.recordings.recording import Recording
from crane.simulation.recorded_run import read_simulation
from crane.simulation.sensitivity.adjoint_integration import AdjointIntegrator
from crane.simulation.sensitivity.motion_sensitivities import SensitivityProblem
from crane.simulation.sensitivity.simulation_constants import SimulationConstants
from crane.simulation.simulation_run import Progress
from crane.simulation.simulation_setup import Force

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
        if parameter not in self.parameters:
            raise InputError(
                f"'{parameter}' is not among them, {suggest_names(self.parameters, parameter)}"
            )
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
    motion, recording, names, directions = SensitivityProblem.from_arguments(
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
    simulated, columns, values = motion.chart.machine, recording.columns(), []
    for name in names:
        joint = name.removesuffix(VELOCITY_SUFFIX)
        if name not in columns and joint in simulated.joints:  # the velocity of a passive joint
            rows = simulated.closure.gamma(motion.parts.q)[:, simulated.joints.index(joint)]
            values.append(np.einsum("ni,ni->n", rows, motion.parts.v_a))
        else:
            values.append(read_simulation(simulated, recording, [name])[:, 0])
    observed = np.column_stack(values)
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
