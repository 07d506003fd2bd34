"""Signals of valves: from a controller, a joystick, or a recording."""

import threading
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from crane.codegen import Number
from crane.codegen.scalar import apply
from crane.common.errors import InputError, known
from crane.common.magnitudes import meant
from crane.common.samples import Array, as_number, as_sample
from crane.common.shown import Brief
from crane.control.base import At
from crane.hydraulics import Hydraulics, PDGains, Valve
from crane.hydraulics.components import Spool
from crane.machine import Machine
from crane.motion.curves import Trajectory
from crane.motion.trajectories import with_free

_LOGGED = 0.02  # [s] between samples of a log, at most
_STRAIGHT = 1e-12  # of a signal, that slopes differ by over its shortest step where it goes on
_SAME = 1e-9  # of a period, between instants that are one
_JUMP = 0.01  # of the spool's stroke, over which the feedforward jumps the dead band


@runtime_checkable
class Command(Protocol):
    """Where the signals of m spools come from, one per valve and one more per second spool.

    What is written here is what those have that say nothing else. A valve with dead time gets the
    signal of an earlier instant: `ValveDrive` asks for it.

    Attributes:
        reference: The reference motion, or None.
        start: (n,) active coordinates that it begins at, None for home or the reference's start.
        measured: Whether the last two references are the pressures of supply and tank.
        settings: (s,) its numbers.
        period: Time between calls of `update` [s]; 0 if it wants none.
        given: Whether the first m references are the signals, whatever the machine does, and those
            of instants that have passed are remembered.
        duration: How long it takes, at most [s]; 0 where it does not know.
        ended: Whether it has no more to do: a run that was given no duration ends then.
        channels: Names and units of what its references have behind the signals, to be recorded.
        clock: Tells its phase (N,) at times (N,) [s]; None where it has none.
    """

    reference: Trajectory | None = None
    start: Array | None = None
    measured: bool = False
    settings: Array = np.zeros(0)
    period: float = 0.0
    given: bool = False
    duration: float = 0.0
    ended: bool = False
    channels: tuple[tuple[str, str], ...] = ()
    clock: Callable[[Array], Array] | None = None

    def update(self, time: float, q: Array, v_a: Array, pressures: Array) -> None:
        """Think about the next period, given (nq,), (n,), (m, 2) [Pa]."""
        return

    def references(self, times: Array) -> Array:
        """All that depends on time alone, (N, c) at times (N,) [s]; nothing yet."""
        return np.zeros((len(times), 0))

    def signals(self, at: At) -> Sequence[Number]:
        """Signals (m,) [V], from floats or as formulas; what it sees are its own settings."""
        raise NotImplementedError


def circuit_of(machine: Machine) -> Hydraulics:
    """The circuit of a machine.

    Raises:
        InputError: It has none.
    """
    if machine.hydraulics is None:
        raise InputError(
            f"machine '{machine.name}' has no valves, describe its circuit under 'hydraulics' of "
            "the machine file"
        )
    return machine.hydraulics


def signal_of(spool: Valve | Spool, lever: Array) -> Array:
    """Signals of a spool (.,) [V] for a lever (.,) from -1 to 1, a share of its valve's flow.

    Beyond zero it jumps over the dead band, as the electronics of such machines do.
    """
    u = lever * (1.0 - spool.dead_band) + spool.dead_band * np.sign(lever)
    return np.asarray(spool.neutral + (spool.full - spool.neutral) * u)


class Signals(Command, Brief):
    """Signals given in time, straight between the instants and constant beyond them.

    Args:
        machine: The machine.
        time: Instants (N,) [s], increasing.
        signals: [V] (N,) by joint, and by JOINT_b of second spools, which get that of the first
            one if they are not named; valves that are not named stay neutral.
        supply: Measured pressure of the supply (N,) [Pa], if it is to be used.
        tank: Measured pressure of the tank (N,) [Pa]; that of the machine file if not given.

    Attributes:
        title: What they come from, in words; recordings name their controller by it.
        duration: From zero to the last instant [s].

    Raises:
        InputError: Unknown joints, wrong lengths, or times that do not increase.
    """

    title = "given valve signals"
    given = True

    def __init__(
        self,
        machine: Machine,
        time: ArrayLike,
        signals: Mapping[str, ArrayLike],
        supply: ArrayLike | None = None,
        tank: ArrayLike | None = None,
    ):
        circuit = circuit_of(machine)
        shape = np.shape(time)
        if len(shape) != 1 or not shape[0]:
            raise InputError(f"time has the shape {shape}, give (N,) instants")
        self._time = as_sample(time, shape[0], "time of the signals").copy()
        if not (np.diff(self._time) > 0).all():
            raise InputError("time of the signals does not increase, sort it")
        if not isinstance(signals, Mapping):
            example = next(iter(circuit.spools))
            raise InputError(
                f"signals are a {type(signals).__name__}, give those of each valve by its joint, "
                f"as {{'{example}': [...]}}"
            )
        for name in signals:
            if name not in circuit.spools:
                raise InputError(f"no valve for '{name}', {known(circuit.spools, name)}")
        columns = []
        for name, spool in circuit.spools.items():
            by = name if name in signals else spool.joint
            columns.append(
                self._column(signals[by], f"signal of '{by}'")
                if by in signals
                else np.full(len(self._time), spool.neutral)
            )
        self.measured = supply is not None or tank is not None
        if self.measured:
            for given, usual, what in (
                (supply, circuit.supply.pressure, "supply"),
                (tank, circuit.supply.tank, "tank"),
            ):
                full = np.full(len(self._time), usual) if given is None else given
                columns.append(self._column(full, f"pressure of the {what}"))
                if columns[-1].min() < 0:
                    raise InputError(
                        f"pressure of the {what} is {columns[-1].min():g} Pa, it counts from a "
                        "vacuum and cannot be negative: add 1e5 to gauge pressures"
                    )
            highest = float(columns[-2].max())
            if 0 < highest < columns[-1].min() / 2:  # also of a pump that rests the line has more
                raise InputError(
                    f"pressure of the supply is {highest:g} Pa at most, far below the tank's"
                    + (meant("pressure", highest) or ", give it in Pa from a vacuum")
                )
        self._values = np.asfortranarray(np.column_stack(columns))  # read column by column
        self._count = len(circuit.spools)
        self.duration = float(self._time[-1])

    def _column(self, values: ArrayLike, what: str) -> Array:
        return as_sample(values, len(self._time), what)

    def breaks(self) -> Array:
        """Times (k,) [s] at which signals turn; none of a log, whose samples are close."""
        if len(self._time) > 1 and self.duration - self._time[0] < _LOGGED * len(self._time):
            return np.zeros(0)
        return self._time

    def corners(self, i: int) -> Array:
        """Times (k,) [s] at which the signal of a spool turns."""
        time, values = self._time, self._values[:, i]
        if len(time) < 2:
            return time
        slopes = np.concatenate([[0.0], np.diff(values) / np.diff(time), [0.0]])
        least = _STRAIGHT * np.abs(values).max() / np.diff(time).min()
        found: Array = time[np.abs(np.diff(slopes)) > least]
        return found

    def references(self, times: Array) -> Array:
        """See `Command`."""
        return np.column_stack([np.interp(times, self._time, x) for x in self._values.T])

    def signals(self, at: At) -> Sequence[Number]:
        """See `Command`."""
        return at.reference[: self._count]


class ValvePD(Command, Brief):
    """One PD controller per spool, equation (37) of the electro-hydraulic forwarder paper.

    u = K_p (q_ref - q) + K_d (q_ref' - q') + F_f, with the feedforward F_f that jumps over the
    dead band d: F_f = d tanh(w / 0.01), w the sum of the other terms. q are the active joints'
    own coordinates.

    Args:
        machine: The machine.
        reference: Reference of the active joints.
        gains: By joint; those of the machine file if not given.

    Raises:
        InputError: No valves, or no gains for one.
    """

    def __init__(
        self, machine: Machine, reference: Trajectory, gains: Mapping[str, PDGains] | None = None
    ):
        circuit = circuit_of(machine)
        gains = circuit.control if gains is None else gains
        for joint in circuit.joints:
            if joint not in gains:
                raise InputError(
                    f"no gains for the valve of '{joint}' of '{machine.name}', give kp and kd "
                    "under 'control' of its 'hydraulics'"
                )
        self.reference: Trajectory = with_free(machine, reference)
        spools = circuit.spools.values()
        self._which = [machine.active.index(spool.joint) for spool in spools]
        numbers = [
            [gains[spool.joint].kp for spool in spools],
            [gains[spool.joint].kd for spool in spools],
            [spool.dead_band for spool in spools],
            [spool.neutral for spool in spools],
            [spool.full - spool.neutral for spool in spools],
        ]
        self.settings = np.array(numbers, dtype=np.float64).ravel()

    def references(self, times: Array) -> Array:
        """See `Command`."""
        q, v = self.reference.position(times), self.reference.velocity(times)
        return np.hstack([q[:, self._which], v[:, self._which]])

    def signals(self, at: At) -> Sequence[Number]:
        """See `Command`."""
        m = len(self._which)
        kp, kd, dead, neutral, span = (at.settings[i * m : (i + 1) * m] for i in range(5))
        out: list[Number] = []
        for i, joint in enumerate(self._which):
            wanted = kp[i] * (at.reference[i] - at.q_a[joint])
            wanted = wanted + kd[i] * (at.reference[m + i] - at.v_a[joint])
            jump = dead[i] * apply("tanh", wanted * (1.0 / _JUMP))
            out.append(neutral[i] + span[i] * (wanted + jump))
        return out


class _Held(threading.local):
    """Signals (s,) that the valves keep until they are set again, in every thread its own.

    Attributes:
        signals: All of them.
        since: When each of them was set [s].
    """

    def __init__(self, signals: Array):
        self.signals, self.since = [signals], [0.0]


class Sampled(Command, Brief):
    """A program of the user that sets the valves once per period, as a control unit does.

    Args:
        function: (t, q_a, v_a, pressures) -> signals, in the order of `machine.hydraulics.spools`,
            which are its joints where no valve has two; t [s], q_a and v_a (n,), pressures (m, 2)
            of A and B by joint [Pa], signals (s,) [V].
        machine: The machine.
        period: [s], a whole number of steps of the simulation.
    """

    given = True

    def __init__(
        self,
        function: Callable[[float, Array, Array, Array], ArrayLike],
        machine: Machine,
        period: float = 0.01,
    ):
        if not callable(function):
            raise InputError(f"{function!r} is no function (t, q_a, v_a, pressures) -> signals")
        self._function = function
        circuit = circuit_of(machine)
        self._spools = tuple(circuit.spools)
        self._active = machine.closure.active
        self.period = as_number(period, "the period", "s", above=0)
        neutral = np.array([spool.neutral for spool in circuit.spools.values()])
        self._held = _Held(neutral)  # by a run, which is one thread's

    def update(self, time: float, q: Array, v_a: Array, pressures: Array) -> None:
        """See `Command`."""
        answer = self._function(time, q[self._active].copy(), v_a.copy(), pressures)
        what = f"the signals at t = {time:g} s"
        held = self._held
        kept = bisect_left(held.since, time - _SAME * self.period)  # what is later is of before
        held.since[kept:] = [time]
        held.signals[kept:] = [as_sample(answer, len(self._spools), what, self._spools)]

    def references(self, times: Array) -> Array:
        """See `Command`; between two jumps, at which steps end, it holds one signal."""
        middle = 0.5 * (times[0] + times[-1]) + _SAME * self.period
        held = self._held.signals[max(bisect_right(self._held.since, middle) - 1, 0)]
        return np.tile(held, (len(times), 1))

    def signals(self, at: At) -> Sequence[Number]:
        """See `Command`."""
        return at.reference
