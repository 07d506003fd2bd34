"""Levers as an operator works them: each is held until its joint is where it shall be."""

import threading
from bisect import bisect_right
from collections.abc import Mapping, Sequence

import numpy as np

from crane.codegen import Scalar
from crane.common.errors import ClosureError, InputError, SimulationError
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array, as_number
from crane.control.control_law import ControllerInputs
from crane.control.valve_commands import ValveCommand, lever_signals, require_circuit
from crane.description.specification import DEFAULT_RAMP_TIME
from crane.description.task_phases import Phase
from crane.machine import Machine

_SAMPLING_PERIOD = 0.01  # [s] between looks at the machine


class LeverPhases(ValveCommand, OneLineRepr, threading.local):
    """Levers that are held until joints have come to their positions, phase by phase.

    Every 10 ms it looks where the joints are. A joint that has come to its position, in the
    direction of its lever, has its lever moved back to neutral; when all of a phase have, the next
    one begins. A hand takes `ramp` from neutral to the end of a lever. Between looks the signals
    go straight, so those of a recording are the same signals again.

    Every thread has its own look at them: what one run has come to is not another's.

    Its clock counts phases: 1.5 when the slowest joint of the second has gone half of its way
    there; it tells this one look late, straight in between.

    Args:
        machine: The machine.
        phases: One after the other.
        ramp: From neutral to a full lever [s].
        initial_coordinates: Active coordinates (n,) to begin at [m], [rad]; home if not given.

    Attributes:
        title: What recordings call it.
        duration: What all phases may take, and the levers to go back [s].
        is_finished: Whether all phases are done and the levers back in neutral.

    Raises:
        InputError: There are none, a joint has no valve, a lever no position, or one that it does
            not reach.
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
        joint_limits = zip(machine.lower.tolist(), machine.upper.tolist(), strict=True)
        limits = dict(zip(machine.active, joint_limits, strict=True))
        for phase in phases:
            for _, _, problem in phase.find_problems(circuit.joints, limits, start_positions):
                raise InputError(problem)
            start_positions |= phase.until
        self._ramp = as_number(ramp, "the ramp of the levers", "s")
        if self._ramp < 0:
            raise InputError(f"the ramp of the levers is {ramp:g} s, give at least 0")
        self._phases, self._spools = tuple(phases), tuple(circuit.spools.values())
        self._columns = {x: int(machine.column(x)) for x in circuit.joints}
        self._joints = circuit.joints
        self._closure = machine.closure
        self._home_positions = dict(
            zip(machine.active, machine.home[machine.closure.active], strict=True)
        )
        self._units = {x: machine.unit(x) for x in circuit.joints}
        self._lever_indices = [self._joints.index(spool.joint) for spool in self._spools]
        # what may be left of a phase as it ends, and the way of the levers back
        final_allowance = (len(phases) + 2) * _SAMPLING_PERIOD + self._ramp
        self.duration = float(
            np.ceil((sum(x.within for x in phases) + final_allowance) / 0.1) * 0.1
        )
        self._reset()

    def _reset(self) -> None:
        self._last_time, self._phase_index, self._phase_start_time = -np.inf, -1, 0.0
        self._phase_start: dict[str, float] = {}  # where joints were as the phase began
        self._pending_joints: set[str] = set()
        self._levers = np.zeros(len(self._joints))
        neutral = np.append([spool.neutral for spool in self._spools], 0.0)
        # signals and clock at every look, at last those of the next one
        self._sample_times, self._sample_rows = [0.0], [neutral]
        self.is_finished = False

    def update(self, time: float, q: Array, v_a: Array, pressures: Array) -> None:
        """See `ValveCommand`.

        Raises:
            SimulationError: A phase takes longer than it may, or the run goes back in time.
        """
        if not time:
            self._reset()
        elif time == self._last_time:
            return  # asked again, in other coordinates
        elif time < self._last_time:  # where branches of motion cross, a run looks back
            raise SimulationError(
                f"at t = {time:.6g} s: the linkage comes to where it could go on in "
                "several ways, and levers by positions do not go back: give levers over time"
            )
        positions = {joint: float(q[column]) for joint, column in self._columns.items()}
        if self._phase_index < 0:
            self._begin_phase(0, time, positions)
        self._check_arrivals(time, positions)
        targets = self._lever_targets()
        max_change = _SAMPLING_PERIOD / self._ramp if self._ramp else np.inf
        self.is_finished = self._phase_index == len(self._phases) and not self._levers.any()
        self._levers = self._levers + np.clip(targets - self._levers, -max_change, max_change)
        pairs = zip(self._spools, self._levers[self._lever_indices], strict=True)
        signals = [float(lever_signals(spool, np.asarray(lever))) for spool, lever in pairs]
        self._last_time = time
        self._sample_times.append(time + _SAMPLING_PERIOD)
        self._sample_rows.append(np.append(signals, self._phase_clock(positions)))

    def _begin_phase(self, index: int, time: float, positions: Mapping[str, float]) -> None:
        """Begin a phase."""
        self._phase_index, self._phase_start_time, self._phase_start = index, time, dict(positions)
        is_done = index == len(self._phases)
        self._pending_joints = set() if is_done else set(self._phases[index].until)

    def _check_arrivals(self, time: float, positions: Mapping[str, float]) -> None:
        """See which joints have arrived, and begin the next phase when all have."""
        while self._phase_index < len(self._phases):
            phase = self._phases[self._phase_index]
            self._pending_joints = {
                joint
                for joint in self._pending_joints
                if phase.levers[joint] * (phase.until[joint] - positions[joint]) > 0
            }
            if self._pending_joints:
                break
            self._begin_phase(self._phase_index + 1, time, positions)
        else:
            return
        if time - self._phase_start_time > phase.within:
            joint = min(self._pending_joints, key=lambda x: self._completed_share(x, positions))
            unit = self._units[joint]
            raise SimulationError(
                f"at t = {time:.6g} s: phase '{phase.name}' has not ended within "
                f"{phase.within:g} s, '{joint}' is at {positions[joint]:.4g} {unit} on its way "
                f"from "
                f"{self._phase_start[joint]:.4g} to {phase.until[joint]:.4g} {unit}: "
                + self._remedy_text(phase, positions)
            )

    def _remedy_text(self, phase: Phase, positions: Mapping[str, float]) -> str:
        """What to do about a phase that does not end; a dead centre on the way is named."""
        end = {joint: phase.until[joint] for joint in self._pending_joints}
        q_a = np.array(
            [{**positions, **end}.get(joint, at) for joint, at in self._home_positions.items()]
        )
        try:
            self._closure.solve(q_a)
        except ClosureError as error:
            return f"a dead centre is in between ({error}), give a position before it"
        return "give it more time or lever, or a position that it reaches"

    def _lever_targets(self) -> Array:
        """Where the hand wants the levers (m,)."""
        if self._phase_index == len(self._phases):
            return np.zeros(len(self._joints))
        levers = self._phases[self._phase_index].levers
        return np.array([levers[x] if x in self._pending_joints else 0.0 for x in self._joints])

    def _completed_share(self, joint: str, positions: Mapping[str, float]) -> float:
        """How much of its way in the phase a joint has gone that has not arrived."""
        initial_coordinates, end = (
            self._phase_start[joint],
            self._phases[self._phase_index].until[joint],
        )
        return max((positions[joint] - initial_coordinates) / (end - initial_coordinates), 0.0)

    def _phase_clock(self, positions: Mapping[str, float]) -> float:
        """The clock, which does not go back."""
        share = min(
            (self._completed_share(x, positions) for x in self._pending_joints), default=0.0
        )
        return max(self._phase_index + share, float(self._sample_rows[-1][-1]))

    def references(self, times: Array) -> Array:
        """See `ValveCommand`: signals, and the clock."""
        first = max(bisect_right(self._sample_times, float(times.min())) - 1, 0)
        last = bisect_right(self._sample_times, float(times.max())) + 1
        sample_times, rows = (
            self._sample_times[first:last],
            np.array(self._sample_rows[first:last]),
        )
        return np.column_stack([np.interp(times, sample_times, column) for column in rows.T])

    def signals(self, inputs: ControllerInputs) -> Sequence[Scalar]:
        """See `ValveCommand`."""
        return inputs.reference[: len(self._spools)]

    def clock(self, times: Array) -> Array:
        """The phase (N,) at times (N,) [s] until the next look."""
        return self.references(times)[:, -1]
