"""What signals of valves may make of a machine."""

import numpy as np

from crane.common.errors import InputError
from crane.common.samples import Array
from crane.control.valves import Signals, circuit_of
from crane.description.sensors import SIGNAL
from crane.identification.calibration.unknowns import Unknown
from crane.identification.excitation.told import Told
from crane.machine import Machine
from crane.recordings.recording import Recording
from crane.simulation.run import simulate

_OFF = 0.3  # share that a number is off by of which no bounds are given
_END, _RESTS = 0.5, 0.1  # [s] before the end, and share of the velocities that counts as rest


class SignalLimits:
    """What signals may make of a machine that starts at home.

    Strokes keep `margin` to both ends, or half of what home does where that is less; the pump
    delivers what is asked for, pressures keep as much below those of relief valves, and in the
    last half second all move at less than a tenth of their largest velocities. With each of the
    wanted numbers at its bounds, or off by 30 % if it has one sign, strokes do not reach their
    ends.

    Args:
        told: Of the machine and the wanted numbers.
        margin: Share of a stroke, of a relief pressure, of the pump's flow.

    Attributes:
        machine: See above.
        low: (m,) least coordinates [m], [rad].
        high: (m,) largest.
        flow: The most that is asked of the pump [m3/s].
    """

    def __init__(self, told: Told, margin: float):
        machine = self.machine = told.machine
        self._circuit, self._margin = circuit_of(machine), margin
        which = [machine.active.index(joint) for joint in self._circuit.joints]
        self._lower, self._upper = machine.lower[which], machine.upper[which]
        self._span = self._upper - self._lower
        home = np.array([machine.home[machine.column(joint)] for joint in self._circuit.joints])
        below, above = np.minimum(
            margin * self._span, [(home - self._lower) / 2, (self._upper - home) / 2]
        )
        self.low, self.high = self._lower + below, self._upper - above
        supply = self._circuit.supply
        if supply.control != "pressure":
            raise InputError(
                f"signals are designed for a pump that keeps its pressure, that of "
                f"'{machine.name}' has {supply.control} control: record a task instead"
            )
        for joint, cylinder in self._circuit.cylinders.items():
            if cylinder.motor:
                raise InputError(
                    f"signals are designed for cylinders, '{joint}' has a motor: lock it"
                )
        flow = supply.flow
        self.flow = (1 - margin) * flow if flow else np.inf
        self._doubts = [told.variant(values) for values in _doubts(told.unknowns)]

    def refused(self, run: Recording) -> str:
        """Which limit a run exceeds, "" if none."""
        q = self._strokes(run)
        for i, joint in enumerate(self._circuit.joints):
            if q[:, i].min() < self.low[i] - 1e-9 or q[:, i].max() > self.high[i] + 1e-9:
                return f"the stroke of '{joint}'"
        if self.pump(run) > 1:
            return "the pump's flow"
        for joint, pressure in zip(self._circuit.joints, self.pressures(run), strict=True):
            relief = self._circuit.cylinders[joint].relief
            if relief and pressure > (1 - self._margin) * relief:
                return f"the relief pressure of '{joint}'"
        speeds = np.abs(run.v)
        last = speeds[run.time > run.time[-1] - _END].max(axis=0)
        free = np.isin(run.joints, run.free)  # they sway as they will
        moving = (last > _RESTS * speeds.max(axis=0)) & ~free
        if moving.any():
            return f"the rest of '{run.joints[int(np.argmax(moving))]}' at the end"
        return ""

    def left(self, run: Recording) -> Array:
        """(m,) what is left of strokes to their nearer ends, as shares of them."""
        q = self._strokes(run)
        ends = np.minimum(q.min(axis=0) - self._lower, self._upper - q.max(axis=0))
        return np.asarray(ends / self._span)

    def doubted(self, run: Recording) -> Array:
        """(m,) the same, of the worst machine whose numbers are off, driven by the same signals.

        Raises:
            CraneError: One cannot be simulated.
        """
        runs = [played(machine, run) for machine in self._doubts]
        return np.min([self.left(other) for other in (run, *runs)], axis=0)

    def pump(self, run: Recording) -> float:
        """The largest share of the pump's flow, 0 where it has no limit."""
        supply = self._circuit.supply
        if not supply.flow:
            return 0.0
        asked = (supply.pressure - run.channels["pressure_supply"]) / supply.droop
        return float(asked.max())

    def pressures(self, run: Recording) -> Array:
        """(m,) largest in a cylinder [Pa]."""
        return np.array([
            max(run.channels[f"pressure_{joint}_{side}"].max() for side in "ab")
            for joint in self._circuit.joints
        ])  # fmt: skip

    def _strokes(self, run: Recording) -> Array:
        return run.q[:, [run.joints.index(joint) for joint in self._circuit.joints]]


def _doubts(unknowns: list[Unknown]) -> list[dict[str, float]]:
    """Values of numbers of the machine that are off by as much as may be, one at a time."""
    found = []
    for one in unknowns:
        ends = one.low, one.high
        if not np.isfinite(ends).all():
            off = _OFF * one.start if np.isfinite(ends).any() else 0.0
            ends = one.start - off, one.start + off
        found += [{one.name: end} for end in ends if end != one.start and not one.sensor]
    return found


def played(machine: Machine, run: Recording) -> Recording:
    """A machine driven by the signals of another run, from home.

    Raises:
        CraneError: It cannot be simulated.
    """
    joints, step = circuit_of(machine).joints, float(run.time[1] - run.time[0])
    signals = {joint: run.channels[SIGNAL + joint] for joint in joints}
    return simulate(
        machine, Signals(machine, run.time, signals), None, step * (len(run.time) - 1), step
    )
