"""Valve signals of pulse plans, and the exchange algorithm that improves them by slots."""

from collections.abc import Callable, Sequence

import numpy as np

from crane.codegen import Scalar
from crane.common.errors import CraneError, InputError
from crane.common.progress import Progress
from crane.common.samples import Array
from crane.control.control_law import ControllerInputs
from crane.control.valve_commands import ValveCommand, require_circuit
from crane.hydraulics.circuit_elements import Supply
from crane.hydraulics.components import Cylinder, Valve
from crane.identification.excitation.signal_information import (
    SignalInformation,
    SignalLimits,
    replay_signals,
)
from crane.machine.machine import Machine
from crane.recordings.recording import Recording
from crane.simulation.simulation_run import simulate

# approximate duration of a slot [s], and least number of slots
_SLOT_DURATION, _MIN_SLOTS = 1.5, 4
_RANDOM_TRIAL_SHARE = 0.25  # of all trials that are completely random
_IDLE_SHARE = 0.25  # of all pulses that are omitted
_MIN_OPENING, _MIN_SLOT_SHARE = 0.05, 0.25  # least opening, and least share of a slot
_MAX_LAST_OPENING = 0.15  # largest opening in the last slot, whose small flow damps oscillations
_REFERENCE_OPENING = 0.5  # opening of the reference signals


class PulseSignals(ValveCommand):
    """Pulses of valve signals, one per valve and time slot, that keep cylinders within strokes.

    A plan contains the largest opening y of each pulse, -1 to 1, and the share of its slot that
    the pulse takes. The spool position u = (U - neutral) / (full - neutral) goes from 0 to sign(y)
    (d + (1 - d) |y|) with the dead band d, and back to 0, at the rate r, so that over a pulse of
    duration T

        integral of |y| dt = |y| (T - (|u| + d) / r),

    and the stroke changes by this times its steady velocity at full opening
    (`full_opening_speed`). At the start of a slot the plan is adapted to the state of the machine:
    a pulse that would exceed its range is reversed or reduced, and all openings are reduced if
    together they would exceed the pump's flow.

    Args:
        machine: The machine.
        plan: (slots, m, 2) openings, and shares of the slot from 0 to 1; valves are closed in the
            slot before and after them.
        slot: Duration of a slot [s].
        rate: Rate of u [1/s].
        low: (m,) lower limits of the coordinates [m], [rad].
        high: (m,) upper limits [m], [rad].
        flow: Largest demand of pump flow [m3/s]; infinite without limit.
    """

    is_open_loop = True

    def __init__(
        self,
        machine: Machine,
        plan: Array,
        slot: float,
        rate: float,
        low: Array,
        high: Array,
        flow: float,
    ):
        circuit = self._circuit = require_circuit(machine)
        self._plan, self.period, self._rate, self._max_flow = plan, slot, rate, flow
        self._low, self._high = low, high
        self._joint_columns = [machine.column(joint) for joint in circuit.joints]
        valves = list(circuit.valves.values())
        cylinders = [circuit.cylinders[joint] for joint in circuit.joints]
        self._areas = np.array([(x.area_a, x.area_b) for x in cylinders])
        self._neutral = np.array([valve.neutral for valve in valves])
        self._signal_ranges = np.array([valve.full - valve.neutral for valve in valves])
        self._dead_bands = np.array([valve.overlap for valve in valves])
        self._valve_indices = [
            circuit.joints.index(spool.joint) for spool in circuit.spools.values()
        ]
        # start times of slots, peak spool positions, and durations of pulses
        self._slot_starts = [0.0]
        self._peak_positions, self._duration_history = (
            [np.zeros(len(valves))],
            [np.zeros(len(valves))],
        )

    def update(self, time: float, q: Array, v_a: Array, pressures: Array) -> None:
        """See `ValveCommand`."""
        slot = round(time / self.period) - 1
        peak_positions = self._pulse_durations = np.zeros(len(self._signal_ranges))
        if 0 <= slot < len(self._plan):
            peak_positions = self._pulse_positions(slot, q, pressures)
        slot_index = max(0, slot + 1)
        (
            self._slot_starts[slot_index:],
            self._peak_positions[slot_index:],
            self._duration_history[slot_index:],
        ) = [time], [peak_positions], [self._pulse_durations]

    def _pulse_positions(self, slot: int, q: Array, pressures: Array) -> Array:
        """Peak spool positions (m,) in a slot."""
        opening, share = self._plan[slot].T
        x = q[self._joint_columns]
        circuit = self._circuit
        forces = (self._areas * pressures * [1.0, -1.0]).sum(axis=1)
        speeds = np.array([  # at full opening, forwards and backwards
            [
                full_opening_speed(
                    circuit.cylinders[joint], circuit.valves[joint], circuit.supply, force, side
                )
                for side in (False, True)
            ]
            for joint, force in zip(circuit.joints, forces.tolist(), strict=True)
        ])  # fmt: skip
        self._pulse_durations = share * self.period
        openings = np.array(
            [
                self._opening_within_stroke(i, float(y), float(x[i]), speeds[i])
                for i, y in enumerate(opening)
            ]
        )
        sides = np.arange(len(openings)), (openings < 0).astype(int)
        flow = (np.abs(openings) * speeds[sides] * self._areas[sides]).sum()
        openings *= min(1.0, self._max_flow / max(flow, 1e-30))
        u = self._dead_bands + (1.0 - self._dead_bands) * np.abs(openings)
        return np.where(openings, np.copysign(u, openings), 0.0)

    def references(self, times: Array) -> Array:
        """See `ValveCommand`."""
        at = np.maximum(np.searchsorted(self._slot_starts, times, "right") - 1, 0)
        top, last = np.array(self._peak_positions)[at], np.array(self._duration_history)[at]
        since = np.asarray(times)[:, None] - np.array(self._slot_starts)[at, None]
        ramps = self._rate * np.clip(np.minimum(since, last - since), 0.0, None)
        u = np.copysign(np.minimum(np.abs(top), ramps), top)
        # a second spool gets the signal of the first one, as in `ValveSignals`
        return (self._neutral + self._signal_ranges * u)[:, self._valve_indices]

    def signals(self, inputs: ControllerInputs) -> Sequence[Scalar]:
        """See `ValveCommand`."""
        return inputs.reference

    def _opening_within_stroke(self, i: int, opening: float, x: float, speeds: Array) -> float:
        """Opening of a pulse that keeps cylinder i within its range."""
        dead, rate, duration = self._dead_bands[i], self._rate, self._pulse_durations[i]
        clearances = max(self._high[i] - x, 0.0), max(x - self._low[i], 0.0)
        side = int(opening < 0)
        # what the rate allows within the pulse
        size = min(abs(opening), max((rate * duration / 2 - dead) / (1.0 - dead), 0.0))
        if size and self._opening_integral(i, size) * speeds[side] > clearances[side]:
            side = int(clearances[1] > clearances[0])
            if self._opening_integral(i, size) * speeds[side] > clearances[side]:
                # the smaller root of the integral, which is quadratic in the opening
                integral, slope = clearances[side] / speeds[side], duration - 2 * dead / rate
                root = np.sqrt(max(slope**2 - 4 * (1.0 - dead) / rate * integral, 0.0))
                size = float(2 * integral / (slope + root)) if slope > 0 else 0.0
        return -size if side else size

    def _opening_integral(self, i: int, opening: float) -> float:
        """Integral of the opening over the pulse [s]."""
        dead = self._dead_bands[i]
        u = dead + (1.0 - dead) * opening
        return float(opening * (self._pulse_durations[i] - (u + dead) / self._rate))


def full_opening_speed(
    cylinder: Cylinder, valve: Valve, supply: Supply, force: float, backwards: bool
) -> float:
    """Steady speed of a cylinder at full opening [m/s], [rad/s].

    With the pressure drops of both orifices, (A_in w / c_in)^2 and (A_out w / c_out)^2, and the
    force F against the motion, the speed w is given by

        w^2 (A_in^3 / c_in^2 + A_out^3 / c_out^2) = A_in p_S - A_out p_R - F,

    A compensator limits the inflow to c_in sqrt(margin), unless a pulling load causes a larger
    outflow, c_out sqrt(-F / A_out - p_R). The speed is 0 if the load is too large.

    Args:
        cylinder: The cylinder.
        valve: Valve of the cylinder.
        supply: Supply of the circuit.
        force: Cylinder force A_A p_A - A_B p_B [N], [N m].
        backwards: Whether oil flows into chamber B.
    """
    inward, outward = cylinder.area_a, cylinder.area_b
    inlet, outlet = valve.c1, valve.c2
    if backwards:
        inward, outward, inlet, outlet = outward, inward, valve.c4, valve.c3
        force = -force
    driving_force = inward * supply.pressure - outward * supply.tank - force
    speed = np.sqrt(max(driving_force, 0.0) / (inward**3 / inlet**2 + outward**3 / outlet**2))
    if valve.margin:
        load_driven_speed = outlet * np.sqrt(max(-force / outward - supply.tank, 0.0)) / outward
        speed = min(speed, max(inlet * np.sqrt(valve.margin) / inward, load_driven_speed))
    return float(speed)


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
            min_rate = 2 * valve.overlap / self._slot_duration
            if not rate > min_rate:
                raise InputError(
                    f"signals of {rate:g} strokes per second do not leave the dead band of "
                    f"'{joint}' in a pulse of {self._slot_duration:.3g} s, give at least "
                    f"{1.1 * min_rate:.3g}"
                )

    def run(
        self, trials: int, rng: np.random.Generator, progress: Progress
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
            if (found := self._improved_run(trial_plan, lowest_cost)) is not None:
                plan, (best, lowest_cost) = trial_plan, found
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

    def _improved_run(self, plan: Array, lowest_cost: float) -> tuple[Recording, float] | None:
        """Run without smoothed friction, and its cost.

        None if the cost is not lower, or if the run, that with smoothed friction or perturbed
        machines exceed the limits.
        """
        limits = self._limits
        try:
            run = self._simulate_plan(plan)
            if reason := limits.exceeded_limit(run):
                self._rejection_reason = f"for {reason}"
                return None
            rows = self._information.information_factor(run, estimate_start=False)
            singular_values = np.asarray(np.linalg.svd(rows, compute_uv=False), dtype=np.float64)
            cost = float(self._criterion(singular_values))
            if not cost < lowest_cost:
                return None
            unsmoothed_run = replay_signals(self._information.machine, run)
            stroke_margins = limits.worst_case_stroke_margins(run)
        except CraneError as error:
            self._rejection_reason = str(error)
            return None
        reason = limits.exceeded_limit(unsmoothed_run)
        if not reason and stroke_margins.min() <= 0:
            reason = "a stroke with deviating parameters"
        self._rejection_reason = f"for {reason}"
        return None if reason else (unsmoothed_run, cost)
