"""Dead times of valves in an instance: signals at the spools follow the inputs of before."""

from crane.codegen import ArrayPointer, Layout, Program, Routine, RoutineValue, select
from crane.codegen.routine_statements import Operand, as_value, magnitude
from crane.export.kinematics_program import InstanceWriter

_NEVER = 1e299  # [s]
_SPACING = 1.0  # of the ends of calls before the start, which nothing but their order counts [s]
_SLOPE_TOLERANCE = 1e-12  # share of the signals, as of `ValveSignals`
_TIME_TOLERANCE = 1e-9  # share of a step


class DeadTimes(InstanceWriter):
    """Writer of the routines for dead times.

    The signals are linear during each call of `advance`, and may jump between two. The part
    `history` of an instance has a row for each of the last calls, the oldest first: the time at
    its end [s], the signals at its start, and at its end. A spool gets the signal of the time
    t - delay, and before the first call the first signal. Steps end where its slope changes, as
    those of `simulate`.

    Args:
        layout: Layout of an instance.
    """

    def __init__(self, layout: Layout):
        super().__init__(layout)
        self.count = layout.parts["delays"]
        self._width = dead_time_row(self.count)
        self._rows = as_value(layout.parts["history"] // self._width, "integer")

    def _call(self, index: RoutineValue | int) -> ArrayPointer:
        return self._part("history").row_pointer(index, self._width)

    def add_to(self, program: Program) -> None:
        """Add append_call(instance), delay_signals(instance, now, row), find_kink(.., kink).

        append_call adds the inputs of the step in place of the oldest row; 0 if that is needed.
        delay_signals stores the signals at the spools that have a dead time in row; now (2,) [s]
        is the time, and one in the same piece of all signals. find_kink stores the next time at
        which one of their slopes changes, or they jump.
        """
        with program.add_routine("append_call", arrays=("instance",)) as r:
            self._write_append(r)
        with program.add_routine("delay_signals", arrays=("instance", "now", "row")) as r:
            for i in range(self.count):
                with r.if_then(self._element("delays", i) > 0.0):
                    self._write_signal(r, i)
        with program.add_routine("find_kink", arrays=("instance", "now", "kink")) as r:
            r.store(r.kink, 0, _NEVER)
            with r.loop(self._rows - 2) as k:
                self._write_kinks(r, k)

    def write_start(self, r: Routine) -> None:
        """Write rows before the time, of the inputs."""
        end = r.new_variable(self._element("time"))
        with r.loop(self._rows) as k:
            self._write_row(r, self._call(self._rows - 1 - k), end, "inputs")
            r.assign(end, end - _SPACING)

    def _write_row(self, r: Routine, row: ArrayPointer, end: Operand, start: str) -> None:
        r.store(row, 0, end)
        r.copy(row.element_pointer(1), self._part(start), self.count)
        r.copy(row.element_pointer(1 + self.count), self._part("inputs"), self.count)

    def _write_append(self, r: Routine) -> None:
        time, step = (r.new_variable(self._part(x)[0]) for x in ("time", "step"))
        longest = r.new_variable(0.0)
        for i in range(self.count):
            delay = self._element("delays", i)
            r.assign(longest, select(delay > longest, delay, longest))
        last = self._call(self._rows - 1)
        with r.if_then(last[0] <= time + step * _TIME_TOLERANCE):  # else of a call that failed
            with r.if_then(self._call(1)[0] > time - longest):
                r.return_value(0)
            with r.loop(self._rows - 1) as k:
                r.copy(self._call(k), self._call(k + 1), self._width)
        self._write_row(r, last, time + step, "inputs_start")
        r.return_value(1)

    def _write_signal(self, r: Routine, i: int) -> None:
        delay, start, end = self._element("delays", i), 1 + i, 1 + self.count + i
        time, within = (r.new_variable(r.now[x] - delay) for x in range(2))
        r.store(r.row, i, self._element("history", end))
        with r.loop(self._rows - 1) as k:
            before, call = self._call(k), self._call(k + 1)
            with r.if_then(before[0] <= within):
                share = r.new_variable((time - before[0]) / (call[0] - before[0]))
                r.assign(share, select(share < 1.0, share, 1.0))
                r.store(r.row, i, call[start] + share * (call[end] - call[start]))

    def _write_kinks(self, r: Routine, k: RoutineValue) -> None:
        """Write the comparison of the changes of signals at a call with the next one so far."""
        previous, before, call = (self._call(k + i) for i in range(3))
        earliest = r.now[0] + self._element("step") * _TIME_TOLERANCE
        length = r.new_variable(call[0] - before[0])
        for i in range(self.count):
            start, end = 1 + i, 1 + self.count + i
            slope = (before[end] - before[start]) / (before[0] - previous[0])
            change = r.new_variable(call[end] - call[start] - slope * length)
            size = magnitude(call[end]) + magnitude(before[end])
            jump = magnitude(call[start] - before[end])
            time = r.new_variable(before[0] + self._element("delays", i))
            is_kink = magnitude(change) + jump > size * _SLOPE_TOLERANCE
            with r.if_then(is_kink & (time > earliest) & (time < r.kink[0])):
                r.store(r.kink, 0, time)


def dead_time_row(count: int) -> int:
    """Numbers of a call for a number of spools."""
    return 1 + 2 * count
