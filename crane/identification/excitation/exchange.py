"""The search for signals of valves: pulses at random, and the exchange of single slots."""

from collections.abc import Callable

import numpy as np

from crane.common.errors import CraneError, InputError
from crane.common.samples import Array
from crane.control.valves import circuit_of
from crane.identification.excitation.levers import Levers
from crane.identification.excitation.signal_limits import SignalLimits, played
from crane.identification.excitation.told import Told
from crane.recordings.recording import Recording
from crane.simulation.run import simulate

_SLOT, _FEWEST = 1.5, 4  # of a pulse of every valve, about [s], and how many at least
_RANDOM = 0.25  # of all trials that are drawn as a whole
_IDLE = 0.25  # of all pulses that are left out
_LEAST, _SHORTEST = 0.05, 0.25  # of an opening, and of a slot
_GENTLE = 0.15  # largest opening in the last slot, whose flow calms what rings
_PLAIN = 0.5  # opening of the plain signals

Progress = Callable[[float], None]


class Exchange:
    """Plans of pulses and what their recordings tell; see `Levers` for plans.

    Args:
        told: What recordings tell.
        limits: Not to be left.
        criterion: See `crane.identification.excitation.information.CRITERIA`.
        duration: [s].
        step: [s].
        rate: See `Levers`.

    Raises:
        InputError: The signals are too slow to leave the dead bands.
    """

    def __init__(
        self,
        told: Told,
        limits: SignalLimits,
        criterion: Callable[[Array], Array],
        duration: float,
        step: float,
        rate: float,
    ):
        self._told, self._limits, self._criterion = told, limits, criterion
        self._machine = told.variant({})
        self._step, self._rate = step, rate
        self._steps = max(round(duration / step), 1)
        self._slots = max(round(duration / _SLOT) - 2, _FEWEST)  # rest before and after
        self._slot = step * max(self._steps // (self._slots + 2), 1)
        self._valves = len(circuit_of(told.machine).joints)
        self._reason = ""
        for joint, valve in circuit_of(told.machine).valves.items():
            least = 2 * valve.dead_band / self._slot
            if not rate > least:
                raise InputError(
                    f"signals of {rate:g} strokes per second do not leave the dead band of "
                    f"'{joint}' in a pulse of {self._slot:.3g} s, give at least {1.1 * least:.3g}"
                )

    def run(
        self, trials: int, rng: np.random.Generator, progress: Progress | None
    ) -> tuple[Recording, Recording]:
        """The plain signals, and the best of so many trials.

        Raises:
            InputError: None keeps the limits.
        """
        plain = self._driven(self._plain())
        plan = best = None
        least = np.inf
        first = max(round(_RANDOM * trials), 1)
        for trial in range(trials):
            tried = self._drawn(rng)
            if plan is not None and trial >= first:
                tried = self._exchanged(plan, tried, rng)
            if (run := self._kept(tried)) is not None:
                cost = self._cost(run)
                if cost < least and (exact := self._holding(run)) is not None:
                    plan, best, least = tried, exact, cost
            if progress is not None:
                progress((trial + 1) / trials)
        if best is None:
            raise InputError(
                f"none of {trials} random signals keeps '{self._told.machine.name}' within its "
                f"limits, lastly {self._reason}: lower the margin or the rate, or try another seed"
            )
        return plain, best

    def _plain(self) -> Array:
        """One lever after the other, out and back."""
        plan = np.zeros((self._slots, self._valves, 2))
        for slot in range(self._slots):
            valve, back = slot // 2 % self._valves, slot % 2
            plan[slot, valve] = -_PLAIN if back else _PLAIN, 1.0
        return plan

    def _drawn(self, rng: np.random.Generator) -> Array:
        shape = self._slots, self._valves
        openings = rng.uniform(_LEAST, 1.0, shape) * rng.choice([-1.0, 1.0], shape)
        openings *= rng.random(shape) >= _IDLE
        shares = rng.uniform(_SHORTEST, 1.0, shape)
        openings[-1] *= _GENTLE
        shares[-1] = 1.0
        return np.stack([openings, shares], axis=-1)

    def _exchanged(self, plan: Array, drawn: Array, rng: np.random.Generator) -> Array:
        """A plan with some valves' pulses in a slot drawn anew."""
        out, slot = plan.copy(), rng.integers(self._slots)
        some = rng.random(self._valves) < 0.5
        some[rng.integers(self._valves)] = True
        out[slot, some] = drawn[slot, some]
        return out

    def _driven(self, plan: Array) -> Recording:
        """A run with a plan's signals, sampled as they will be played.

        Raises:
            CraneError: It cannot be simulated.
        """
        machine, limits = self._machine, self._limits
        levers = Levers(
            machine, plan, self._slot, self._rate, limits.low, limits.high, limits.flow
        )
        closed = simulate(machine, levers, None, self._steps * self._step, self._step)
        return played(machine, closed)

    def _kept(self, plan: Array) -> Recording | None:
        """A plan's run if it keeps the limits."""
        try:
            run = self._driven(plan)
        except CraneError as error:
            self._reason = str(error)
            return None
        if reason := self._limits.refused(run):
            self._reason = f"for {reason}"
            return None
        return run

    def _cost(self, run: Recording) -> float:
        try:
            rows = self._told.rows(run, starts=False)
        except CraneError as error:
            self._reason = str(error)
            return np.inf
        sizes = np.asarray(np.linalg.svd(rows, compute_uv=False), dtype=np.float64)
        return float(self._criterion(sizes))

    def _holding(self, run: Recording) -> Recording | None:
        """The run with friction as it is, if it and machines whose numbers are off hold."""
        try:
            exact = played(self._told.machine, run)
            left = self._limits.doubted(run)
        except CraneError as error:
            self._reason = str(error)
            return None
        reason = self._limits.refused(exact)
        if not reason and left.min() <= 0:
            reason = "a stroke of a machine whose numbers are off"
        self._reason = f"for {reason}"
        return None if reason else exact
