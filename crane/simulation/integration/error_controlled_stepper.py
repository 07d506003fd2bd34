"""Compiled methods with step-size control: base class, and the method of Dormand and Prince.

The method of order 8 with embedded methods of order 5 and 3 and an interpolant of order 7 is that
of Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, II.5 and II.6; the
coefficients are those of scipy.
"""

from abc import abstractmethod
from collections.abc import Hashable, Sequence

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
from crane.control.valve_drive import ValveDrive
from crane.dynamics.external_forces import state_count
from crane.machine.machine import Machine
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.machine_code_stepper import MachineCodeStepper
from crane.simulation.integration.machine_formulas import reference_samples, wrap_rotations
from crane.simulation.integration.step_loop import MIN_STEP_RATIO, StepLoop, StepWriter

MAX_REFERENCE_SPACING = 5e-4  # largest interval between the samples of references [s]
MIN_SCALE = 0.1  # least scale of states: rad, characteristic lengths, per characteristic time
ENERGY_TOLERANCE_FACTOR = 10.0  # tolerance of energies, relative to that of other states
STAGES, INTERPOLATION_STAGES = 12, 3  # of the method of Dormand and Prince
DORMAND_PRINCE_TOLERANCE = 1e-12  # error of a step, relative to the size of the state
_DORMAND_PRINCE_MAX_STEP_RATIO = 5.0
_SAFETY_FACTOR = 0.9  # of proposed step sizes
_MAX_ROTATION_PER_STEP = 2.5  # largest rotation of floating bodies in a step [rad]
_MAX_REFERENCE_PAIRS = 1000  # pairs of references of a call
_STEP_REDUCTION_AFTER_EVENT = 0.2  # ratio of the first step size after an event
_TIME_TOLERANCE = 1e-9  # share of the output interval: difference of equal instants


def characteristic_energy(machine: Machine) -> float:
    """Kinetic energy of the mass of a machine at its characteristic speed, doubled [J]."""
    closure = machine.closure
    mass = sum(inertia.mass for inertia in machine.model.inertias)
    return float(mass * (closure.characteristic_length / closure.characteristic_time) ** 2)


def error_tolerances(chart: Chart, tolerance: float) -> Array:
    """Absolute tolerances (k,) of all states, and then the relative tolerance.

    Those of work and dissipation, which do not act back, are larger by `ENERGY_TOLERANCE_FACTOR`.
    """
    closure = chart.machine.closure
    rates = closure.units[closure.active] / closure.characteristic_time
    energies = np.full(
        2 + len(chart.machine.external_forces),
        ENERGY_TOLERANCE_FACTOR * characteristic_energy(chart.machine),
    )
    contact_scales = np.full(
        state_count(chart.machine.external_forces), closure.characteristic_length
    )
    scales = np.concatenate(
        [closure.units, rates, contact_scales, np.ones(chart.controller_state_count), energies]
    )
    return tolerance * np.append(MIN_SCALE * scales, 1.0)


def weighted_sum(tape: Tape, argument: int, size: int, weights: Array) -> list[Scalar]:
    """Weighted sum of the vectors of a size that an argument holds one after another."""
    out: list[Scalar] = [0.0] * size
    for j, weight in enumerate(weights):
        if weight:
            out = add_vectors(
                out, scale_vector(float(weight), tape.load_vector(argument, j * size, size))
            )
    return out


class ErrorControlledStepper(MachineCodeStepper):
    """Base class of compiled methods with step-size control and dense output.

    A method implements `_add_method` and `_write_step`. Steps end at the break times of the
    controller. Those of circuits also end at the output instants, as dense output does not keep
    the oil balance.

    Args:
        chart: The machine in a chart.
        method: Further properties on which the code depends.
        fold_settings: Whether zeros and ones among the settings of the controller become part of
            the code.
        tolerance: Error tolerances of the method.

    Raises:
        FormulaTooLongError: The formulas are too long to be compiled.
    """

    def __init__(
        self,
        chart: Chart,
        method: tuple[Hashable, ...],
        fold_settings: bool,
        tolerance: Array,
    ):
        self._steps_end_at_outputs = isinstance(chart.control, ValveDrive)
        super().__init__(chart, method, fold_settings)
        self.tolerance = np.ascontiguousarray(tolerance)
        self._step_state = np.array([0.0] * 5 + [np.inf, 0.0])
        # of the controller, or its reference, and of external forces [s]
        sources = [x for x in (self._control, self._control.reference) if hasattr(x, "breaks")]
        breaks = [x.breaks() for x in (*chart.machine.external_forces, *sources[:1])]
        self._break_times = np.unique(np.concatenate([*breaks, [np.inf]]))

    def restart(self) -> None:
        """Start the next run with a short step."""
        self._step_state[0] = 0.0

    def run(
        self, first: float, state: Array, offset: float, step: float, rows: Array
    ) -> tuple[int, float]:
        """Integrate over output instants, up to the instant behind the last.

        Args:
            first: The first output instant [s].
            state: State, replaced by the final one.
            offset: Time of the state after the first instant; at least minus one interval [s].
            step: Interval of the output instants [s].
            rows: (N, row size) in any memory order, filled; empty to integrate to the next
                instant.

        Returns:
            Number of filled rows, and time of the state after the next instant without a row [s].
            Fewer than all rows are filled where a step fails or another chart is needed.
        """
        lengths, pair = self._step_state, min(step, 2.0 * MAX_REFERENCE_SPACING)
        lengths[6] = 0.0
        if lengths[0] != step:
            lengths[:2] = step, 0.01 * min(step, MAX_REFERENCE_SPACING)
        functions = [self.closure_code.close_address]
        if self.external_callback is not None:
            functions.append(self.external_callback.address)
        max_rows, done = max(1, int(_MAX_REFERENCE_PAIRS * pair / step)), 0
        out = np.empty((min(max_rows, len(rows)), rows.shape[1]))
        while done < len(rows) or offset < 0:
            count = min(max_rows, len(rows) - done)
            now, segment_start = first + step * done, offset
            segment_end = min(count * step, segment_start + _MAX_REFERENCE_PAIRS * pair)
            difference = _TIME_TOLERANCE * step
            next_time = now + segment_start + difference
            breaks, following = self._break_times, np.searchsorted(self._break_times, next_time)
            time_to_break = breaks[following] - now
            may_jump = bool(self._control.period)
            if isinstance(self._control, ValveDrive) and may_jump:
                time_to_break = min(
                    time_to_break, self._control.next_delayed_jump(next_time) - now
                )
            starts_at_break = following and breaks[following - 1] > next_time - 2.0 * difference
            segment_end = min(segment_end, time_to_break)
            last_output = np.floor((segment_end + difference) / step) * step
            has_outputs = last_output > segment_start + difference
            if self._steps_end_at_outputs and has_outputs:  # samples of a log are output instants
                segment_end = min(segment_end, 0.0 if offset < 0 else last_output)
            ends_at_break = time_to_break < segment_end + difference
            pairs = max(1, int(np.ceil((segment_end - segment_start) / pair - _TIME_TOLERANCE)))
            lengths[2:5] = segment_start, (segment_end - segment_start) / pairs, segment_end
            # references have one-sided limits where they may jump
            grid = np.linspace(now + segment_start, now + segment_end, 2 * pairs + 1)
            inwards = np.array([may_jump or starts_at_break, may_jump or ends_at_break]) * [1, -1]
            grid[[0, -1]] += _TIME_TOLERANCE * (grid[1] - grid[0]) * inwards
            rows_made = self._program.call(
                "run",
                count,
                *functions,
                *self._common_arguments,
                reference_samples(self._chart.machine, self._control, grid),
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
            if lengths[6]:
                lengths[1] *= _STEP_REDUCTION_AFTER_EVENT
                break
            if time_left > _TIME_TOLERANCE * step:
                lengths[0] = 0.0  # the step size may have become minimal
                break
        return done, offset

    def _build(self, program: Program) -> None:
        for suffix, with_joints_at_rest in self._rest_variants:
            machine = self.trace_controlled_machine(Tape())
            outputs = machine.outputs(with_joints_at_rest)
            if isinstance(self._control, ValveDrive):
                outputs += self._control.channel_values(machine.inputs)
            rate, margin = machine.state_rate(with_joints_at_rest)
            program.add_formula("observe" + suffix, 5, {"outputs": outputs, "margin": [margin]})
            closure = self._chart.machine.closure
            event_distances = machine.dynamics_formulas.end_stop_distances(
                closure.units.tolist(), closure.characteristic_length
            )
            event_distances += scale_vector(
                1.0 / closure.characteristic_length, machine.external_forces.event_distances
            )
            if isinstance(self._control, ValveDrive):
                event_distances += self._control.void_distances(machine.inputs)
            program.add_formula(
                "rate" + suffix,
                5,
                {"rate": rate, "margin": [margin], "event_distances": event_distances},
            )
        if self.external_callback is not None:
            program.add_formula("callback_inputs", 5, machine.external_forces.callback_inputs)
            with program.add_routine(
                "external", functions=("callback",), arrays=("callback_inputs", "results")
            ) as r:
                r.return_value(r.call("callback", r.callback_inputs, r.results))
        if count := len(event_distances):  # signs, and the least product of distance and sign
            start = program.formula_outputs("rate").start_index("event_distances")
            signs = [copysign(1.0, x) for x in Tape().load_vector(0, start, count)]
            program.add_formula("event_signs", 1, signs)
            tape = Tape()
            smallest: Scalar = 1.0
            pairs = tape.load_vector(0, start, count), tape.load_vector(1, 0, count)
            for distance, sign in zip(*pairs, strict=True):
                smallest = minimum(smallest, distance * sign)
            program.add_formula("least_distance", 2, [smallest])
        self._add_method(program)
        self._add_interpolation(program)
        functions = ("close",) if self.external_callback is None else ("close", "callback")
        names = ("geometry", "numbers", "control", "refs", "state", "out", "h", "bounds", "tol")
        with program.add_routine("run", counts=("steps",), functions=functions, arrays=names) as r:
            StepLoop(self, program, r, self._steps_end_at_outputs).write(self._write_step)

    def _add_interpolation(self, program: Program) -> None:
        """reference(rows, s), interpolate(state, dense, x), wrap(state)."""
        # the parabola through references at 0, 1/2, 1
        tape = Tape()
        s, columns = tape.load(1, 0), self.reference_columns
        rows = [tape.load_vector(0, columns * row, columns) for row in range(3)]
        shares = ((2.0 * s - 1.0) * (s - 1.0), 4.0 * s * (1.0 - s), s * (2.0 * s - 1.0))
        program.add_formula(
            "reference", 2, [dot(shares, values) for values in zip(*rows, strict=True)]
        )
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

    def _inverse_error_scales(
        self, tape: Tape, argument: int, start: list[Scalar], end: list[Scalar]
    ) -> list[Scalar]:
        """One over the tolerated errors of all states of a step, by `error_tolerances`."""
        out: list[Scalar] = []
        for i, (x, y) in enumerate(zip(start, end, strict=True)):
            size = maximum(apply_function("abs", x), apply_function("abs", y))
            if i >= self.state_layout.start_index("work"):
                size = ENERGY_TOLERANCE_FACTOR * size
            out.append(
                1.0 / maximum(tape.load(argument, i), tape.load(argument, len(start)) * size)
            )
        return out

    def _largest_move(self, tape: Tape, displacements: Sequence[Scalar]) -> Scalar:
        """Largest displacement of a joint [rad], [characteristic lengths]."""
        is_length = [not turns for turns in self.closure_code.geometry.is_revolute[1:]]
        return largest_scaled_value(
            displacements, is_length, self.closure_code.inverse_characteristic_length(tape)
        )

    def _finish_outputs(
        self,
        after: list[Scalar],
        error: Scalar,
        largest_move: Scalar,
        order: float,
        max_step_ratio: float,
    ) -> dict[str, list[Scalar]]:
        """Outputs of the formula `finish`, with the ratio of the next step size.

        Args:
            after: State after the step.
            error: Error over its tolerance.
            largest_move: See `_largest_move`.
            order: Order of the error.
            max_step_ratio: Largest ratio of step sizes.
        """
        if self.has_rotation_vectors:  # larger rotations are not unique
            error = maximum(error, largest_move * (1.0 / _MAX_ROTATION_PER_STEP))
        log_error = apply_function("log", minimum(maximum(error, 1e-9), 1e9))
        step_ratio = _SAFETY_FACTOR * apply_function("exp", (-1.0 / order) * log_error)
        step_ratio = minimum(maximum(step_ratio, MIN_STEP_RATIO), max_step_ratio)
        return {"state": after, "error": [error], "change": [step_ratio], "move": [largest_move]}

    @abstractmethod
    def _add_method(self, program: Program) -> None:
        """Add the formulas of a method, among them `finish` and `dense`.

        For `finish` see `_finish_outputs`; `dense` has the coefficients of the dense output.
        """

    @abstractmethod
    def _write_step(self, program: Program, step: StepLoop) -> tuple[StepWriter, StepWriter]:
        """Writers of a step up to `finish`, and of `dense` after a step."""


class DormandPrinceStepper(ErrorControlledStepper):
    """Compiled steps of the method of Dormand and Prince of order 8.

    Args:
        chart: The machine in a chart.
        tolerance: Error of a step, relative to the size of the state.

    Raises:
        FormulaTooLongError: The formulas are too long to be compiled.
    """

    def __init__(self, chart: Chart, tolerance: float = DORMAND_PRINCE_TOLERANCE):
        super().__init__(chart, ("explicit",), False, error_tolerances(chart, tolerance))

    def _add_method(self, program: Program) -> None:
        """stage1(s, k, h) to stage11, extra0 to extra2; finish(constants, s, k, h, tol); dense."""
        # slow to import, and needed only where the program is not cached
        from scipy.integrate import DOP853

        size = self.state_layout.size
        stages = {f"stage{i}": DOP853.A[i] for i in range(1, STAGES)}
        stages |= {f"extra{i}": row for i, row in enumerate(DOP853.A_EXTRA)}
        for name, weights in stages.items():
            tape = Tape()
            displaced = scale_vector(tape.load(2, 0), weighted_sum(tape, 1, size, weights))
            program.add_formula(name, 3, add_vectors(tape.load_vector(0, 0, size), displaced))
        tape = Tape()
        state, h = tape.load_vector(1, 0, size), tape.load(3, 0)
        after = add_vectors(state, scale_vector(h, weighted_sum(tape, 2, size, DOP853.B)))
        fifth: Scalar = 0.0
        third: Scalar = 0.0
        errors = weighted_sum(tape, 2, size, DOP853.E5), weighted_sum(tape, 2, size, DOP853.E3)
        for error5, error3, scale in zip(
            *errors, self._inverse_error_scales(tape, 4, state, after), strict=True
        ):
            fifth = fifth + error5 * scale * (error5 * scale)
            third = third + error3 * scale * (error3 * scale)
        denominator = maximum(fifth + 0.01 * third, 1e-300)
        error = (
            apply_function("abs", h) * fifth / apply_function("sqrt", denominator * float(size))
        )
        largest_move = h * self._largest_move(
            tape, tape.load_vector(2, 0, self.state_layout.parts["q"])
        )
        program.add_formula(
            "finish",
            5,
            self._finish_outputs(after, error, largest_move, 8.0, _DORMAND_PRINCE_MAX_STEP_RATIO),
        )
        # dense output: from the states and rates at both ends, and the extra stages
        tape = Tape()
        state, h = tape.load_vector(0, 0, size), tape.load(2, 0)
        after = tape.load_vector(3, 0, size)
        first, last = tape.load_vector(1, 0, size), tape.load_vector(1, STAGES * size, size)
        displacement = subtract_vectors(after, state)
        parts = [
            *displacement,
            *subtract_vectors(scale_vector(h, first), displacement),
            *subtract_vectors(
                scale_vector(2.0, displacement), scale_vector(h, add_vectors(first, last))
            ),
        ]
        for weights in DOP853.D:
            parts += scale_vector(h, weighted_sum(tape, 1, size, weights))
        program.add_formula("dense", 4, parts)

    def _write_step(self, program: Program, step: StepLoop) -> tuple[StepWriter, StepWriter]:
        from scipy.integrate import DOP853  # slow to import

        r, size = step.routine, self.state_layout.size
        # rates have further outputs, which the next rate overwrites
        k = r.local_array(
            "k",
            (STAGES + 1 + INTERPOLATION_STAGES) * size
            + (program.formula_outputs("rate").size - size),
        )
        stage = r.local_array("stage", size)

        def attempt(t: RoutineValue, length: RoutineValue) -> None:
            r.copy(k, step.start_rate, size)
            for i in range(1, STAGES):
                r.call(f"stage{i}", r.state, k, step.length, stage)
                step.call(
                    "rate", t + length * float(DOP853.C[i]), stage, k.element_pointer(i * size)
                )
            r.call("finish", r.geometry, r.state, k, step.length, r.tol, step.step_result)

        def interpolate(t: RoutineValue, length: RoutineValue) -> None:
            r.copy(k.element_pointer(STAGES * size), step.end_rate, size)
            for i in range(INTERPOLATION_STAGES):
                r.call(f"extra{i}", r.state, k, step.length, stage)
                step.call(
                    "rate",
                    t + length * float(DOP853.C_EXTRA[i]),
                    stage,
                    k.element_pointer((STAGES + 1 + i) * size),
                )
            r.call("dense", r.state, k, step.length, step.step_result, step.dense_output)

        return attempt, interpolate
