"""Dead times of valves in an instance: signals at the spools follow the inputs of before."""

from crane.codegen import ArrayPointer, Layout, Program, Routine, RoutineValue, select
from crane.codegen.routine_statements import as_value

DEAD_TIME_ROUTINES = ("append_node", "delay_signals", "find_kink")
_NO_NODE = 1e299  # times of nodes that are not there are larger [s]
_SLOPE_TOLERANCE = 1e-12  # share of the signals, as of `ValveSignals`
_TIME_TOLERANCE = 1e-9  # share of a step


class DeadTimes:
    """Writer of the routines for dead times.

    The signals are linear between nodes, one at the end of each call of `advance`. The part
    `history` of an instance has rows of a time [s] and the signals there, the oldest first, back
    to the longest dead time. A spool gets the signal of the time t - delay, and before the first
    node the first signal. Steps end where its slope changes, as those of `simulate`.

    Args:
        layout: Layout of an instance.
    """

    def __init__(self, layout: Layout):
        self._layout, self.count = layout, layout.parts["delays"]
        self._width = self.count + 1
        self._rows = as_value(layout.parts["history"] // self._width, "integer")

    def _part(self, name: str) -> ArrayPointer:
        return ArrayPointer("instance").element_pointer(self._layout.start_index(name))

    def _node(self, index: RoutineValue) -> ArrayPointer:
        return self._part("history").row_pointer(index, self._width)

    def add_to(self, program: Program) -> None:
        """Add append_node(instance), delay_signals(instance, now, row), find_kink(.., kink).

        append_node adds the inputs at the end of the step; 0 if there is no row left.
        delay_signals stores the signals at the spools at a time (1,) [s] in row. find_kink stores
        the next time at which one of their slopes changes.
        """
        with program.add_routine("append_node", arrays=("instance",)) as r:
            self._write_append(r)
        with program.add_routine("delay_signals", arrays=("instance", "now", "row")) as r:
            for i in range(self.count):
                self._write_signal(r, i)
        with program.add_routine("find_kink", arrays=("instance", "now", "kink")) as r:
            r.store(r.kink, 0, _NO_NODE)
            with r.loop(self._rows - 1) as k:
                self._write_kinks(r, k)

    def write_start(self, r: Routine) -> None:
        """Write the first node, at the inputs."""
        with r.loop(self._rows) as k:
            r.store(self._node(k), 0, 10.0 * _NO_NODE)
        first = self._part("history")
        r.store(first, 0, 0.0)
        r.copy(first.element_pointer(1), self._part("inputs"), self.count)

    def _write_append(self, r: Routine) -> None:
        time, step = (r.new_variable(self._part(x)[0]) for x in ("time", "step"))
        longest = r.new_variable(0.0)
        for i in range(self.count):
            delay = self._part("delays")[i]
            r.assign(longest, select(delay > longest, delay, longest))
        unused, used = r.new_variable(0), r.new_variable(0)
        with r.loop(self._rows) as k:
            # of a call that failed
            with r.if_then(self._node(k)[0] > time + step * _TIME_TOLERANCE):
                r.store(self._node(k), 0, 10.0 * _NO_NODE)
            with r.if_then(self._node(k)[0] < _NO_NODE):
                r.assign(used, used + 1)
        with r.loop(self._rows - 1) as k, r.if_then(self._node(k + 1)[0] <= time - longest):
            r.assign(unused, unused + 1)
        with r.if_then(unused > 0), r.loop(self._rows - unused) as k:
            for i in range(self._width):
                r.store(self._node(k), i, self._node(k + unused)[i])
        with r.loop(unused) as k:
            r.store(self._node(self._rows - unused + k), 0, 10.0 * _NO_NODE)
        r.assign(used, used - unused)
        with r.if_then(used < self._rows):
            r.store(self._node(used), 0, time + step)
            r.copy(self._node(used).element_pointer(1), self._part("inputs"), self.count)
            r.return_value(1)

    def _write_signal(self, r: Routine, i: int) -> None:
        time = r.new_variable(r.now[0] - self._part("delays")[i])
        r.store(r.row, i, self._part("history")[i + 1])
        with r.loop(self._rows - 1) as k:
            node, after = self._node(k), self._node(k + 1)
            with r.if_then((node[0] <= time) & (after[0] < _NO_NODE)):
                share = r.new_variable((time - node[0]) / (after[0] - node[0]))
                r.assign(share, select(share < 1.0, share, 1.0))
                change = after[i + 1] - node[i + 1]
                r.store(r.row, i, node[i + 1] + share * change)

    def _write_kinks(self, r: Routine, k: RoutineValue) -> None:
        """Write the comparison of the changes of slopes at a node with the next one so far."""
        node, after = self._node(k), self._node(k + 1)
        earliest = r.now[0] + self._part("step")[0] * _TIME_TOLERANCE
        before = self._node(k - 1)
        length = r.new_variable(after[0] - node[0])
        for i in range(1, self._width):
            slope = r.new_variable((after[i] - node[i]) / length)
            size = r.new_variable(_magnitude(after[i]) + _magnitude(node[i]))
            with r.if_then(k > 0):
                r.assign(slope, slope - (node[i] - before[i]) / (node[0] - before[0]))
            time = r.new_variable(node[0] + self._part("delays")[i - 1])
            is_kink = _magnitude(slope) * length > size * _SLOPE_TOLERANCE
            is_kink = is_kink & (after[0] < _NO_NODE)
            with r.if_then(is_kink & (time > earliest) & (time < r.kink[0])):
                r.store(r.kink, 0, time)


def _magnitude(value: RoutineValue) -> RoutineValue:
    return select(value < 0.0, value * -1.0, value)
