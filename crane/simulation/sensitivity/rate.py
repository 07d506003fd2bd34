"""The rate of a simulated machine as formulas of its state and of all its numbers."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from crane.closure.screws import Vector
from crane.closure.traced import Constants, folded
from crane.codegen import Expression, Number, Program, Tape, TooLongError
from crane.codegen.derivative import along
from crane.codegen.scalar import add, apply, dot, subtract, times, transposed
from crane.common.errors import InputError
from crane.common.samples import Array
from crane.control import TracedController, ValveDrive
from crane.description.sensors import FORCE, INCLINATION, VELOCITY
from crane.dynamics.external import columns_of as counts_of
from crane.machine import Machine
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.state import state_layout
from crane.simulation.integration.traced import (
    Traced,
    columns_of,
    form_of,
    machine_at,
    program_of,
)  # fmt: skip
from crane.simulation.sensitivity.setup import FRAME, Setup

_REST = "_rest"


@dataclass(frozen=True)
class Rated:
    """What is differentiated, on one tape.

    Attributes:
        tape: The tape; its arguments are geometry, numbers, settings, frames, references, state.
        machine: The machine at the state.
        rate: (m,) of the minimal state.
        seen: What is observed, with a factor of its derivative each.
        margin: See `Moved.margin`.
    """

    tape: Tape
    machine: Traced
    rate: list[Number]
    seen: list[tuple[Number, Number]]
    margin: Number

    @property
    def values(self) -> list[Number]:
        """Rate, outputs, margin, that derivatives are taken of."""
        return [*self.rate, *(value for value, _ in self.seen), self.margin]


class Rate:
    """A machine's rate in machine code, and derivatives that a kind of it adds.

    A kind writes `_add`, which adds its formulas and routines to what is at rest or not.

    Args:
        chart: The machine, in its own coordinates.
        control: Its controller.
        states: Number of all the controller's states.
        stiff: Number of those that act back, the first.
        outputs: What is observed: names, see `sensitivities`.
        moved: Which numbers change in some direction.

    Attributes:
        size: Length of the minimal state.
        outputs: What is observed.

    Raises:
        TooLongError: It would take too long to compile.
        InputError: An output that is not there.
    """

    def __init__(
        self,
        chart: Chart,
        control: TracedController,
        states: int,
        stiff: int,
        outputs: Sequence[str],
        moved: Setup,
    ):
        self._chart, self._control, self.outputs = chart, control, tuple(outputs)
        self._stiff, self._moved = stiff, moved
        machine = chart.machine
        self._fast, self._n = machine.closure.fast, len(machine.active)
        self._state, self.size = state_layout(machine, states), 2 * self._n + stiff
        self._own = columns_of(control)
        self._columns = self._own + sum(counts_of(machine.external))
        self._frames = frames_of(machine, outputs)
        self._folds = (
            np.where(moved.geometry != 0, np.nan, self._fast.geometry.numbers),
            np.where(moved.numbers != 0, np.nan, chart.dynamics.pattern),
        )
        # what a circuit has not is 0 among its settings, and no part of the formulas
        self._settings = np.where(moved.settings != 0, np.nan, control.settings)
        form = form_of(control, self._own, chart, states, True)
        key = (
            type(self).__name__, form, states, stiff, *chart.formulas, self.outputs,
            *self._frames, *map(folded, (*self._folds, self._settings)),
            *(np.asarray(part != 0).tobytes() for part in (
                moved.geometry, moved.numbers, moved.settings, moved.references, moved.frames)),
        )  # fmt: skip
        if key not in self._fast.programs:
            self._fast.programs[key] = program_of(machine, control, self._fast, key, self._build)
        self._program = self._fast.programs[key]

    def rate(self, base: Setup, state: Array, rest: bool) -> Array:
        """The rate (m,) of the minimal state.

        Args:
            base: The simulation's numbers, with what sticks (see `Dynamics.set_modes`) and one row
                of references.
            state: As it is integrated.
            rest: Whether some joint is at rest.
        """
        out = np.empty(self.size)
        self._program.call(
            "rate" + _REST * rest, base.geometry, base.numbers, base.settings, base.frames,
            base.references, state, out,
        )  # fmt: skip
        return out

    def _call(self, routine: str, rest: bool, *arguments: "int | Array") -> None:
        self._program.call(routine + _REST * rest, *arguments)

    def _add(self, program: Program, added: str, rated: Rated) -> None:
        raise NotImplementedError

    def _build(self, program: Program) -> None:
        for added, rest in (("", False), (_REST, True)):
            if rest and not self._chart.sticking.columns:
                continue
            rated = self._traced(rest)
            self._add(program, added, rated)
            program.add("rate" + added, 6, rated.rate)

    def _traced(self, rest: bool) -> Rated:
        tape = Tape()
        references = tape.loads(4, 0, self._columns)
        outside = references[self._own :]
        machine = machine_at(self._chart, tape, self._state, 5, outside, self._folds)
        settings = Constants(tape, 2, self._settings).vector(0, len(self._settings))
        at = machine.seen(settings, references[: self._own])
        tau, own_rate = self._control.trace(at)
        look = self._control.look(at) if isinstance(self._control, ValveDrive) else []
        machine = machine.gripped(self._control, at)
        found, sweep = machine.moved(tau, rest), machine.sweep
        active = self._chart.machine.closure.active
        rate = [*(sweep.slopes[i] for i in active), *found.a_a, *own_rate[: self._stiff]]
        seen = [self._observable(name, machine, tape, tau, look) for name in self.outputs]
        return Rated(tape, machine, rate, seen, found.margin)

    def _observable(
        self, name: str, machine: Traced, tape: Tape, tau: Sequence[Number], look: Sequence[Number]
    ) -> tuple[Number, Number]:
        """What is observed and a factor of its derivative; names as in `sensitivities`."""
        of, control, sweep = self._chart.machine, self._control, machine.sweep
        columns = {joint: i for i, joint in enumerate(of.joints)}
        if name in columns:
            return sweep.q[columns[name]], 1.0
        joint = name.removesuffix(VELOCITY)
        if joint in columns:
            return sweep.rates[columns[joint] + 1], 1.0
        joint = name.removesuffix(FORCE)
        if joint in of.active:
            return tau[of.active.index(joint)], 1.0
        if isinstance(control, ValveDrive):
            channels = [channel for channel, _ in control.channels]
            if name in channels:
                return look[channels.index(name)], 1.0
        if name in ("kinetic", "potential"):
            return getattr(sweep, name), 1.0
        links = [link for link, _ in self._frames]
        if not name.startswith((INCLINATION, "tip_")) or frame_of(of, name) not in links:
            raise InputError(
                f"'{name}' is no output of '{of.name}': take joints, forces, channels"
            )
        place = links.index(frame_of(of, name))
        body = self._frames[place][1]
        numbers = tape.loads(3, FRAME * place, FRAME)
        return _at_frame(name, machine, body, numbers)


@contextmanager
def traceable(machine: Machine) -> Iterator[None]:
    """Say in one line that formulas are too long.

    Raises:
        InputError: They are.
    """
    try:
        yield
    except TooLongError:
        raise InputError(
            f"the formulas of '{machine.name}' are too long to differentiate: lock joints"
        ) from None


def _at_frame(name: str, machine: Traced, body: int, numbers: Vector) -> tuple[Number, Number]:
    """Position of the tip, or inclination of a link's x axis and its rate."""
    sweep = machine.sweep
    posture = sweep.posture
    if not name.startswith(INCLINATION):
        place = add(posture.origin[body], times(posture.rotation[body], numbers[:3]))
        back = transposed(posture.rotation[0])
        return times(back, subtract(place, posture.origin[0]))["xyz".index(name[-1])], 1.0
    axis = times(posture.rotation[body], numbers[3:])
    height = dot(axis, [row[2] for row in posture.rotation[0]])
    flat = apply("sqrt", 1.0 - height * height)
    if not name.endswith(VELOCITY):
        return height, 1.0 / flat
    ways = dict(zip(map(index_of, sweep.q), sweep.slopes, strict=True))
    return along([height], ways)[0] / flat, 1.0


def frame_of(machine: Machine, name: str) -> str:
    """The link whose place or inclination is observed."""
    inclined = name.startswith(INCLINATION)
    return name.removeprefix(INCLINATION).removesuffix(VELOCITY) if inclined else str(machine.tip)


def frames_of(machine: Machine, outputs: Sequence[str]) -> list[tuple[str, int]]:
    """Links whose place or inclination is observed, and their bodies in the geometry.

    Raises:
        InputError: An output that is not there.
    """
    found: dict[str, int] = {}
    tips = {f"tip_{axis}" for axis in "xyz"} if machine.tip is not None else set()
    for name in outputs:
        if name in tips or name.startswith(INCLINATION):
            link = frame_of(machine, name)
            frame = machine.model.frames[machine.frame(link)]
            joint = int(frame.parentJoint)
            found[link] = machine.coordinates.bodies[joint]
    return list(found.items())


def index_of(loaded: Number) -> int:
    """Of a number that was loaded."""
    assert isinstance(loaded, Expression)
    return loaded.index
