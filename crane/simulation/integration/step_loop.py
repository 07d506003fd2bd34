"""The loop over the steps of a method with step-size control, as a compiled routine."""

from collections.abc import Callable
from dataclasses import dataclass

from crane.codegen import Program, RoutineValue, select
from crane.codegen.llvm.routine_builder import ArrayPointer, Routine
from crane.simulation.integration.machine_code_stepper import (
    HELD_INDEX,
    MachineCodeStepper,
    exceeds_chart_limits,
)
from crane.simulation.integration.stick_slip_modes import EVENT_TOLERANCE

MIN_STEP_RATIO = 0.2  # least ratio of a step size to the one before
_MIN_CLOSABLE_MOVE = 0.02  # displacement in coordinate units up to which the loops have to close
_MIN_STEP_SHARE = 1e-9  # least step size, as a share of the output interval
_MIN_TRIAL_SHARE = 0.02  # least share of a step that is tried to locate an event
_SECANT_TRIALS = 8  # trials before bisection
_END_SHARE = 1.0 - 2.0**-41  # share of the remaining time from which a step ends at its goal

FormulaCaller = Callable[..., None]
"""Writes the call of a formula by name, at a time relative to `run`, with state and arrays."""


StepWriter = Callable[[RoutineValue, RoutineValue], None]
"""Writes code for a start time and a step size."""


@dataclass(frozen=True)
class StepCode:
    """Code elements of a step.

    Attributes:
        routine: The routine.
        call: See `FormulaCaller`.
        start_rate: Rate at the start of the step.
        end_rate: Rate at its end.
        length: (1,) step size.
        step_result: Outputs of the formula `finish`.
        dense_output: Outputs of the formula `dense`.
    """

    routine: Routine
    call: FormulaCaller
    start_rate: ArrayPointer
    end_rate: ArrayPointer
    length: ArrayPointer
    step_result: ArrayPointer
    dense_output: ArrayPointer


@dataclass(frozen=True)
class _StepVariables:
    """Variables of one step.

    Attributes:
        length: Step size.
        last: Whether it ends at its goal.
        goal: The time at which it has to end at the latest.
        sure: 1 where an event counts as located.
        proposed: The step size that error control proposes.
    """

    length: RoutineValue
    last: RoutineValue
    goal: RoutineValue
    sure: RoutineValue
    proposed: RoutineValue


class StepLoop:
    """Writer of the routine `run`: steps and output instants until an end or an event.

    Elements of its argument h: output interval; step size to try; time of the state, relative to
    the first output instant before, and to the next one behind; spacing of references; end;
    whether a stick-slip transition is there.

    A step that passes an event is rejected. The secant method locates the event; steps that end
    before it are accepted.

    Args:
        stepper: The method with its machine and controller.
        program: The program with its formulas.
        routine: The routine to write.
        steps_end_at_outputs: Whether steps end at output instants.
    """

    def __init__(
        self,
        stepper: MachineCodeStepper,
        program: Program,
        routine: Routine,
        steps_end_at_outputs: bool,
    ):
        self._stepper, self._program, self._r, self._steps_end_at_outputs = (
            stepper,
            program,
            routine,
            steps_end_at_outputs,
        )
        self._size, self._output_size = stepper.state_layout.size, stepper.output_layout.size
        self._columns, self._has_stick_slip = stepper.reference_columns, stepper.has_stick_slip
        self._step_result = routine.local_array("following", program.formula_outputs("finish"))
        self._start_rate, self._end_rate = (
            routine.local_array(x, program.formula_outputs("rate")) for x in ("first", "ending")
        )
        self._observation = routine.local_array("looked", program.formula_outputs("observe"))
        self._dense_output = routine.local_array("inside", program.formula_outputs("dense"))
        self._interpolated = routine.local_array("between", self._size)
        self._closure_result = routine.local_array(
            "result", stepper.closure_code.formula_outputs("newton")
        )
        self._output_closure_result = routine.local_array(
            "found", stepper.closure_code.formula_outputs("newton")
        )
        self._relative_time, self._step_length = (
            routine.local_array("theta", 1),
            routine.local_array("part", 1),
        )
        self._reference = routine.local_array("reference", max(1, self._columns))
        self._machine_arguments = (
            routine.geometry,
            routine.numbers,
            routine.control,
            self._reference,
        )
        if stepper.external_callback is not None:
            self._callback_inputs = routine.local_array(
                "callback_inputs", program.formula_outputs("callback_inputs")
            )
            self._callback_results = self._reference.element_pointer(stepper.controller_columns)
        self._output_interval, self._reference_spacing, self._end_time = (
            routine.new_variable(routine.h[0]),
            routine.new_variable(routine.h[3]),
            routine.new_variable(routine.h[4]),
        )
        self._time = routine.new_variable(routine.h[2])
        self._recorded_count, self._output_time = (
            routine.new_variable(0),
            routine.new_variable(0.0),
        )
        # references at the start of the step
        self._reference_index, self._reference_time = (
            routine.new_variable(0),
            routine.new_variable(self._time),
        )
        self._event_distance_count = program.formula_outputs("rate").parts["event_distances"]

    def write(
        self, make_step: Callable[[Program, StepCode], tuple[StepWriter, StepWriter]]
    ) -> None:
        """Write the routine.

        Args:
            make_step: Returns the writers of a step up to `finish`, and of `dense` after a step.
        """
        r = self._r
        self._attempt_step, self._interpolate = make_step(
            self._program,
            StepCode(
                r,
                self._call_formula,
                self._start_rate,
                self._end_rate,
                self._step_length,
                self._step_result,
                self._dense_output,
            ),
        )
        self._call_formula("rate", self._time, r.state, self._start_rate)
        self._begin_location()
        with r.loop_forever():
            self._write_step()
        self._write_return()

    def _begin_location(self) -> None:
        """Variables of event location: time to the event, and margins before and behind it."""
        r = self._r
        self._time_to_event, self._margin_before, self._margin_behind = (
            r.new_variable(0.0),
            r.new_variable(1.0),
            r.new_variable(0.0),
        )
        self._trial_count = r.new_variable(0)
        self._event_signs, self._signed_distance = (
            r.local_array("event_signs", max(1, self._event_distance_count)),
            r.local_array("least_distance", 1),
        )
        if self._event_distance_count:
            r.call("event_signs", self._start_rate, self._event_signs)
        if self._has_stick_slip:
            r.assign(self._margin_before, self._start_rate["margin"])
            with r.if_then(self._margin_before < -EVENT_TOLERANCE):
                r.store(r.h, 5, 1.0)
                self._write_return()

    def _write_step(self) -> None:
        r = self._r
        step = self._propose_step()
        if self._columns:
            self._advance_references(self._reference_index, self._reference_time, self._time)
        r.store(self._step_length, 0, step.length)
        self._attempt_step(self._time, step.length)
        change = self._step_result["change"]
        # NaN: slower
        next_length = r.new_variable(step.length * select(change > 0.0, change, MIN_STEP_RATIO))
        with r.if_then(self._step_result["error"] <= 1.0):
            closed = r.call("close", r.geometry, self._step_result, self._closure_result, r.bounds)
            with r.if_then(closed < 1):
                # a shorter step, which comes nearer to the end of a branch
                r.store(r.h, 1, step.length * MIN_STEP_RATIO)
                with r.if_then(self._step_result["move"] < _MIN_CLOSABLE_MOVE):
                    self._write_return()
            with r.if_else():
                self._finish_step(step, next_length)
        with r.if_else():
            r.store(r.h, 1, next_length)

    def _propose_step(self) -> _StepVariables:
        """Size and end of the next step; leaves the loop at the end."""
        r, output_interval = self._r, self._output_interval
        time_left, proposed = r.new_variable(self._end_time - self._time), r.new_variable(r.h[1])
        with r.if_then(~(time_left > output_interval * _MIN_STEP_SHARE)):
            r.break_loop()
        is_located, goal = r.new_variable(0), r.new_variable(self._end_time)
        if self._steps_end_at_outputs:
            output_time = self._output_time
            r.assign(
                goal,
                select(
                    output_time > self._time + output_interval * _MIN_STEP_SHARE,
                    output_time,
                    output_time + output_interval,
                ),
            )
            with r.if_then(goal > self._end_time):
                r.assign(goal, self._end_time)
            r.assign(time_left, goal - self._time)
        if self._has_stick_slip:
            with r.if_then((r.bounds[HELD_INDEX] > 0.5) & (proposed > output_interval)):
                r.assign(
                    proposed, output_interval
                )  # the margin of joints at rest does not limit the step size
        if self._has_stick_slip or self._event_distance_count:
            with r.if_then(self._time_to_event > 0.0):
                self._locate_event(time_left, is_located)
        last = r.new_variable(proposed >= time_left * _END_SHARE)
        length = r.new_variable(select(last, time_left, proposed))
        with r.if_then(
            ~(length >= output_interval * _MIN_STEP_SHARE) & (self._time_to_event <= 0.0)
        ):
            self._write_return()
        return _StepVariables(length, last, goal, is_located, proposed)

    def _locate_event(self, time_left: RoutineValue, is_located: RoutineValue) -> None:
        """Shorten the remaining time to where the secant method expects the event."""
        r, time_to_event = self._r, self._time_to_event
        share = r.new_variable(
            (self._margin_before + 1.5 * EVENT_TOLERANCE)
            / (self._margin_before - self._margin_behind)
        )
        with r.if_then(self._trial_count > _SECANT_TRIALS):
            r.assign(share, 0.5)
        with r.if_then(~(share > _MIN_TRIAL_SHARE)):
            r.assign(share, _MIN_TRIAL_SHARE)
        with r.if_then(share > 1.0 - _MIN_TRIAL_SHARE):
            r.assign(share, 1.0 - _MIN_TRIAL_SHARE)
        with r.if_then(
            time_to_event < self._output_interval * _MIN_STEP_SHARE
        ):  # a margin that jumps
            r.assign(share, 1.0)
            r.assign(is_located, 1)
        r.assign(time_left, time_to_event * share)
        r.assign(self._trial_count, self._trial_count + 1)

    def _finish_step(self, step: _StepVariables, next_length: RoutineValue) -> None:
        """Detect events and record outputs after an accepted step whose loops are closed."""
        r = self._r
        self._call_formula("rate", self._time + step.length, self._step_result, self._end_rate)
        is_beyond_event, event = r.new_variable(0), r.new_variable(0)
        least_margin = r.new_variable(1.0)
        self._detect_event(step, is_beyond_event, event, least_margin)
        self._record_outputs(step, is_beyond_event, event)
        with r.if_then(is_beyond_event < 1):
            self._accept_step(step, next_length, event, least_margin)

    def _detect_event(
        self,
        step: _StepVariables,
        is_beyond_event: RoutineValue,
        event: RoutineValue,
        least_margin: RoutineValue,
    ) -> None:
        """Detect whether an event is within the step (is_beyond_event) or at its end (event)."""
        r = self._r
        if self._has_stick_slip:
            r.assign(least_margin, self._end_rate["margin"])
            with r.if_then(least_margin < -EVENT_TOLERANCE):
                r.assign(event, 1)
        if self._event_distance_count:
            r.call("least_distance", self._end_rate, self._event_signs, self._signed_distance)
            with r.if_then(self._signed_distance[0] < least_margin):
                r.assign(least_margin, self._signed_distance[0])
        if self._has_stick_slip or self._event_distance_count:
            with r.if_then((least_margin < -2.0 * EVENT_TOLERANCE) & (step.sure < 1)):
                r.assign(is_beyond_event, 1)
                r.assign(event, 0)
                r.assign(self._time_to_event, step.length)
                r.assign(self._margin_behind, least_margin)

    def _record_outputs(
        self, step: _StepVariables, is_beyond_event: RoutineValue, event: RoutineValue
    ) -> None:
        """Write the rows of the output instants within the step."""
        r, output_time, length = self._r, self._output_time, step.length
        count, output_time_before = (
            r.new_variable(self._recorded_count),
            r.new_variable(output_time),
        )
        with r.if_then((is_beyond_event < 1) & (output_time < (self._time + length) * _END_SHARE)):
            self._interpolate(self._time, length)
        with r.loop_forever():
            with r.if_then(
                (is_beyond_event > 0) | ~(output_time < (self._time + length) * _END_SHARE)
            ):
                r.break_loop()
            row = r.out.row_pointer(self._recorded_count, self._size + self._output_size)
            r.store(self._relative_time, 0, (output_time - self._time) / length)
            r.call(
                "interpolate", r.state, self._dense_output, self._relative_time, self._interpolated
            )
            closed = r.call(
                "close", r.geometry, self._interpolated, self._output_closure_result, r.bounds
            )
            with r.if_then(closed < 1):
                self._write_return()
            self._call_formula("observe", output_time, self._interpolated, self._observation)
            if self._has_stick_slip:
                margin = self._observation["margin"]
                with r.if_then(
                    (margin < -2.0 * EVENT_TOLERANCE) & (output_time > self._time) & (event < 1)
                ):
                    r.assign(is_beyond_event, 1)
                    r.assign(self._time_to_event, output_time - self._time)
                    r.assign(self._margin_behind, margin)
                    r.assign(self._recorded_count, count)
                    r.assign(output_time, output_time_before)
                    r.break_loop()
            r.copy(row.element_pointer(self._size), self._observation, self._output_size)
            r.copy(row, self._interpolated, self._size)
            r.assign(self._recorded_count, self._recorded_count + 1)
            r.assign(output_time, output_time + self._output_interval)

    def _accept_step(
        self,
        step: _StepVariables,
        next_length: RoutineValue,
        event: RoutineValue,
        least_margin: RoutineValue,
    ) -> None:
        """Continue from the end of the step."""
        r, time_to_event = self._r, self._time_to_event
        # a step that was shortened to its goal keeps the proposed size
        keeps_proposal = step.last & (step.proposed > next_length)
        r.store(r.h, 1, select(keeps_proposal, step.proposed, next_length))
        at_goal = step.last & (time_to_event <= 0.0)
        r.assign(self._time, select(at_goal, step.goal, self._time + step.length))
        if self._stepper.has_floating_base:  # rates depend on the rotation vector
            r.call("wrap", self._step_result, r.state)
            self._call_formula("rate", self._time, r.state, self._start_rate)
        else:
            r.copy(r.state, self._step_result, self._size)
            r.copy(self._start_rate, self._end_rate, self._size)
        with r.if_then(event > 0):
            r.store(r.h, 5, 1.0)
            self._write_return()
        with r.if_then(time_to_event > 0.0):
            r.assign(time_to_event, time_to_event - step.length)
            r.assign(self._margin_before, least_margin)
        if self._event_distance_count:
            r.call("event_signs", self._end_rate, self._event_signs)
            with r.if_then(least_margin < -EVENT_TOLERANCE):  # a passed event distance
                r.assign(time_to_event, 0.0)
                r.assign(self._trial_count, 0)
                r.assign(self._margin_before, 1.0)
        with r.if_then(exceeds_chart_limits(r, self._closure_result)):
            self._write_return()

    def _advance_references(
        self, index: RoutineValue, start_time: RoutineValue, time: RoutineValue
    ) -> None:
        """Move the interpolated references to those around a time."""
        r = self._r
        with r.loop_forever():
            with r.if_then(
                ~(
                    (time >= start_time + self._reference_spacing)
                    & (start_time + self._reference_spacing * 1.5 < self._end_time)
                )
            ):
                r.break_loop()
            r.assign(index, index + 1)
            r.assign(start_time, start_time + self._reference_spacing)

    def _interpolate_references(self, time: RoutineValue) -> None:
        """Interpolate the references at a time within the step."""
        r = self._r
        index, start_time = (
            r.new_variable(self._reference_index),
            r.new_variable(self._reference_time),
        )
        self._advance_references(index, start_time, time)
        r.store(self._relative_time, 0, (time - start_time) / self._reference_spacing)
        row = r.refs.row_pointer(index, 2 * self._columns)
        r.call("reference", row, self._relative_time, self._reference)

    def _call_formula(self, formula: str, time: RoutineValue, *arrays: ArrayPointer) -> None:
        r = self._r
        if self._columns:
            self._interpolate_references(time)
        if self._stepper.external_callback is not None:
            r.call("callback_inputs", *self._machine_arguments, arrays[0], self._callback_inputs)
            r.call("callback", self._callback_inputs, self._callback_results)
        self._stepper.call_formula(r, formula, *self._machine_arguments, *arrays)

    def _write_return(self) -> None:
        self._r.store(self._r.h, 2, self._time - self._output_time)
        self._r.return_value(self._recorded_count)
