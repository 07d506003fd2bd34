"""The circuit of a machine as a figure: rails, functions above them, pumps and the rest below."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

from crane.common.errors import InputError
from crane.hydraulics.components import Hydraulics
from crane.hydraulics.sources import TANK
from crane.machine import Machine
from crane.view.plots.recording import STYLE, write_figure
from crane.view.plots.text import plain
from crane.view.sketch.circuit import section
from crane.view.sketch.circuit.centres import Centres
from crane.view.sketch.circuit.feeding import Item, items_of
from crane.view.sketch.circuit.ink import SMALL, Ink
from crane.view.sketch.circuit.section import Function, Section
from crane.view.sketch.circuit.spool import HEIGHT

_ACROSS = 4  # functions beside each other
_GAP, _FIRST = 9.0, 12.0  # between rails; from the lowest to what hangs on it
_SIDE, _HEAD = 10.0, 26.0  # around all of it
_NEAR = 3.0  # least distance of wires
_LONG = 24  # letters of a rail's name


def sketch_circuit(machine: Machine, path: str | Path) -> None:
    """Write a drawing of the hydraulic circuit to a file.

    Args:
        machine: A machine with hydraulics.
        path: Where to write; its suffix .png, .svg or .pdf chooses the format.

    Raises:
        OutputError: The suffix is another one, or the file cannot be written.
        InputError: The machine has no hydraulics.
    """
    write_figure(path, lambda: circuit_figure(machine)[0])


def circuit_figure(machine: Machine) -> tuple[Figure, Ink]:
    """The figure of a circuit, and what it was drawn with; see `sketch_circuit`.

    Functions stand side by side in the order of the active joints, at most four in a row, each
    over the rails that it is joined to; pumps, tank, accumulators and elements hang below the
    lowest rails. Coordinates are points.
    """
    hydraulics = machine.hydraulics
    if hydraulics is None:
        raise InputError(
            f"'{machine.name}' has no hydraulic circuit, sketch its mechanism or add 'hydraulics'"
        )
    with mpl.rc_context(STYLE):
        return _Drawing(machine, hydraulics).draw()


class _Drawing:
    """A circuit as it is laid out."""

    def __init__(self, machine: Machine, hydraulics: Hydraulics):
        self._machine, self._hydraulics = machine, hydraulics
        functions = _functions(machine, hydraulics)
        count = -(-len(functions) // _ACROSS)
        self._stories = _parted(functions, count)
        self._centres = Centres(hydraulics, self._stories)
        items = items_of(hydraulics, functions)
        across = max(len(row) for row in self._stories) * section.WIDTH
        self._hanging = _packed(items, max(across, _ACROSS * section.WIDTH))
        wide = max(sum(item.width for item in row) + 16 for row in self._hanging)
        self._names = _rails(hydraulics, functions, self._centres)
        labels = {net: _told(hydraulics, net) for net in self._names}
        self._margin = 4 + 0.62 * SMALL * max(map(len, labels.values()))
        self._labels = labels
        self._wide = max(across, wide)

    def draw(self) -> tuple[Figure, Ink]:
        rows = self._used()
        risers = [net for net in self._names if sum(net in row for row in rows) > 1]
        left = self._margin + 5.0 * len(risers)
        heights = [self._height(k, len(row)) for k, row in enumerate(rows)]
        width = _SIDE + left + self._wide + 2 * _SIDE
        height = sum(heights) + _HEAD + _SIDE
        figure = Figure(figsize=(width / 72, height / 72))
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set(xlim=(0, width), ylim=(0, height), aspect="equal")
        axes.axis("off")
        ink = Ink(axes)
        name = plain(self._machine.name.replace("_", " "))
        ink.words(_SIDE, height - 12, f"{name}: hydraulic circuit", "heading", size=11,
                  weight="bold", ha="left")  # fmt: skip
        top, places = height - _HEAD, []
        for k, row in enumerate(rows):
            up = self._up(k)
            start = top - up
            rails = {net: start - _GAP * i for i, net in enumerate(row)}
            self._row(ink, k, rails, _SIDE + left, start)
            places.append(rails)
            top -= heights[k]
        self._draw_rails(ink, places, risers, _SIDE + self._margin)
        ink.dots()
        return figure, ink

    def _used(self) -> list[list[str]]:
        """Nets that have a rail, by row; the last row of functions is the first that hangs."""
        rows: list[set[str]] = []
        for k, functions in enumerate(self._stories):
            row = {net for x in functions for net in x.rails.values()}
            rows.append(row | self._centres.rails(k))
        for k, items in enumerate(self._hanging):
            at = len(self._stories) - 1 + k
            if at == len(rows):
                rows.append(set())
            rows[at] |= {net for item in items for net, _ in item.wires}
        return [[net for net in self._names if net in row] for row in rows]

    def _up(self, k: int) -> float:
        if k >= len(self._stories):
            return 14.0
        return self._valve(k) + HEIGHT + self._middle(k) + section.TOP

    def _valve(self, k: int) -> float:
        """Height of the valves above the highest rail."""
        functions = self._stories[k]
        words = 4 + 7.6 * max(len(x.told) for x in functions)
        space = 12 + max(max(x.below for x in functions), words)
        return space + 4.0 * self._centres.count(k) + 2

    def _middle(self, k: int) -> float:
        """Height of the actuators' middle above the valves."""
        functions = self._stories[k]
        rows = max(sum(h for _, h in section.rows_of(x)) for x in functions)
        return rows + 20 + (6 if self._centres.count(k) else 0)

    def _height(self, k: int, rails: int) -> float:
        hanging = k - len(self._stories) + 1
        down = 18.0
        if 0 <= hanging < len(self._hanging):
            down = _FIRST + max(item.height for item in self._hanging[hanging]) + 6
        return self._up(k) + _GAP * (rails - 1) + down

    def _row(
        self, ink: Ink, k: int, rails: Mapping[str, float], left: float, start: float
    ) -> None:
        before = len(ink.wires)
        if k < len(self._stories):
            functions = self._stories[k]
            valve = start + self._valve(k)
            actuator = valve + HEIGHT + self._middle(k)
            spare = max(self._wide - len(functions) * section.WIDTH, 0.0)
            first = left + (spare / 2 if spare < section.WIDTH else 0.25 * spare)
            middles = [first + (i + 0.5) * section.WIDTH for i in range(len(functions))]
            levels = self._centres.levels(k, valve)
            ends = {}
            for function, x in zip(functions, middles, strict=True):
                drawn = Section(ink, function, x, valve, actuator, rails, levels).draw()
                if drawn is not None:
                    ends[function.joint] = x, *drawn
            self._centres.draw(ink, k, ends, rails, levels)
        hanging = k - len(self._stories) + 1
        if not 0 <= hanging < len(self._hanging):
            return
        taken = [w.start[0] for w in ink.wires[before:] if w.start[0] == w.end[0]]
        low = min(rails.values(), default=start) - _FIRST
        cursor = left
        for item in self._hanging[hanging]:
            while any(abs(cursor + at - other) < _NEAR for _, at in item.wires for other in taken):
                cursor += 1.0
            item.draw(ink, cursor, low, rails)
            cursor += item.width

    def _draw_rails(
        self, ink: Ink, rows: Sequence[Mapping[str, float]], risers: Sequence[str], left: float
    ) -> None:
        for net in self._names:
            signal = net.startswith(("LS ", "N "))
            own = risers.index(net) if net in risers else len(risers)
            lane = left + 5.0 * own
            heights = [row[net] for row in rows if net in row]
            for y in heights:
                ends = [w.end[0] for w in ink.wires if w.net == net and w.end[1] == y]
                ends += [w.start[0] for w in ink.wires if w.net == net and w.start[1] == y]
                for one, other in zip([lane, *sorted(set(ends))], sorted(set(ends)), strict=False):
                    ink.wire(net, (one, y), (other, y), signal=signal)
                ink.words(left - 4, y, self._labels[net], f"rail {net}", ha="right")
                if lane > left:
                    ink.line([(left - 2, y), (lane, y)], linewidth=0.4, color="#8a8a8a", zorder=1)
            for one, other in zip(heights, heights[1:], strict=False):
                ink.wire(net, (lane, one), (lane, other), signal=signal)


def _functions(machine: Machine, hydraulics: Hydraulics) -> list[Function]:
    asked = {node for x in hydraulics.elements.values() for node in (x.source, x.target)}
    for valve in hydraulics.valves.values():
        asked |= {valve.return_a, valve.return_b}
    found = []
    for joint, cylinder in hydraulics.cylinders.items():
        valve = hydraulics.valves[joint]
        beside = [x for x in hydraulics.valves.values() if x.supply == valve.supply]
        supply, at = hydraulics.sources[valve.supply], machine.active.index(joint)
        found.append(
            Function(
                joint, cylinder, valve, supply, machine.unit(joint) == "rad",
                float(machine.upper[at] - machine.lower[at]),
                frozenset(side for side in "ab" if f"{joint}.{side}" in asked),
                supply.control == "load-sensing" or any(x.sharing for x in beside),
                len(beside) > 1,
            )
        )  # fmt: skip
    return found


def _parted(functions: Sequence[Function], count: int) -> list[list[Function]]:
    """Rows of nearly equal length, the longer ones first, with the nets of open centres."""
    nets: dict[str, int] = {}
    rows: list[list[Function]] = []
    given = iter(functions)
    for k in range(count):
        row = []
        for _ in range(len(functions) // count + (k < len(functions) % count)):
            function = next(given)
            if function.valve.centre > 0:
                supply = function.valve.supply
                i = nets[supply] = nets.get(supply, -1) + 1
                before = f"C {supply} {i}" if i else supply
                function = replace(function, centre=(before, f"C {supply} {i + 1}"))
            row.append(function)
        rows.append(row)
    return rows


def _packed(items: Sequence[Item], most: float) -> list[list[Item]]:
    """Items in rows that are at most so wide; what must stay together is in the first."""
    rows: list[list[Item]] = [[]]
    for item in items:
        used = sum(x.width for x in rows[-1])
        if rows[-1] and not item.together and used + item.width + 16 > most:
            rows.append([])
        rows[-1].append(item)
    return rows


def _rails(hydraulics: Hydraulics, functions: Sequence[Function], centres: Centres) -> list[str]:
    """All nets that may have a rail, from the top."""
    signals = [f"LS {name}" for name in hydraulics.sources]
    signals += [f"N {name}" for name in hydraulics.sources]
    nodes = [TANK, *hydraulics.sources, *hydraulics.lines, *hydraulics.accumulators]
    return [*signals, *centres.nets, *nodes,
            *(f"{x.joint}.{side}" for x in functions for side in "ab")]  # fmt: skip


def _told(hydraulics: Hydraulics, net: str) -> str:
    """What a rail is called."""
    kind, _, name = net.partition(" ")
    alone = len(hydraulics.sources) == 1
    shown = net
    if kind == "C" and name:
        shown = f"{name.split()[0]} centre"
    elif kind in ("LS", "N") and name:
        sign = {"LS": "LS", "N": "pN"}[kind]
        shown = sign if alone else f"{sign} {name}"
    return plain(shown if len(shown) <= _LONG else f"{shown[: _LONG - 1]}…")
