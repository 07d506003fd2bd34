"""Routines of an instance of a machine, see `crane.export.instance_program`."""

from collections.abc import Mapping, Sequence
from itertools import combinations_with_replacement
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from crane.codegen import ArrayPointer, Program, Routine, RoutineValue, Scalar, Tape, select
from crane.codegen.routine_statements import as_value
from crane.codegen.symbolic import (
    add_vectors,
    dot,
    matmul,
    matvec,
    maximum,
    scale_vector,
    subtract_vectors,
    transpose,
)
from crane.codegen.vector_layout import Formula
from crane.control.valve_drive import ValveDrive
from crane.dynamics.formula_structure import BODY_SIZE
from crane.dynamics.frame_jacobians import frame_placement
from crane.export.dead_times import DeadTimes
from crane.export.kinematics_program import (
    BEYOND_CHART,
    DONE,
    HALTED,
    NOT_CLOSED,
    TOO_MANY_CALLS,
    TOO_MANY_EVENTS,
    KinematicsRoutines,
)
from crane.simulation.integration.machine_code_stepper import HELD_INDEX, exceeds_chart_limits
from crane.simulation.integration.machine_formulas import AT_REST_SUFFIX
from crane.simulation.integration.stick_slip_routine import add_stick_slip_routines

if TYPE_CHECKING:
    from crane.export.instance_program import InstanceProgram

STATUS_TEXTS = MappingProxyType(
    {
        DONE: "done",
        NOT_CLOSED: "the loops do not close",
        BEYOND_CHART: "a dead centre: the active joints do not determine the motion, make others "
        "active",
        HALTED: "the step failed: the motion diverges, or too many steps were needed",
        TOO_MANY_EVENTS: "joints stick and slip too often",
        TOO_MANY_CALLS: "the dead time of a valve takes more calls than are kept: longer steps",
    }
)
_FIRST_STEP_SHARE, _LONGEST_FIRST_STEP = 0.01, 5e-4  # as `ErrorControlledStepper.run`
_STEP_REDUCTION_AFTER_EVENT = 0.2
_LONGEST_STEP = 1e300  # [s]
_TIME_TOLERANCE = 1e-9  # of a step
_LEAST_MASS = 1e-30  # by which moments are divided [kg]


class InstanceRoutines(KinematicsRoutines):
    """Writer of the routines of an instance.

    Args:
        program: The program of the instance.
    """

    def __init__(self, program: "InstanceProgram"):
        super().__init__(program.layout, program.machine.closure.compiled_closure)
        self._programs, self.chart = program.programs, program.chart
        self._k = len(self.chart.stick_slip.columns)
        self._dead_times = DeadTimes(self.layout) if self.layout.parts["delays"] else None
        self.stepper, self.control = program.stepper, program.control
        self.machine, self._nq = program.machine, program.machine.model.nv
        self._quantities, self._tip = program.quantities, program.tip_frame

    def add_to(self, program: Program) -> None:
        """Add all routines to a program that has the functions of `programs`."""
        if self._dead_times is not None:
            self._dead_times.add_to(program)
        if self._k:
            formulas = self.stepper.trace_controlled_machine(Tape())
            add_stick_slip_routines(program, self.chart, formulas)
        self._add_initialize(program)
        self._add_advance(program)
        self._add_evaluations(program)
        super().add_to(program)
        self._add_tip(program)
        self._add_dynamics(program)
        if self.layout.parts["unladen"]:
            self._add_payload(program)

    def _add_payload(self, program: Program) -> None:
        """set_payload(instance, payload): the inertia of the body of the tip with a payload."""
        machine, tape = self.machine, Tape()
        assert machine.tip is not None
        joint, pose = frame_placement(machine, machine.tip)
        body = machine.coordinates.body_of_joint[joint]
        frame = pin.SE3(self._closure.geometry.body_rotations[body].T, np.zeros(3)) * pose
        unladen, payload = (tape.load_vector(i, 0, BODY_SIZE) for i in range(2))
        program.add_formula("laden", 2, _laden_inertia(unladen, payload, frame))
        first = self.chart.dynamics.formula_structure.tip_inertia.start
        with self._entry(program, "set_payload", "payload") as r:
            inertia = self._part("dynamics").element_pointer(first)
            r.call("laden", self._part("unladen"), r.payload, inertia)

    def _write_find_modes(self, r: Routine, refs: ArrayPointer) -> None:
        """Write `find_modes` at the state, and whether joints are held."""
        if not self._k:
            return
        arguments = *self._machine_arguments, refs, self._part("q")
        self._call_or_return(r, HALTED, "find_modes", *arguments)
        held = r.new_variable(0.0)
        *places, _ = self.chart.dynamics.formula_structure.stick_slip_mode_indices
        for place in places[1::3]:
            is_held = self._element("dynamics", place)
            r.assign(held, select(is_held > 0.5, 1.0, held))
        self._store(r, "bounds", held, HELD_INDEX)

    def _add_initialize(self, program: Program) -> None:
        """initialize(instance): at rest at the active coordinates in q, with other q as guess.

        update_modes(instance): after a change of parameters.
        """
        tape, layout = Tape(), self.chart.state_layout
        machine = self.stepper.trace_controlled_machine(tape)
        dynamics, loads = machine.dynamics_formulas, machine.external_forces.active_forces

        def inverse(a_a: Sequence[Scalar], friction: bool) -> list[Scalar]:
            return subtract_vectors(dynamics.inverse_dynamics(a_a, friction), loads)

        inputs = machine.inputs._replace(inverse=inverse)
        program.add_formula("start", 5, {"state": list(self.control.initial_state(inputs))})
        with self._entry(program, "initialize") as r:
            self._write_start(r)
        with self._entry(program, "update_modes") as r:
            self._store(r, "lengths", 0.0)
            if self.stepper.has_rotation_vectors:
                state = self._part("q")
                wrapped = r.local_array("wrapped", layout.size)
                r.call("steps_wrap", state, wrapped)
                r.copy(state, wrapped, self._nq)
                r.copy(self._part("cursor"), state, self._nq)
            self._write_find_modes(r, self._part("inputs"))

    def _write_start(self, r: Routine) -> None:
        layout, newton = self.chart.state_layout, self._closure.formula_outputs("newton")
        result, state = r.local_array("result", newton), self._part("q")
        cursor, refs = self._part("cursor"), self._part("inputs")
        close = "project" if self._closure.has_partly_active_rotations else "close"
        arguments = self._part("geometry"), state, result, self._part("bounds")
        self._call_or_return(r, NOT_CLOSED, f"loops_{close}", *arguments)
        with r.loop(as_value(layout.size - self._nq, "integer")) as i:
            r.store(state, i + self._nq, 0.0)
        if states := layout.parts["controller"]:
            values = r.local_array("values", states)
            r.call("start", *self._machine_arguments, refs, state, values)
            r.copy(self._part("controller"), values, states)
        r.copy(self._part("inputs_start"), refs, self.layout.parts["inputs"])
        if self._dead_times is not None:
            self._dead_times.write_start(r)
        r.copy(cursor, state, self._nq)
        gamma = result.element_pointer("gamma")
        r.copy(cursor.element_pointer(self._nq), gamma, newton.parts["gamma"])
        self._store(r, "lengths", 0.0)
        self._write_find_modes(r, refs)

    def _add_advance(self, program: Program) -> None:
        """advance(instance): integrate over `step`, inputs linear from `inputs_start`.

        advance_fixed(instance): one step of the classical Runge-Kutta method.
        """
        with self._entry(program, "advance") as r:
            self._write_advance(r)
        if not isinstance(self.control, ValveDrive):
            with self._entry(program, "advance_fixed") as r:
                self._write_fixed_step(r)

    def _write_advance(self, r: Routine) -> None:
        columns = self.stepper.reference_columns
        refs, row = r.local_array("refs", max(1, 3 * columns)), r.local_array("row", 1)
        state, lengths = self._part("q"), self._part("lengths")
        bounds, tolerances = (self._part(x) for x in ("bounds", "tolerances"))
        step = r.new_variable(self._element("step"))
        with r.if_then(~((step > 0.0) & (step < _LONGEST_STEP))):
            r.return_value(HALTED)
        if self._dead_times is not None:
            self._call_or_return(r, TOO_MANY_CALLS, "append_call", r.instance)
        # a run that goes on to the next output instant, see `ErrorControlledStepper.run`
        with r.if_then(~((lengths[0] >= step) & (lengths[0] <= step))):
            r.store(lengths, 0, step)
            longest = select(step < _LONGEST_FIRST_STEP, step, _LONGEST_FIRST_STEP)
            r.store(lengths, 1, longest * _FIRST_STEP_SHARE)
        time, end, events = (r.new_variable(x) for x in (step * -1.0, 0.0, 0.0))
        arrays = refs, r.local_array("now", 2), r.local_array("kink", 1)
        with r.loop_forever():
            self._write_references(r, arrays, step, (time, end))
            for place, length in ((2, time), (3, end - time), (4, end), (6, 0.0)):
                r.store(lengths, place, length)
            r.call(
                "steps_run", 1, *self._machine_arguments, refs, state, row, lengths,
                bounds, tolerances,
            )  # fmt: skip
            r.assign(time, lengths[2])
            with r.if_then((lengths[6] > 0.0) & (time <= 0.0)):
                r.store(lengths, 1, lengths[1] * _STEP_REDUCTION_AFTER_EVENT)
                r.assign(events, events + 1.0)
                with r.if_then(events > self._element("max_events")):
                    self._write_elapsed(r, step + time)
                    r.return_value(TOO_MANY_EVENTS)
                self._write_references(r, arrays, step, (time, end))
                self._write_find_modes(r, refs)
            with r.if_else(), r.if_then(time < end - step * _TIME_TOLERANCE):
                self._write_elapsed(r, step + time)
                self._write_halt(r)
            with r.if_then(~(time < step * -_TIME_TOLERANCE)):
                r.break_loop()
        self._write_elapsed(r, step)
        r.copy(self._part("inputs_start"), self._part("inputs"), columns)

    def _write_elapsed(self, r: Routine, elapsed: RoutineValue) -> None:
        self._store(r, "time", self._element("time") + elapsed)

    def _write_references(
        self,
        r: Routine,
        arrays: tuple[ArrayPointer, ArrayPointer, ArrayPointer],
        step: RoutineValue,
        span: tuple[RoutineValue, RoutineValue],
    ) -> None:
        """Write the references from a time to an end, both before the end of the call.

        Where valves have dead times the end becomes the next change of a slope, or 0.
        """
        (time, end), (refs, now, kink) = span, arrays
        goal = r.new_variable(self._element("time") + step)
        if self._dead_times is not None:
            r.store(now, 0, goal + time)
            r.call("find_kink", r.instance, now, kink)
            r.assign(end, kink[0] - goal)
            r.assign(end, select(end < step * -_TIME_TOLERANCE, end, 0.0))
        self._write_ramp(r, refs, (time + step) / step, (end + step) / step)
        for i, share in enumerate((0.0, 0.5, 1.0) if self._dead_times is not None else ()):
            r.store(now, 1, goal + time + (end - time) * 0.5)
            r.store(now, 0, goal + time + (end - time) * share)
            row = refs.row_pointer(i, self.stepper.reference_columns)
            r.call("delay_signals", r.instance, now, row)

    def _write_ramp(
        self, r: Routine, refs: ArrayPointer, first: RoutineValue, last: RoutineValue
    ) -> None:
        """Write the inputs at two shares of the step, and between them, to the rows of `refs`."""
        columns = self.stepper.reference_columns
        inputs, start = (self._part(x) for x in ("inputs", "inputs_start"))
        for row, share in enumerate((first, (first + last) * 0.5, last)):
            with r.loop(as_value(columns, "integer")) as i:
                value = start[i] + share * (inputs[i] - start[i])
                r.store(refs.row_pointer(row, columns), i, value)

    def _write_halt(self, r: Routine) -> None:
        """Return why a step failed."""
        r.store(self._part("lengths"), 0, 0.0)
        self._write_chart_check(r)
        r.return_value(HALTED)

    def _write_fixed_step(self, r: Routine) -> None:
        columns, size = self.stepper.reference_columns, self.chart.row_layout.size
        refs = r.local_array("refs", max(1, 3 * columns))
        row, sizes = r.local_array("row", size), r.local_array("sizes", 3)
        state, bounds = self._part("q"), self._part("bounds")
        step = r.new_variable(self._element("step"))
        self._write_ramp(r, refs, as_value(0.0, "real"), as_value(1.0, "real"))
        for i, share in enumerate((1.0, 0.5, 0.0)):
            r.store(sizes, i, step * share)
        arguments = refs, state, row, sizes, bounds
        done = r.call("fixed_run", 1, *self._machine_arguments, *arguments)
        with r.if_then((done < 1) & (sizes[2] > 0.0)):  # joints begin to slip, or stop
            self._write_find_modes(r, refs)
            r.store(sizes, 2, 0.0)
            again = r.call("fixed_run", 1, *self._machine_arguments, *arguments)
            r.assign(done, again)
        with r.if_then(done < 1):
            self._write_halt(r)
        self._write_elapsed(r, step)
        r.copy(self._part("inputs_start"), self._part("inputs"), columns)

    def _add_tip(self, program: Program) -> None:
        """tip(instance, q, v_a, tip)."""
        if self._tip is None:
            return
        with self._entry(program, "tip", "q", "v_a", "tip") as r:
            offset = r.local_array("offset", 3)
            for i, x in enumerate(self._tip.frame_offset.tolist()):
                r.store(offset, i, x)
            r.call("tip_formula", self._part("geometry"), offset, r.q, r.v_a, r.tip)

    def _add_dynamics(self, program: Program) -> None:
        """The routines of `DYNAMICS_ROUTINES`: (instance, q, v_a, x, result)."""
        for name in self._quantities:
            if name not in self._programs:
                continue
            with self._entry(program, name, "q", "v_a", "x", "result") as r:
                n = len(self.machine.active)
                inputs = r.local_array("values", 2 * n)
                r.copy(inputs, r.v_a, n)
                r.copy(inputs.element_pointer(n), r.x, n)
                geometry, dynamics = (self._part(x) for x in ("geometry", "dynamics"))
                r.call(f"{name}_formula", geometry, dynamics, r.q, inputs, r.result)

    @property
    def _machine_arguments(self) -> tuple[ArrayPointer, ...]:
        return tuple(self._part(x) for x in ("geometry", "dynamics", "settings"))

    def _add_evaluations(self, program: Program) -> None:
        """Add update_outputs(instance) and derivatives(instance, rate) of the state.

        event_indicators(instance, indicators); directional_derivatives(instance, direction,
        result) of rate and outputs.
        """
        with self._entry(program, "update_outputs") as r:
            self._write_evaluation(r, "steps_observe", ["outputs"], self._part("tau"))
        with self._entry(program, "derivatives", "rate") as r:
            self._write_chart_check(r)
            self._write_evaluation(r, "steps_rate", ["rate"], r.rate)
        if self.event_parts:
            with self._entry(program, "event_indicators", "indicators") as r:
                self._write_evaluation(r, "steps_rate", [*self.event_parts], r.indicators)
        if "tangent" in self._programs:
            with self._entry(program, "directional_derivatives", "direction", "result") as r:
                self._write_evaluation(r, "tangent_rate", ["all"], r.result, r.direction)

    def _write_chart_check(self, r: Routine) -> None:
        """Write a return where the active joints do not determine the motion, see `Chart`."""
        result = r.local_array("result", self._closure.formula_outputs("newton"))
        geometry, state, bounds = (self._part(x) for x in ("geometry", "q", "bounds"))
        r.call("loops_newton", geometry, state, result)
        with r.if_then(exceeds_chart_limits(bounds, result)):
            r.return_value(BEYOND_CHART)

    @property
    def step_functions(self) -> Mapping[str, Formula | Routine]:
        """Functions of the stepper by name."""
        return self._programs["steps"].functions

    @property
    def event_parts(self) -> dict[str, int]:
        """Numbers of event indicators by part of the formula `rate`."""
        parts = self._programs["steps"].formula_outputs("rate").parts
        events = {"margin": min(self._k, 1), "event_distances": parts["event_distances"]}
        return {name: count for name, count in events.items() if count}

    def _write_evaluation(
        self,
        r: Routine,
        formula: str,
        parts: Sequence[str],
        target: ArrayPointer,
        *further: ArrayPointer,
    ) -> None:
        """Write the evaluation of parts of a formula at the state, the inputs and `further`."""
        program, own_name = formula.split("_")
        layout = self._programs[program].formula_outputs(own_name)
        values = r.local_array("values", layout)
        inputs, state = (self._part(x) for x in ("inputs", "q"))
        if self._dead_times is not None:
            row, now = r.local_array("row", self.layout.parts["inputs"]), r.local_array("now", 2)
            r.copy(row, inputs, self.layout.parts["inputs"])
            for i in range(2):
                r.store(now, i, self._element("time"))
            r.call("delay_signals", r.instance, now, row)
            inputs = row
        arguments = *self._machine_arguments, inputs, state, *further, values
        if self._k:
            with r.if_then(self._element("bounds", HELD_INDEX) > 0.5):
                r.call(formula + AT_REST_SUFFIX, *arguments)
            with r.if_else():
                r.call(formula, *arguments)
        else:
            r.call(formula, *arguments)
        count = sum(layout.parts[part] for part in parts)
        r.copy(target, values.element_pointer(parts[0]), count)


def _laden_inertia(
    unladen: Sequence[Scalar], payload: Sequence[Scalar], frame: pin.SE3
) -> list[Scalar]:
    """Inertia of a body with a payload on one of its frames.

    With masses m_i, centres c_i and inertias I_i about them, d = c_2 - c_1 and
    mu = m_1 m_2 / (m_1 + m_2),

        m = m_1 + m_2,    c = c_1 + m_2 / m d,    I = I_1 + I_2 + mu (d.d 1 - d d^T).

    Args:
        unladen: (10,) mass, centre of mass (3), inertia about it (xx, xy, xz, yy, yz, zz) in the
            axes of the body.
        payload: (10,) the same in the frame.
        frame: The frame in the body.

    Returns:
        (10,) like `unladen`.
    """
    turn = frame.rotation.tolist()
    mass = unladen[0] + payload[0]
    share = payload[0] / maximum(mass, _LEAST_MASS)
    centre = add_vectors(matvec(turn, payload[1:4]), frame.translation.tolist())
    distance = subtract_vectors(centre, unladen[1:4])
    xx, xy, xz, yy, yz, zz = payload[4:]
    tensor = matmul(matmul(turn, [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]), transpose(turn))
    square, reduced = dot(distance, distance), unladen[0] * share
    moments = [
        inertia
        + tensor[i][k]
        + reduced * ((square if i == k else 0.0) - distance[i] * distance[k])
        for inertia, (i, k) in zip(
            unladen[4:], combinations_with_replacement(range(3), 2), strict=True
        )
    ]
    moved = add_vectors(unladen[1:4], scale_vector(share, distance))
    return [mass, *moved, *moments]
