"""Constants of a simulation, and their derivatives by named parameters."""

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from crane.closure.kinematics_formulas import tree_geometry
from crane.common.errors import InputError, suggest_names
from crane.common.samples import Array
from crane.control import TracedController, ValveDrive
from crane.description.sensors import VELOCITY_SUFFIX
from crane.dynamics import Dynamics
from crane.dynamics.constant_derivatives import UNIT_OF_ZERO_PARAMETER, ConstantDerivatives
from crane.machine import Machine
from crane.simulation.integration.machine_formulas import reference_samples

FRAME_SIZE = 6  # numbers of a frame


class SimulationConstants(NamedTuple):
    """What a simulation depends on.

    Attributes:
        geometry: Where joints and loops are, see `crane.closure.kinematics_formulas.TreeGeometry`.
        dynamics_constants: Masses and force laws, see
            `crane.dynamics.dynamics_formulas.dynamics_constants`, without what joints do whose
            friction sticks.
        settings: Of the controller; a circuit's are among them.
        frames: Per frame that is observed, where it is on its body (3,) and its x axis (3,).
        references: (N, c) of the controller at N instants.
        initial_state: (m,) the minimal state at first.
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
        """(self - other) / over."""
        return SimulationConstants(
            *((one - two) / interval for one, two in zip(self, other, strict=True))
        )


def simulation_constants_of(
    dynamics: Dynamics,
    control: TracedController,
    initial: tuple[Array, Array],
    frames: Sequence[str],
    times: Array,
    variant: Machine | None = None,
) -> SimulationConstants:
    """The numbers of a simulation.

    Args:
        dynamics: Of the machine.
        control: Its controller.
        initial: q_A and v_A at first.
        frames: Links that are observed.
        times: (N,) [s].
        variant: A machine of the same structure whose numbers are asked for, if not the machine's
            own, with the controller on it.
    """
    machine = dynamics.machine if variant is None else variant
    constants = dynamics.constants_of(machine)
    geometry, dynamics_constants = np.split(
        constants, [len(dynamics.machine.closure.compiled_closure.geometry.constants)]
    )
    # what residuals are measured by is no part of the motion
    geometry[-1] = dynamics.machine.closure.compiled_closure.geometry.constants[-1]
    q = machine.closure.solve(initial[0], initial_guess=machine.home)
    controller_state = np.zeros(0)
    if hasattr(control, "start_closed"):
        # nothing is worth compiling for one posture
        controller_state = control.start_closed(Dynamics(machine, backend="pinocchio"), q)
    if isinstance(control, ValveDrive):
        controller_state = controller_state[: control.circuit.stiff_state_count]
    # of a variant that a circuit grips elsewhere there are more numbers
    dynamics_constants[np.flatnonzero(np.isnan(dynamics.constant_pattern))] = 0.0
    frame_constants = [np.zeros(0)]
    body_rotations = tree_geometry(machine.closure.equations).body_rotations
    for link in frames:
        frame = machine.model.frames[machine.frame(link)]
        rotation = body_rotations[machine.coordinates.body_of_joint[int(frame.parentJoint)]].T
        frame_constants += [
            rotation @ frame.placement.translation,
            rotation @ frame.placement.rotation[:, 0],
        ]
    return SimulationConstants(
        geometry,
        dynamics_constants,
        np.asarray(control.settings, dtype=np.float64),
        np.concatenate(frame_constants),
        reference_samples(machine, control, times),
        np.concatenate([*initial, controller_state]),
    )


START_PREFIX = "start."
_DIFFERENCE_STEP = 1e-4  # rad, machine's size, per `Closure.characteristic_time`, of starts
_CENTRAL_DIFFERENCE_WEIGHTS = (
    (1, 8.0 / 12.0),
    (-1, -8.0 / 12.0),
    (2, -1.0 / 12.0),
    (-2, 1.0 / 12.0),
)


class ParameterDirections:
    """A simulation's numbers, and their derivatives by named ones.

    Args:
        dynamics: Of the machine.
        control: Its controller.
        start: q_A and v_A at first.
        frames: Links that are observed.
    """

    def __init__(
        self,
        dynamics: Dynamics,
        control: TracedController,
        start: tuple[Array, Array],
        frames: Sequence[str],
    ):
        self._dynamics, self._control = dynamics, control
        self._initial_motion, self._frames = start, frames

    @cached_property
    def _constant_derivatives(self) -> ConstantDerivatives:
        return ConstantDerivatives(self._dynamics.machine)

    def nominal_constants(self, times: Array) -> SimulationConstants:
        """The numbers, given the times (2 N + 1,) at which references are asked [s]."""
        return self._constants_of(self._dynamics.machine, self._initial_motion, times)

    def derivatives(self, names: Sequence[str], times: Array) -> dict[str, SimulationConstants]:
        """Derivatives by some numbers; see `nominal_constants`.

        Raises:
            InputError: An unknown name, or a number that no machine can be made with beside it.
        """
        return dict(self._iterate_derivatives(names, times, skip_invalid=False))

    def all_derivatives(self, times: Array) -> dict[str, SimulationConstants]:
        """Derivatives by all numbers of the machine that change something and can be varied."""
        every = self._iterate_derivatives(
            self._constant_derivatives.parameter_names, times, skip_invalid=True
        )
        return {name: found for name, found in every if any(part.any() for part in found)}

    def _iterate_derivatives(
        self, names: Sequence[str], times: Array, skip_invalid: bool
    ) -> Iterator[tuple[str, SimulationConstants]]:
        base = self.nominal_constants(times)
        ends = np.cumsum([part.size for part in base])[:-1]

        def flat(machine: Machine) -> Array:
            return np.concatenate(
                [x.ravel() for x in self._constants_of(machine, self._initial_motion, times)]
            )

        nominal = None
        for name in names:
            if name.startswith(START_PREFIX):
                yield name, self._start_derivative(name, times)
                continue
            nominal = (
                self._constant_derivatives.nominal_constants(flat) if nominal is None else nominal
            )
            try:
                derivative = self._constant_derivatives.derivative(name, flat, nominal)
            except InputError:
                if not skip_invalid:
                    raise
                continue
            parts = zip(np.split(derivative, ends), base, strict=True)
            found = SimulationConstants(*(part.reshape(like.shape) for part, like in parts))
            if not found.references.any():  # which are long
                found = SimulationConstants(*map(np.copy, found))._replace(
                    references=np.broadcast_to(0.0, found.references.shape)
                )
            yield name, found

    def parameter_value(self, name: str) -> float:
        """A number, or a coordinate or velocity at the start."""
        if name.startswith(START_PREFIX):
            part, i = _parse_start_name(name, self._dynamics.machine)
            return float(self._initial_motion[part][i])
        return self._constant_derivatives.parameter_value(name)

    def typical_change(self, name: str) -> float:
        """By how much a number changes that changes much."""
        value = self.parameter_value(name)
        return (
            abs(value) if value and not name.startswith(START_PREFIX) else UNIT_OF_ZERO_PARAMETER
        )

    def _constants_of(
        self, machine: Machine, start: tuple[Array, Array], times: Array
    ) -> SimulationConstants:
        """The numbers of a machine like this one, from a start."""
        control = self._control
        machine_controller = (
            control.for_machine(machine) if isinstance(control, ValveDrive) else control
        )
        return simulation_constants_of(
            self._dynamics, machine_controller, start, self._frames, times, machine
        )

    def _start_derivative(self, name: str, times: Array) -> SimulationConstants:
        """How the numbers change with a coordinate or velocity at the start."""
        machine = self._dynamics.machine
        part, i = _parse_start_name(name, machine)
        closure = machine.closure
        difference_step = (
            _DIFFERENCE_STEP
            * closure.units[closure.active][i]
            / (closure.characteristic_time if part else 1.0)
        )
        start = np.zeros(0)
        for side, weight in _CENTRAL_DIFFERENCE_WEIGHTS:
            moved = self._initial_motion[0].copy(), self._initial_motion[1].copy()
            moved[part][i] += side * difference_step
            more = (
                weight / difference_step * self._constants_of(machine, moved, times).initial_state
            )
            start = start + more if start.size else more
        base = self.nominal_constants(times)  # nothing else of it depends on where a motion starts
        return SimulationConstants(*(np.broadcast_to(0.0, x.shape) for x in base))._replace(
            initial_state=start
        )


def _parse_start_name(name: str, machine: Machine) -> tuple[int, int]:
    """Which part of the start a name is of, and which joint.

    Raises:
        InputError: It is of none.
    """
    joint = name.removeprefix(START_PREFIX)
    part = int(joint.endswith(VELOCITY_SUFFIX) and joint not in machine.active)
    joint = joint.removesuffix(VELOCITY_SUFFIX) if part else joint
    if joint not in machine.active:
        raise InputError(
            f"'{name}' is no start of an active joint, {suggest_names(machine.active, joint)}"
        )
    return part, machine.active.index(joint)
