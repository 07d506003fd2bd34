"""The search for signals of valves: pulses at random, and the exchange of single slots."""

from collections.abc import Callable

import numpy as np

from crane.common.errors import CraneError, InputError
from crane.common.samples import Array
from crane.control.valve_commands import require_circuit
from crane.identification.excitation.pulse_signals import PulseSignals
from crane.identification.excitation.signal_information import SignalInformation
from crane.identification.excitation.signal_limits import SignalLimits, replay_signals
from crane.recordings.recording import Recording
from crane.simulation.simulation_run import simulate

_SLOT_DURATION, _MIN_SLOTS = 1.5, 4  # of a pulse of every valve, about [s], and how many at least
_RANDOM_TRIAL_SHARE = 0.25  # of all trials that are drawn as a whole
_IDLE_SHARE = 0.25  # of all pulses that are left out
_MIN_OPENING, _MIN_SLOT_SHARE = 0.05, 0.25  # of an opening, and of a slot
_MAX_LAST_OPENING = 0.15  # largest opening in the last slot, whose flow calms what rings
_REFERENCE_OPENING = 0.5  # opening of the plain signals

Progress = Callable[[float], None]


class ExchangeAlgorithm:
    """Plans of pulses and what their recordings tell; see `PulseSignals` for plans.

    Args:
        information: What recordings tell.
        limits: Not to be left.
        criterion: See `crane.identification.excitation.fisher_information.CRITERIA`.
        duration: [s].
        step: [s].
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
        self._slot_count = max(
            round(duration / _SLOT_DURATION) - 2, _MIN_SLOTS
        )  # rest before and after
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
        """The plain signals, and the best of so many trials.

        Raises:
            InputError: None keeps the limits.
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
                f"within its "
                f"limits, lastly {self._rejection_reason}: lower the margin or the rate, or try "
                f"another seed"
            )
        return reference_run, best

    def _reference_plan(self) -> Array:
        """One lever after the other, out and back."""
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
        """A plan with some valves' pulses in a slot drawn anew."""
        out, slot = plan.copy(), rng.integers(self._slot_count)
        valve_mask = rng.random(self._valve_count) < 0.5
        valve_mask[rng.integers(self._valve_count)] = True
        out[slot, valve_mask] = random_plan[slot, valve_mask]
        return out

    def _simulate_plan(self, plan: Array) -> Recording:
        """A run with a plan's signals, sampled as they will be played.

        Raises:
            CraneError: It cannot be simulated.
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
        """A plan's run if it keeps the limits."""
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
        """The run with friction as it is, if it and machines whose numbers are off hold."""
        try:
            unsmoothed_run = replay_signals(self._information.machine, run)
            stroke_margins = self._limits.worst_case_stroke_margins(run)
        except CraneError as error:
            self._rejection_reason = str(error)
            return None
        reason = self._limits.exceeded_limit(unsmoothed_run)
        if not reason and stroke_margins.min() <= 0:
            reason = "a stroke of a machine whose numbers are off"
        self._rejection_reason = f"for {reason}"
        return None if reason else unsmoothed_run
