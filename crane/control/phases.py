"""Levers as an operator works them: each is held until its joint is where it shall be."""

import threading
from bisect import bisect_right
from collections.abc import Mapping, Sequence

import numpy as np

from crane.codegen import Number
from crane.common.errors import ClosureError, InputError, SimulationError
from crane.common.samples import Array, as_number
from crane.common.shown import Brief
from crane.control.base import At
from crane.control.valves import Command, circuit_of, signal_of
from crane.description.phases import Phase
from crane.description.spec import RAMP
from crane.machine import Machine

_PERIOD = 0.01  # [s] between looks at the machine


class Phases(Command, Brief, threading.local):
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
        start: Active coordinates (n,) to begin at [m], [rad]; home if not given.

    Attributes:
        title: What recordings call it.
        duration: What all phases may take, and the levers to go back [s].
        ended: Whether all phases are done and the levers back in neutral.

    Raises:
        InputError: There are none, a joint has no valve, a lever no position, or one that it does
            not reach.
    """

    title = "joystick"
    given = True
    period = _PERIOD
    channels = (("phase", ""),)

    def __init__(
        self,
        machine: Machine,
        phases: Sequence[Phase],
        ramp: float = RAMP,
        start: Array | None = None,
    ):
        circuit = circuit_of(machine)
        if not phases:
            raise InputError("there are no phases of levers, give one at least")
        self.start = start
        q = machine.home[machine.closure.active] if start is None else start
        before: dict[str, float] = dict(zip(machine.active, q.tolist(), strict=True))
        ends = zip(machine.lower.tolist(), machine.upper.tolist(), strict=True)
        limits = dict(zip(machine.active, ends, strict=True))
        for phase in phases:
            for _, _, problem in phase.problems(circuit.joints, limits, before):
                raise InputError(problem)
            before |= phase.until
        self._ramp = as_number(ramp, "the ramp of the levers", "s")
        if self._ramp < 0:
            raise InputError(f"the ramp of the levers is {ramp:g} s, give at least 0")
        self._phases, self._spools = tuple(phases), tuple(circuit.spools.values())
        self._columns = {x: int(machine.column(x)) for x in circuit.joints}
        self._joints = circuit.joints
        self._closure = machine.closure
        self._home = dict(zip(machine.active, machine.home[machine.closure.active], strict=True))
        self._units = {x: machine.unit(x) for x in circuit.joints}
        self._which = [self._joints.index(spool.joint) for spool in self._spools]
        # what may be left of a phase as it ends, and the way of the levers back
        late = (len(phases) + 2) * _PERIOD + self._ramp
        self.duration = float(np.ceil((sum(x.within for x in phases) + late) / 0.1) * 0.1)
        self._reset()

    def _reset(self) -> None:
        self._time, self._index, self._since = -np.inf, -1, 0.0
        self._from: dict[str, float] = {}  # where joints were as the phase began
        self._waiting: set[str] = set()
        self._levers = np.zeros(len(self._joints))
        neutral = np.append([spool.neutral for spool in self._spools], 0.0)
        # signals and clock at every look, at last those of the next one
        self._looks, self._rows = [0.0], [neutral]
        self.ended = False

    def update(self, time: float, q: Array, v_a: Array, pressures: Array) -> None:
        """See `Command`.

        Raises:
            SimulationError: A phase takes longer than it may, or the run goes back in time.
        """
        if not time:
            self._reset()
        elif time == self._time:
            return  # asked again, in other coordinates
        elif time < self._time:  # where branches of motion cross, a run looks back
            raise SimulationError(
                f"at t = {time:.6g} s: the linkage comes to where it could go on in "
                "several ways, and levers by positions do not go back: give levers over time"
            )
        now = {joint: float(q[column]) for joint, column in self._columns.items()}
        if self._index < 0:
            self._enter(0, time, now)
        self._look(time, now)
        targets = self._targets()
        most = _PERIOD / self._ramp if self._ramp else np.inf
        self.ended = self._index == len(self._phases) and not self._levers.any()
        self._levers = self._levers + np.clip(targets - self._levers, -most, most)
        pairs = zip(self._spools, self._levers[self._which], strict=True)
        signals = [float(signal_of(spool, np.asarray(lever))) for spool, lever in pairs]
        self._time = time
        self._looks.append(time + _PERIOD)
        self._rows.append(np.append(signals, self._progress(now)))

    def _enter(self, index: int, time: float, now: Mapping[str, float]) -> None:
        """Begin a phase."""
        self._index, self._since, self._from = index, time, dict(now)
        done = index == len(self._phases)
        self._waiting = set() if done else set(self._phases[index].until)

    def _look(self, time: float, now: Mapping[str, float]) -> None:
        """See which joints have arrived, and begin the next phase when all have."""
        while self._index < len(self._phases):
            phase = self._phases[self._index]
            self._waiting = {
                joint
                for joint in self._waiting
                if phase.levers[joint] * (phase.until[joint] - now[joint]) > 0
            }
            if self._waiting:
                break
            self._enter(self._index + 1, time, now)
        else:
            return
        if time - self._since > phase.within:
            joint = min(self._waiting, key=lambda x: self._share(x, now))
            unit = self._units[joint]
            raise SimulationError(
                f"at t = {time:.6g} s: phase '{phase.name}' has not ended within "
                f"{phase.within:g} s, '{joint}' is at {now[joint]:.4g} {unit} on its way from "
                f"{self._from[joint]:.4g} to {phase.until[joint]:.4g} {unit}: "
                + self._remedy(phase, now)
            )

    def _remedy(self, phase: Phase, now: Mapping[str, float]) -> str:
        """What to do about a phase that does not end; a dead centre on the way is named."""
        end = {joint: phase.until[joint] for joint in self._waiting}
        q_a = np.array([{**now, **end}.get(joint, at) for joint, at in self._home.items()])
        try:
            self._closure.solve(q_a)
        except ClosureError as error:
            return f"a dead centre is in between ({error}), give a position before it"
        return "give it more time or lever, or a position that it reaches"

    def _targets(self) -> Array:
        """Where the hand wants the levers (m,)."""
        if self._index == len(self._phases):
            return np.zeros(len(self._joints))
        levers = self._phases[self._index].levers
        return np.array([levers[x] if x in self._waiting else 0.0 for x in self._joints])

    def _share(self, joint: str, now: Mapping[str, float]) -> float:
        """How much of its way in the phase a joint has gone that has not arrived."""
        start, end = self._from[joint], self._phases[self._index].until[joint]
        return max((now[joint] - start) / (end - start), 0.0)

    def _progress(self, now: Mapping[str, float]) -> float:
        """The clock, which does not go back."""
        share = min((self._share(x, now) for x in self._waiting), default=0.0)
        return max(self._index + share, float(self._rows[-1][-1]))

    def references(self, times: Array) -> Array:
        """See `Command`: signals, and the clock."""
        first = max(bisect_right(self._looks, float(times.min())) - 1, 0)
        last = bisect_right(self._looks, float(times.max())) + 1
        looks, rows = self._looks[first:last], np.array(self._rows[first:last])
        return np.column_stack([np.interp(times, looks, column) for column in rows.T])

    def signals(self, at: At) -> Sequence[Number]:
        """See `Command`."""
        return at.reference[: len(self._spools)]

    def clock(self, times: Array) -> Array:
        """The phase (N,) at times (N,) [s] until the next look."""
        return self.references(times)[:, -1]
