"""Set-up of a simulation: controller, number of steps, initial state."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import InputError
from crane.common.samples import Array, as_number, as_sample
from crane.control.control_law import (
    ControlLaw,
    Controller,
    FunctionController,
    ZeroForce,
    controller_reference,
)
from crane.control.force_inputs import ForceInputs
from crane.control.valve_commands import SampledCommand, ValveCommand, ValveSignals
from crane.control.valve_drive import ValveDrive
from crane.machine.machine import Machine
from crane.motion.limit_violations import limit_violation_message, passive_limit_violation_message

_MAX_STEPS, _MAX_DURATION = 4_000_000, 1e6  # steps of one recording, and its duration [s]

Force = Callable[[float, Array, Array], Array]
"""(t, q_a, v_a) -> tau_a."""


def resolve_controller(
    controller: Controller | ValveCommand | Force | None, machine: Machine
) -> Controller:
    """The controller of a machine, from the argument `controller` of `simulate`.

    Raises:
        InputError: The controller or the machine has a wrong type.
    """
    if not isinstance(machine, Machine):
        raise InputError(f"{machine!r} is not a machine, load it with crane.load")
    if isinstance(controller, ControlLaw):
        return controller
    if controller is None:
        if machine.hydraulics is not None:
            neutral = ValveSignals(machine, [0.0], {})
            neutral.title = "neutral valves"
            return ValveDrive(machine, neutral)
        return ZeroForce(machine)
    if isinstance(controller, SampledCommand) and machine.hydraulics is None:
        return ForceInputs(machine, controller)
    if isinstance(controller, ValveCommand):
        return ValveDrive(machine, controller)
    if hasattr(controller, "start"):
        return controller  # type: ignore[return-value]
    if not callable(controller) or isinstance(controller, type):
        raise InputError(
            f"the controller is a {type(controller).__name__}, give a function (t, q_a, v_a) -> "
            "tau_a or a controller object"
        )
    return FunctionController(controller, machine)


def machine_under_control(machine: Machine, control: Controller) -> Machine:
    """The machine with loads that follow the clock of the controller.

    Without a simulated circuit, the friction of seals and brakes is removed.

    Raises:
        InputError: A load depends on phases, and the controller has none.
    """
    machine = machine.with_phase_function(
        control.command.clock if isinstance(control, ValveDrive) else None
    )
    hydraulics = machine.hydraulics
    if (
        hydraulics is None
        or not hydraulics.circuit_friction_joints
        or isinstance(control, ValveDrive)
    ):
        return machine
    without_friction = {
        joint: replace(cylinder, seal_friction=0.0, brake=0.0)
        for joint, cylinder in hydraulics.cylinders.items()
    }
    return machine.replace(hydraulics=replace(hydraulics, cylinders=without_friction))


def count_steps(control: Controller, duration: float | None, step: float) -> int:
    """Number of steps of a run.

    Args:
        control: The controller; its reference or levers give the default duration.
        duration: Duration [s]. That of levers is rounded up to a whole step.
        step: Step size [s].

    Raises:
        InputError: There is no duration, there are too many steps, or no whole number of them.
    """
    levers = False
    if duration is None:
        duration_source = getattr(control, "reference", None)
        if (
            duration_source is None
            and isinstance(control, ValveDrive)
            and control.command.duration
        ):
            duration_source, levers = control.command, True
        if duration_source is None:
            raise InputError("no duration and no reference to take it from, give a duration")
        duration = duration_source.duration
    duration = as_number(duration, "the duration", "s", greater_than=0)
    step = as_number(step, "the step", "s", greater_than=0)
    if duration > min(_MAX_DURATION, _MAX_STEPS * step):
        raise InputError(
            f"{duration:g} s are {duration / step:.3g} steps of {step:g} s, at most {_MAX_STEPS} "
            f"and {_MAX_DURATION:g} s: simulate less, or go on from the last sample of a first "
            "part"
        )
    steps = int(np.ceil(duration / step - 1e-9)) if levers else round(duration / step)
    if steps < 1 or not levers and abs(steps * step - duration) > 1e-9 * duration:
        raise InputError(
            f"the duration {duration:g} s is no whole number of steps of {step:g} s, change one"
        )
    return steps


def reference_limits_text(machine: Machine, control: Controller, end_time: float) -> str:
    """Warning about a reference outside of the limits before a time [s]; empty if inside."""
    reference = controller_reference(control, machine)
    if reference is None:
        return ""
    return limit_violation_message(
        machine, reference, end_time
    ) or passive_limit_violation_message(machine, reference, end_time)


def initial_motion(
    machine: Machine,
    initial: ArrayLike | tuple[ArrayLike, ArrayLike] | None,
    control: Controller | None = None,
) -> tuple[Array, Array]:
    """Initial active coordinates and velocities (n,), see `simulate`."""
    size, rest = len(machine.active), np.zeros(len(machine.active))
    if initial is None:
        reference = None if control is None else controller_reference(control, machine)
        if isinstance(control, ValveDrive) and control.command.initial_coordinates is not None:
            return np.array(control.command.initial_coordinates), rest
        if reference is not None:
            return machine.check_limits(
                reference.position(0.0), "the start of the reference"
            ), rest
        return np.array(machine.home[machine.closure.active]), rest
    if isinstance(initial, tuple) and len(initial) == 2 and np.ndim(initial[0]) == 1:
        q_a = machine.check_limits(initial[0], "initial q_a")
        v_a = as_sample(initial[1], size, "initial v_a", machine.active)
    else:
        q_a, v_a = machine.check_limits(initial, "initial"), rest  # type: ignore[arg-type]
    if q_a.ndim != 1:
        raise InputError(
            f"initial is a stack, give one sample ({size},) or a pair as a tuple (q_a, v_a)"
        )
    return q_a, v_a
