"""What signals of valves may make of a machine."""

import numpy as np

from crane.common.errors import InputError
from crane.common.samples import Array
from crane.control.valve_commands import ValveSignals, require_circuit
from crane.description.sensors import VALVE_SIGNAL_PREFIX
from crane.identification.calibration.unknowns import Unknown
from crane.identification.excitation.signal_information import SignalInformation
from crane.machine import Machine
from crane.recordings.recording import Recording
from crane.simulation.simulation_run import simulate

_DEFAULT_DEVIATION = 0.3  # share that a number is off by of which no bounds are given
_FINAL_DURATION, _REST_SPEED_SHARE = (
    0.5,
    0.1,
)  # [s] before the end, and share of the velocities that counts as rest


class SignalLimits:
    """What signals may make of a machine that starts at home.

    Strokes keep `margin` to both ends, or half of what home does where that is less; the pump
    delivers what is asked for, pressures keep as much below those of relief valves, and in the
    last half second all move at less than a tenth of their largest velocities. With each of the
    wanted numbers at its bounds, or off by 30 % if it has one sign, strokes do not reach their
    ends.

    Args:
        information: Of the machine and the wanted numbers.
        margin: Share of a stroke, of a relief pressure, of the pump's flow.

    Attributes:
        machine: See above.
        low: (m,) least coordinates [m], [rad].
        high: (m,) largest.
        max_flow: The most that is asked of the pump [m3/s].
    """

    def __init__(self, information: SignalInformation, margin: float):
        machine = self.machine = information.machine
        self._circuit, self._margin = require_circuit(machine), margin
        which = [machine.active.index(joint) for joint in self._circuit.joints]
        self._lower, self._upper = machine.lower[which], machine.upper[which]
        self._stroke_lengths = self._upper - self._lower
        home = np.array([machine.home[machine.column(joint)] for joint in self._circuit.joints])
        below, above = np.minimum(
            margin * self._stroke_lengths, [(home - self._lower) / 2, (self._upper - home) / 2]
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
        max_flow = supply.flow
        self.flow = (1 - margin) * max_flow if max_flow else np.inf
        self._perturbed_machines = [
            information.perturbed_machine(values)
            for values in _perturbed_values(information.unknowns)
        ]

    def exceeded_limit(self, run: Recording) -> str:
        """Which limit a run exceeds, "" if none."""
        q = self._strokes(run)
        for i, joint in enumerate(self._circuit.joints):
            if q[:, i].min() < self.low[i] - 1e-9 or q[:, i].max() > self.high[i] + 1e-9:
                return f"the stroke of '{joint}'"
        if self.pump_flow_share(run) > 1:
            return "the pump's flow"
        for joint, pressure in zip(self._circuit.joints, self.peak_pressures(run), strict=True):
            relief = self._circuit.cylinders[joint].relief
            if relief and pressure > (1 - self._margin) * relief:
                return f"the relief pressure of '{joint}'"
        speeds = np.abs(run.v)
        last = speeds[run.time > run.time[-1] - _FINAL_DURATION].max(axis=0)
        free = np.isin(run.joints, run.free)  # they sway as they will
        moving = (last > _REST_SPEED_SHARE * speeds.max(axis=0)) & ~free
        if moving.any():
            return f"the rest of '{run.joints[int(np.argmax(moving))]}' at the end"
        return ""

    def stroke_margins(self, run: Recording) -> Array:
        """(m,) what is left of strokes to their nearer ends, as shares of them."""
        q = self._strokes(run)
        ends = np.minimum(q.min(axis=0) - self._lower, self._upper - q.max(axis=0))
        return np.asarray(ends / self._stroke_lengths)

    def worst_case_stroke_margins(self, run: Recording) -> Array:
        """(m,) the same, of the worst machine whose numbers are off, driven by the same signals.

        Raises:
            CraneError: One cannot be simulated.
        """
        runs = [replay_signals(machine, run) for machine in self._perturbed_machines]
        return np.min([self.stroke_margins(other) for other in (run, *runs)], axis=0)

    def pump_flow_share(self, run: Recording) -> float:
        """The largest share of the pump's flow, 0 where it has no limit."""
        supply = self._circuit.supply
        if not supply.flow:
            return 0.0
        flow_shares = (supply.pressure - run.channels["pressure_supply"]) / supply.droop
        return float(flow_shares.max())

    def peak_pressures(self, run: Recording) -> Array:
        """(m,) largest in a cylinder [Pa]."""
        return np.array([
            max(run.channels[f"pressure_{joint}_{side}"].max() for side in "ab")
            for joint in self._circuit.joints
        ])  # fmt: skip

    def _strokes(self, run: Recording) -> Array:
        return run.q[:, [run.joints.index(joint) for joint in self._circuit.joints]]


def _perturbed_values(unknowns: list[Unknown]) -> list[dict[str, float]]:
    """Values of numbers of the machine that are off by as much as may be, one at a time."""
    found = []
    for one in unknowns:
        ends = one.low, one.high
        if not np.isfinite(ends).all():
            deviation = _DEFAULT_DEVIATION * one.start if np.isfinite(ends).any() else 0.0
            ends = one.start - deviation, one.start + deviation
        found += [{one.name: end} for end in ends if end != one.start and not one.sensor]
    return found


def replay_signals(machine: Machine, run: Recording) -> Recording:
    """A machine driven by the signals of another run, from home.

    Raises:
        CraneError: It cannot be simulated.
    """
    joints, step = require_circuit(machine).joints, float(run.time[1] - run.time[0])
    signals = {joint: run.channels[VALVE_SIGNAL_PREFIX + joint] for joint in joints}
    return simulate(
        machine, ValveSignals(machine, run.time, signals), None, step * (len(run.time) - 1), step
    )
