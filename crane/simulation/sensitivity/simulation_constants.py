"""Constants of a simulation, and their derivatives by named parameters."""

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from crane.closure.kinematics_formulas import tree_geometry
from crane.common.errors import InputError, suggest_names
from crane.common.samples import Array
from crane.control.control_law import ControlLaw
from crane.control.valve_drive import ValveDrive
from crane.description.sensors import VELOCITY_SUFFIX
from crane.dynamics.dynamics import Dynamics
from crane.dynamics.quantity_evaluator import UNIT_OF_ZERO_PARAMETER, ConstantDerivatives
from crane.machine.machine import Machine
from crane.simulation.integration.machine_formulas import reference_samples

FRAME_SIZE = 9  # numbers of a frame


class SimulationConstants(NamedTuple):
    """All constants on which a simulation depends.

    Attributes:
        geometry: Placements of joints and loops, see
            `crane.closure.kinematics_formulas.TreeGeometry`.
        dynamics_constants: Inertias and force laws, see
            `crane.dynamics.formula_structure.dynamics_constants`, without stick-slip modes.
        settings: Settings of the controller, with the constants of a circuit.
        frames: Position (3,) on its body, x axis (3,) and direction up in the world (3,) of each
            frame of an output.
        references: (N, c) references at N instants.
        initial_state: (m,) initial minimal state, with a small motion of the active joints from
            the nominal configuration in place of their coordinates.
    """

    geometry: Array
    dynamics_constants: Array
    settings: Array
    frames: Array
    references: Array
    initial_state: Array

    def difference_quotient(
        self, other: "SimulationConstants", interval: float
    ) -> "SimulationConstants":
        """(self - other) / interval."""
        return SimulationConstants(
            *((one - two) / interval for one, two in zip(self, other, strict=True))
        )


def simulation_constants_of(
    dynamics: Dynamics,
    control: ControlLaw,
    initial: tuple[Array, Array],
    frames: Sequence[str],
    times: Array,
    nominal_start: Array,
    variant: Machine | None = None,
) -> SimulationConstants:
    """Constants of a simulation.

    Args:
        dynamics: Dynamics of the machine.
        control: Its controller.
        initial: Initial q_A and v_A.
        frames: Links of outputs.
        times: (N,) instants of the references [s].
        nominal_start: (nv,) configuration from which the initial one is a small motion.
        variant: A machine of the same structure with its controller, whose constants are computed
            instead.
    """
    machine = dynamics.machine if variant is None else variant
    constants = dynamics.constants_of(machine)
    geometry, dynamics_constants = np.split(
        constants, [len(dynamics.machine.closure.compiled_closure.geometry.constants)]
    )
    # the scale of residuals does not affect the motion
    geometry[-1] = dynamics.machine.closure.compiled_closure.geometry.constants[-1]
    q = machine.closure.solve(initial[0], initial_guess=machine.home)
    motion = np.linalg.solve(machine.coordinates.rate_matrix(nominal_start), q - nominal_start)
    # compiling does not pay for a single configuration
    controller_state = control.start_closed(Dynamics(machine, backend="pinocchio"), q)
    if isinstance(control, ValveDrive):
        controller_state = controller_state[: control.circuit.stiff_state_count]
    # a variant may have circuit friction at other joints, and more constants
    dynamics_constants[np.flatnonzero(np.isnan(dynamics.constant_pattern))] = 0.0
    frame_constants = [np.zeros(0)]
    body_rotations = tree_geometry(machine.closure.equations).body_rotations
    for link in frames:
        frame = machine.model.frames[machine.frame(link)]
        rotation = body_rotations[machine.coordinates.body_of_joint[int(frame.parentJoint)]].T
        frame_constants += [
            rotation @ frame.placement.translation,
            rotation @ frame.placement.rotation[:, 0],
            machine.up_direction,
        ]
    return SimulationConstants(
        geometry,
        dynamics_constants,
        np.asarray(control.settings, dtype=np.float64),
        np.concatenate(frame_constants),
        reference_samples(machine, control, times),
        np.concatenate([motion[machine.closure.active], initial[1], controller_state]),
    )


START_PREFIX = "start."
_DIFFERENCE_STEP = 1e-4  # of initial motions [coordinate units], per characteristic time
_CENTRAL_DIFFERENCE_WEIGHTS = (
    (1, 8.0 / 12.0),
    (-1, -8.0 / 12.0),
    (2, -1.0 / 12.0),
    (-2, 1.0 / 12.0),
)


class ParameterDirections:
    """Constants of a simulation, and their derivatives by named parameters.

    Args:
        dynamics: Dynamics of the machine.
        control: Its controller.
        start: Initial q_A and v_A.
        frames: Links of outputs.
    """

    def __init__(
        self,
        dynamics: Dynamics,
        control: ControlLaw,
        start: tuple[Array, Array],
        frames: Sequence[str],
    ):
        self._dynamics, self._control = dynamics, control
        self._initial_motion, self._frames = start, frames
        self._start = dynamics.machine.closure.solve(start[0], initial_guess=dynamics.machine.home)

    @cached_property
    def _constant_derivatives(self) -> ConstantDerivatives:
        return ConstantDerivatives(self._dynamics.machine)

    def nominal_constants(self, times: Array) -> SimulationConstants:
        """Constants, for the times (2 N + 1,) of the references [s]."""
        return self._constants_of(self._dynamics.machine, self._initial_motion, times)

    def derivatives(
        self, names: Sequence[str] | None, times: Array
    ) -> dict[str, SimulationConstants]:
        """Derivatives by parameters; see `nominal_constants`.

        Args:
            names: Names of the parameters; None for all of the machine that have an effect and can
                be varied.
            times: See `nominal_constants`.

        Raises:
            InputError: A name is unknown, or a parameter cannot be varied.
        """
        base = self.nominal_constants(times)
        ends = np.cumsum([part.size for part in base])[:-1]

        def flat(machine: Machine) -> Array:
            return np.concatenate(
                [x.ravel() for x in self._constants_of(machine, self._initial_motion, times)]
            )

        out: dict[str, SimulationConstants] = {}
        nominal, ignored_errors = None, InputError if names is None else ()
        for name in self._constant_derivatives.parameter_names if names is None else names:
            if name.startswith(START_PREFIX):
                out[name] = self._start_derivative(name, times)
                continue
            if nominal is None:
                nominal = self._constant_derivatives.nominal_constants(flat)
            try:
                derivative = self._constant_derivatives.derivative(name, flat, nominal)
            except ignored_errors:
                continue
            if names is None and not derivative.any():
                continue
            parts = zip(np.split(derivative, ends), base, strict=True)
            found = SimulationConstants(*(part.reshape(like.shape) for part, like in parts))
            if not found.references.any():  # saves memory
                found = SimulationConstants(*map(np.copy, found))._replace(
                    references=np.broadcast_to(0.0, found.references.shape)
                )
            out[name] = found
        return out

    def parameter_value(self, name: str) -> float:
        """Value of a parameter, or of an initial coordinate or velocity."""
        if name.startswith(START_PREFIX):
            part, i = _parse_start_name(name, self._dynamics.machine)
            return float(self._initial_motion[part][i])
        return self._constant_derivatives.parameter_value(name)

    def typical_change(self, name: str) -> float:
        """Size of a large change of a parameter."""
        value = self.parameter_value(name)
        return (
            abs(value) if value and not name.startswith(START_PREFIX) else UNIT_OF_ZERO_PARAMETER
        )

    def _constants_of(
        self, machine: Machine, start: tuple[Array, Array], times: Array
    ) -> SimulationConstants:
        """Constants of a machine of the same structure, from an initial motion."""
        control = self._control
        machine_controller = (
            control.for_machine(machine) if isinstance(control, ValveDrive) else control
        )
        return simulation_constants_of(
            self._dynamics, machine_controller, start, self._frames, times, self._start, machine
        )

    def _start_derivative(self, name: str, times: Array) -> SimulationConstants:
        """Derivatives of the constants by an initial coordinate or velocity."""
        machine = self._dynamics.machine
        part, i = _parse_start_name(name, machine)
        closure = machine.closure
        difference_step = (
            _DIFFERENCE_STEP
            * closure.units[closure.active][i]
            / (closure.characteristic_time if part else 1.0)
        )
        base = self.nominal_constants(times)  # no other constant depends on the initial motion
        start = np.zeros_like(base.initial_state)
        for side, weight in _CENTRAL_DIFFERENCE_WEIGHTS:
            moved = self._initial_motion[0].copy(), self._initial_motion[1].copy()
            moved[part][i] += side * difference_step
            state = self._constants_of(machine, moved, times).initial_state
            start += weight / difference_step * state
        return SimulationConstants(*(np.broadcast_to(0.0, x.shape) for x in base))._replace(
            initial_state=start
        )


def _parse_start_name(name: str, machine: Machine) -> tuple[int, int]:
    """Part of the initial motion of a name (0 for q_A, 1 for v_A), and index of the joint.

    Raises:
        InputError: The joint is no active joint.
    """
    joint = name.removeprefix(START_PREFIX)
    part = int(joint.endswith(VELOCITY_SUFFIX) and joint not in machine.active)
    joint = joint.removesuffix(VELOCITY_SUFFIX) if part else joint
    if joint not in machine.active:
        raise InputError(
            f"'{name}' is no start of an active joint, {suggest_names(machine.active, joint)}"
        )
    return part, machine.active.index(joint)
