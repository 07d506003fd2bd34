"""A machine and its controller as formulas of the state."""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from crane.closure import rotations
from crane.closure.compiled import FastClosure
from crane.closure.traced import Constants
from crane.codegen import Expression, Layout, Number, Parts, Program, Tape, Value
from crane.codegen.derivative import derivatives
from crane.codegen.representation import Array as Place
from crane.codegen.representation import Routine
from crane.codegen.scalar import add, dot, subtract
from crane.common.errors import InputError
from crane.common.samples import Array
from crane.control import At, TracedController, ValveDrive
from crane.dynamics import external
from crane.dynamics.traced import Moved, Sweep
from crane.machine import Machine
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.state import seen_layout, state_layout

HELD = 5  # of `Stepper.bounds`, whether joints are at rest
_REST = "_rest"


def beyond(r: Routine, result: Place) -> Value:
    """Whether a closed posture is beyond a chart's limits, see `Stepper.bounds`."""
    return (result["steepest"] > r.bounds[3]) | (result["edge"] < r.bounds[4])


def references_of(machine: Machine, control: TracedController, times: Array) -> Array:
    """All that depends on time alone (N, c): the controller's, then those of `external`."""
    outside = external.references_of(machine.external, times)
    return np.ascontiguousarray(np.hstack([control.references(times), outside]))


def columns_of(control: TracedController) -> int:
    """Length of a controller's row of references."""
    return control.references(np.zeros(1)).shape[1]


@dataclass(frozen=True)
class Traced:
    """A machine at a state.

    Attributes:
        chart: What the state is in.
        sweep: Its dynamics.
        parts: Of the state.
        q_a: (n,) coordinates that the controller sees.
        v_a: (n,) their velocities.
        outside: What forces from outside do.
    """

    chart: Chart
    sweep: Sweep
    parts: Parts
    q_a: list[Number]
    v_a: list[Number]
    outside: external.Applied

    def seen(self, settings: list[Number], reference: list[Number]) -> At:
        """What a controller sees."""
        inverse = self.sweep.inverse if self.chart.own else _undetermined
        gravity = (lambda: list(self.sweep.weight)) if self.chart.own else _undetermined
        return At(self.q_a, self.v_a, self.parts.own, settings, reference, inverse, gravity)

    def gripped(self, control: TracedController, at: At) -> "Traced":
        """The machine with the Coulomb friction that seals and brakes of a circuit add."""
        if not self.sweep.form.gripped or not isinstance(control, ValveDrive):
            return self
        return replace(self, sweep=self.sweep.gripped(control.grip(at)))

    def moved(self, tau: Sequence[Number], rest: bool) -> Moved:
        """What it does under a controller's forces, with joints at rest or without."""
        return self.sweep.moved(self._pushed(tau), rest)

    def _pushed(self, tau: Sequence[Number]) -> list[Number]:
        """Forces along the chart's coordinates, a controller's and those from outside."""
        return add(self.chart.traced_forces(self.sweep.gamma, tau), self.outside.forces)

    def observed(self, tau: Sequence[Number], rest: bool) -> list[Number]:
        """What is seen, but for a circuit's channels; see `seen_layout`."""
        moved, sweep = self.moved(tau, rest), self.sweep
        own = [*tau, *moved.friction, sweep.kinetic, sweep.potential, *moved.rest]
        a: list[Number] = []
        if self.chart.machine.supports:
            rows = sorted(sweep.gamma.items())
            a = [dot(row, moved.a_a) + sweep.drift[i] for i, row in rows]
        return [*own, *self.outside.seen, *a]

    def forces(self, tau: Sequence[Number]) -> list[Number]:
        """What acts along the chart's coordinates, inertia and weight apart."""
        return subtract(add(self._pushed(tau), self.sweep.passive), self.sweep.friction)

    def stiffness(self, own_rate: Sequence[Number], tau: Sequence[Number]) -> list[list[Number]]:
        """What rates of a controller's states and forces along the chart change with q_B.

        At frozen gamma, without weight and what moves.

        Args:
            own_rate: (k,) of the controller.
            tau: (n,) of the controller.

        Returns:
            (k + n, n).
        """
        gamma, seen = self.sweep.gamma, [x for x in self.q_a if isinstance(x, Expression)]
        outputs = [*own_rate, *self.chart.traced_forces(gamma, tau)]
        rows = derivatives(outputs, seen)
        if not self.chart.own:
            columns = list(zip(*(gamma[i + 1] for i in self.chart.seen.tolist()), strict=True))
            rows = [[dot(row, column) for column in columns] for row in rows]
        passive = zip(rows[len(own_rate) :], self.sweep.stiffness, strict=True)
        return [*rows[: len(own_rate)], *(add(one, other) for one, other in passive)]

    def powers(self, tau: Sequence[Number]) -> list[Number]:
        """What forces put in, a controller's and each from outside, and what is taken out [W]."""
        return [dot(tau, self.v_a), *self.outside.powers, self.sweep.dissipation]


def _undetermined(a_a: Sequence[Number] = (), friction: bool = False) -> list[Number]:
    raise InputError("inverse dynamics of coordinates that do not determine the motion")


def machine_at(
    chart: Chart,
    tape: Tape,
    layout: Layout,
    state: int,
    outside: Sequence[Number],
    folds: tuple[Array, Array] | None = None,
) -> Traced:
    """The machine at the state in an argument.

    Geometry and numbers of the machine are the arguments 0 and 1; `outside` are references of
    forces from there; `folds` has geometry and numbers with NaN where none may become part of the
    formulas, the machine's own if not given.
    """
    dynamics, closure = chart.dynamics, chart.machine.closure
    geometry, pattern = folds or (None, dynamics.pattern)
    q, posture, loops = closure.fast.trace(tape, 0, state, geometry)
    parts = layout.view(tape.loads(state, 0, layout.size))
    constants = Constants(tape, 1, pattern)
    sweep = Sweep(posture, loops, constants, q, parts.v_a, dynamics.form, modes=True)
    v_a = parts.v_a if chart.own else [sweep.rates[i + 1] for i in chart.seen]
    applied = external.traced(chart.machine, sweep, outside, parts.shear)
    return Traced(chart, sweep, parts, [q[i] for i in chart.seen], v_a, applied)


class Stepper:
    """A machine and its controller in machine code: what all methods have in common.

    A method writes `_build`, which adds formulas `observe` with the parts `seen` and `margin`,
    and `observe_rest` where joints can stick.

    Args:
        chart: The machine.
        control: Its controller.
        states: Number of the controller's states.
        method: What the method's code depends on besides them.
        fold: Whether zeros and ones among the controller's settings become part of the code.

    Attributes:
        bounds: See `FastClosure`; where other coordinates are better, see `Chart.limits`; whether
            joints are at rest.
        asks: What calls those external forces that are functions in Python, if there are some.
        state_layout: Parts of the state.
        output_layout: Parts of what a row has besides.
        reference_columns: Length of a row of references.
        controller_columns: Of these, the first ones that are the controller's.
        sticks: Whether joints have friction that sticks.
        closure_code: The loops in machine code.

    Raises:
        TooLongError: It would take too long to compile.
    """

    def __init__(
        self, chart: Chart, control: TracedController, states: int, method: tuple, fold: bool
    ):
        machine = chart.machine
        self.closure_code, self._numbers = machine.closure.fast, chart.dynamics.numbers
        self._chart, self._control = chart, control
        self.bounds = np.concatenate([self.closure_code.bounds, chart.limits, [0.0]])
        own = self.controller_columns = columns_of(control)
        self.reference_columns, self._fold = own + sum(external.columns_of(machine.external)), fold
        self.asks = None if machine.traced else external.Asked(machine.external)
        self.sticks = bool(chart.sticking.columns)
        self.state_layout, self.output_layout = (
            state_layout(machine, states),
            seen_layout(machine, control),
        )
        form = form_of(control, own, chart, states, fold)
        key = (*method, form, states, bool(machine.supports), *chart.formulas)
        if key not in self.closure_code.programs:
            self.closure_code.programs[key] = program_of(
                machine, control, self.closure_code, key, self._build
            )
        self._program = self.closure_code.programs[key]

    def _build(self, program: Program) -> None:
        """Add formulas and routines."""
        raise NotImplementedError

    def _driven(self, tape: Tape) -> tuple[Traced, At, Sequence[Number], Sequence[Number]]:
        """Machine, what the controller sees, its forces and rates.

        References and state are the arguments 3 and 4.
        """
        references, own = tape.loads(3, 0, self.reference_columns), columns_of(self._control)
        machine = machine_at(self._chart, tape, self.state_layout, 4, references[own:])
        settings = settings_of(self._control, tape, 2, self._fold)
        at = machine.seen(settings, references[:own])
        tau, rates = self._control.trace(at)
        return machine.gripped(self._control, at), at, tau, rates

    @property
    def floats(self) -> bool:
        """Whether a body floats."""
        return bool(self._chart.machine.coordinates.floating)

    @property
    def width(self) -> int:
        """Length of a row."""
        return self.state_layout.size + self.output_layout.size

    def adopt(self) -> None:
        """Take over what the joints do whose friction sticks."""
        if self.sticks:
            self._chart.sticking.tell(self._chart.dynamics)
            self.bounds[HELD] = self._chart.sticking.held.any()

    @property
    def _rests(self) -> tuple[tuple[str, bool], ...]:
        """What to add to a formula's name without joints at rest, and with some."""
        return (("", False), (_REST, True)) if self.sticks else (("", False),)

    def call_formula(self, r: Routine, formula: str, *arguments: Place) -> None:
        """Call a formula for what the joints do that stick."""
        if not self.sticks:
            r.call(formula, *arguments)
            return
        with r.when(r.bounds[HELD] > 0.5):
            r.call(formula + _REST, *arguments)
        with r.otherwise():
            r.call(formula, *arguments)

    @property
    def _arguments(self) -> tuple[Array, Array, Array]:
        """What all formulas begin with: geometry, numbers of the machine, settings."""
        settings = np.ascontiguousarray(self._control.settings)
        return self.closure_code.geometry.numbers, self._numbers, settings

    def observe(self, time: float, state: Array) -> tuple[Array, float]:
        """What is seen (.,) at a time [s] and a state, and its margin (`Moved.margin`)."""
        reference = references_of(self._chart.machine, self._control, np.array([time]))
        if self.asks is not None:
            asked = np.empty(self._program.outputs("asked").size)
            self._program.call("asked", *self._arguments, reference, state, asked)
            outside = columns_of(self._control)
            self._program.call("ask", self.asks.address, asked, reference[0, outside:])
            self.asks.check()
        layout = self._program.outputs("observe")
        out = np.empty(layout.size)
        name = "observe" + _REST if self.bounds[HELD] else "observe"
        self._program.call(name, *self._arguments, reference, state, out)
        return out[layout["seen"]], float(out[layout.start("margin")])


def wrapped(chart: Chart, state: Sequence[Number]) -> list[Number]:
    """A state, q first, with rotation vectors of at most pi."""
    out = list(state)
    for column in chart.machine.coordinates.floating:
        out[column + 3 : column + 6] = rotations.wrapped(out[column + 3 : column + 6])
    return out


def form_of(
    control: TracedController, columns: int, chart: Chart, states: int, fold: bool
) -> Hashable:
    """All that a controller's formulas are, so that equal ones share their machine code.

    They are traced by themselves, for rows of so many references, the active joints of a chart's
    user and so many states, what the machine makes of accelerations left open. With `fold`, zeros
    and ones of the settings become part of them.

    Raises:
        InputError: There are too few or too many of them, or a free joint gets a force.
    """
    tape, n = Tape(), len(chart.seen)
    asked: list[Number] = []

    def inverse(a_a: Sequence[Number], friction: bool) -> list[Number]:
        answer = tape.loads(5, len(asked), n)
        asked.extend([*a_a, float(friction)])
        return answer

    q_a, v_a, own = tape.loads(0, 0, n), tape.loads(1, 0, n), tape.loads(2, 0, states)
    settings, reference = settings_of(control, tape, 3, fold), tape.loads(4, 0, columns)
    at = At(q_a, v_a, own, settings, reference, inverse, lambda: tape.loads(6, 0, n))
    tau, rates = control.trace(at)
    if (len(tau), len(rates)) != (n, states):
        raise InputError(
            f"the law of {type(control).__name__} gives {len(tau)} forces and {len(rates)} rates, "
            f"give {n} and {states}: one per active joint, one per state"
        )
    chart.check_free(tau)
    seen: list[Number] = []
    if isinstance(control, ValveDrive):
        seen = [*control.look(at), *control.grip(at)]
    outputs = [
        [x.index if isinstance(x, Expression) else float(x) for x in part]
        for part in (tau, rates, seen, asked)
    ]
    # as text, in which the constant 2.0 and operation number 2 differ
    return repr((columns, len(control.settings), tape.operations, outputs))


def program_of(
    machine: Machine,
    control: TracedController,
    fast: FastClosure,
    key: tuple,
    build: Callable[[Program], None],
) -> Program:
    """Machine code of a machine and its controller.

    Found by what it depends on only where the package wrote the controller and the forces from
    outside: what a user's class does with a machine may depend on more than its formulas tell.

    Args:
        machine: The machine.
        control: The controller.
        fast: Of the machine.
        key: What the code depends on, `form_of` among it.
        build: Adds formulas and routines.

    Raises:
        TooLongError: It would take too long to compile.
    """
    parts: list[object] = [control, *machine.external]
    if isinstance(control, ValveDrive):
        parts.append(control.command)
    if all(type(part).__module__.startswith("crane.") for part in parts):
        return fast.kept(key, build)
    return Program.kept(None, build)


def settings_of(control: TracedController, tape: Tape, array: int, fold: bool) -> list[Number]:
    """The controller's settings, read from an argument."""
    size = len(control.settings)
    if fold:
        return Constants(tape, array, control.settings).vector(0, size)
    return tape.loads(array, 0, size)
