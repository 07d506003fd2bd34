"""Dead times of valves in an instance: signals at the spools follow the inputs of before."""

from crane.codegen import ArrayPointer, Layout, Program, Routine, RoutineValue, select
from crane.codegen.routine_statements import Operand, as_value
from crane.export.kinematics_program import InstanceWriter

DEAD_TIME_ROUTINES = ("append_call", "delay_signals", "find_kink")
_NO_CALL = 1e299  # ends of calls that are not there are larger [s]
_SLOPE_TOLERANCE = 1e-12  # share of the signals, as of `ValveSignals`
_TIME_TOLERANCE = 1e-9  # share of a step


class DeadTimes(InstanceWriter):
    """Writer of the routines for dead times.

    The signals are linear during each call of `advance`, and may jump between two. The part
    `history` of an instance has a row for each call, the oldest first, back to the longest dead
    time: the time at its end [s], the signals at its start, and at its end. A spool gets the
    signal of the time t - delay, and before the first call the first signal. Steps end where its
    slope changes, as those of `simulate`.

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

        append_call adds the inputs of the step; 0 if there is no row left. delay_signals stores
        the signals at the spools that have a dead time in row; now (2,) [s] is the time, and one
        in the same piece of all signals. find_kink stores the next time at which one of their
        slopes changes, or they jump.
        """
        with program.add_routine("append_call", arrays=("instance",)) as r:
            self._write_append(r)
        with program.add_routine("delay_signals", arrays=("instance", "now", "row")) as r:
            for i in range(self.count):
                with r.if_then(self._element("delays", i) > 0.0):
                    self._write_signal(r, i)
        with program.add_routine("find_kink", arrays=("instance", "now", "kink")) as r:
            r.store(r.kink, 0, _NO_CALL)
            with r.loop(self._rows - 1) as k:
                self._write_kinks(r, k)

    def write_start(self, r: Routine) -> None:
        """Write the first row, of the inputs."""
        with r.loop(self._rows) as k:
            r.store(self._call(k), 0, 10.0 * _NO_CALL)
        self._write_row(r, self._call(0), 0.0, "inputs")

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
        unused, used = r.new_variable(0), r.new_variable(0)
        with r.loop(self._rows) as k:
            # of a call that failed
            with r.if_then(self._call(k)[0] > time + step * _TIME_TOLERANCE):
                r.store(self._call(k), 0, 10.0 * _NO_CALL)
            with r.if_then(self._call(k)[0] < _NO_CALL):
                r.assign(used, used + 1)
        with r.loop(self._rows - 1) as k, r.if_then(self._call(k + 1)[0] <= time - longest):
            r.assign(unused, unused + 1)
        with r.if_then(unused > 0), r.loop(self._rows - unused) as k:
            r.copy(self._call(k), self._call(k + unused), self._width)
        with r.loop(unused) as k:
            r.store(self._call(self._rows - unused + k), 0, 10.0 * _NO_CALL)
        r.assign(used, used - unused)
        with r.if_then(used < self._rows):
            self._write_row(r, self._call(used), time + step, "inputs_start")
            r.return_value(1)

    def _write_signal(self, r: Routine, i: int) -> None:
        delay, start, end = self._element("delays", i), 1 + i, 1 + self.count + i
        time, within = (r.new_variable(r.now[x] - delay) for x in range(2))
        r.store(r.row, i, self._element("history", end))
        with r.loop(self._rows - 1) as k:
            before, call = self._call(k), self._call(k + 1)
            with r.if_then((before[0] <= within) & (call[0] < _NO_CALL)):
                share = r.new_variable((time - before[0]) / (call[0] - before[0]))
                r.assign(share, select(share < 1.0, share, 1.0))
                r.store(r.row, i, call[start] + share * (call[end] - call[start]))

    def _write_kinks(self, r: Routine, k: RoutineValue) -> None:
        """Write the comparison of the changes of signals at a call with the next one so far."""
        before, call, previous = self._call(k), self._call(k + 1), self._call(k - 1)
        earliest = r.now[0] + self._element("step") * _TIME_TOLERANCE
        length = r.new_variable(call[0] - before[0])
        for i in range(self.count):
            start, end = 1 + i, 1 + self.count + i
            change = r.new_variable(call[end] - call[start])
            size = r.new_variable(_magnitude(call[end]) + _magnitude(before[end]))
            with r.if_then(k > 0):
                slope = (before[end] - before[start]) / (before[0] - previous[0])
                r.assign(change, change - slope * length)
            jump = _magnitude(call[start] - before[end])
            time = r.new_variable(before[0] + self._element("delays", i))
            is_kink = _magnitude(change) + jump > size * _SLOPE_TOLERANCE
            is_kink = is_kink & (call[0] < _NO_CALL)
            with r.if_then(is_kink & (time > earliest) & (time < r.kink[0])):
                r.store(r.kink, 0, time)


def dead_time_row(count: int) -> int:
    """Numbers of a call for a number of spools."""
    return 1 + 2 * count


def _magnitude(value: RoutineValue) -> RoutineValue:
    return select(value < 0.0, value * -1.0, value)
