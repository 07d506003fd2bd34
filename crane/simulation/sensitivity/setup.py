"""All numbers of a simulation."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from crane.closure.traced import geometry_of
from crane.common.samples import Array
from crane.control import TracedController, ValveDrive
from crane.dynamics import Dynamics
from crane.machine import Machine
from crane.simulation.integration.traced import references_of

FRAME = 6  # numbers of a frame


class Setup(NamedTuple):
    """What a simulation depends on.

    Attributes:
        geometry: Where joints and loops are, see `crane.closure.traced.Geometry`.
        numbers: Masses and force laws, see `crane.dynamics.traced.numbers_of`, without what joints
            do whose friction sticks.
        settings: Of the controller; a circuit's are among them.
        frames: Per frame that is observed, where it is on its body (3,) and its x axis (3,).
        references: (N, c) of the controller at N instants.
        start: (m,) the minimal state at first.
    """

    geometry: Array
    numbers: Array
    settings: Array
    frames: Array
    references: Array
    start: Array

    def difference(self, other: "Setup", over: float) -> "Setup":
        """(self - other) / over."""
        return Setup(*((one - two) / over for one, two in zip(self, other, strict=True)))


def setup_of(
    dynamics: Dynamics,
    control: TracedController,
    initial: tuple[Array, Array],
    frames: Sequence[str],
    times: Array,
    variant: Machine | None = None,
) -> Setup:
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
    constants = dynamics.constants(machine)
    geometry, numbers = np.split(constants, [len(dynamics.machine.closure.fast.geometry.numbers)])
    # what residuals are measured by is no part of the motion
    geometry[-1] = dynamics.machine.closure.fast.geometry.numbers[-1]
    q = machine.closure.solve(initial[0], guess=machine.home)
    own = np.zeros(0)
    if hasattr(control, "start_at"):
        # nothing is worth compiling for one posture
        own = control.start_at(Dynamics(machine, backend="pinocchio"), q)
    if isinstance(control, ValveDrive):
        own = own[: control.circuit.stiff]
    # of a variant that a circuit grips elsewhere there are more numbers
    numbers[np.flatnonzero(np.isnan(dynamics.pattern))] = 0.0
    places = [np.zeros(0)]
    turns = geometry_of(machine.closure.equations).turns
    for link in frames:
        frame = machine.model.frames[machine.frame(link)]
        turn = turns[machine.coordinates.bodies[int(frame.parentJoint)]].T
        places += [turn @ frame.placement.translation, turn @ frame.placement.rotation[:, 0]]
    return Setup(
        geometry,
        numbers,
        np.asarray(control.settings, dtype=np.float64),
        np.concatenate(places),
        references_of(machine, control, times),
        np.concatenate([*initial, own]),
    )
