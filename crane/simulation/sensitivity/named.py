"""How a simulated motion depends on numbers of the machine and on its start."""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import CraneWarning, InputError, known
from crane.common.samples import Array
from crane.control import Command, Controller, TracedController, ValveDrive, reference_of
from crane.dynamics import Dynamics
from crane.dynamics.named import SMALL, Named
from crane.formats import load
from crane.machine import Machine
from crane.recordings.recording import VELOCITY, Recording
from crane.simulation.recorded import recorded
from crane.simulation.run import Force, Progress, as_controller, count_steps, start_of
from crane.simulation.sensitivity.follow import Motion, follow
from crane.simulation.sensitivity.setup import Setup, setup_of
from crane.simulation.sensitivity.tangent import frames_of

START = "start."
_NUDGE = 1e-4  # rad, machine's size, per `Closure.pace`, of starts
_CENTRAL = ((1, 8.0 / 12.0), (-1, -8.0 / 12.0), (2, -1.0 / 12.0), (-2, 1.0 / 12.0))


@dataclass(frozen=True, eq=False)
class Sensitivities:
    """A motion, and its derivatives by numbers.

    Attributes:
        recording: The motion.
        outputs: Names (k,) of what is observed.
        by: Names (p,) of the numbers.
        values: (p,) of these.
        slopes: (N, k, p) derivatives of the outputs, SI units.
    """

    recording: Recording
    outputs: tuple[str, ...]
    by: tuple[str, ...]
    values: Array
    slopes: Array

    def __repr__(self) -> str:
        """Of what, by what."""
        return f"Sensitivities of {', '.join(self.outputs)} by {', '.join(self.by)}"

    def of(self, output: str, by: str) -> Array:
        """(N,) d output / d number over time.

        Raises:
            InputError: There is no such output or number.
        """
        for name, names in ((output, self.outputs), (by, self.by)):
            if name not in names:
                raise InputError(f"'{name}' is not among them, {known(names, name)}")
        found: Array = self.slopes[:, self.outputs.index(output), self.by.index(by)]
        return found

    def to_markdown(self, share: float = 0.01) -> str:
        """What a change of each number by a share does to each output, root mean square."""
        head = ["number", "value", *self.outputs]
        lines = [" | ".join(["", *head, ""]).strip(), "|---|" + "---:|" * (len(head) - 1)]
        sizes = np.sqrt(np.mean(self.slopes**2, axis=0)).T * np.abs(self.values[:, None]) * share
        for name, value, row in zip(self.by, self.values, sizes, strict=True):
            cells = [name, f"{value:.6g}", *(f"{x:.3g}" for x in row)]
            lines.append(f"| {' | '.join(cells)} |")
        return "\n".join(lines) + "\n"


def sensitivities(
    machine: Machine | str | Path,
    controller: Controller | Command | Force | None = None,
    initial: ArrayLike | tuple[ArrayLike, ArrayLike] | None = None,
    duration: float | None = None,
    step: float = 1e-3,
    *,
    by: Sequence[str],
    outputs: Sequence[str] | None = None,
    method: str | None = None,
    tolerance: float | None = None,
    progress: Progress | None = None,
) -> Sensitivities:
    """Simulate a machine, with the exact derivatives of its motion by numbers.

    With the minimal state s = (q_A, v_A, controller), s' = r(s, t, p), and S = ds/dp,

        S' = dr/ds S + dr/dp,    S(0) = ds(0)/dp,

    between the instants at which a joint starts or stops, at which S jumps by (r - r_+) dt/dp; dr
    is differentiated operation by operation through the closed loops. The equations are solved
    along the states of the simulation, by Lobatto's method IIIC of order 4 over its recorded
    steps, which are taken in up to 4,096 parts where something jumps.

    Args:
        machine: The machine, or what `crane.load` takes.
        controller: See `simulate`; it stays the same where the machine changes, as do starting
            coordinates.
        initial: See `simulate`.
        duration: See `simulate`.
        step: See `simulate`.
        by: Numbers of the machine as `crane.description.parameters` lists them, such as
            "payload.mass" or "oil.bulk_modulus", and `start.JOINT`, `start.JOINT_velocity` of
            active joints.
        outputs: Names of joints, `JOINT_velocity`, `JOINT_force` of active ones, channels of the
            circuit such as `pressure_JOINT_a`, "kinetic", "potential", `tip_x`,
            `inclination_LINK` and `inclination_LINK_velocity`. If not given, the active joints,
            and with valves the chambers' pressures.
        method: See `simulate`.
        tolerance: See `simulate`.
        progress: See `simulate`.

    Raises:
        InputError: Unknown names, a machine that floats, or one without formulas.
        SimulationError: The motion comes to a dead centre; else as `simulate`.
    """
    if not isinstance(machine, Machine):
        machine = load(machine)
    if not by:
        raise InputError("no number is named, give `by` such as ['payload.mass']")
    control = as_controller(controller, machine)
    count = count_steps(control, duration, step)
    reference = reference_of(control)
    start = start_of(machine, initial, reference)
    programmed = isinstance(control, ValveDrive) and control.period
    if programmed or not isinstance(control, TracedController):
        raise InputError("a controller in Python has no formulas, write it as a crane.control.Law")
    dynamics = Dynamics(machine)
    outputs = _usual(machine) if outputs is None else list(outputs)
    starts = [name for name in by if name.startswith(START)]
    numbers = [name for name in by if name not in starts]
    named = Named(machine) if numbers else None
    links = [link for link, _ in frames_of(machine, outputs)]

    def at(which: Machine, initial: tuple[Array, Array], times: Array) -> Setup:
        own = control.on(which) if isinstance(control, ValveDrive) else control
        kept = dynamics if which is machine else Dynamics(which)
        return setup_of(kept, own, initial, links, times)

    def setup(times: Array) -> tuple[Setup, Setup]:
        base = at(machine, start, times)
        found = {name: _started(name, machine, lambda x: at(machine, x, times), start)
                 for name in starts}  # fmt: skip
        if named is not None:
            sizes = np.cumsum([part.size for part in base])[:-1]
            every = named.slopes(
                numbers,
                lambda which: np.concatenate([x.ravel() for x in at(which, start, times)]),
            )
            for name, flat in zip(numbers, every, strict=True):
                parts = zip(np.split(flat, sizes), base, strict=True)
                found[name] = Setup(*(part.reshape(like.shape) for part, like in parts))
        return base, Setup(*(np.array(x) for x in zip(*(found[x] for x in by), strict=True)))

    motion = Motion(dynamics, control, start, count, step, method, tolerance)
    values = np.array([_value(name, machine, named, start) for name in by])
    sizes = np.array(
        [
            abs(value) if value and name in numbers else SMALL
            for name, value in zip(by, values, strict=True)
        ]
    )
    followed = follow(motion, outputs, setup, sizes, progress=progress)
    for note in followed.notes:
        warnings.warn(note, CraneWarning, stacklevel=2)
    return Sensitivities(
        recorded(machine, control, followed.time, followed.parts, ""),
        tuple(outputs),
        tuple(by),
        values,
        followed.slopes,
    )


def _usual(machine: Machine) -> list[str]:
    joints = machine.hydraulics.joints if machine.hydraulics is not None else ()
    return [*machine.active, *(f"pressure_{joint}_{side}" for joint in joints for side in "ab")]


def _begins(name: str, machine: Machine) -> tuple[int, int]:
    """Which part of the start a name is of, and which joint.

    Raises:
        InputError: It is of none.
    """
    joint = name.removeprefix(START)
    part = int(joint.endswith(VELOCITY) and joint not in machine.active)
    joint = joint.removesuffix(VELOCITY) if part else joint
    if joint not in machine.active:
        raise InputError(
            f"'{name}' is no start of an active joint, {known(machine.active, joint)}"
        )
    return part, machine.active.index(joint)


def _started(
    name: str,
    machine: Machine,
    setup: Callable[[tuple[Array, Array]], Setup],
    start: tuple[Array, Array],
) -> Setup:
    """How the numbers change with a coordinate or velocity at the start."""
    part, i = _begins(name, machine)
    closure = machine.closure
    nudge = _NUDGE * closure.units[closure.active][i] / (closure.pace if part else 1.0)
    total: list[Array] = []
    for side, weight in _CENTRAL:
        moved = start[0].copy(), start[1].copy()
        moved[part][i] += side * nudge
        more = [weight / nudge * x for x in setup(moved)]
        total = [x + y for x, y in zip(total, more, strict=True)] if total else more
    return Setup(*total)


def _value(name: str, machine: Machine, named: Named | None, start: tuple[Array, Array]) -> float:
    if named is None or name.startswith(START):
        part, i = _begins(name, machine)
        return float(start[part][i])
    return named.value(name)
