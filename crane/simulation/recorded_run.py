"""Recording of a simulation: its channels, and readings of ideal sensors."""

from collections.abc import Iterable, Iterator
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from crane.codegen import LayoutView
from crane.common import scratch_arrays
from crane.common.errors import CraneError, RecordingError, check_name, format_one_line
from crane.common.one_line_repr import shorten_to_line
from crane.common.samples import MAX_QUANTITY, Array
from crane.control.control_law import Controller, ZeroForce, controller_reference
from crane.control.valve_drive import ValveDrive
from crane.description.external_forces import WRENCH_COMPONENTS
from crane.description.sensors import (
    FORCE_SUFFIX,
    FORCE_UNITS,
    INCLINATION_PREFIX,
    SUPPLY_PRESSURE,
    TANK_PRESSURE,
    VALVE_SIGNAL_PREFIX,
    VELOCITY_SUFFIX,
    VELOCITY_UNITS,
    quantity_unit,
)
from crane.dynamics.joint_forces import find_stick_slip_columns
from crane.dynamics.tipping_stability import TippingStability, has_supports
from crane.hydraulics.circuit_states import BALANCE_UNITS
from crane.machine.machine import Machine
from crane.motion.kinematics import Kinematics
from crane.motion.trajectory import Trajectory
from crane.recordings.recording import Recording
from crane.recordings.sensor_kinematics import ideal_readings
from crane.recordings.timeseries import TIME, Table, accepted_units, check_unit
from crane.simulation.integration.charts import Chart

ChannelColumn = tuple[str, Array, str]  # name, values, unit


class IntegrationResult(NamedTuple):
    """Result of an integration.

    Attributes:
        time: (N,) instants [s].
        array: (N, .) rows at these instants.
        chart: The machine in the coordinates of the user.
        notes: Notes for the user about the motion.
        start_text: Note about an initial state that differs from home.
        stop: The exception that stopped it, or None.
    """

    time: Array
    array: Array
    chart: Chart
    notes: Iterable[str]
    start_text: str = ""
    stop: BaseException | None = None

    @property
    def rows(self) -> LayoutView:
        """The parts of the rows, (N, .) each."""
        return self.chart.row_layout.view(self.array)

    def first_instants(self, count: int, stop: BaseException | None) -> "IntegrationResult":
        """The first instants of the result, with the exception that stopped it there."""
        return self._replace(time=self.time[:count], array=self.array[:count], stop=stop)


class InterruptedRun(KeyboardInterrupt):
    """Interrupt of a run.

    Attributes:
        recording: The recording up to the interrupt; its `stopped` says where it ended.
    """

    def __init__(self, recording: Recording):
        super().__init__(f"interrupted at t = {recording.time[-1]:g} s")
        self.recording = recording


def stop_with_recording(
    machine: Machine,
    control: Controller,
    run: IntegrationResult,
    stop: BaseException,
    task: str,
    end_time: float,
) -> BaseException:
    """The exception that stopped a run, with the recording up to there as its `recording`.

    Args:
        machine: The machine.
        control: Its controller.
        run: Result of the integration.
        stop: The exception.
        task: Name of the motion.
        end_time: Intended end [s].
    """
    if not len(run.time):
        return stop
    largest_values = scratch_arrays.compute_in_blocks(
        lambda part: np.abs(run.array[part]).max(axis=1, keepdims=True), len(run.time)
    )
    # values that diverged are removed
    run = run.first_instants(int(np.append(largest_values < MAX_QUANTITY, False).argmin()), stop)
    if not len(run.time):
        return stop
    interrupted = isinstance(stop, KeyboardInterrupt)
    text = format_one_line(" ".join(str(stop).split())) or type(stop).__name__
    if interrupted:
        text = f"at t = {run.time[-1]:g} s of {end_time:g} s: interrupted"
    elif not text.startswith("at t = "):
        text = f"at t = {run.time[-1]:g} s: {text}"
    with suppress(CraneError):  # an error of the channels must not hide that of the run
        recording = record_run(machine, control, run.time, run.rows, task, text)
        if interrupted:
            return InterruptedRun(recording)
        stop.recording = recording  # type: ignore[attr-defined]
    return stop


def record_run(
    machine: Machine,
    control: Controller,
    time: Array,
    rows: LayoutView,
    task: str,
    stopped: str = "",
    start_text: str = "",
) -> Recording:
    """The recording of a run.

    Args:
        machine: The machine.
        control: Its controller.
        time: (N,) instants [s].
        rows: Parts of the rows, see `integrate`.
        task: Name of the motion.
        stopped: When and why the run was stopped.
        start_text: Note about an initial state that differs from home.
    """
    active = machine.closure.active
    q_a = scratch_arrays.compute_in_blocks(lambda part: rows.q[part][:, active], len(time))
    columns = list(_channel_columns(machine, control, time, rows))
    controller = "" if isinstance(control, ZeroForce) else type(control).__name__
    if isinstance(control, ValveDrive):
        controller = getattr(control.command, "title", type(control.command).__name__)
    return Recording(
        time=time,
        joints=machine.active,
        q=q_a,
        v=rows.v_a,
        tau=rows.tau,
        units={joint: machine.unit(joint) for joint in machine.active},
        channels={name: values for name, values, _ in columns},
        channel_units={name: unit for name, _, unit in columns},
        machine=machine.load_expression,
        task=task,
        controller=controller,
        ideal=True,
        free=machine.free,
        machine_name=shorten_to_line(machine.name).strip(),
        stopped=stopped,
        start=start_text,
        copy=False,
    )


def _channel_columns(
    machine: Machine, control: Controller, time: Array, rows: LayoutView
) -> Iterator[ChannelColumn]:
    """Channels besides the active joints."""
    for column in machine.closure.passive:
        joint = machine.joints[column]
        yield joint, rows.q[:, column], machine.unit(joint)
    if machine.tip is not None:
        tip = Kinematics(machine)
        places = scratch_arrays.compute_in_blocks(
            lambda part: tip.positions_at_configurations(rows.q[part]), len(time)
        )
        yield from _point_columns("tip", places)
    reference = controller_reference(control, machine)
    if reference is not None:
        yield from _reference_columns(machine, reference, time)
    for i, joint in enumerate(machine.active):
        yield (
            f"friction_{joint}",
            rows.friction[:, i],
            FORCE_UNITS[machine.unit(joint)],
        )
    for column, values in zip(
        find_stick_slip_columns(machine), rows.friction_at_rest.T, strict=True
    ):
        joint = machine.joints[column]
        yield f"rest_{joint}", values, FORCE_UNITS[machine.unit(joint)]
    for name in ("kinetic", "potential", "work", "dissipated"):
        yield name, getattr(rows, name)[:, 0], "J"
    yield from _external_force_columns(machine, rows)
    yield from _stability_columns(machine, rows)
    if isinstance(control, ValveDrive):
        integrals = rows.controller[:, -len(BALANCE_UNITS) :]
        units = [*control.channels, *BALANCE_UNITS.items()]
        delayed_signals: dict[str, Array] = {}
        if control.delays.any():  # a log has the commanded signals
            spools = (f"voltage_{name}" for name in control.circuit.spools)
            commanded = scratch_arrays.compute_in_blocks(
                lambda part: control.commanded_signals(time[part]), len(time)
            )
            delayed_signals = dict(zip(spools, commanded.T, strict=True))
        for (name, unit), values in zip(units, [*rows.channels.T, *integrals.T], strict=True):
            yield name, delayed_signals.get(name, values), unit


def _external_force_columns(machine: Machine, rows: LayoutView) -> Iterator[ChannelColumn]:
    """External forces in the axes of the world at the origins of their frames, and their work."""
    columns = iter(rows.external.T)
    for k, force in enumerate(machine.external_forces):
        for part, values in zip(WRENCH_COMPONENTS, columns, strict=False):
            if part.startswith("force") or values.any():
                yield f"load_{force.name}_{part}", values, "N" if "force" in part else "N m"
        for (name, unit), values in zip(force.channels, columns, strict=False):
            yield name, values, unit
        yield f"work_{force.name}", rows.work[:, 1 + k], "J"


def _stability_columns(machine: Machine, rows: LayoutView) -> Iterator[ChannelColumn]:
    """Forces of supports, and stability margins."""
    if not has_supports(machine):
        return
    stability = TippingStability(machine)
    titles = [
        (f"support_{name}", "N") for name in stability.support_names if stability.is_stationary
    ]
    for word in ("stability", "static_stability"):
        titles += [(f"{word}_{'_'.join(line)}", "N m") for line in stability.line_names]
        titles += [(word, "")]

    def stand(part: slice) -> Array:
        q, outside = rows.q[part], rows.external[part]
        columns: list[Array] = []
        if stability.is_stationary:
            v = np.einsum("nij,nj->ni", machine.closure.gamma(q), rows.v_a[part])
            ground = stability.ground_wrench(q, v, rows.a[part], outside)
            columns += [stability.support_forces(q, ground)]
        else:
            ground = stability.contact_wrench(q, outside)
        for wrench in (ground, stability.ground_wrench(q, external_wrenches=outside)):
            margins = stability.tipping_margins(q, wrench)
            columns += [margins.moments, margins.smallest_ratio[:, None]]
        return np.hstack(columns)

    for (name, unit), values in zip(
        titles, scratch_arrays.compute_in_blocks(stand, len(rows.q)).T, strict=True
    ):
        yield name, values, unit


def _reference_columns(
    machine: Machine, reference: Trajectory, time: Array
) -> Iterator[ChannelColumn]:
    """The reference of the joints, and of the tip if it is a trajectory of the tip."""
    q = scratch_arrays.compute_in_blocks(lambda part: reference.position(time[part]), len(time))
    v = scratch_arrays.compute_in_blocks(lambda part: reference.velocity(time[part]), len(time))
    for i in np.flatnonzero(machine.is_driven):
        joint = machine.active[i]
        unit = machine.unit(joint)
        yield f"reference_{joint}", q[:, i], unit
        yield f"reference_velocity_{joint}", v[:, i], unit + "/s"
    if reference.tip is not None:
        wanted = reference.tip.position
        places = scratch_arrays.compute_in_blocks(lambda part: wanted(time[part]), len(time))
        yield from _point_columns("reference_tip", places)


def _point_columns(name: str, positions: Array) -> Iterator[ChannelColumn]:
    """Positions (N, 3) [m] by axis."""
    for axis, values in zip("xyz", positions.T, strict=True):
        yield f"{name}_{axis}", values, "m"


_INPUT_PREFIXES = (VALVE_SIGNAL_PREFIX, SUPPLY_PRESSURE, TANK_PRESSURE)


def simulated_columns(
    machine: Machine, table: Table, recording: Recording | None = None
) -> list[str]:
    """Columns of a measured table that a simulation of its inputs has.

    Joints, their velocities and forces, pressures, channels of the circuit, the tip, and
    inclinations of links, `inclination_LINK` and `inclination_LINK_velocity`.

    Args:
        machine: The machine.
        table: The measured table.
        recording: Recording of the simulation; None where there is none yet.

    Raises:
        RecordingError: A column has the unit of another quantity, or belongs to no link.
    """
    units = simulated_units(machine) if recording is None else recording.column_units()
    columns = []
    for name, unit in table.units.items():
        if name == TIME:
            continue
        wanted = units.get(name)
        if name.startswith(INCLINATION_PREFIX):
            wanted = quantity_unit(machine.tree, name)
            if wanted is None:
                link = name.removeprefix(INCLINATION_PREFIX).removesuffix(VELOCITY_SUFFIX)
                problem = f"column '{name}' is of no link"
                check_name(link, machine.tree.links, problem, RecordingError)
        if wanted is not None:
            check_unit(name, unit, accepted_units(wanted))
            if not name.startswith(_INPUT_PREFIXES):
                columns.append(name)
    return columns


def simulated_units(machine: Machine) -> dict[str, str]:
    """Units of the columns that a simulation with valves records, by name."""
    units = {joint: machine.unit(joint) for joint in machine.joints}
    units |= {x + VELOCITY_SUFFIX: VELOCITY_UNITS[machine.unit(x)] for x in machine.active}
    units |= {x + FORCE_SUFFIX: FORCE_UNITS[machine.unit(x)] for x in machine.driven_joints}
    units |= {f"tip_{axis}": "m" for axis in "xyz" if machine.tip is not None}
    for joint in machine.hydraulics.joints if machine.hydraulics else ():
        units |= {f"pressure_{joint}_{side}": "Pa" for side in "ab"}
        units |= {f"spool_{joint}": ""}
    return units


def read_simulation(machine: Machine, recording: Recording, names: list[str]) -> Array:
    """Readings (N, k) of ideal sensors at the recorded instants, SI units.

    Args:
        machine: The simulated machine.
        recording: Its recording.
        names: See `simulated_columns`; also velocities of passive joints.
    """
    columns = recording.columns()
    if derived := [name for name in names if name not in columns]:
        q = np.column_stack([columns[joint] for joint in machine.joints])
        order = [recording.joints.index(joint) for joint in machine.active]
        v = np.einsum("nij,nj->ni", machine.closure.gamma(q), recording.v[:, order])
        columns |= ideal_readings(machine, q, v, derived)
    values = [columns[name] for name in names]
    return np.column_stack(values) if values else np.empty((len(recording.time), 0))
