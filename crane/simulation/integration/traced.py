"""A machine and its controller as formulas of the state."""

from collections.abc import Callable, Hashable, Sequence

import numpy as np

from crane.closure import rotations
from crane.closure.compiled import FastClosure
from crane.closure.traced import Constants
from crane.codegen import Expression, Layout, Number, Parts, Program, Tape
from crane.common.errors import InputError
from crane.control import At, TracedController, ValveDrive
from crane.dynamics import Dynamics
from crane.dynamics.traced import Sweep


def columns_of(control: TracedController) -> int:
    """Length of a row of references."""
    return control.references(np.zeros(1)).shape[1]


def machine_at(
    dynamics: Dynamics, tape: Tape, layout: Layout, state: int
) -> tuple[Sweep, list[Number], Parts]:
    """The dynamics, q_A and the parts of the state at the posture in an argument.

    Geometry and numbers of the machine are the arguments 0 and 1.
    """
    closure = dynamics.machine.closure
    q, posture, loops = closure.fast.trace(tape, 0, state)
    parts = layout.view(tape.loads(state, 0, layout.size))
    constants = Constants(tape, 1, dynamics.numbers)
    sweep = Sweep(
        posture, loops, constants, q, parts.v_a, dynamics.carriers, dynamics.plan, dynamics.spans
    )
    return sweep, [q[i] for i in closure.active], parts


def wrapped(dynamics: Dynamics, state: Sequence[Number]) -> list[Number]:
    """A state, q first, with rotation vectors of at most pi."""
    out = list(state)
    for column in dynamics.machine.coordinates.floating:
        out[column + 3 : column + 6] = rotations.wrapped(out[column + 3 : column + 6])
    return out


def form_of(control: TracedController, columns: int, n: int, states: int, fold: bool) -> Hashable:
    """All that a controller's formulas are, so that equal ones share their machine code.

    They are traced by themselves, for rows of so many references, n active joints and so many
    states, what the machine makes of accelerations left open. With `fold`, zeros and ones of the
    settings become part of them.

    Raises:
        InputError: There are too few or too many of them.
    """
    tape = Tape()
    asked: list[Number] = []

    def inverse(a_a: Sequence[Number], friction: bool) -> list[Number]:
        answer = tape.loads(5, len(asked), n)
        asked.extend([*a_a, float(friction)])
        return answer

    q_a, v_a, own = tape.loads(0, 0, n), tape.loads(1, 0, n), tape.loads(2, 0, states)
    settings, reference = settings_of(control, tape, 3, fold), tape.loads(4, 0, columns)
    at = At(q_a, v_a, own, settings, reference, inverse)
    tau, rates = control.trace(at)
    if (len(tau), len(rates)) != (n, states):
        raise InputError(
            f"the law of {type(control).__name__} gives {len(tau)} forces and {len(rates)} rates, "
            f"give {n} and {states}: one per active joint, one per state"
        )
    seen = control.look(at) if isinstance(control, ValveDrive) else []
    outputs = [
        [x.index if isinstance(x, Expression) else float(x) for x in part]
        for part in (tau, rates, seen, asked)
    ]
    # as text, in which the constant 2.0 and operation number 2 differ
    return repr((columns, len(control.settings), tape.operations, outputs))


def program_of(
    control: TracedController, fast: FastClosure, key: tuple, build: Callable[[Program], None]
) -> Program:
    """Machine code of a machine and its controller.

    Found by what it depends on only where the package wrote the controller: what a user's class
    does with a machine may depend on more than its formulas tell.

    Args:
        control: The controller.
        fast: Of the machine.
        key: What the code depends on, `form_of` among it.
        build: Adds formulas and routines.

    Raises:
        TooLongError: It would take too long to compile.
    """
    parts = [control, control.command] if isinstance(control, ValveDrive) else [control]
    if all(type(part).__module__.startswith("crane.") for part in parts):
        return fast.kept(key, build)
    return Program.kept(None, build)


def settings_of(control: TracedController, tape: Tape, array: int, fold: bool) -> list[Number]:
    """The controller's settings, read from an argument."""
    size = len(control.settings)
    if fold:
        return Constants(tape, array, control.settings).vector(0, size)
    return tape.loads(array, 0, size)
