"""All numbers of a simulation."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from crane.closure.kinematics_formulas import tree_geometry
from crane.common.samples import Array
from crane.control import TracedController, ValveDrive
from crane.dynamics import Dynamics
from crane.machine import Machine
from crane.simulation.integration.machine_formulas import reference_samples

FRAME_SIZE = 6  # numbers of a frame


class SimulationConstants(NamedTuple):
    """What a simulation depends on.

    Attributes:
        geometry: Where joints and loops are, see `crane.closure.kinematics_formulas.TreeGeometry`.
        dynamics_constants: Masses and force laws, see
            `crane.dynamics.formula_structure.dynamics_constants`, without what joints do whose
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
