"""Compiled methods with step-size control: base class, and the method of Dormand and Prince.

The method of order 8 with embedded methods of order 5 and 3 and an interpolant of order 7 is that
of Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, II.5 and II.6; the
coefficients are those of scipy.
"""

from abc import abstractmethod
from collections.abc import Hashable
from typing import Any

import numpy as np

from crane.closure.kinematics_formulas import largest_scaled_value
from crane.codegen import Program, RoutineValue, Scalar, Tape
from crane.codegen.symbolic import (
    add_vectors,
    apply_function,
    copysign,
    dot,
    maximum,
    minimum,
    scale_vector,
    subtract_vectors,
)
from crane.common.samples import Array
from crane.control import TracedController, ValveDrive
from crane.dynamics.external_forces import state_count
from crane.machine import Machine
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.machine_formulas import (
    MachineCodeStepper,
    reference_samples,
    wrap_rotations,
)
from crane.simulation.integration.step_loop import MIN_STEP_RATIO, StepCode, StepLoop, StepWriter

MAX_REFERENCE_SPACING = 5e-4  # [s] between the instants that references are known at, at most
MIN_SCALE = 0.1  # what is taken for no smaller: rad, machine's size, per `Closure.pace`
ENERGY_TOLERANCE_FACTOR = 10.0  # times the tolerance, of energies
_MAX_ROTATION_PER_STEP = 2.5  # [rad] of a step, of bodies that float
_MAX_REFERENCE_PAIRS = 1000  # pairs of references of a call
_STEP_REDUCTION_AFTER_EVENT = 0.2  # of a step's length, the first behind an event
_TIME_TOLERANCE = 1e-9  # of a recorded step, between instants that are one


def characteristic_energy(chart: Chart) -> float:
    """Of a machine as heavy and as fast as this one [J]."""
    closure = chart.machine.closure
    mass = sum(inertia.mass for inertia in chart.machine.model.inertias)
    return float(mass * (closure.characteristic_length / closure.characteristic_time) ** 2)


def error_tolerances(chart: Chart, controller_state_count: int, tolerance: float) -> Array:
    """(k + 1,) least errors that matter of all states, and the tolerance they are of.

    Work and dissipation, which nothing depends on, count `ENERGY_TOLERANCE_FACTOR` times less.
    """
    closure = chart.machine.closure
    rates = closure.units[closure.active] / closure.characteristic_time
    energies = np.full(
        2 + len(chart.machine.external_forces),
        ENERGY_TOLERANCE_FACTOR * characteristic_energy(chart),
    )
    contact_scales = np.full(
        state_count(chart.machine.external_forces), closure.characteristic_length
    )
    scales = np.concatenate(
        [closure.units, rates, contact_scales, np.ones(controller_state_count), energies]
    )
    return tolerance * np.append(MIN_SCALE * scales, 1.0)


def weighted_sum(tape: Tape, argument: int, size: int, weights: Array) -> list[Scalar]:
    """A weighted sum of vectors of some size that are in an argument one after the other."""
    out: list[Scalar] = [0.0] * size
    for j, weight in enumerate(weights):
        if weight:
            out = add_vectors(
                out, scale_vector(float(weight), tape.load_vector(argument, j * size, size))
            )
    return out


class ErrorControlledStepper(MachineCodeStepper):
    """Many steps at once in machine code, with references and recorded instants within them.

    A method writes `_add_method` and `_write_step`. Steps end at the controller's breaks, those of
    circuits at recorded instants, too: what is between keeps no balance of oil.

    Args:
        chart: The machine.
        control: Its controller.
        controller_state_count: Number of the controller's states.
        method: What the method's code depends on besides them.
        fold_settings: Whether zeros and ones among the controller's settings become part of the
            code.
        tolerance: What tells the method which error matters.

    Raises:
        TooLongError: It would take too long to compile.
    """

    def __init__(
        self,
        chart: Chart,
        control: TracedController,
        controller_state_count: int,
        method: tuple[Hashable, ...],
        fold_settings: bool,
        tolerance: Array,
    ):
        self._steps_end_at_outputs = isinstance(control, ValveDrive)
        super().__init__(chart, control, controller_state_count, method, fold_settings)
        self.tolerance = np.ascontiguousarray(tolerance)
        self._step_state, self._break_times = (
            np.zeros(6),
            np.append(break_times(chart.machine, control), np.inf),
        )

    def reset_step_size(self) -> None:
        """Begin with a short step, whatever was integrated before."""
        self._step_state[0] = 0.0

    def run(
        self, first: float, state: Array, offset: float, step: float, rows: Array
    ) -> tuple[int, float]:
        """Steps up to the instant behind the last of some that are recorded.

        Args:
            first: The first instant that is recorded [s].
            state: The state; replaced by that where it has got to.
            offset: When that is, after the first instant and at most a step before [s].
            step: [s] between instants.
            rows: (N, .) in any order, filled; none to come to the next instant.

        Returns:
            How many have their row, and when the state is, after the next of them [s]. Fewer than
            all where the next step needs a closer look or other coordinates.
        """
        lengths, pair = self._step_state, min(step, 2.0 * MAX_REFERENCE_SPACING)
        lengths[5] = 0.0
        if lengths[0] != step:
            lengths[:2] = step, 0.01 * min(step, MAX_REFERENCE_SPACING)
        functions = [self.closure_code.close_address]
        if self.external_callback is not None:
            functions.append(self.external_callback.address)
        max_rows, done = max(1, int(_MAX_REFERENCE_PAIRS * pair / step)), 0
        out = np.empty((min(max_rows, len(rows)), rows.shape[1]))
        while done < len(rows) or offset < 0:
            count = min(max_rows, len(rows) - done)
            now, segment_start, segment_end = first + step * done, offset, count * step
            next_time = now + segment_start + _TIME_TOLERANCE * step
            time_to_break = self._break_times[np.searchsorted(self._break_times, next_time)] - now
            if isinstance(self._control, ValveDrive) and self._control.period:
                time_to_break = min(
                    time_to_break, self._control.next_delayed_jump(next_time) - now
                )
            if time_to_break < segment_end - _TIME_TOLERANCE * step:
                segment_end = time_to_break
            pairs = max(1, int(np.ceil((segment_end - segment_start) / pair - _TIME_TOLERANCE)))
            lengths[2:5] = segment_start, (segment_end - segment_start) / pairs, segment_end
            rows_made = self._program.call(
                "run",
                count,
                *functions,
                *self._common_arguments,
                self._reference_rows(now + segment_start, now + segment_end, pairs),
                state,
                out,
                lengths,
                self.bounds,
                self.tolerance,
            )
            if self.external_callback is not None:
                self.external_callback.raise_pending()
            rows[done : done + rows_made] = out[:rows_made]
            done, offset = done + rows_made, float(lengths[2])
            time_left = segment_end - (rows_made * step + offset)
            if abs(offset) < _TIME_TOLERANCE * step:
                offset = 0.0
            if lengths[5]:
                lengths[1] *= _STEP_REDUCTION_AFTER_EVENT
                break
            if time_left > _TIME_TOLERANCE * step:
                lengths[0] = 0.0  # it may have got as short as can be
                break
        return done, offset

    def _reference_rows(self, start_time: float, end_time: float, pairs: int) -> Array:
        """Rows (2 pairs + 1, c) between two times [s], at the ends as between them."""
        grid = np.linspace(start_time, end_time, 2 * pairs + 1)
        grid[[0, -1]] += _TIME_TOLERANCE * (grid[1] - start_time) * np.array([1.0, -1.0])
        return reference_samples(self._chart.machine, self._control, grid)

    @property
    def event(self) -> float:
        """Whether a joint starts or stops at the state."""
        return float(self._step_state[5])

    def _build(self, program: Program) -> None:
        for suffix, with_joints_at_rest in self._rest_variants:
            machine, inputs, tau, _ = self._trace_controlled_machine(Tape())
            channels = (
                self._control.channel_values(inputs)
                if isinstance(self._control, ValveDrive)
                else []
            )
            outputs_seen, margin = (
                machine.outputs(tau, with_joints_at_rest),
                machine.accelerations(tau, with_joints_at_rest).transition_margin,
            )
            program.add_formula(
                "observe" + suffix, 5, {"seen": [*outputs_seen, *channels], "margin": [margin]}
            )
            machine, _, tau, controller_rate = self._trace_controlled_machine(Tape())
            accelerations, coordinate_rates = (
                machine.accelerations(tau, with_joints_at_rest),
                machine.dynamics_formulas.coordinate_derivatives,
            )
            contact_rates = machine.external_forces.state_rates
            rate = [
                *coordinate_rates,
                *accelerations.a_a,
                *contact_rates,
                *controller_rate,
                *machine.powers(tau),
            ]
            closure = self._chart.machine.closure
            event_distances = machine.dynamics_formulas.end_stop_distances(
                closure.units.tolist(), closure.characteristic_length
            )
            event_distances += scale_vector(
                1.0 / closure.characteristic_length, machine.external_forces.event_lengths
            )
            outputs = {
                "rate": rate,
                "margin": [accelerations.transition_margin],
                "edges": event_distances,
            }
            program.add_formula("rate" + suffix, 5, outputs)
        if self.external_callback is not None:
            program.add_formula("asked", 5, machine.external_forces.callback_inputs)
            with program.add_routine(
                "ask", functions=("answer",), arrays=("asked", "outside")
            ) as r:
                r.return_value(r.call("answer", r.asked, r.outside))
        self._add_event_formulas(program, len(event_distances))
        # the parabola through rows at 0, 1/2, 1
        tape = Tape()
        s, columns = tape.load(1, 0), self.reference_columns
        rows = [tape.load_vector(0, columns * row, columns) for row in range(3)]
        shares = ((2.0 * s - 1.0) * (s - 1.0), 4.0 * s * (1.0 - s), s * (2.0 * s - 1.0))
        program.add_formula(
            "reference", 2, [dot(shares, values) for values in zip(*rows, strict=True)]
        )
        self._add_method(program)
        # s + x (c0 + (1 - x) (c1 + x (c2 + ...)))
        tape, size = Tape(), self.state_layout.size
        state, x = tape.load_vector(0, 0, size), tape.load(2, 0)
        out: list[Scalar] = [0.0] * size
        for i in reversed(range(program.formula_outputs("dense").size // size)):
            out = add_vectors(out, tape.load_vector(1, i * size, size))
            out = scale_vector(x if i % 2 == 0 else 1.0 - x, out)
        program.add_formula("interpolate", 3, wrap_rotations(self._chart, add_vectors(state, out)))
        tape = Tape()
        program.add_formula("wrap", 1, wrap_rotations(self._chart, tape.load_vector(0, 0, size)))
        self._add_run(program)

    def _inverse_error_scales(
        self, tape: Tape, argument: int, one: list[Scalar], other: list[Scalar]
    ) -> list[Scalar]:
        """One over the errors that matter of all states between two, by `error_tolerances`."""
        out: list[Scalar] = []
        for i, (x, y) in enumerate(zip(one, other, strict=True)):
            size = maximum(apply_function("abs", x), apply_function("abs", y))
            size = (
                size
                if i < self.state_layout.start_index("work")
                else ENERGY_TOLERANCE_FACTOR * size
            )
            out.append(1.0 / maximum(tape.load(argument, i), tape.load(argument, len(one)) * size))
        return out

    def _limit_rotation(self, error: Scalar, largest_move: Scalar) -> Scalar:
        """An error, above 1 where a floating body turns so far that nobody knows how often."""
        floating = self._chart.machine.coordinates.floating_base_columns
        return maximum(error, largest_move * (1.0 / _MAX_ROTATION_PER_STEP)) if floating else error

    def _add_event_formulas(self, program: Program, count: int) -> None:
        """sides(rate): the signs of edges; crossed(rate, sides): the least of edge times sign."""
        start = program.formula_outputs("rate").start_index("edges")
        if not count:
            return
        tape = Tape()
        signs = [copysign(1.0, x) for x in tape.load_vector(0, start, count)]
        program.add_formula("sides", 1, signs)
        tape = Tape()
        smallest: Scalar = 1.0
        for edge, side in zip(
            tape.load_vector(0, start, count), tape.load_vector(1, 0, count), strict=True
        ):
            smallest = minimum(smallest, edge * side)
        program.add_formula("crossed", 2, [smallest])

    @abstractmethod
    def _add_method(self, program: Program) -> None:
        """Add formulas, among them `finish` and `dense`.

        `finish` has the parts state; error, at most 1; change of the length for the next; move.
        `dense` has the c of what is between two states.
        """

    @abstractmethod
    def _write_step(self, program: Program, step: StepCode) -> tuple[StepWriter, StepWriter]:
        """What makes a step up to `finish`, and what calls `dense` behind one."""

    def _add_run(self, program: Program) -> None:
        functions = ("close",) if self.external_callback is None else ("close", "answer")
        names = ("geometry", "numbers", "control", "refs", "state", "out", "h", "bounds", "tol")
        with program.add_routine("run", counts=("steps",), functions=functions, arrays=names) as r:
            loop = StepLoop(self, program, r, self._steps_end_at_outputs)
            loop.write(self._write_step)


def break_times(machine: Machine, control: TracedController) -> Array:
    """Times (k,) [s] at which what a controller or a force refers to turns sharply, in order.

    As they say themselves (`breaks`), or its reference.
    """
    all_times = [force.breaks() for force in machine.external_forces]
    sources: tuple[Any, ...] = control, getattr(control, "reference", None)
    for one in sources:
        if hasattr(one, "breaks"):
            all_times.append(np.asarray(one.breaks(), dtype=np.float64))
            break
    return np.array(sorted({time for times in all_times for time in times.tolist()}), dtype=float)


STAGES, INTERPOLATION_STAGES = 12, 3  # of a step, and for what is between its ends
DORMAND_PRINCE_TOLERANCE = 1e-12  # error of a step, per size of the state
_MAX_STEP_RATIO, _SAFETY_FACTOR = 5.0, 0.9  # change of the step's length from one to the next


def _scipy_method() -> Any:
    """What has the coefficients, which only a program that is not kept has to be made of."""
    from scipy.integrate import DOP853  # slow to import

    return DOP853


class DormandPrinceStepper(ErrorControlledStepper):
    """See above; `tolerance` is that of `error_tolerances`.

    Args:
        chart: The machine.
        control: Its controller.
        controller_state_count: Number of the controller's states.
        tolerance: Error of a step, per size of the state.

    Raises:
        TooLongError: It would take too long to compile.
    """

    def __init__(
        self,
        chart: Chart,
        control: TracedController,
        controller_state_count: int,
        tolerance: float = DORMAND_PRINCE_TOLERANCE,
    ):
        errors = error_tolerances(chart, controller_state_count, tolerance)
        super().__init__(chart, control, controller_state_count, ("explicit",), False, errors)

    def _add_method(self, program: Program) -> None:
        """stage1(s, k, h) to stage11, more0 to more2; finish(numbers, s, k, h, tol); dense."""
        size, method = self.state_layout.size, _scipy_method()
        stages = {f"stage{i}": method.A[i] for i in range(1, STAGES)}
        stages |= {f"more{i}": row for i, row in enumerate(method.A_EXTRA)}
        for name, weights in stages.items():
            tape = Tape()
            displaced = scale_vector(tape.load(2, 0), weighted_sum(tape, 1, size, weights))
            program.add_formula(name, 3, add_vectors(tape.load_vector(0, 0, size), displaced))
        tape = Tape()
        state, h = tape.load_vector(1, 0, size), tape.load(3, 0)
        after = add_vectors(state, scale_vector(h, weighted_sum(tape, 2, size, method.B)))
        fifth: Scalar = 0.0
        third: Scalar = 0.0
        gaps = weighted_sum(tape, 2, size, method.E5), weighted_sum(tape, 2, size, method.E3)
        for one, other, share in zip(
            *gaps, self._inverse_error_scales(tape, 4, state, after), strict=True
        ):
            fifth = fifth + one * share * (one * share)
            third = third + other * share * (other * share)
        denominator = maximum(fifth + 0.01 * third, 1e-300)
        error = (
            apply_function("abs", h) * fifth / apply_function("sqrt", denominator * float(size))
        )
        is_length = [not turns for turns in self.closure_code.geometry.is_revolute[1:]]
        rates = tape.load_vector(2, 0, self.state_layout.parts["q"])
        largest_move = h * largest_scaled_value(
            rates, is_length, self.closure_code.inverse_characteristic_length(tape)
        )
        error = self._limit_rotation(error, largest_move)
        clipped_error = minimum(maximum(error, 1e-9), 1e9)
        step_ratio = _SAFETY_FACTOR * apply_function(
            "exp", (-1.0 / 8.0) * apply_function("log", clipped_error)
        )
        step_ratio = minimum(maximum(step_ratio, MIN_STEP_RATIO), _MAX_STEP_RATIO)
        outputs = {
            "state": after,
            "error": [error],
            "change": [step_ratio],
            "move": [largest_move],
        }
        program.add_formula("finish", 5, outputs)
        # between the ends: state, slopes there, behind it
        tape = Tape()
        state, h, after = (
            tape.load_vector(0, 0, size),
            tape.load(2, 0),
            tape.load_vector(3, 0, size),
        )
        first, last = tape.load_vector(1, 0, size), tape.load_vector(1, STAGES * size, size)
        displacement = subtract_vectors(after, state)
        parts = [
            *displacement,
            *subtract_vectors(scale_vector(h, first), displacement),
            *subtract_vectors(
                scale_vector(2.0, displacement), scale_vector(h, add_vectors(first, last))
            ),
        ]
        for weights in method.D:
            parts += scale_vector(h, weighted_sum(tape, 1, size, weights))
        program.add_formula("dense", 4, parts)

    def _write_step(self, program: Program, step: StepCode) -> tuple[StepWriter, StepWriter]:
        """See `ErrorControlledStepper`."""
        r, size, method = step.routine, self.state_layout.size, _scipy_method()
        # a rate has more behind it, which the next one replaces
        more = program.formula_outputs("rate").size - size
        k, stage = (
            r.local_array("k", (STAGES + 1 + INTERPOLATION_STAGES) * size + more),
            r.local_array("stage", size),
        )

        def attempt(t: RoutineValue, length: RoutineValue) -> None:
            r.copy(k, step.start_rate, size)
            for i in range(1, STAGES):
                r.call(f"stage{i}", r.state, k, step.length, stage)
                step.call(
                    "rate", t + length * float(method.C[i]), stage, k.element_pointer(i * size)
                )
            r.call("finish", r.geometry, r.state, k, step.length, r.tol, step.step_result)

        def interpolate(t: RoutineValue, length: RoutineValue) -> None:
            r.copy(k.element_pointer(STAGES * size), step.end_rate, size)
            for i in range(INTERPOLATION_STAGES):
                r.call(f"more{i}", r.state, k, step.length, stage)
                at = k.element_pointer((STAGES + 1 + i) * size)
                step.call("rate", t + length * float(method.C_EXTRA[i]), stage, at)
            r.call("dense", r.state, k, step.length, step.step_result, step.dense_output)

        return attempt, interpolate
