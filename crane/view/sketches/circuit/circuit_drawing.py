"""Drawing of a hydraulic circuit: rails, functions above, pumps and other items below."""

import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from crane.common.errors import InputError
from crane.hydraulics.circuit_elements import TANK_NODE
from crane.hydraulics.hydraulic_circuit import Hydraulics
from crane.machine.machine import Machine
from crane.view.plots.figure_style import escape_label, figure_style, write_figure
from crane.view.sketches.circuit.circuit_canvas import LINE_HEIGHT, SMALL_TEXT_SIZE, CircuitCanvas
from crane.view.sketches.circuit.circuit_functions import (
    CircuitFunction,
    OpenCentreLines,
    valve_rows,
)
from crane.view.sketches.circuit.circuit_section import SECTION_WIDTH, TOP_HEIGHT, CircuitSection
from crane.view.sketches.circuit.supply_items import SupplyItem, create_supply_items
from crane.view.sketches.circuit.valve_symbols import SPOOL_HEIGHT

_FUNCTIONS_PER_ROW = 4  # functions beside each other
_RAIL_SPACING, _ITEM_DISTANCE = 9.0, 12.0  # between rails; from the lowest rail to items
_MARGIN, _HEADING_HEIGHT = 10.0, 26.0  # around all of it
_MIN_WIRE_DISTANCE = 3.0  # least distance of wires
_MAX_LABEL_LENGTH = 24  # letters of a rail's name


def sketch_circuit(machine: Machine, path: str | Path) -> None:
    """Write a drawing of the hydraulic circuit to a file.

    Args:
        machine: A machine with hydraulics.
        path: File to write; the suffix .png, .svg or .pdf determines the format.

    Raises:
        OutputError: The suffix is another one, or the file cannot be written.
        InputError: The machine has no hydraulics.
    """
    write_figure(path, lambda: circuit_figure(machine)[0])


@figure_style
def circuit_figure(machine: Machine) -> tuple[Figure, CircuitCanvas]:
    """Return the figure of a circuit and its canvas; see `sketch_circuit`.

    Functions stand side by side in the order of the active joints, at most four in a row, each
    above the rails that it is connected to; pumps, tank, accumulators and elements are below the
    lowest rails. Coordinates are points.
    """
    if machine.hydraulics is None:
        raise InputError(
            f"'{machine.name}' has no hydraulic circuit, sketch its mechanism or add 'hydraulics'"
        )
    return _CircuitDrawing(machine, machine.hydraulics).draw()


class _CircuitDrawing:
    """Layout of a circuit."""

    def __init__(self, machine: Machine, hydraulics: Hydraulics):
        self._machine = machine
        functions = _circuit_functions(machine, hydraulics)
        self._function_rows = _split_into_rows(functions)
        self._open_centres = OpenCentreLines(hydraulics, self._function_rows)
        functions_width = max(map(len, self._function_rows)) * SECTION_WIDTH
        self._item_rows = _pack_items(
            create_supply_items(hydraulics, functions),
            max(functions_width, _FUNCTIONS_PER_ROW * SECTION_WIDTH),
        )
        items_width = max(sum(item.width for item in row) + 16 for row in self._item_rows)
        self._content_width = max(functions_width, items_width)
        # all nets that may have a rail, from the top
        self._rail_labels = {
            net: _rail_label(hydraulics, net)
            for net in [
                *[f"{kind} {name}" for kind in ("LS", "N") for name in hydraulics.pumps],
                *self._open_centres.row_nets,
                TANK_NODE,
                *hydraulics.pumps,
                *hydraulics.lines,
                *hydraulics.accumulators,
                *[f"{x.joint}.{side}" for x in functions for side in "ab"],
            ]
        }
        self._label_width = 4 + 0.62 * SMALL_TEXT_SIZE * max(map(len, self._rail_labels.values()))

    def draw(self) -> tuple[Figure, CircuitCanvas]:
        nets_by_row = self._used_nets()
        risers = [net for net in self._rail_labels if sum(net in row for row in nets_by_row) > 1]
        left = self._label_width + 5.0 * len(risers)
        heights = [
            self._height_above_rail(k)
            + _RAIL_SPACING * (len(row) - 1)
            + (_ITEM_DISTANCE + max((x.height for x in self._items_below(k)), default=0.0) + 6)
            for k, row in enumerate(nets_by_row)
        ]
        width = _MARGIN + left + self._content_width + 2 * _MARGIN
        height = sum(heights) + _HEADING_HEIGHT + _MARGIN
        figure = Figure(figsize=(width / 72, height / 72))
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set(xlim=(0, width), ylim=(0, height), aspect="equal")
        axes.axis("off")
        canvas = CircuitCanvas(axes)
        heading = escape_label(self._machine.name.replace("_", " "))
        canvas.draw_text(_MARGIN, height - 12, f"{heading}: hydraulic circuit", "heading", size=11,
                  weight="bold", ha="left")  # fmt: skip
        top, rail_heights_by_row = height - _HEADING_HEIGHT, []
        for k, row in enumerate(nets_by_row):
            top_rail = top - self._height_above_rail(k)
            rails = {net: top_rail - _RAIL_SPACING * i for i, net in enumerate(row)}
            self._draw_row(canvas, k, rails, _MARGIN + left, top_rail)
            rail_heights_by_row.append(rails)
            top -= heights[k]
        self._draw_rails(canvas, rail_heights_by_row, risers, _MARGIN + self._label_width)
        canvas.draw_junctions()
        return figure, canvas

    def _used_nets(self) -> list[list[str]]:
        """Return the nets with a rail by row; items hang below the last row of functions."""
        first_item_row = len(self._function_rows) - 1
        rows: list[set[str]] = [set() for _ in range(first_item_row + len(self._item_rows))]
        for k, functions in enumerate(self._function_rows):
            rows[k] |= {net for x in functions for net in x.rails.values()}
            rows[k] |= self._open_centres.required_nets(k)
        for k, items in enumerate(self._item_rows, start=first_item_row):
            rows[k] |= {net for item in items for net, _ in item.wires}
        return [[net for net in self._rail_labels if net in row] for row in rows]

    def _height_above_rail(self, row: int) -> float:
        if row >= len(self._function_rows):
            return 14.0
        return self._valve_height(row) + self._actuator_height(row) + TOP_HEIGHT

    def _valve_height(self, row: int) -> float:
        """Return the height of the valves above the highest rail."""
        functions = self._function_rows[row]
        required_height = 12 + max(
            max(x.height_below for x in functions),
            4 + LINE_HEIGHT * max(len(x.valve_texts) for x in functions),
        )
        return required_height + 4.0 * self._open_centres.line_count(row) + 2

    def _actuator_height(self, row: int) -> float:
        """Return the height of the actuators' middle above the lower edge of the valves."""
        return (
            SPOOL_HEIGHT
            + max(sum(h for _, h in valve_rows(x)) for x in self._function_rows[row])
            + 20
            + (6 if self._open_centres.line_count(row) else 0)
        )

    def _items_below(self, row: int) -> list[SupplyItem]:
        item_row = row - len(self._function_rows) + 1
        return self._item_rows[item_row] if item_row >= 0 else []

    def _draw_row(
        self,
        canvas: CircuitCanvas,
        row: int,
        rail_heights: Mapping[str, float],
        left: float,
        top_rail: float,
    ) -> None:
        previous_wires = len(canvas.wires)
        if row < len(self._function_rows):
            functions = self._function_rows[row]
            valve = top_rail + self._valve_height(row)
            spare_width = max(self._content_width - len(functions) * SECTION_WIDTH, 0.0)
            levels = self._open_centres.line_heights(row, valve)
            centre_ends = {}
            for i, function in enumerate(functions):
                x = (
                    left
                    + (0.5 if spare_width < SECTION_WIDTH else 0.25) * spare_width
                    + (i + 0.5) * SECTION_WIDTH
                )
                centre_ports = CircuitSection(
                    canvas,
                    function,
                    x,
                    valve,
                    valve + self._actuator_height(row),
                    rail_heights,
                    levels,
                ).draw()
                if centre_ports is not None:
                    centre_ends[function.joint] = x, *centre_ports
            self._open_centres.draw(canvas, row, centre_ends, rail_heights, levels)
        occupied_x = [w.start[0] for w in canvas.wires[previous_wires:] if w.start[0] == w.end[0]]
        item_top = min(rail_heights.values(), default=top_rail) - _ITEM_DISTANCE
        for item in self._items_below(row):
            while any(
                abs(left + position - other) < _MIN_WIRE_DISTANCE
                for _, position in item.wires
                for other in occupied_x
            ):
                left += 1.0
            item.draw(canvas, left, item_top, rail_heights)
            left += item.width

    def _draw_rails(
        self,
        canvas: CircuitCanvas,
        rail_heights_by_row: Sequence[Mapping[str, float]],
        risers: Sequence[str],
        left: float,
    ) -> None:
        for net, label in self._rail_labels.items():
            is_signal = net.startswith(("LS ", "N "))
            lane = left + 5.0 * (risers.index(net) if net in risers else len(risers))
            heights = [row[net] for row in rail_heights_by_row if net in row]
            for y in heights:
                ends = sorted(
                    {
                        end[0]
                        for w in [wire for wire in canvas.wires if wire.net == net]
                        for end in (w.start, w.end)
                        if end[1] == y
                    }
                )
                for first, second in itertools.pairwise([lane, *ends]):
                    canvas.draw_wire(net, (first, y), (second, y), is_signal=is_signal)
                canvas.draw_text(left - 4, y, label, f"rail {net}", ha="right")
                if lane > left:
                    canvas.draw_line(
                        [(left - 2, y), (lane, y)], linewidth=0.4, color="#8a8a8a", zorder=1
                    )
            for first, second in itertools.pairwise(heights):
                canvas.draw_wire(net, (lane, first), (lane, second), is_signal=is_signal)


def _circuit_functions(machine: Machine, hydraulics: Hydraulics) -> list[CircuitFunction]:
    connected_nodes = {node for x in hydraulics.elements.values() for node in (x.source, x.target)}
    for valve in hydraulics.valves.values():
        connected_nodes |= {valve.return_a, valve.return_b}
    functions = []
    for joint, cylinder in hydraulics.cylinders.items():
        valve = hydraulics.valves[joint]
        valves_of_supply = [x for x in hydraulics.valves.values() if x.supply == valve.supply]
        supply, joint_index = hydraulics.pumps[valve.supply], machine.active.index(joint)
        functions.append(
            CircuitFunction(
                joint, cylinder, valve, supply, machine.unit(joint) == "rad",
                float(machine.upper[joint_index] - machine.lower[joint_index]),
                frozenset(side for side in "ab" if f"{joint}.{side}" in connected_nodes),
                supply.control == "load-sensing" or any(x.sharing for x in valves_of_supply),
                len(valves_of_supply) > 1,
            )
        )  # fmt: skip
    return functions


def _split_into_rows(functions: Sequence[CircuitFunction]) -> list[list[CircuitFunction]]:
    """Split functions into rows of similar length, with the nets of open centres."""
    counts: Counter[str] = Counter()
    connected = []
    for function in functions:
        if function.valve.centre > 0:
            supply = function.valve.supply
            inlet_net = f"C {supply} {counts[supply]}" if counts[supply] else supply
            counts[supply] += 1
            function = replace(function, centre_nets=(inlet_net, f"C {supply} {counts[supply]}"))
        connected.append(function)
    return [
        [connected[i] for i in row]
        for row in np.array_split(range(len(functions)), -(-len(functions) // _FUNCTIONS_PER_ROW))
    ]


def _pack_items(items: Sequence[SupplyItem], max_width: float) -> list[list[SupplyItem]]:
    """Pack items into rows of limited width; items with `stays_in_row` stay together."""
    rows: list[list[SupplyItem]] = [[]]
    for item in items:
        if (
            rows[-1]
            and not item.stays_in_row
            and (sum(x.width for x in (*rows[-1], item)) + 16) > max_width
        ):
            rows.append([])
        rows[-1].append(item)
    return rows


def _rail_label(hydraulics: Hydraulics, net: str) -> str:
    kind, _, name = net.partition(" ")
    label = net
    if kind == "C" and name:
        label = f"{name.split()[0]} centre"
    elif kind in ("LS", "N") and name:
        sign = "LS" if kind == "LS" else "pN"
        label = sign if len(hydraulics.pumps) == 1 else f"{sign} {name}"
    return escape_label(
        label if len(label) <= _MAX_LABEL_LENGTH else f"{label[: _MAX_LABEL_LENGTH - 1]}…"
    )
