"""How the rate of a simulated machine changes with its state and with all its numbers.

The state of a motion is s = (q_A, v_A, o): active coordinates, their velocities, the states o of
the controller or circuit that act back; c are all numbers of the simulation, see `Setup`. The
rate r(s, c) = s' is differentiated operation by operation along a direction (ds, dc), through the
closed loops phi(q, c) = 0:

    J_P dq_P = -(J_A dq_A + dphi/dc dc).
"""

from collections.abc import Sequence

import numpy as np

from crane.closure.screws import Vector
from crane.closure.traced import Constants, folded
from crane.codegen import Expression, Number, Program, Tape
from crane.codegen.derivative import along
from crane.codegen.scalar import add, apply, dot, subtract, times, transposed
from crane.common.errors import InputError
from crane.common.samples import Array
from crane.control import TracedController, ValveDrive
from crane.description.sensors import FORCE, INCLINATION, VELOCITY
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


class Tangent:
    """Derivatives of a machine's rate in machine code.

    Args:
        chart: The machine, in its own coordinates.
        control: Its controller.
        states: Number of all the controller's states.
        stiff: Number of those that act back, the first.
        outputs: What is observed; see `observable`.
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
        self._columns = columns_of(control)
        self._frames = frames_of(machine, outputs)
        self._folds = (
            np.where(moved.geometry != 0, np.nan, self._fast.geometry.numbers),
            np.where(moved.numbers != 0, np.nan, chart.dynamics.pattern),
        )
        # what a circuit has not is 0 among its settings, and no part of the formulas
        self._settings = np.where(moved.settings != 0, np.nan, control.settings)
        form = form_of(control, self._columns, self._n, states, True)
        key = (
            "tangent", form, states, stiff, *chart.formulas, self.outputs,
            *self._frames, *map(folded, (*self._folds, self._settings)),
            *(np.asarray(part != 0).tobytes() for part in (
                moved.geometry, moved.numbers, moved.settings, moved.references, moved.frames)),
        )  # fmt: skip
        if key not in self._fast.programs:
            self._fast.programs[key] = program_of(control, self._fast, key, self._build)
        self._program = self._fast.programs[key]

    def along(self, base: Setup, states: Array, change: Setup, rest: bool) -> tuple[Array, Array]:
        """Derivatives at states of one motion.

        Args:
            base: The simulation's numbers, with what sticks (see `Dynamics.set_modes`) and
                references (N, c) of the states.
            states: (N, .) as they are integrated.
            change: p directions of the numbers, each part with a leading axis.
            rest: Whether some joint is at rest.

        Returns:
            d r/d s and d r/d c (N, m, m + p); the same of the outputs and the margin (N, k + 1,
            m + p).
        """
        m, p, count = self.size, len(change.geometry), len(states)
        inputs = np.zeros((m + p, m))
        inputs[:m] = np.eye(m)
        padded = [
            np.ascontiguousarray(np.vstack([np.zeros((m, part.shape[1])), part]))
            for part in (change.geometry, change.numbers, change.settings, change.frames)
        ]
        references = np.zeros((count, m + p, self._columns))
        references[:, m:] = np.swapaxes(change.references, 0, 1)
        width = self._program.outputs("tangent").size
        out = np.empty((count, m + p, width))
        self._program.call(
            "along" + _REST * rest, count, m + p, base.geometry, base.numbers, base.settings,
            base.frames, np.ascontiguousarray(base.references),
            np.ascontiguousarray(states), *padded, references, inputs, out,
        )  # fmt: skip
        out = np.swapaxes(out, 1, 2)
        return out[:, :m], out[:, m:]

    def rate(self, base: Setup, state: Array, rest: bool) -> Array:
        """The rate (m,) of the minimal state, with one row of references; see `along`."""
        out = np.empty(self.size)
        self._program.call(
            "rate" + _REST * rest, base.geometry, base.numbers, base.settings, base.frames,
            base.references, state, out,
        )  # fmt: skip
        return out

    def _build(self, program: Program) -> None:
        for added, rest in (("", False), (_REST, True)):
            if rest and not self._chart.sticking.columns:
                continue
            self._add(program, added, rest)

    def _add(self, program: Program, added: str, rest: bool) -> None:
        """tangent(geometry, numbers, settings, frames, references, state, their changes, ds)."""
        tape, n, moved = Tape(), self._n, self._moved
        machine = machine_at(self._chart, tape, self._state, 5, self._folds)
        settings = Constants(tape, 2, self._settings).vector(0, len(self._settings))
        at = machine.seen(settings, tape.loads(4, 0, self._columns))
        tau, own_rate = self._control.trace(at)
        look = self._control.look(at) if isinstance(self._control, ValveDrive) else []
        found, sweep = machine.moved(tau, rest), machine.sweep
        active = self._chart.machine.closure.active
        rate = [*(sweep.slopes[i] for i in active), *found.a_a, *own_rate[: self._stiff]]
        masks = moved.geometry, moved.numbers, moved.settings, moved.frames, moved.references
        seeds: dict[int, Number] = {}

        def seed(array: int, mask: Array) -> None:
            for i in np.flatnonzero(mask).tolist():
                seeds[tape.load(array, i).index] = tape.load(6 + array, i)

        seed(0, masks[0])
        changed = [tape.loads(11, part * n, n) for part in range(2)]
        opened = along([row.phi for row in sweep.loops.rows], seeds)
        joints = sweep.loops.active_joints
        held = {joint: [change] for joint, change in zip(joints, changed[0], strict=True)}
        moving, _ = sweep.loops.solve(held, [[-1.0 * x] for x in opened])
        seeds |= {_index(sweep.q[i - 1]): change for i, (change,) in moving.items()}
        seeds |= dict(zip(map(_index, sweep.v_a), changed[1], strict=True))
        own = tape.loads(11, 2 * n, self._stiff)
        seeds |= dict(zip(map(_index, machine.parts.own[: self._stiff]), own, strict=True))
        for array, mask in enumerate(masks[1:], start=1):
            seed(array, mask)
        seen = [self._observable(name, machine, tape, tau, look) for name in self.outputs]
        slopes = along([*rate, *(value for value, _ in seen), found.margin], seeds)
        size = len(rate)
        for k, (_, factor) in enumerate(seen):
            slopes[size + k] = factor * slopes[size + k]
        program.add("tangent" + added, 12, slopes)
        program.add("rate" + added, 6, rate)
        sizes = [len(mask) for mask in masks[:4]]
        width, m, columns = len(slopes), self.size, self._columns
        names = (
            "geometry", "numbers", "settings", "frames", "references", "states", "geometries",
            "numbered", "settled", "framed", "referred", "inputs", "out",
        )  # fmt: skip
        counts = ("count", "directions")
        with program.routine("along" + added, counts=counts, arrays=names) as r:
            with r.loop(r.count) as i, r.loop(r.directions) as j:
                at_both = i * r.directions + j
                r.call(
                    "tangent" + added, r.geometry, r.numbers, r.settings, r.frames,
                    r.references.row(i, columns), r.states.row(i, self._state.size),
                    r.geometries.row(j, sizes[0]), r.numbered.row(j, sizes[1]),
                    r.settled.row(j, sizes[2]), r.framed.row(j, sizes[3]),
                    r.referred.row(at_both, columns), r.inputs.row(j, m),
                    r.out.row(at_both, width),
                )  # fmt: skip
            r.give(r.count)

    def _observable(
        self, name: str, machine: Traced, tape: Tape, tau: Sequence[Number], look: Sequence[Number]
    ) -> tuple[Number, Number]:
        """What is observed and a factor of its derivative; see `observables`."""
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
    ways = dict(zip(map(_index, sweep.q), sweep.slopes, strict=True))
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


def _index(loaded: Number) -> int:
    """Of a number that was loaded."""
    assert isinstance(loaded, Expression)
    return loaded.index
