"""Checks of a run: passed limits, energy imbalance, chattering friction, closed valves."""

import numpy as np

from crane.codegen import LayoutView
from crane.common.one_line_repr import list_first
from crane.common.samples import MAX_COORDINATE, Array
from crane.common.scratch_arrays import release_pages
from crane.description.ground_contact import Contact
from crane.dynamics.frame_jacobians import FrameJacobians
from crane.dynamics.joint_forces import JointForces
from crane.hydraulics.components import CounterbalanceValve, Valve
from crane.machine.machine import Machine
from crane.motion.limit_violations import limit_tolerances
from crane.recordings.recording import Recording
from crane.simulation.integration.error_controlled_stepper import characteristic_energy
from crane.simulation.integration.rosenbrock import ROSENBROCK_TOLERANCE

_MAX_CONTACT_FORCE_RATIO = 3.0  # largest initial force of a contact over the weight of the machine
_MAX_NAMED_JOINTS = 3  # joints that a message names
_MAX_RELATIVE_IMBALANCE = 5e-3  # share of the energy throughput
_ENERGY_ROUNDING = 1e-12  # share of the largest energy
_MAX_STROKE_EXCESS = 5e-3  # share of the stroke by which end stops may be compressed
_MAX_STOP_ENERGY_GAIN = 0.05  # share of the largest energy in an end stop
_SMOOTHING_RANGE = 3.0  # velocity, in smoothing velocities, below which friction reverses
_MAX_DISSIPATION_ERROR = 0.2  # share of the dissipation of a step
_MIN_CHATTER_SAMPLES, _MIN_CHATTER_SHARE = 3, 1e-3  # accepted number and share of samples
_BLOCK_SAMPLES = 20000  # samples of a block
_MIN_CLOSED_TIME = 0.3  # least time of an open spool under a closed counterbalance valve [s]
_MIN_SETTLED_SHARE = 0.99  # of the pilot pressure, reached in the first three quarters of it
_MIN_CLOSED_TIME = 0.3  # least time of an open spool under a closed counterbalance valve [s]
_MIN_SETTLED_SHARE = 0.99  # of the pilot pressure, reached in the first three quarters of it


def run_warnings(
    machine: Machine,
    time: Array,
    rows: LayoutView,
    step: float,
    has_fixed_steps: bool,
    is_exact: bool = True,
) -> list[str]:
    """Warnings about a run.

    The energies are integrated with the motion, so their imbalance shows a step that is too long.

    Args:
        machine: The machine.
        time: (N,) [s].
        rows: See `integrate`.
        step: [s].
        has_fixed_steps: Whether the steps of the method are the output intervals.
        is_exact: Whether the formulation conserves energy.
    """
    texts = (
        passed_limits_text(machine, time, rows.q),
        passed_strokes_text(machine, time, rows.q),
        friction_chatter_text(machine, time, rows, step) if has_fixed_steps else "",
        energy_imbalance_text(machine, rows, step, _energy_imbalance(rows)) if is_exact else "",
    )
    return [text for text in texts if text]


def find_invalid_motion(
    machine: Machine, time: Array, rows: LayoutView, step: float, is_exact: bool = True
) -> tuple[int, str] | None:
    """Index of the first invalid instant of a run, and the reason; None for a valid run.

    A run is invalid where a piston has left its cylinder, or an end stop has released more energy
    than it took. For the arguments see `run_warnings`.
    """
    departure = find_piston_outside_cylinder(machine, time, rows.q)
    if departure is None and is_exact:
        return find_stop_energy_gain(machine, time, rows, step, _energy_imbalance(rows))
    return departure


def passed_limits_text(machine: Machine, time: Array, q: Array) -> str:
    """Warning about joints without end stops beyond their limits; empty without any.

    Args:
        machine: The machine.
        time: (N,) [s].
        q: (N, nv) configurations.
    """
    lower, upper = machine.coordinates.lower, machine.coordinates.upper

    def beyond(i: int) -> Array:
        release_pages()
        return np.asarray(np.maximum(lower[i] - q[:, i], q[:, i] - upper[i]))

    largest_excess = np.array([beyond(i).max() for i in range(len(lower))])
    with_end_stop = {stop.joint for stop in machine.end_stops}
    slack = limit_tolerances(machine)
    passed_columns = [
        i for i in np.flatnonzero(largest_excess > slack) if machine.joints[i] not in with_end_stop
    ]
    if not passed_columns:
        return ""
    units = machine.closure.units
    passed_columns.sort(
        key=lambda i: -largest_excess[i] / min(upper[i] - lower[i], MAX_COORDINATE * units[i])
    )
    words = []
    for i in passed_columns:
        joint, first = machine.joints[i], int(np.argmax(beyond(int(i)) > slack[i]))
        limit = lower[i] if q[first, i] < lower[i] else upper[i]
        unit = machine.unit(joint)
        words.append(
            f"'{joint}' passes its limit {limit:.4g} {unit} at t = {time[first]:.4g} s, by up to "
            f"{largest_excess[i]:.3g} {unit}"
        )
    one = len(passed_columns) == 1
    return (
        f"{list_first(words, 'joints', _MAX_NAMED_JOINTS)}: nothing stops "
        f"{'it' if one else 'them'} there, give {'it an end stop' if one else 'them end stops'}"
    )


def passed_strokes_text(machine: Machine, time: Array, q: Array) -> str:
    """Warning about end stops of cylinders that are too soft; empty without any.

    For the arguments see `passed_limits_text`.
    """
    cylinders = machine.hydraulics.cylinders if machine.hydraulics is not None else {}
    with_end_stop = {stop.joint for stop in machine.end_stops}
    words = []
    for joint in (x for x in cylinders if x in with_end_stop):
        release_pages()
        depth, stroke = _limit_excess(machine, joint, q)
        deepest = int(depth.argmax())
        if depth[deepest] > _MAX_STROKE_EXCESS * stroke:
            words.append(
                f"the piston of '{joint}' is {depth[deepest]:.3g} m beyond its stroke at "
                f"t = {time[deepest]:.4g} s"
            )
    remedy = ": make end stops as stiff as steel is, or move slower"
    return ", ".join(words) + remedy if words else ""


def _limit_excess(machine: Machine, joint: str, q: Array) -> tuple[Array, float]:
    """By how much a joint is beyond its limits (N,), and the distance between these."""
    i = machine.column(joint)
    lower, upper = machine.coordinates.lower[i], machine.coordinates.upper[i]
    return np.maximum(lower - q[:, i], q[:, i] - upper), upper - lower


def find_piston_outside_cylinder(
    machine: Machine, time: Array, q: Array
) -> tuple[int, str] | None:
    """Index of the instant when a piston leaves its cylinder and hoses, and the error; else None.

    For the arguments see `passed_limits_text`.
    """
    for joint, cylinder in (
        machine.hydraulics.cylinders if machine.hydraulics is not None else {}
    ).items():
        if cylinder.motor:
            continue
        release_pages()
        i = machine.column(joint)
        lower, upper = machine.coordinates.lower[i], machine.coordinates.upper[i]
        lowest, highest = (
            lower - cylinder.hose_a / cylinder.area_a,
            upper + cylinder.hose_b / cylinder.area_b,
        )
        if (is_outside := (q[:, i] <= lowest) | (q[:, i] >= highest)).any():
            first = int(np.argmax(is_outside))
            chamber = "A" if q[first, i] <= lowest else "B"
            return first, (
                f"at t = {time[first]:.4g} s the piston of '{joint}' has left its cylinder, whose "
                f"chamber {chamber} has no room: give '{joint}' an end stop (end_stops)"
            )
    return None


def buried_contact_text(machine: Machine, q: Array) -> str:
    """Error of a contact deep in the ground at a configuration (nq,); empty without one."""
    contacts = [force for force in machine.external_forces if isinstance(force, Contact)]
    if not contacts:
        return ""
    gravity = float(np.linalg.norm(machine.gravity)) or 9.81  # [m/s2]
    weight = gravity * sum(inertia.mass for inertia in machine.model.inertias)
    frames = FrameJacobians(machine)
    frames.set_configuration(q)
    for contact in contacts:
        position = frames.frame_pose(contact.frame).translation.tolist()
        height = float(contact.ground.distance_and_normal(position)[0])  # type: ignore[arg-type]
        depth = contact.radius - height
        if contact.stiffness * depth > _MAX_CONTACT_FORCE_RATIO * weight:
            return (
                f"'{contact.name}' is {depth:.3g} m inside the ground, where its whole weight at "
                f"{gravity:.3g} m/s2 presses it in by {weight / contact.stiffness:.2g} m: start "
                "higher"
            )
    return ""


def _energy_imbalance(rows: LayoutView) -> Array:
    """(N,) work less change of energy less dissipation [J]: the error of the integration."""
    stored = rows.kinetic[:, 0] + rows.potential[:, 0]
    return rows.work.sum(axis=1) - rows.dissipated[:, 0] - stored + stored[0]


def _energy_throughput(rows: LayoutView) -> float:
    """The energy throughput: largest range of work, dissipation and energies [J]."""
    return float(
        max(np.ptp(part) for part in (rows.work, rows.dissipated, rows.kinetic, rows.potential))
    )


def _tolerated_imbalance(machine: Machine, rows: LayoutView) -> float:
    """Imbalance that is no sign of long steps [J].

    It is a share of the throughput, but at least what the methods leave in a machine that hardly
    moves: their error control tolerates this share of the machine's characteristic energy, in
    which speeds below 0.2 mm/s of a machine of 1 m disappear, and energies are rounded.
    """
    size = max(np.abs(rows.kinetic).max(), np.abs(rows.potential).max())
    unresolved = ROSENBROCK_TOLERANCE * characteristic_energy(machine) + _ENERGY_ROUNDING * size
    return _MAX_RELATIVE_IMBALANCE * _energy_throughput(rows) + float(unresolved)


def find_stop_energy_gain(
    machine: Machine, time: Array, rows: LayoutView, step: float, energy_imbalance: Array
) -> tuple[int, str] | None:
    """Index of the instant when an end stop releases more energy than it took, and the error."""
    min_gain = _tolerated_imbalance(machine, rows)
    if not np.ptp(energy_imbalance) > min_gain:
        return None
    for stop in machine.end_stops:
        depth, _ = _limit_excess(machine, stop.joint, rows.q)
        for first, behind in (
            np.flatnonzero(np.diff((depth > 0).astype(np.int8), prepend=0, append=0))
            .reshape(-1, 2)
            .tolist()
        ):
            before, after = max(first - 1, 0), min(behind, len(energy_imbalance) - 1)
            stored_energy = 0.5 * stop.stiffness * float(depth[first:behind].max()) ** 2
            energy_gain = float(energy_imbalance[before] - energy_imbalance[after])
            if energy_gain > max(_MAX_STOP_ENERGY_GAIN * stored_energy, min_gain):
                return first, (
                    f"at t = {time[first]:.4g} s the end stop of '{stop.joint}' gives back "
                    f"{energy_gain:.2g} J more than it takes, so the step of {step:g} s is too "
                    "long for it: shorten it, or let method DOP853 choose it"
                )
    return None


def friction_chatter_text(machine: Machine, time: Array, rows: LayoutView, step: float) -> str:
    """Warning about smoothed friction that chatters; empty without any.

    Where a fixed step is too long for the smoothing, friction changes its sign between stages: the
    dissipation of the step differs from that by its power at both ends.
    """
    laws = machine.friction.items()
    smoothings = {
        machine.column(x): f.smoothing for x, f in laws if f.smoothing and f.breakaway_force
    }
    columns = list(smoothings)
    if not columns:
        return ""
    dissipated_per_step = np.diff(rows.dissipated[:, 0])
    energy_tolerance = 1e-6 * float(dissipated_per_step.max())
    friction = np.einsum("ni,ni->n", rows.friction, rows.v_a)
    expected = 0.5 * (friction[1:] + friction[:-1]) * step
    suspect_steps = np.flatnonzero(
        _energies_differ(dissipated_per_step, expected, energy_tolerance)
    )
    forces, max_slow_velocities = (
        JointForces(machine),
        _SMOOTHING_RANGE * np.array(list(smoothings.values())),
    )
    count, names, first = 0, set(), len(time)
    for start in range(
        0, len(suspect_steps), _BLOCK_SAMPLES
    ):  # with dampers and stops, and where they turn
        block = suspect_steps[start : start + _BLOCK_SAMPLES]
        power, is_turning = (
            np.zeros((2, len(block))),
            np.zeros((len(block), len(columns)), dtype=bool),
        )
        for end, at in enumerate((block, block + 1)):
            q = rows.q[at]
            v = np.einsum("nij,nj->ni", machine.closure.gamma(q), rows.v_a[at])
            braking = forces.passive_forces(q, 0.0 * v) - forces.passive_forces(q, v)
            power[end] = friction[at] + np.einsum("ni,ni->n", v, braking)
            is_turning |= np.abs(v[:, columns]) < max_slow_velocities
        is_inconsistent = _energies_differ(
            dissipated_per_step[block], 0.5 * step * power.sum(axis=0), energy_tolerance
        )
        is_inconsistent &= is_turning.any(axis=1)
        if is_inconsistent.any():
            count += int(is_inconsistent.sum())
            first = min(first, int(block[is_inconsistent.argmax()]))
            names |= {columns[i] for i in np.flatnonzero(is_turning[is_inconsistent].any(axis=0))}
    if count <= max(_MIN_CHATTER_SAMPLES, _MIN_CHATTER_SHARE * len(time)):
        return ""
    joints = [f"'{machine.joints[i]}'" for i in sorted(names)]
    return (
        f"friction of {list_first(joints, 'joints', _MAX_NAMED_JOINTS)} chatters in {count} of "
        f"{len(time)} samples, first at t = {time[first]:.4g} s: steps of {step:g} s do not "
        "follow its smoothing, leave that out, so that it sticks, or shorten the step"
    )


def _energies_differ(one: Array, other: Array, tolerance: float) -> np.ndarray:
    gap = np.abs(one - other)
    return (gap > _MAX_DISSIPATION_ERROR * np.maximum(np.abs(one), np.abs(other))) & (
        gap > tolerance
    )


def energy_imbalance_text(
    machine: Machine, rows: LayoutView, step: float, energy_imbalance: Array
) -> str:
    """Warning about the energy imbalance of a run; empty if it is small."""
    gap = float(np.abs(energy_imbalance).max())
    if gap <= _tolerated_imbalance(machine, rows):
        return ""
    return (
        f"work, energy and dissipation differ by {gap:.2g} J of "
        f"{_energy_throughput(rows):.2g} J, so the "
        f"step of {step:g} s is too long: shorten it, or let method DOP853 choose it"
    )


def closed_counterbalance_text(machine: Machine, recording: Recording) -> str:
    """Warning about counterbalance valves that stay closed under open spools; empty without any.

    Such a joint stands still: the pilot pressure does not suffice at the pressure of the load.
    """
    circuit = machine.hydraulics
    if circuit is None or f"spool_{circuit.joints[0]}" not in recording.channels:
        return ""
    texts = [
        _closed_valve_text(circuit.valves[joint], holding, side, recording)
        for joint, cylinder in circuit.cylinders.items()
        for side, holding in enumerate((cylinder.counterbalance_a, cylinder.counterbalance_b))
        if holding is not None
    ]
    return "; ".join(filter(None, texts))


def _closed_valve_text(
    valve: Valve, holding: CounterbalanceValve, side: int, recording: Recording
) -> str:
    """Warning about the counterbalance valve of chamber A, side 0, or B, side 1; empty if none."""
    name, spool = list(valve.spools.items())[-1 if side else 0]
    stroke = recording[f"spool_{name}"] * (1.0 if side else -1.0)  # that drains the chamber
    is_open = stroke > spool.overlap
    if (curve := valve.curves.get("c2" if side else "c3")) is not None:
        is_open &= np.interp(stroke, *np.transpose(curve.points)) > 0
    load_pressure, pilot_pressure = (
        recording[f"pressure_{valve.joint}_{x}"][is_open] for x in ("ba" if side else "ab")
    )
    count = len(pilot_pressure)
    needed = (holding.pressure - load_pressure) / holding.pilot_ratio
    if (
        count * np.diff(recording.time[:2]).sum() < _MIN_CLOSED_TIME
        or (pilot_pressure > needed).any()
        or pilot_pressure[: 3 * count // 4].max() < _MIN_SETTLED_SHARE * pilot_pressure.max()
    ):
        return ""
    nearest = int((pilot_pressure - needed).argmax())
    return (
        f"the counterbalance valve of chamber {'AB'[side]} of '{valve.joint}' stays closed under "
        f"an open spool: nearest to opening, at t = {recording.time[is_open][nearest]:.4g} s, its "
        f"load pressure is {1e-5 * load_pressure[nearest]:.4g} bar, for which it needs a pilot "
        f"pressure of {1e-5 * needed[nearest]:.4g} bar and has "
        f"{1e-5 * pilot_pressure[nearest]:.4g} bar: raise 'pilot_ratio' or the supply pressure, "
        "or lower 'pressure'"
    )
