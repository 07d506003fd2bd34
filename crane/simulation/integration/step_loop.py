"""The loop over the steps of a method with step-size control, as a compiled routine."""

from collections.abc import Callable

from crane.codegen import ArrayPointer, Program, Routine, RoutineValue, select
from crane.simulation.integration.machine_code_stepper import (
    HELD_INDEX,
    MachineCodeStepper,
    exceeds_chart_limits,
)
from crane.simulation.integration.stick_slip_modes import EVENT_TOLERANCE

MIN_STEP_RATIO = 0.2  # least ratio of a step size to the one before
_MIN_CLOSABLE_MOVE = 0.02  # displacement in coordinate units up to which the loops have to close
_MIN_STEP_SHARE = 1e-9  # least step size, as a share of the output interval
_MAX_JUMP_SHARE = 1e-6  # step size from which on rejected steps are searched for jumps, likewise
_MAX_JUMP_ERROR = 1e9  # largest error of a step over a located jump, over its tolerance
_MIN_TRIAL_SHARE = 0.02  # least share of a step that is tried to locate an event
_SECANT_TRIALS = 24  # trials of the Illinois method before bisection
_END_SHARE = 1.0 - 2.0**-41  # share of the remaining time from which a step ends at its goal

_GRID_RATIO = 0.95  # of step sizes on the grid
_GRID_SHARE = 1e-3  # least size on the grid, as a share of the output interval

StepWriter = Callable[[RoutineValue, RoutineValue], None]
"""Writes code for a start time and a step size."""


class StepLoop:
    """Writer of the routine `run`: steps and output instants until an end or an event.

    Elements of its argument h: output interval; step size to try; time of the state, relative to
    the first output instant before, and to the next one behind; spacing of references; end;
    most steps, rejected ones included; whether a stick-slip transition is there.

    A step that passes an event is rejected. The Illinois method locates the event (a secant method
    that halves the margin of an end that stays); steps that end before it are accepted. Where
    rates jump, as where a void forms, no step over the event meets its tolerance: it is located by
    the rejected steps, and passed by one of a billionth of the output interval.

    Args:
        stepper: The method with its machine and controller.
        program: The program with its formulas.
        routine: The routine to write.
        steps_end_at_outputs: Whether steps end at output instants.

    Attributes:
        routine: The routine.
        start_rate: Rate at the start of the step.
        end_rate: Rate at its end.
        length: (1,) step size.
        step_result: Outputs of the formula `finish`.
        dense_output: Outputs of the formula `dense`.
    """

    def __init__(
        self,
        stepper: MachineCodeStepper,
        program: Program,
        routine: Routine,
        steps_end_at_outputs: bool,
    ):
        self.routine, self._program, self._stepper = routine, program, stepper
        self._steps_end_at_outputs = steps_end_at_outputs
        self._size, self._output_size = stepper.state_layout.size, stepper.output_layout.size
        self._columns, self._has_stick_slip = stepper.reference_columns, stepper.has_stick_slip
        array, formula_outputs = routine.local_array, program.formula_outputs
        self.step_result = array("following", formula_outputs("finish"))
        self.start_rate, self.end_rate = (
            array(name, formula_outputs("rate")) for name in ("first", "ending")
        )
        self._observation = array("looked", formula_outputs("observe"))
        self.dense_output = array("inside", formula_outputs("dense"))
        self._interpolated = array("between", self._size)
        self._closure_result, self._output_closure_result = (
            array(name, stepper.closure_code.formula_outputs("newton"))
            for name in ("result", "found")
        )
        self._relative_time, self.length = array("theta", 1), array("part", 1)
        self._reference = array("reference", max(1, self._columns))
        self._machine_arguments = (
            routine.geometry, routine.numbers, routine.control, self._reference,
        )  # fmt: skip
        if stepper.external_callback is not None:
            self._callback_inputs = array("callback_inputs", formula_outputs("callback_inputs"))
        self._output_interval, self._time, self._reference_spacing, self._end_time = (
            routine.new_variable(routine.h[i]) for i in (0, 2, 3, 4)
        )
        self._recorded_count, self._output_time = (
            routine.new_variable(0),
            routine.new_variable(0.0),
        )
        # references at the start of the step
        self._reference_index, self._reference_time = (
            routine.new_variable(0),
            routine.new_variable(self._time),
        )
        self._event_distance_count = formula_outputs("rate").parts["event_distances"]
        self._has_events = self._has_stick_slip or bool(self._event_distance_count)

    def write(
        self, make_step: Callable[[Program, "StepLoop"], tuple[StepWriter, StepWriter]]
    ) -> None:
        """Write the routine.

        Args:
            make_step: Returns the writers of a step up to `finish`, and of `dense` after a step.
        """
        r = self.routine
        self._attempt_step, self._interpolate = make_step(self._program, self)
        self.call("rate", self._time, r.state, self.start_rate)
        # event location: time to the event, and margins before and behind it
        self._time_to_event, self._trial_count = r.new_variable(0.0), r.new_variable(0)
        self._last_trial = r.new_variable(0)  # 1 beyond the event, -1 before it
        self._margin_before, self._margin_behind = r.new_variable(1.0), r.new_variable(0.0)
        self._event_signs = r.local_array("event_signs", max(1, self._event_distance_count))
        self._signed_distance = r.local_array("least_distance", 1)
        self._update_margin_before(self.start_rate)
        if self._has_stick_slip:
            with r.if_then(self.start_rate["margin"] < -EVENT_TOLERANCE):
                r.store(r.h, 6, 1.0)
                self._write_return()
        tried = r.new_variable(0.0)
        with r.loop_forever():
            with r.if_then(~(tried < r.h[5])):
                r.break_loop()
            r.assign(tried, tried + 1.0)
            self._write_step()
        self._write_return()

    def _update_margin_before(self, rate: ArrayPointer) -> None:
        """Margin of the next event, from the rate at the start of a step."""
        r, margin = self.routine, self._margin_before
        r.assign(margin, rate["margin"] if self._has_stick_slip else 1.0)
        if self._event_distance_count:
            r.call("event_signs", rate, self._event_signs)
            r.call("least_distance", rate, self._event_signs, self._signed_distance)
            distance = self._signed_distance[0]
            r.assign(margin, select(distance < margin, distance, margin))

    def _write_step(self) -> None:
        r = self.routine
        self._propose_step()
        length = self._step_size
        if self._columns:
            self._advance_references(self._reference_index, self._reference_time, self._time)
        r.store(self.length, 0, length)
        self._attempt_step(self._time, length)
        change = self.step_result["change"]
        # NaN: slower
        ratio = select(change > 0.0, change, MIN_STEP_RATIO)
        next_length = self._size_on_grid(r.new_variable(length * ratio))
        error = self.step_result["error"]
        # no step over a jump is short enough for its tolerance
        with r.if_then((error <= 1.0) | ((self._is_located > 0) & (error < _MAX_JUMP_ERROR))):
            with r.if_then(self._close_loops(self.step_result, self._closure_result) < 1):
                # a shorter step, which comes nearer to the end of a branch
                r.store(r.h, 1, length * MIN_STEP_RATIO)
                with r.if_then(self.step_result["move"] < _MIN_CLOSABLE_MOVE):
                    self._write_return()
            with r.if_else():
                # behind a jump the error of the step over it says nothing
                restart = r.new_variable(self._output_interval * _MAX_JUMP_SHARE)
                is_short = (self._is_located > 0) & (next_length < restart)
                r.assign(next_length, select(is_short, restart, next_length))
                self._finish_step(next_length)
        with r.if_else():
            r.store(r.h, 1, next_length)
            if self._event_distance_count:
                self._detect_jump()

    def _size_on_grid(self, proposed: RoutineValue) -> RoutineValue:
        """The largest size on the grid up to a proposed one within the range of the grid.

        Rounding errors of the error of a step thus hardly ever change the sizes of later ones.
        """
        r, interval = self.routine, self._output_interval
        size, least = r.new_variable(interval), r.new_variable(interval * _GRID_SHARE)
        with r.loop_forever():
            with r.if_then((size <= proposed) | (size < least)):
                r.break_loop()
            r.assign(size, size * _GRID_RATIO)
        is_inside = (proposed > least) & (proposed < interval)
        return r.new_variable(select(is_inside, size, proposed))

    def _detect_jump(self) -> None:
        """Detect an event at which rates jump, in a step that has become short for that."""
        r, size = self.routine, self._step_size
        with r.if_then(size < self._output_interval * _MAX_JUMP_SHARE):
            self.call("rate", self._time + size, self.step_result, self.end_rate)
            r.call("least_distance", self.end_rate, self._event_signs, self._signed_distance)
            with r.if_then(self._signed_distance[0] < -2.0 * EVENT_TOLERANCE):
                self._bring_nearer(size, r.new_variable(self._signed_distance[0]))

    def _close_loops(self, state: ArrayPointer, result: ArrayPointer) -> RoutineValue:
        """Close the loops of a state; returns 1 if they close."""
        return self.routine.call(
            "close", self.routine.geometry, state, result, self.routine.bounds
        )

    def _propose_step(self) -> None:
        """Size and end of the next step; leaves the loop at the end."""
        r, output_interval = self.routine, self._output_interval
        min_size = output_interval * _MIN_STEP_SHARE
        time_left, proposed = r.new_variable(self._end_time - self._time), r.new_variable(r.h[1])
        with r.if_then(~(time_left > min_size)):
            r.break_loop()
        self._is_located, self._goal = r.new_variable(0), r.new_variable(self._end_time)
        if self._steps_end_at_outputs:
            output_time, goal = self._output_time, self._goal
            is_ahead = output_time > self._time + min_size
            r.assign(goal, select(is_ahead, output_time, output_time + output_interval))
            r.assign(goal, select(goal > self._end_time, self._end_time, goal))
            r.assign(time_left, goal - self._time)
        if self._has_stick_slip:
            # the margin of joints at rest does not limit the step size
            with r.if_then((r.bounds[HELD_INDEX] > 0.5) & (proposed > output_interval)):
                r.assign(proposed, output_interval)
        if self._has_events:
            with r.if_then(self._time_to_event > 0.0):
                self._locate_event(time_left)
        self._proposed_size = proposed
        self._is_last = r.new_variable(proposed >= time_left * _END_SHARE)
        self._step_size = r.new_variable(select(self._is_last, time_left, proposed))
        with r.if_then(~(self._step_size >= min_size) & (self._time_to_event <= 0.0)):
            self._write_return()

    def _locate_event(self, time_left: RoutineValue) -> None:
        """Shorten the remaining time to where the Illinois method expects the event."""
        r, time_to_event = self.routine, self._time_to_event
        share = r.new_variable(
            (self._margin_before + 1.5 * EVENT_TOLERANCE)
            / (self._margin_before - self._margin_behind)
        )
        r.assign(share, select(self._trial_count > _SECANT_TRIALS, 0.5, share))
        r.assign(share, select(share > _MIN_TRIAL_SHARE, share, _MIN_TRIAL_SHARE))
        max_share = 1.0 - _MIN_TRIAL_SHARE
        r.assign(share, select(share > max_share, max_share, share))
        # a margin that jumps
        with r.if_then(time_to_event < self._output_interval * _MIN_STEP_SHARE):
            r.assign(share, 1.0)
            r.assign(self._is_located, 1)
        r.assign(time_left, time_to_event * share)
        r.assign(self._trial_count, self._trial_count + 1)

    def _finish_step(self, next_length: RoutineValue) -> None:
        """Detect events and record outputs after an accepted step whose loops are closed."""
        r = self.routine
        self.call("rate", self._time + self._step_size, self.step_result, self.end_rate)
        is_beyond_event, event = r.new_variable(0), r.new_variable(0)
        least_margin = r.new_variable(1.0)
        self._detect_event(is_beyond_event, event, least_margin)
        self._record_outputs(is_beyond_event, event)
        with r.if_then(is_beyond_event < 1):
            self._accept_step(next_length, event, least_margin)

    def _detect_event(
        self, is_beyond_event: RoutineValue, event: RoutineValue, least_margin: RoutineValue
    ) -> None:
        """Detect whether an event is within the step (is_beyond_event) or at its end (event)."""
        r = self.routine
        if self._has_stick_slip:
            r.assign(least_margin, self.end_rate["margin"])
            with r.if_then(least_margin < -EVENT_TOLERANCE):
                r.assign(event, 1)
        if self._event_distance_count:
            r.call("least_distance", self.end_rate, self._event_signs, self._signed_distance)
            with r.if_then(self._signed_distance[0] < least_margin):
                r.assign(least_margin, self._signed_distance[0])
        if self._has_events:
            with r.if_then((least_margin < -2.0 * EVENT_TOLERANCE) & (self._is_located < 1)):
                r.assign(is_beyond_event, 1)
                r.assign(event, 0)
                self._bring_nearer(self._step_size, least_margin)

    def _bring_nearer(self, time_to_event: RoutineValue, margin: RoutineValue) -> None:
        """Note a step beyond the event: its size and margin."""
        r = self.routine
        halved = r.new_variable(self._margin_before * 0.5)
        r.assign(self._margin_before, select(self._last_trial > 0, halved, self._margin_before))
        r.assign(self._time_to_event, time_to_event)
        r.assign(self._margin_behind, margin)
        r.assign(self._last_trial, 1)

    def _record_outputs(self, is_beyond_event: RoutineValue, event: RoutineValue) -> None:
        """Write the rows of the output instants within the step."""
        r, output_time, length = self.routine, self._output_time, self._step_size
        count, first_time = r.new_variable(self._recorded_count), r.new_variable(output_time)
        is_inside = output_time < (self._time + length) * _END_SHARE
        with r.if_then((is_beyond_event < 1) & is_inside):
            self._interpolate(self._time, length)
        with r.loop_forever():
            with r.if_then((is_beyond_event > 0) | ~is_inside):
                r.break_loop()
            row = r.out.row_pointer(self._recorded_count, self._size + self._output_size)
            r.store(self._relative_time, 0, (output_time - self._time) / length)
            r.call(
                "interpolate", r.state, self.dense_output, self._relative_time, self._interpolated
            )
            with r.if_then(self._close_loops(self._interpolated, self._output_closure_result) < 1):
                self._write_return()
            self.call("observe", output_time, self._interpolated, self._observation)
            if self._has_stick_slip:
                margin = self._observation["margin"]
                with r.if_then(
                    (margin < -2.0 * EVENT_TOLERANCE) & (output_time > self._time) & (event < 1)
                ):
                    r.assign(is_beyond_event, 1)
                    self._bring_nearer(output_time - self._time, margin)
                    r.assign(self._recorded_count, count)
                    r.assign(output_time, first_time)
                    r.break_loop()
            r.copy(row.element_pointer(self._size), self._observation, self._output_size)
            r.copy(row, self._interpolated, self._size)
            r.assign(self._recorded_count, self._recorded_count + 1)
            r.assign(output_time, output_time + self._output_interval)

    def _accept_step(
        self, next_length: RoutineValue, event: RoutineValue, least_margin: RoutineValue
    ) -> None:
        """Continue from the end of the step."""
        r, time_to_event, length = self.routine, self._time_to_event, self._step_size
        # a step that was shortened to its goal keeps the proposed size
        keeps_proposal = self._is_last & (self._proposed_size > next_length)
        r.store(r.h, 1, select(keeps_proposal, self._proposed_size, next_length))
        is_at_goal = self._is_last & (time_to_event <= 0.0)
        r.assign(self._time, select(is_at_goal, self._goal, self._time + length))
        if self._stepper.has_rotation_vectors:  # rates depend on the rotation vector
            r.call("wrap", self.step_result, r.state)
            self.call("rate", self._time, r.state, self.start_rate)
        else:
            r.copy(r.state, self.step_result, self._size)
            r.copy(self.start_rate, self.end_rate, self._size)
        with r.if_then(event > 0):
            r.store(r.h, 6, 1.0)
            self._write_return()
        r.assign(time_to_event, select(time_to_event > 0.0, time_to_event - length, 0.0))
        self._update_margin_before(self.end_rate)
        retained = select(self._last_trial < 0, 0.5, 1.0)
        r.assign(self._margin_behind, self._margin_behind * retained)
        r.assign(self._last_trial, -1)
        if self._event_distance_count:
            with r.if_then(least_margin < -EVENT_TOLERANCE):  # a passed event distance
                r.assign(time_to_event, 0.0)
                r.assign(self._trial_count, 0)
        with r.if_then(exceeds_chart_limits(r.bounds, self._closure_result)):
            self._write_return()

    def _advance_references(
        self, index: RoutineValue, start_time: RoutineValue, time: RoutineValue
    ) -> None:
        """Move the interpolated references to those around a time."""
        r, spacing = self.routine, self._reference_spacing
        with r.loop_forever():
            with r.if_then(
                ~((time >= start_time + spacing) & (start_time + spacing * 1.5 < self._end_time))
            ):
                r.break_loop()
            r.assign(index, index + 1)
            r.assign(start_time, start_time + spacing)

    def call(self, formula: str, time: RoutineValue, *arrays: ArrayPointer) -> None:
        """Write the call of a formula at a time relative to `run`, with state and arrays."""
        r = self.routine
        if self._columns:
            index = r.new_variable(self._reference_index)
            start = r.new_variable(self._reference_time)
            self._advance_references(index, start, time)
            r.store(self._relative_time, 0, (time - start) / self._reference_spacing)
            r.call(
                "reference",
                r.refs.row_pointer(index, 2 * self._columns),
                self._relative_time,
                self._reference,
            )
        if self._stepper.external_callback is not None:
            r.call("callback_inputs", *self._machine_arguments, arrays[0], self._callback_inputs)
            r.call(
                "callback",
                self._callback_inputs,
                self._reference.element_pointer(self._stepper.controller_columns),
            )
        self._stepper.call_formula(r, formula, *self._machine_arguments, *arrays)

    def _write_return(self) -> None:
        self.routine.store(self.routine.h, 2, self._time - self._output_time)
        self.routine.return_value(self._recorded_count)
