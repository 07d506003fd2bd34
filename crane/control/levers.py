"""Valve signals of an operator: by levers, or by the velocity of the tip."""

import threading
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from crane.codegen import Scalar
from crane.common.errors import ClosureError, InputError, SimulationError, check_name
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array, as_sample
from crane.control.control_law import ControllerInputs
from crane.control.valve_commands import (
    SampledCommand,
    ValveCommand,
    ValveSignals,
    lever_signals,
    opening_per_velocity,
    require_circuit,
)
from crane.description.force_elements import as_nonnegative_number
from crane.description.specification import DEFAULT_RAMP_TIME, Phase
from crane.machine.machine import Machine
from crane.motion.kinematics import Kinematics
from crane.motion.trajectory import Trajectory

_SAMPLING_PERIOD = 0.01  # sampling period of the joints [s]


class LeverPhases(ValveCommand, OneLineRepr, threading.local):
    """Valve command by levers that are held until joints reach their positions, phase by phase.

    The joints are sampled every 10 ms. The lever of a joint that has reached its position, in the
    direction of the lever, moves back to neutral; when all joints of a phase have, the next phase
    begins. A lever takes `ramp` from neutral to its end. Signals are linear between samples, so
    that a recording of them gives the same signals again.

    The state is separate in each thread, so that several runs can use the same command.

    The clock counts phases: it is 1.5 when the slowest joint of the second phase has moved half of
    its way. It is delayed by one sample and linear between samples.

    Args:
        machine: The machine.
        phases: The phases in their order.
        ramp: Time from neutral to the end of a lever [s].
        start: Initial active coordinates (n,) [m], [rad]; home if not given.

    Attributes:
        title: Name of the controller in recordings.
        duration: Largest duration of all phases and of the return of the levers [s].
        is_finished: Whether all phases have ended and the levers are in neutral.

    Raises:
        InputError: There are no phases, a joint has no valve, a lever has no position, or it
            cannot reach the position.
    """

    title = "joystick"
    is_open_loop = True
    period = _SAMPLING_PERIOD
    channels = (("phase", ""),)

    def __init__(
        self,
        machine: Machine,
        phases: Sequence[Phase],
        ramp: float = DEFAULT_RAMP_TIME,
        start: Array | None = None,
    ):
        circuit = require_circuit(machine)
        if not phases:
            raise InputError("there are no phases of levers, give one at least")
        self.initial_coordinates = start
        q = machine.home[machine.closure.active] if start is None else start
        start_positions: dict[str, float] = dict(zip(machine.active, q.tolist(), strict=True))
        pairs = zip(machine.lower.tolist(), machine.upper.tolist(), strict=True)
        limits = dict(zip(machine.active, pairs, strict=True))
        for phase in phases:
            for _, _, problem in phase.find_problems(circuit.joints, limits, start_positions):
                raise InputError(problem)
            start_positions |= phase.until
        self._ramp = as_nonnegative_number(ramp, "the ramp of the levers", "s")
        self._phases, self._spools = tuple(phases), tuple(circuit.spools.values())
        self._machine, self._joints = machine, circuit.joints
        self._columns = {x: int(machine.column(x)) for x in circuit.joints}
        self._lever_indices = [self._joints.index(spool.joint) for spool in self._spools]
        # a phase ends at a sample; then the levers return
        final_allowance = (len(phases) + 2) * _SAMPLING_PERIOD + self._ramp
        self.duration = float(
            np.ceil((sum(x.within for x in phases) + final_allowance) / 0.1) * 0.1
        )
        self._reset()

    def _reset(self) -> None:
        self._last_time, self._phase_index, self._phase_start_time = -np.inf, -1, 0.0
        self._phase_start: dict[str, float] = {}  # positions at the begin of the phase
        self._pending_joints: set[str] = set()
        self._levers = np.zeros(len(self._joints))
        # signals and clock at each sample, and at last at the next one
        self._sample_times, self._sample_rows = (
            [0.0],
            [np.append([spool.neutral for spool in self._spools], 0.0)],
        )
        self.is_finished = False

    def update(self, time: float, q: Array, v_a: Array, pressures: Array) -> None:
        """See `ValveCommand`.

        Raises:
            SimulationError: A phase takes too long, or the run goes back in time.
        """
        if not time:
            self._reset()
        if time == self._last_time:
            return  # called again in another chart
        if time < self._last_time:  # a run goes back before it crosses branches
            raise SimulationError(
                f"at t = {time:.6g} s: the linkage comes to where it could go on in "
                "several ways, and levers by positions do not go back: give levers over time"
            )
        positions = {joint: float(q[column]) for joint, column in self._columns.items()}
        if self._phase_index < 0:
            self._begin_phase(0, time, positions)
        self._check_arrivals(time, positions)
        targets = np.zeros(len(self._joints))
        if self._phase_index < len(self._phases):
            levers, pending = self._phases[self._phase_index].levers, self._pending_joints
            targets = np.array([levers[x] if x in pending else 0.0 for x in self._joints])
        max_change = _SAMPLING_PERIOD / self._ramp if self._ramp else np.inf
        self.is_finished = self._phase_index == len(self._phases) and not self._levers.any()
        self._levers = self._levers + np.clip(targets - self._levers, -max_change, max_change)
        pairs = zip(self._spools, self._levers[self._lever_indices], strict=True)
        signals = [float(lever_signals(spool, np.asarray(lever))) for spool, lever in pairs]
        self._last_time = time
        self._sample_times.append(time + _SAMPLING_PERIOD)
        shares = (self._completed_share(x, positions) for x in self._pending_joints)
        # the clock never decreases
        clock = max(self._phase_index + min(shares, default=0.0), float(self._sample_rows[-1][-1]))
        self._sample_rows.append(np.append(signals, clock))

    def _begin_phase(self, index: int, time: float, positions: Mapping[str, float]) -> None:
        self._phase_index, self._phase_start_time, self._phase_start = index, time, dict(positions)
        self._pending_joints = (
            set() if (index == len(self._phases)) else set(self._phases[index].until)
        )

    def _check_arrivals(self, time: float, positions: dict[str, float]) -> None:
        """Find the joints that have reached their positions; start the next phase if all have."""
        while self._phase_index < len(self._phases):
            phase = self._phases[self._phase_index]
            self._pending_joints = {
                joint
                for joint in self._pending_joints
                if phase.levers[joint] * (phase.until[joint] - positions[joint]) > 0
            }
            if self._pending_joints and time - self._phase_start_time > phase.within:
                shares = {x: self._completed_share(x, positions) for x in self._pending_joints}
                joint = min(shares, key=lambda x: shares[x])
                at, unit = positions[joint], self._machine.unit(joint)
                raise SimulationError(
                    f"at t = {time:.6g} s: phase '{phase.name}' has not ended within "
                    f"{phase.within:g} s, '{joint}' is at {at:.4g} {unit} on its way from "
                    f"{self._phase_start[joint]:.4g} to {phase.until[joint]:.4g} {unit}: "
                    + self._remedy_text(phase, positions)
                )
            if self._pending_joints:
                break
            self._begin_phase(self._phase_index + 1, time, positions)

    def _remedy_text(self, phase: Phase, positions: dict[str, float]) -> str:
        """Remedy for a phase that does not end; names a dead centre before the positions."""
        machine = self._machine
        home = dict(zip(machine.active, machine.home[machine.closure.active], strict=True))
        ends = {joint: phase.until[joint] for joint in self._pending_joints}
        try:
            machine.closure.solve(np.array([(home | positions | ends)[x] for x in machine.active]))
        except ClosureError as error:
            return f"a dead centre is in between ({error}), give a position before it"
        return "give it more time or lever, or a position that it reaches"

    def _completed_share(self, joint: str, positions: Mapping[str, float]) -> float:
        """Share of its way in the phase that a joint has moved."""
        start, end = self._phase_start[joint], self._phases[self._phase_index].until[joint]
        return max((positions[joint] - start) / (end - start), 0.0)

    def references(self, times: Array) -> Array:
        """See `ValveCommand`: the signals, then the clock."""
        first = max(bisect_right(self._sample_times, float(times.min())) - 1, 0)
        last = bisect_right(self._sample_times, float(times.max())) + 1
        columns = np.array(self._sample_rows[first:last]).T
        return np.column_stack(
            [np.interp(times, self._sample_times[first:last], x) for x in columns]
        )

    def signals(self, inputs: ControllerInputs) -> Sequence[Scalar]:
        """See `ValveCommand`."""
        return inputs.reference[: len(self._spools)]

    def clock(self, times: Array) -> Array:
        """The phase (N,) at times (N,) [s] up to the next sample."""
        return self.references(times)[:, -1]


_MAX_DURATION = 4000.0  # largest duration of levers [s]: steps of a run in milliseconds


def joystick(
    machine: Machine, points: Mapping[str, Sequence[tuple[float, float]]] | str
) -> ValveSignals | LeverPhases:
    """Valve signals by levers.

    A lever moves both spools of a valve with two spools; JOINT_b names a lever of the second spool
    alone. A task starts at its `start`, and may have phases instead of polygons. The position of a
    lever is a share of the flow of the valve, see `lever_signals`.

    Args:
        machine: The machine.
        points: Polygons of (time [s], lever from -1 to 1) by joint, or the name of a task.

    Raises:
        InputError: Unknown joints or task, levers outside of -1 to 1, or times that do not
            increase.
    """
    circuit = require_circuit(machine)
    last, start = 0.0, None
    if isinstance(points, str):
        tasks = {name: task for name, task in machine.tasks.items() if task.space == "joystick"}
        check_name(points, tasks, f"'{points}' is no task of levers")
        task = tasks[points]
        if task.start:
            start = machine.check_limits(
                [
                    task.start.get(joint, machine.home[machine.column(joint)])
                    for joint in machine.active
                ],
                f"the start of task '{points}'",
            )
        if task.phases:
            return LeverPhases(machine, task.phases, task.ramp, start)
        points, last = task.levers, task.duration
    polygons: dict[str, tuple[Array, Array]] = {}
    for joint, polygon in points.items():
        check_name(joint, circuit.spools, f"no valve for '{joint}'")
        try:
            table = np.array(polygon, dtype=np.float64)
        except (TypeError, ValueError):
            table = np.zeros(0)
        if table.shape[1:] != (2,) or not len(table):
            raise InputError(f"lever of '{joint}': give pairs of time and position")
        if not (np.diff(table[:, 0]) > 0).all() or not (np.abs(table[:, 1]) <= 1).all():
            raise InputError(
                f"lever of '{joint}': give increasing times and positions from -1 to 1"
            )
        polygons[joint] = table[:, 0], table[:, 1]
    # a signal jumps over the dead band where a lever passes zero, so corners alone do not suffice
    last = max([last, *(times[-1] for times, _ in polygons.values())])
    if not 0 < last <= _MAX_DURATION:
        raise InputError(f"the levers end at {last:g} s, give times up to {_MAX_DURATION:g} s")
    times_fine = np.linspace(0.0, last, max(2, round(last / 1e-3) + 1))
    signals = {}
    for name, spool in circuit.spools.items():
        lever = name if name in polygons else spool.joint
        if lever in polygons:
            signals[name] = lever_signals(spool, np.interp(times_fine, *polygons[lever]))
    command = ValveSignals(machine, times_fine, signals)
    command.title, command.initial_coordinates = "joystick", start
    return command


_DEAD_BAND_SMOOTHING = 1e-3  # opening over which the signal crosses the dead band
_LIMIT_MARGIN = 1e-3  # share of the stroke within which a joint is at its limit


class TipVelocity(SampledCommand):
    """Valve command that opens the valves for a velocity of the tip.

    Once per period, with J the reduced Jacobian of the tip and W the squares of the strokes, the
    joint velocities are the least-norm solution

        v_A = W J^T (J W J^T)^+ x',    Q = A |v_A|,    y = Q / (c sqrt(dp)).

    At the inlet, dp is the margin of the compensator, or what the supply leaves of it. At the
    outlet, which sets the speed where the load drives the cylinder, it is the pressure of the
    load. The signals jump over the dead band. The position of the tip is not fed back: the
    operator closes that loop. Joints at their limits are not used, and all velocities are reduced
    where a valve would have to open more than fully.

    Args:
        machine: A machine with a tip.
        velocity: (t) -> (3,) velocity of the tip in the world [m/s], or a trajectory of the tip.
        period: Sampling period [s].

    Raises:
        InputError: No tip, no valves, or a trajectory of joints.
    """

    def __init__(
        self,
        machine: Machine,
        velocity: Callable[[float], ArrayLike] | Trajectory,
        period: float = 0.01,
    ):
        super().__init__(self._valve_signals, machine, period)
        if isinstance(velocity, Trajectory):
            if velocity.tip is None:
                raise InputError("the trajectory is not one of the tip, give one in x, y, z")
            self.reference = velocity
            curve = velocity.tip
            self._tip_velocity: Callable[[float], ArrayLike] = lambda time: curve(time)[1]
        else:
            self._tip_velocity = velocity
        self._machine, self._kinematics = machine, Kinematics(machine)
        self._circuit = require_circuit(machine)
        self._active_indices = [machine.active.index(joint) for joint in self._circuit.joints]
        self._joint_ranges = machine.upper - machine.lower

    def joint_velocities(self, q_a: Array, tip_velocity: Array) -> Array:
        """Active velocities (n,) for a velocity of the tip, by the joints within their limits.

        Args:
            q_a: (n,) active coordinates [m], [rad].
            tip_velocity: (3,) velocity of the tip [m/s].
        """
        jacobian = self._kinematics.jacobian(q_a)
        is_usable = np.zeros(len(q_a), dtype=bool)
        is_usable[self._active_indices] = True
        lower, upper = self._machine.lower, self._machine.upper
        while True:
            weight = np.where(is_usable, self._joint_ranges, 0.0)
            v = weight * (np.linalg.pinv(jacobian * weight, rcond=1e-3) @ tip_velocity)
            margin = _LIMIT_MARGIN * self._joint_ranges
            is_at_limit = is_usable & (
                ((v < 0) & (q_a <= lower + margin)) | ((v > 0) & (q_a >= upper - margin))
            )
            if not is_at_limit.any():
                return v
            is_usable &= ~is_at_limit

    def _valve_signals(self, time: float, q_a: Array, v_a: Array, pressures: Array) -> Array:
        tip_velocity = as_sample(
            self._tip_velocity(time), 3, f"the tip's velocity at t = {time:g} s"
        )
        v = self.joint_velocities(q_a, tip_velocity)[self._active_indices]
        supply = self._circuit.supply
        opening = np.zeros(len(v))
        for i, joint in enumerate(self._circuit.joints):
            valve, cylinder = self._circuit.valves[joint], self._circuit.cylinders[joint]
            a, b = pressures[i]
            force = cylinder.area_a * a - cylinder.area_b * b
            drop = supply.pressure - (a if v[i] > 0 else b)
            opening[i] = v[i] * opening_per_velocity(valve, cylinder, v[i] > 0, force, drop)
        opening /= max(1.0, np.abs(opening).max())
        openings = dict(zip(self._circuit.joints, opening, strict=True))
        spools = self._circuit.spools.values()
        y, overlap, neutral, full = np.array(
            [(openings[x.joint], x.overlap, x.neutral, x.full) for x in spools]
        ).T
        u = y * (1.0 - overlap) + overlap * np.tanh(y / _DEAD_BAND_SMOOTHING)
        return np.asarray(neutral + (full - neutral) * u)
