"""What is to be said of a run: limits passed, energy lost or gained, friction that chatters."""

import numpy as np

from crane.codegen import Parts
from crane.common.samples import FARTHEST, Array
from crane.common.scratch import release
from crane.description.ground import Contact
from crane.dynamics.frames import FrameJacobians
from crane.dynamics.joint_forces import JointForces
from crane.machine import Machine
from crane.motion.limits import limit_slack

_BURIED = 3.0  # weights of the machine, with which a contact may press at the start
_SHOWN = 3  # joints beyond their limits that are named
_IMBALANCE = 5e-3  # share of the energy that went through
_STROKE = 5e-3  # share of a cylinder's stroke, of which no steel gives way
_GAIN = 0.05  # share of what a stop held at most
_SLOW = 3.0  # smoothing velocities, below which friction turns
_OFF = 0.2  # of what is taken out over a step
_FEW, _RARE = 3, 1e-3  # samples that may, of all
_BLOCK = 20000  # samples looked at at once


def said(
    machine: Machine, time: Array, rows: Parts, step: float, fixed: bool, exact: bool = True
) -> list[str]:
    """What to say of a run.

    The energies are integrated with the motion, so they tell when the step is too long.

    Args:
        machine: The machine.
        time: (N,) [s].
        rows: See `integrate`.
        step: [s].
        fixed: Whether the method's steps are these, whatever their error.
        exact: Whether the formulation keeps its energy.

    """
    every = (
        limits_passed(machine, time, rows.q),
        strokes_passed(machine, time, rows.q),
        chatter(machine, time, rows, step) if fixed else "",
        imbalance(rows, step, _gap(rows)) if exact else "",
    )
    return [text for text in every if text]


def fault(
    machine: Machine, time: Array, rows: Parts, step: float, exact: bool = True
) -> tuple[int, str] | None:
    """From which instant on a run is no motion of the machine, and why; None if it is one.

    A piston has left its cylinder, or an end stop has given back more energy than it took.
    Arguments as those of `said`.
    """
    left = cylinders_left(machine, time, rows.q)
    return left or (stop_gains(machine, time, rows, step, _gap(rows)) if exact else None)


def limits_passed(machine: Machine, time: Array, q: Array) -> str:
    """What to say of joints that went beyond limits where nothing stops them, else nothing.

    Args:
        machine: The machine.
        time: (N,) [s].
        q: (N, nv) the motion.
    """
    lower, upper = machine.coordinates.lower, machine.coordinates.upper

    def beyond(i: int) -> Array:
        release()
        return np.asarray(np.maximum(lower[i] - q[:, i], q[:, i] - upper[i]))

    farthest = np.array([beyond(i).max() for i in range(len(lower))])
    stopped = {stop.joint for stop in machine.end_stops}
    slack = limit_slack(machine)
    passed = [i for i in np.flatnonzero(farthest > slack) if machine.joints[i] not in stopped]
    if not passed:
        return ""
    units = machine.closure.units
    passed.sort(key=lambda i: -farthest[i] / min(upper[i] - lower[i], FARTHEST * units[i]))
    words = []
    for i in passed[:_SHOWN]:
        joint, first = machine.joints[i], int(np.argmax(beyond(int(i)) > slack[i]))
        limit = lower[i] if q[first, i] < lower[i] else upper[i]
        unit = machine.unit(joint)
        words.append(
            f"'{joint}' passes its limit {limit:.4g} {unit} at t = {time[first]:.4g} s, by up to "
            f"{farthest[i]:.3g} {unit}"
        )
    more = f" and {len(passed) - _SHOWN} more joints" if len(passed) > _SHOWN else ""
    one = len(passed) == 1
    return (
        f"{', '.join(words)}{more}: nothing stops {'it' if one else 'them'} there, give "
        f"{'it an end stop' if one else 'them end stops'}"
    )


def strokes_passed(machine: Machine, time: Array, q: Array) -> str:
    """What to say of cylinders whose stops give way as no steel does, else nothing.

    Arguments as those of `limits_passed`.
    """
    cylinders = machine.hydraulics.cylinders if machine.hydraulics is not None else {}
    stopped = {stop.joint for stop in machine.end_stops}
    words = []
    for joint in cylinders:
        release()
        i = machine.column(joint)
        lower, upper = machine.coordinates.lower[i], machine.coordinates.upper[i]
        depth = np.maximum(lower - q[:, i], q[:, i] - upper)
        deepest, most = int(depth.argmax()), _STROKE * (upper - lower)
        if joint in stopped and depth[deepest] > most:
            words.append(
                f"the piston of '{joint}' is {depth[deepest]:.3g} m beyond its stroke at "
                f"t = {time[deepest]:.4g} s"
            )
    if not words:
        return ""
    return f"{', '.join(words)}: make end stops as stiff as steel is, or move slower"


def cylinders_left(machine: Machine, time: Array, q: Array) -> tuple[int, str] | None:
    """When a piston is beyond all room of its chambers, hoses among it, and what to say of it.

    Arguments as those of `limits_passed`.
    """
    cylinders = machine.hydraulics.cylinders if machine.hydraulics is not None else {}
    for joint, cylinder in cylinders.items():
        if cylinder.motor:
            continue
        release()
        i = machine.column(joint)
        lower, upper = machine.coordinates.lower[i], machine.coordinates.upper[i]
        least, most = (
            lower - cylinder.hose_a / cylinder.area_a,
            upper + cylinder.hose_b / cylinder.area_b,
        )
        if (out := (q[:, i] <= least) | (q[:, i] >= most)).any():
            first = int(np.argmax(out))
            chamber = "A" if q[first, i] <= least else "B"
            return first, (
                f"at t = {time[first]:.4g} s the piston of '{joint}' has left its cylinder, whose "
                f"chamber {chamber} has no room: give '{joint}' an end stop (end_stops)"
            )
    return None


def buried(machine: Machine, q: Array) -> str:
    """What to say of a contact deep in the ground at a posture (nq,), else nothing."""
    contacts = [force for force in machine.external if isinstance(force, Contact)]
    if not contacts:
        return ""
    weight = 9.81 * sum(inertia.mass for inertia in machine.model.inertias)
    frames = FrameJacobians(machine)
    frames.place(q)
    for contact in contacts:
        above = float(contact.ground.over(frames.pose(contact.frame).translation.tolist())[0])  # type: ignore[arg-type]
        depth = contact.radius - above
        if contact.stiffness * depth > _BURIED * weight:
            return (
                f"'{contact.name}' is {depth:.3g} m inside the ground, where its whole weight "
                f"presses it in by {weight / contact.stiffness:.2g} m: start higher"
            )
    return ""


def _gap(rows: Parts) -> Array:
    """(N,) work less change of energy less dissipation [J]: what a run has lost by its steps."""
    stored = rows.kinetic[:, 0] + rows.potential[:, 0]
    gap: Array = rows.work.sum(axis=1) - rows.lost[:, 0] - stored + stored[0]
    return gap


def _throughput(rows: Parts) -> float:
    """The energy that went through [J]."""
    parts = rows.work, rows.lost, rows.kinetic, rows.potential
    return float(max(np.ptp(part) for part in parts))


def stop_gains(
    machine: Machine, time: Array, rows: Parts, step: float, gap: Array
) -> tuple[int, str] | None:
    """When a stop was met that gave back more energy than it took, and what to say of it."""
    least = _IMBALANCE * _throughput(rows)
    if not np.ptp(gap) > least:
        return None
    for stop in machine.end_stops:
        i = machine.column(stop.joint)
        lower, upper = machine.coordinates.lower[i], machine.coordinates.upper[i]
        depth = np.maximum(lower - rows.q[:, i], rows.q[:, i] - upper)
        edges = np.flatnonzero(np.diff((depth > 0).astype(np.int8), prepend=0, append=0))
        for first, behind in edges.reshape(-1, 2).tolist():
            before, after = max(first - 1, 0), min(behind, len(gap) - 1)
            held = 0.5 * stop.stiffness * float(depth[first:behind].max()) ** 2
            gained = float(gap[before] - gap[after])
            if gained > max(_GAIN * held, least):
                return first, (
                    f"at t = {time[first]:.4g} s the end stop of '{stop.joint}' gives back "
                    f"{gained:.2g} J more than it takes, so the step of {step:g} s is too long "
                    "for it: shorten it, or let method DOP853 choose it"
                )
    return None


def chatter(machine: Machine, time: Array, rows: Parts, step: float) -> str:
    """What to say of smoothed friction that steps did not follow, else nothing.

    Where a step of a fixed length is too long for a slope that turns within it, friction changes
    its sign from stage to stage: what it took out over the step is not what its power at both
    ends says.
    """
    laws = machine.friction.items()
    smoothings = {machine.column(x): f.smoothing for x, f in laws if f.smoothing and f.breakaway}
    columns = list(smoothings)
    if not columns:
        return ""
    lost = rows.lost[:, 0]
    taken, least = np.diff(lost), 1e-6 * float(np.diff(lost).max())
    friction = np.einsum("ni,ni->n", rows.friction, rows.v_a)
    suspects = np.flatnonzero(_differ(taken, _mean(friction) * step, least))
    forces, slow = JointForces(machine), _SLOW * np.array(list(smoothings.values()))
    count, names, first = 0, set(), len(time)
    for start in range(0, len(suspects), _BLOCK):  # with dampers and stops, and where they turn
        here = suspects[start : start + _BLOCK]
        power, turning = np.zeros((2, len(here))), np.zeros((len(here), len(columns)), dtype=bool)
        for end, at in enumerate((here, here + 1)):
            q = rows.q[at]
            v = np.einsum("nij,nj->ni", machine.closure.gamma(q), rows.v_a[at])
            braking = forces.passive(q, 0.0 * v) - forces.passive(q, v)
            power[end] = friction[at] + np.einsum("ni,ni->n", v, braking)
            turning |= np.abs(v[:, columns]) < slow
        wrong = _differ(taken[here], 0.5 * step * power.sum(axis=0), least)
        wrong &= turning.any(axis=1)
        if wrong.any():
            count += int(wrong.sum())
            first = min(first, int(here[wrong.argmax()]))
            names |= {columns[i] for i in np.flatnonzero(turning[wrong].any(axis=0))}
    if count <= max(_FEW, _RARE * len(time)):
        return ""
    joints = [f"'{machine.joints[i]}'" for i in sorted(names)]
    more = f" and {len(joints) - _SHOWN} more joints" if len(joints) > _SHOWN else ""
    return (
        f"friction of {', '.join(joints[:_SHOWN])}{more} chatters in {count} of {len(time)} "
        f"samples, first at t = {time[first]:.4g} s: steps of {step:g} s do not follow its "
        "smoothing, leave that out, so that it sticks, or shorten the step"
    )


def _mean(values: Array) -> Array:
    """(N - 1,) of each two neighbours."""
    return 0.5 * (values[1:] + values[:-1])


def _differ(one: Array, other: Array, least: float) -> np.ndarray:
    """Where energies (N,) [J] are not the same."""
    gap = np.abs(one - other)
    return (gap > _OFF * np.maximum(np.abs(one), np.abs(other))) & (gap > least)


def imbalance(rows: Parts, step: float, gaps: Array) -> str:
    """What to say if a simulation does not keep its energy, else nothing."""
    gap = float(np.abs(gaps).max())
    throughput = _throughput(rows)
    rounding = 1e-12 * float(max(np.abs(rows.kinetic).max(), np.abs(rows.potential).max()))
    if gap <= _IMBALANCE * throughput + rounding:
        return ""
    return (
        f"work, energy and dissipation differ by {gap:.2g} J of {throughput:.2g} J, so the "
        f"step of {step:g} s is too long: shorten it, or let method DOP853 choose it"
    )
