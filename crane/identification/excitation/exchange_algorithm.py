"""Exchange algorithm for valve signals: random pulse plans within limits, improved by slots."""

from collections.abc import Callable

import numpy as np

from crane.common.errors import CraneError, InputError
from crane.common.samples import Array
from crane.control.valve_commands import ValveSignals, require_circuit
from crane.description.sensors import VALVE_SIGNAL_PREFIX
from crane.identification.calibration.unknowns import Unknown
from crane.identification.excitation.pulse_signals import PulseSignals
from crane.identification.excitation.signal_information import SignalInformation
from crane.machine.machine import Machine
from crane.recordings.recording import Recording
from crane.simulation.simulation_run import simulate

_DEFAULT_DEVIATION = 0.3  # relative deviation of a parameter without bounds
# [s] before the end, and share of the largest speed that counts as rest
_FINAL_DURATION, _REST_SPEED_SHARE = 0.5, 0.1
# approximate duration of a slot [s], and least number of slots
_SLOT_DURATION, _MIN_SLOTS = 1.5, 4
_RANDOM_TRIAL_SHARE = 0.25  # of all trials that are completely random
_IDLE_SHARE = 0.25  # of all pulses that are omitted
_MIN_OPENING, _MIN_SLOT_SHARE = 0.05, 0.25  # least opening, and least share of a slot
_MAX_LAST_OPENING = 0.15  # largest opening in the last slot, whose small flow damps oscillations
_REFERENCE_OPENING = 0.5  # opening of the reference signals
Progress = Callable[[float], None]


class SignalLimits:
    """Limits of a run that starts at home and is driven by valve signals.

    Strokes keep a margin to both ends, or half of the margin of home if that is less; the demand
    of flow is within the pump's flow, pressures are below those of the relief valves by the
    margin, and in the last half second all speeds are below a tenth of their maxima. With each
    unknown at its bounds, or 30 % off if it has one sign, strokes do not reach their ends.

    Args:
        information: Information of the machine and the unknowns.
        margin: Margin relative to strokes, relief pressures and the pump's flow.

    Attributes:
        machine: The machine of the information.
        low: (m,) lower limits [m], [rad].
        high: (m,) upper limits [m], [rad].
        flow: Largest demand of pump flow [m3/s].
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
        """Name of a limit that a run exceeds, "" if it exceeds none."""
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
        free = np.isin(run.joints, run.free)  # free joints sway
        moving = (last > _REST_SPEED_SHARE * speeds.max(axis=0)) & ~free
        if moving.any():
            return f"the rest of '{run.joints[int(np.argmax(moving))]}' at the end"
        return ""

    def stroke_margins(self, run: Recording) -> Array:
        """Smallest distances (m,) to the ends of the strokes, per stroke."""
        q = self._strokes(run)
        ends = np.minimum(q.min(axis=0) - self._lower, self._upper - q.max(axis=0))
        return np.asarray(ends / self._stroke_lengths)

    def worst_case_stroke_margins(self, run: Recording) -> Array:
        """Stroke margins (m,) of the worst machine with deviating parameters and the same signals.

        Raises:
            CraneError: A simulation fails.
        """
        runs = [replay_signals(machine, run) for machine in self._perturbed_machines]
        return np.min([self.stroke_margins(other) for other in (run, *runs)], axis=0)

    def pump_flow_share(self, run: Recording) -> float:
        """Largest share of the pump's flow, 0 if it has no limit."""
        supply = self._circuit.supply
        if not supply.flow:
            return 0.0
        flow_shares = (supply.pressure - run.channels["pressure_supply"]) / supply.droop
        return float(flow_shares.max())

    def peak_pressures(self, run: Recording) -> Array:
        """Largest pressures (m,) in the cylinders [Pa]."""
        return np.array([
            max(run.channels[f"pressure_{joint}_{side}"].max() for side in "ab")
            for joint in self._circuit.joints
        ])  # fmt: skip

    def _strokes(self, run: Recording) -> Array:
        return run.q[:, [run.joints.index(joint) for joint in self._circuit.joints]]


def _perturbed_values(unknowns: list[Unknown]) -> list[dict[str, float]]:
    """Extreme values of the unknowns, one at a time."""
    found = []
    for one in unknowns:
        ends = one.low, one.high
        if not np.isfinite(ends).all():
            deviation = _DEFAULT_DEVIATION * one.start if np.isfinite(ends).any() else 0.0
            ends = one.start - deviation, one.start + deviation
        found += [{one.name: end} for end in ends if end != one.start and not one.sensor]
    return found


def replay_signals(machine: Machine, run: Recording) -> Recording:
    """Simulate a machine from home with the valve signals of another run.

    Raises:
        CraneError: The simulation fails.
    """
    joints, step = require_circuit(machine).joints, float(run.time[1] - run.time[0])
    signals = {joint: run.channels[VALVE_SIGNAL_PREFIX + joint] for joint in joints}
    return simulate(
        machine, ValveSignals(machine, run.time, signals), None, step * (len(run.time) - 1), step
    )


class ExchangeAlgorithm:
    """Search for the pulse plan with the most information; see `PulseSignals` for plans.

    Args:
        information: Information of recordings.
        limits: Limits of the runs.
        criterion: See `crane.identification.excitation.fisher_information.CRITERIA`.
        duration: Duration of the signals [s].
        step: Step of the signals [s].
        rate: See `PulseSignals`.

    Raises:
        InputError: The signals are too slow to leave the dead bands.
    """

    def __init__(
        self,
        information: SignalInformation,
        limits: SignalLimits,
        criterion: Callable[[Array], Array],
        duration: float,
        step: float,
        rate: float,
    ):
        self._information, self._limits, self._criterion = information, limits, criterion
        self._machine = information.perturbed_machine({})
        self._step, self._rate = step, rate
        self._step_count = max(round(duration / step), 1)
        # rest before and after
        self._slot_count = max(round(duration / _SLOT_DURATION) - 2, _MIN_SLOTS)
        self._slot_duration = step * max(self._step_count // (self._slot_count + 2), 1)
        self._valve_count = len(require_circuit(information.machine).joints)
        self._rejection_reason = ""
        for joint, valve in require_circuit(information.machine).valves.items():
            min_rate = 2 * valve.dead_band / self._slot_duration
            if not rate > min_rate:
                raise InputError(
                    f"signals of {rate:g} strokes per second do not leave the dead band of "
                    f"'{joint}' in a pulse of {self._slot_duration:.3g} s, give at least "
                    f"{1.1 * min_rate:.3g}"
                )

    def run(
        self, trials: int, rng: np.random.Generator, progress: Progress | None
    ) -> tuple[Recording, Recording]:
        """Runs of the reference signals and of the best of a number of trials.

        Raises:
            InputError: No trial is within the limits.
        """
        reference_run = self._simulate_plan(self._reference_plan())
        plan = best = None
        lowest_cost = np.inf
        random_trial_count = max(round(_RANDOM_TRIAL_SHARE * trials), 1)
        for trial in range(trials):
            trial_plan = self._random_plan(rng)
            if plan is not None and trial >= random_trial_count:
                trial_plan = self._exchange_slot(plan, trial_plan, rng)
            if (run := self._simulate_within_limits(trial_plan)) is not None:
                cost = self._cost(run)
                if cost < lowest_cost and (unsmoothed_run := self._verified_run(run)) is not None:
                    plan, best, lowest_cost = trial_plan, unsmoothed_run, cost
            if progress is not None:
                progress((trial + 1) / trials)
        if best is None:
            raise InputError(
                f"none of {trials} random signals keeps '{self._information.machine.name}' "
                f"within its limits, lastly {self._rejection_reason}: lower the margin or the "
                "rate, or try another seed"
            )
        return reference_run, best

    def _reference_plan(self) -> Array:
        """Plan with one valve after the other, forwards and backwards."""
        plan = np.zeros((self._slot_count, self._valve_count, 2))
        for slot in range(self._slot_count):
            valve, back = slot // 2 % self._valve_count, slot % 2
            plan[slot, valve] = -_REFERENCE_OPENING if back else _REFERENCE_OPENING, 1.0
        return plan

    def _random_plan(self, rng: np.random.Generator) -> Array:
        shape = self._slot_count, self._valve_count
        openings = rng.uniform(_MIN_OPENING, 1.0, shape) * rng.choice([-1.0, 1.0], shape)
        openings *= rng.random(shape) >= _IDLE_SHARE
        shares = rng.uniform(_MIN_SLOT_SHARE, 1.0, shape)
        openings[-1] *= _MAX_LAST_OPENING
        shares[-1] = 1.0
        return np.stack([openings, shares], axis=-1)

    def _exchange_slot(self, plan: Array, random_plan: Array, rng: np.random.Generator) -> Array:
        """Plan with random new pulses of some valves in one slot."""
        out, slot = plan.copy(), rng.integers(self._slot_count)
        valve_mask = rng.random(self._valve_count) < 0.5
        valve_mask[rng.integers(self._valve_count)] = True
        out[slot, valve_mask] = random_plan[slot, valve_mask]
        return out

    def _simulate_plan(self, plan: Array) -> Recording:
        """Run with the signals of a plan, sampled as they will be replayed.

        Raises:
            CraneError: The simulation fails.
        """
        machine, limits = self._machine, self._limits
        pulse_signals = PulseSignals(
            machine, plan, self._slot_duration, self._rate, limits.low, limits.high, limits.flow
        )
        simulated_run = simulate(
            machine, pulse_signals, None, self._step_count * self._step, self._step
        )
        return replay_signals(machine, simulated_run)

    def _simulate_within_limits(self, plan: Array) -> Recording | None:
        """Run of a plan, None if it exceeds the limits."""
        try:
            run = self._simulate_plan(plan)
        except CraneError as error:
            self._rejection_reason = str(error)
            return None
        if reason := self._limits.exceeded_limit(run):
            self._rejection_reason = f"for {reason}"
            return None
        return run

    def _cost(self, run: Recording) -> float:
        try:
            rows = self._information.information_root(run, estimate_start=False)
        except CraneError as error:
            self._rejection_reason = str(error)
            return np.inf
        singular_values = np.asarray(np.linalg.svd(rows, compute_uv=False), dtype=np.float64)
        return float(self._criterion(singular_values))

    def _verified_run(self, run: Recording) -> Recording | None:
        """Run without smoothed friction, None if it or perturbed machines exceed the limits."""
        try:
            unsmoothed_run = replay_signals(self._information.machine, run)
            stroke_margins = self._limits.worst_case_stroke_margins(run)
        except CraneError as error:
            self._rejection_reason = str(error)
            return None
        reason = self._limits.exceeded_limit(unsmoothed_run)
        if not reason and stroke_margins.min() <= 0:
            reason = "a stroke with deviating parameters"
        self._rejection_reason = f"for {reason}"
        return None if reason else unsmoothed_run
