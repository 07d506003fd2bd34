"""Routines of an instance of a machine, see `crane.export.instance_program`."""

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType

import numpy as np
import pinocchio as pin

from crane.codegen import (
    ArrayPointer,
    Layout,
    Program,
    Routine,
    RoutineValue,
    Scalar,
    Tape,
    select,
)
from crane.codegen.routine_statements import as_value
from crane.codegen.symbolic import add_vectors, scale_vector, subtract_vectors
from crane.common.samples import Array
from crane.control.valve_drive import ValveDrive
from crane.dynamics.formula_structure import BODY_SIZE
from crane.dynamics.frame_jacobians import frame_placement
from crane.export.dead_times import DEAD_TIME_ROUTINES
from crane.export.evaluation_routines import EvaluationRoutines
from crane.export.kinematics_program import (
    BEYOND_CHART,
    DONE,
    HALTED,
    NOT_CLOSED,
    TOO_MANY_CALLS,
    TOO_MANY_EVENTS,
)
from crane.export.laden_inertia import laden_inertia
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.error_controlled_stepper import ErrorControlledStepper
from crane.simulation.integration.machine_code_stepper import HELD_INDEX
from crane.simulation.integration.stick_slip_routine import add_stick_slip_routines

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
_TIME_TOLERANCE = 1e-9  # of a step


class InstanceRoutines(EvaluationRoutines):
    """Writer of the routines of an instance.

    Args:
        chart: The machine with its drives.
        stepper: The method of `advance`.
        layout: Layout of an instance.
        programs: Programs that the routines call, by the prefix of their functions.
        quantities: Names of the routines of dynamics.
        tip_offset: Origin of the tip in its body; None without a tip.
    """

    inner_routines = (
        "find_modes", "orthogonalize", "least_squares", "transposed_least_squares",
        "bounded_least_squares", *DEAD_TIME_ROUTINES,
    )  # fmt: skip

    def __init__(
        self,
        chart: Chart,
        stepper: ErrorControlledStepper,
        layout: Layout,
        programs: Mapping[str, Program],
        quantities: Sequence[str],
        tip_offset: Array | None,
    ):
        closure = chart.machine.closure.compiled_closure
        super().__init__(layout, closure, programs, len(chart.stick_slip.columns))
        self.chart, self.stepper = chart, stepper
        self._quantities, self._tip_offset = quantities, tip_offset
        machine = self.machine = chart.machine
        self.control = chart.control
        self._nq, self._n = machine.model.nv, len(machine.active)

    def add_to(self, program: Program) -> None:
        """Add all routines to a program that has the functions of `programs`."""
        if self._dead_times is not None:
            self._dead_times.add_to(program)
        self._add_stiction(program)
        self._add_initialize(program)
        self._add_advance(program)
        self.add_evaluations(program)
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
        program.add_formula("laden", 2, laden_inertia(unladen, payload, frame))
        first = self.layout.start_index("dynamics")
        first += self.chart.dynamics.formula_structure.constants_layout.start_index("inertias")
        with program.add_routine("set_payload", arrays=("instance", "payload")) as r:
            inertia = ArrayPointer("instance").element_pointer(first + BODY_SIZE * (body - 1))
            r.call("laden", self._part("unladen"), r.payload, inertia)
            r.return_value(DONE)

    def _add_stiction(self, program: Program) -> None:
        """find_modes, see `add_stick_slip_routines`."""
        if not self._k:
            return
        chart, machine = self.chart, self.machine
        closure = machine.closure
        inverse_velocities = closure.characteristic_time / closure.units[chart.stick_slip.columns]
        parts = self.stepper.trace_controlled_machine(Tape()).stiction_problem(
            inverse_velocities.tolist()
        )
        problem = program.add_formula("stiction", 5, parts)
        active = closure.active.tolist()
        add_stick_slip_routines(
            program,
            problem,
            n=self._n,
            k=self._k,
            rates=closure.characteristic_time / closure.units[closure.active],
            active_of_joint=[
                active.index(x) if x in active else None for x in chart.stick_slip.columns
            ],
            state_layout=chart.state_layout,
            mode_indices=chart.dynamics.formula_structure.stick_slip_mode_indices,
        )

    def _write_find_modes(self, r: Routine, refs: ArrayPointer) -> None:
        """Write `find_modes` at the state, and whether joints are held."""
        if not self._k:
            return
        arguments = *self._machine_arguments, refs, self._part("q")
        with r.if_then(r.call("find_modes", *arguments) < 1):
            r.return_value(HALTED)
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
        with program.add_routine("initialize", arrays=("instance",)) as r:
            result = r.local_array("result", self._closure.formula_outputs("newton"))
            state, states = self._part("q"), layout.parts["controller"]
            values = r.local_array("values", max(1, states))
            size = self._closure.formula_outputs("newton").parts["gamma"]
            bounds = self._part("bounds")
            arguments = self._part("geometry"), state, result, bounds
            with r.if_then(r.call(self._close_name, *arguments) < 1):
                r.return_value(NOT_CLOSED)
            with r.loop(as_value(layout.size - self._nq, "integer")) as i:
                r.store(state, i + self._nq, 0.0)
            refs = self._part("inputs")
            if states:
                r.call("start", *self._machine_arguments, refs, state, values)
                start = layout.start_index("controller")
                r.copy(state.element_pointer(start), values, states)
            r.copy(self._part("inputs_start"), refs, self.layout.parts["inputs"])
            if self._dead_times is not None:
                self._dead_times.write_start(r)
            cursor = self._part("cursor")
            r.copy(cursor, state, self._nq)
            r.copy(cursor.element_pointer(self._nq), result.element_pointer("gamma"), size)
            self._store(r, "time", 0.0)
            self._store(r, "lengths", 0.0)
            self._write_find_modes(r, refs)
            r.return_value(DONE)
        with program.add_routine("update_modes", arrays=("instance",)) as r:
            self._store(r, "lengths", 0.0)
            if self.stepper.has_rotation_vectors:
                state = self._part("q")
                wrapped = r.local_array("wrapped", layout.size)
                r.call("steps_wrap", state, wrapped)
                r.copy(state, wrapped, self._nq)
                r.copy(self._part("cursor"), state, self._nq)
            self._write_find_modes(r, self._part("inputs"))
            r.return_value(DONE)

    @property
    def _close_name(self) -> str:
        return "loops_project" if self._closure.has_partly_active_rotations else "loops_close"

    def _add_advance(self, program: Program) -> None:
        """advance(instance): integrate over `step`, inputs linear from `inputs_start`.

        advance_fixed(instance): one step of the classical Runge-Kutta method.
        """
        columns = self.stepper.reference_columns
        tape = Tape()
        start, end = (tape.load_vector(i, 0, columns) for i in range(2))
        first, last = tape.load_vector(2, 0, 2)
        ramp = subtract_vectors(end, start)
        rows = [
            add_vectors(start, scale_vector(share, ramp))
            for share in (first, 0.5 * (first + last), last)
        ]
        program.add_formula("ramp", 3, [x for row in rows for x in row])
        with program.add_routine("advance", arrays=("instance",)) as r:
            self._write_advance(r)
        if not isinstance(self.control, ValveDrive):
            with program.add_routine("advance_fixed", arrays=("instance",)) as r:
                self._write_fixed_step(r)

    def _write_advance(self, r: Routine) -> None:
        columns = self.stepper.reference_columns
        refs, row = r.local_array("refs", max(1, 3 * columns)), r.local_array("row", 1)
        state, lengths = self._part("q"), self._part("lengths")
        bounds, tolerances = (self._part(x) for x in ("bounds", "tolerances"))
        step = r.new_variable(self._element("step"))
        with r.if_then(~(step > 0.0)):
            r.return_value(HALTED)
        if self._dead_times is not None:
            with r.if_then(r.call("append_call", r.instance) < 1):
                r.return_value(TOO_MANY_CALLS)
        # a run that goes on to the next output instant, see `ErrorControlledStepper.run`
        with r.if_then(~((lengths[0] >= step) & (lengths[0] <= step))):
            r.store(lengths, 0, step)
            longest = select(step < _LONGEST_FIRST_STEP, step, _LONGEST_FIRST_STEP)
            r.store(lengths, 1, longest * _FIRST_STEP_SHARE)
        time, end, events = (r.new_variable(x) for x in (step * -1.0, 0.0, 0.0))
        write_references = self._references_writer(r, refs, step)
        with r.loop_forever():
            write_references(time, end)
            r.store(lengths, 2, time)
            r.store(lengths, 3, end - time)
            r.store(lengths, 4, end)
            r.store(lengths, 6, 0.0)
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
                write_references(time, end)
                self._write_find_modes(r, refs)
            with r.if_else(), r.if_then(time < end - step * _TIME_TOLERANCE):
                self._write_elapsed(r, step + time)
                self._write_halt(r)
            with r.if_then(~(time < step * -_TIME_TOLERANCE)):
                r.break_loop()
        self._write_elapsed(r, step)
        r.copy(self._part("inputs_start"), self._part("inputs"), columns)
        r.return_value(DONE)

    def _write_elapsed(self, r: Routine, elapsed: RoutineValue) -> None:
        self._store(r, "time", self._element("time") + elapsed)

    def _references_writer(
        self, r: Routine, refs: ArrayPointer, step: RoutineValue
    ) -> Callable[[RoutineValue, RoutineValue], None]:
        """Function that writes the references from a time to `end`, before the end of the call.

        It sets `end` to the next change of a slope, or 0, where valves have dead times.
        """
        columns, shares = self.stepper.reference_columns, r.local_array("shares", 2)
        now, kink = r.local_array("now", 2), r.local_array("kink", 1)
        inputs, start = (self._part(x) for x in ("inputs", "inputs_start"))
        goal = r.new_variable(self._element("time") + step)

        def write(time: RoutineValue, end: RoutineValue) -> None:
            if self._dead_times is not None:
                r.store(now, 0, goal + time)
                r.call("find_kink", r.instance, now, kink)
                r.assign(end, kink[0] - goal)
                r.assign(end, select(end < step * -_TIME_TOLERANCE, end, 0.0))
            r.store(shares, 0, (time + step) / step)
            r.store(shares, 1, (end + step) / step)
            r.call("ramp", start, inputs, shares, refs)
            if self._dead_times is None:
                return
            r.store(now, 1, goal + time + (end - time) * 0.5)
            for i, share in enumerate((0.0, 0.5, 1.0)):
                r.store(now, 0, goal + time + (end - time) * share)
                r.call("delay_signals", r.instance, now, refs.row_pointer(i, columns))

        return write

    def _write_halt(self, r: Routine) -> None:
        """Return why a step failed."""
        r.store(self._part("lengths"), 0, 0.0)
        self._write_chart_check(r)
        r.return_value(HALTED)

    def _write_fixed_step(self, r: Routine) -> None:
        columns, size = self.stepper.reference_columns, self.chart.row_layout.size
        refs, shares = r.local_array("refs", max(1, 3 * columns)), r.local_array("shares", 2)
        row, sizes = r.local_array("row", size), r.local_array("sizes", 3)
        state, bounds = self._part("q"), self._part("bounds")
        inputs, start = (self._part(x) for x in ("inputs", "inputs_start"))
        step = r.new_variable(self._element("step"))
        r.store(shares, 0, 0.0)
        r.store(shares, 1, 1.0)
        r.call("ramp", start, inputs, shares, refs)
        r.store(sizes, 0, step)
        r.store(sizes, 1, step * 0.5)
        r.store(sizes, 2, 0.0)
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
        r.copy(start, inputs, columns)
        r.return_value(DONE)

    def _add_tip(self, program: Program) -> None:
        """tip(instance, q, v_a, tip)."""
        if self._tip_offset is None:
            return
        with program.add_routine("tip", arrays=("instance", "q", "v_a", "tip")) as r:
            offset = r.local_array("offset", 3)
            for i, x in enumerate(self._tip_offset.tolist()):
                r.store(offset, i, x)
            geometry = self._part("geometry")
            r.call("tip_formula", geometry, offset, r.q, r.v_a, r.tip)
            r.return_value(DONE)

    def _add_dynamics(self, program: Program) -> None:
        """The routines of `DYNAMICS_ROUTINES`: (instance, q, v_a, x, result)."""
        for name in self._quantities:
            with program.add_routine(name, arrays=("instance", "q", "v_a", "x", "result")) as r:
                inputs = r.local_array("values", 2 * self._n)
                r.copy(inputs, r.v_a, self._n)
                r.copy(inputs.element_pointer(self._n), r.x, self._n)
                geometry, dynamics = (self._part(x) for x in ("geometry", "dynamics"))
                r.call(f"{name}_formula", geometry, dynamics, r.q, inputs, r.result)
                r.return_value(DONE)
