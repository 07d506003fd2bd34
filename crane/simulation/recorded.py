"""What a simulation leaves: a recording with channels."""

from collections.abc import Iterator
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from crane.codegen import Layout, Parts
from crane.common import scratch
from crane.common.errors import CraneError, one_line
from crane.common.samples import LARGEST, Array
from crane.common.shown import shortened
from crane.control import Controller, Free, ValveDrive, reference_of
from crane.description.external import PARTS
from crane.dynamics.joint_forces import sticking
from crane.dynamics.stability import Stability, has_supports
from crane.hydraulics.circuit import BALANCES
from crane.machine import Machine
from crane.motion.curves import Trajectory
from crane.motion.kinematics import Kinematics
from crane.recordings.recording import FORCE_UNITS, Recording

Column = tuple[str, Array, str]  # name, values, unit


class Run(NamedTuple):
    """What an integration leaves.

    Attributes:
        time: (N,) [s].
        array: (N, .) rows at these instants.
        layout: Of a row, see `crane.simulation.integration.row_layout`.
        notes: What is to be said of the motion.
        start: How it starts, where that is not what the file says.
        stop: What ended it before its time, if something did.
    """

    time: Array
    array: Array
    layout: Layout
    notes: list[str]
    start: str = ""
    stop: BaseException | None = None

    @property
    def rows(self) -> Parts:
        """The rows part by part, (N, .) each."""
        return self.layout.view(self.array)

    def until(self, count: int, stop: BaseException | None) -> "Run":
        """The first instants of it, and what ended it there."""
        return self._replace(time=self.time[:count], array=self.array[:count], stop=stop)


class InterruptedRun(KeyboardInterrupt):
    """A run that was interrupted.

    Attributes:
        recording: What there is of it, whose `stopped` says where it ended.
    """

    def __init__(self, recording: Recording):
        super().__init__(f"interrupted at t = {recording.time[-1]:g} s")
        self.recording = recording


def stopped(
    machine: Machine, control: Controller, run: Run, task: str, until: float
) -> BaseException:
    """What stopped a run, which has what there is of it as its `recording`.

    Args:
        machine: The machine.
        control: What drove it.
        run: What was integrated.
        task: Name to put into the recording.
        until: When it should have ended [s].
    """
    assert (stop := run.stop) is not None
    if not len(run.time):
        return stop
    largest = scratch.in_blocks(
        lambda part: np.abs(run.array[part]).max(axis=1, keepdims=True), len(run.time)
    )
    # what has exploded is no motion
    run = run.until(int(np.append(largest < LARGEST, False).argmin()), stop)
    if not len(run.time):
        return stop
    interrupted = isinstance(stop, KeyboardInterrupt)
    text = one_line(" ".join(str(stop).split())) or type(stop).__name__
    if interrupted:
        text = f"at t = {run.time[-1]:g} s of {until:g} s: interrupted"
    elif not text.startswith("at t = "):
        text = f"at t = {run.time[-1]:g} s: {text}"
    with suppress(CraneError):  # channels that cannot be computed there hide no error
        recording = recorded(machine, control, run.time, run.rows, task, text)
        if interrupted:
            return InterruptedRun(recording)
        stop.recording = recording  # type: ignore[attr-defined]
    return stop


def recorded(
    machine: Machine,
    control: Controller,
    time: Array,
    rows: Parts,
    task: str,
    stopped: str = "",
    start: str = "",
) -> Recording:
    """What the integration left as a recording.

    Args:
        machine: The machine.
        control: What drove it.
        time: (N,) [s].
        rows: See `integrate`.
        task: Name to put into it.
        stopped: When and why it ended before its time.
        start: How it starts, where that is not what the file says.
    """
    active = machine.closure.active
    q_a = scratch.in_blocks(lambda part: rows.q[part][:, active], len(time))
    channels: dict[str, Array] = {}
    units: dict[str, str] = {}
    for name, values, unit in _channels(machine, control, time, rows):
        channels[name], units[name] = values, unit
    return Recording(
        time=time,
        joints=machine.active,
        q=q_a,
        v=rows.v_a,
        tau=rows.tau,
        units={joint: machine.unit(joint) for joint in machine.active},
        channels=channels,
        channel_units=units,
        machine=machine.call,
        task=task,
        controller=_name_of(control),
        ideal=True,
        free=machine.free,
        machine_name=shortened(machine.name).strip(),
        stopped=stopped,
        start=start,
        copy=False,
    )


def _channels(machine: Machine, control: Controller, time: Array, rows: Parts) -> Iterator[Column]:
    """What is recorded beside the active joints."""
    for column in machine.closure.passive:
        joint = machine.joints[column]
        yield joint, rows.q[:, column], machine.unit(joint)
    if machine.tip is not None:
        tip = Kinematics(machine)
        places = scratch.in_blocks(lambda part: tip.positions(rows.q[part]), len(time))
        yield from _point("tip", places)
    reference = reference_of(control, machine)
    if reference is not None:
        yield from _references(machine, reference, time)
    for i, joint in enumerate(machine.active):
        yield (
            f"friction_{joint}",
            rows.friction[:, i],
            FORCE_UNITS[machine.unit(joint)],
        )
    for column, values in zip(sticking(machine), rows.rest.T, strict=True):
        joint = machine.joints[column]
        yield f"rest_{joint}", values, FORCE_UNITS[machine.unit(joint)]
    names = {"kinetic": "kinetic", "potential": "potential", "work": "work", "dissipated": "lost"}
    for name, part in names.items():
        yield name, getattr(rows, part)[:, 0], "J"
    yield from _outside(machine, rows)
    yield from _standing(machine, rows)
    if isinstance(control, ValveDrive):
        integrals = rows.own[:, -len(BALANCES) :]
        units = [*control.channels, *BALANCES.items()]
        late: dict[str, Array] = {}
        if control.delays.any():  # a log has what was commanded, not what arrives
            spools = (f"voltage_{name}" for name in control.circuit.spools)
            asked = scratch.in_blocks(lambda part: control.commanded(time[part]), len(time))
            late = dict(zip(spools, asked.T, strict=True))
        for (name, unit), values in zip(units, [*rows.channels.T, *integrals.T], strict=True):
            yield name, late.get(name, values), unit


def _outside(machine: Machine, rows: Parts) -> Iterator[Column]:
    """What acts from outside, in the world's axes at the origins of frames, and its work."""
    columns = iter(rows.outside.T)
    for k, force in enumerate(machine.external):
        for part, values in zip(PARTS, columns, strict=False):
            if part.startswith("force") or values.any():
                yield f"load_{force.name}_{part}", values, "N" if "force" in part else "N m"
        for (name, unit), values in zip(force.channels, columns, strict=False):
            yield name, values, unit
        yield f"work_{force.name}", rows.work[:, 1 + k], "J"


def _standing(machine: Machine, rows: Parts) -> Iterator[Column]:
    """What supports carry, and how far it is from tipping."""
    if not has_supports(machine):
        return
    stability = Stability(machine)
    titles = [(f"support_{name}", "N") for name in stability.names if stability.stands]
    for word in ("stability", "static_stability"):
        titles += [(f"{word}_{'_'.join(line)}", "N m") for line in stability.lines]
        titles += [(word, "")]

    def stand(part: slice) -> Array:
        q, outside = rows.q[part], rows.outside[part]
        columns: list[Array] = []
        if stability.stands:
            v = np.einsum("nij,nj->ni", machine.closure.gamma(q), rows.v_a[part])
            ground = stability.ground(q, v, rows.a[part], outside)
            columns += [stability.carried(q, ground)]
        else:
            ground = stability.pressed(q, outside)
        for wrench in (ground, stability.ground(q, outside=outside)):
            margins = stability.margins(q, wrench)
            columns += [margins.moments, margins.least[:, None]]
        return np.hstack(columns)

    found = scratch.in_blocks(stand, len(rows.q))
    for (name, unit), values in zip(titles, found.T, strict=True):
        yield name, values, unit


def _references(machine: Machine, reference: Trajectory, time: Array) -> Iterator[Column]:
    """What a reference asks of the joints, and of the tip where it was given there."""
    q = scratch.in_blocks(lambda part: reference.position(time[part]), len(time))
    v = scratch.in_blocks(lambda part: reference.velocity(time[part]), len(time))
    for i in np.flatnonzero(machine.driven):
        joint = machine.active[i]
        unit = machine.unit(joint)
        yield f"reference_{joint}", q[:, i], unit
        yield f"reference_velocity_{joint}", v[:, i], unit + "/s"
    if reference.tip is not None:
        wanted = reference.tip.position
        places = scratch.in_blocks(lambda part: wanted(time[part]), len(time))
        yield from _point("reference_tip", places)


def _point(name: str, positions: Array) -> Iterator[Column]:
    """Positions (N, 3) [m] by axis."""
    for axis, values in zip("xyz", positions.T, strict=True):
        yield f"{name}_{axis}", values, "m"


def _name_of(control: Controller) -> str:
    """What drives the machine: what its command calls itself, or the name of its class."""
    if isinstance(control, ValveDrive):
        return getattr(control.command, "title", type(control.command).__name__)
    return "" if isinstance(control, Free) else type(control).__name__
