"""Routines of an instance that evaluate its state: outputs, derivatives, event indicators."""

from collections.abc import Mapping, Sequence

from crane.closure.compiled_closure import CompiledClosure
from crane.codegen import ArrayPointer, Layout, Program, Routine
from crane.codegen.vector_layout import Formula
from crane.export.dead_times import DeadTimes
from crane.export.kinematics_program import BEYOND_CHART, DONE, KinematicsRoutines
from crane.simulation.integration.machine_code_stepper import HELD_INDEX, exceeds_chart_limits
from crane.simulation.integration.machine_formulas import AT_REST_SUFFIX


class EvaluationRoutines(KinematicsRoutines):
    """Writer of routines that evaluate the formulas of the stepper.

    Args:
        layout: Layout of an instance.
        closure: The loops.
        programs: Programs that the routines call, by the prefix of their functions.
        stick_slip_count: Number of joints with stiction.
    """

    def __init__(
        self,
        layout: Layout,
        closure: CompiledClosure,
        programs: Mapping[str, Program],
        stick_slip_count: int,
    ):
        super().__init__(layout, closure)
        self._programs, self._k = programs, stick_slip_count
        self._dead_times = DeadTimes(layout) if layout.parts["delays"] else None

    @property
    def _machine_arguments(self) -> tuple[ArrayPointer, ...]:
        return tuple(self._part(x) for x in ("geometry", "dynamics", "settings"))

    def add_evaluations(self, program: Program) -> None:
        """Add update_outputs(instance) and derivatives(instance, rate) of the state.

        event_indicators(instance, indicators); directional_derivatives(instance, direction,
        result) of rate and outputs.
        """
        with program.add_routine("update_outputs", arrays=("instance",)) as r:
            self._write_evaluation(r, "steps_observe", ["outputs"], self._part("tau"))
        with program.add_routine("derivatives", arrays=("instance", "rate")) as r:
            self._write_chart_check(r)
            self._write_evaluation(r, "steps_rate", ["rate"], r.rate)
        if self.event_parts:
            with program.add_routine("event_indicators", arrays=("instance", "indicators")) as r:
                self._write_evaluation(r, "steps_rate", [*self.event_parts], r.indicators)
        if "tangent" in self._programs:
            arrays = "instance", "direction", "result"
            with program.add_routine("directional_derivatives", arrays=arrays) as r:
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
        r.return_value(DONE)
