"""The symbol of a proportional directional valve."""

from collections.abc import Sequence

from crane.view.sketch.circuit.circuit_canvas import CircuitCanvas, SheetPoint

SPOOL_HEIGHT = 20.0
_END_WIDTH = 12.0  # of springs and signals


class SpoolSymbol:
    """A valve's boxes: straight, middle, crossed, and floating where it floats.

    Args:
        x: Middle of the middle box.
        y: Lower edge.
        lower_ports: Its ports below from the left, of "Ta", "LS", "P", "C", "T".
        upper_ports: Those above, of "A", "C", "B".
        has_float_position: Whether it has a floating position.

    Attributes:
        port_positions: By name, with "C'" for the open centre's outlet above.
    """

    def __init__(
        self,
        x: float,
        y: float,
        lower_ports: Sequence[str],
        upper_ports: Sequence[str],
        has_float_position: bool,
    ):
        self._x, self._y, self._has_float_position = x, y, has_float_position
        self._width = 15.0 if has_float_position else 20.0
        self._lower_ports = dict(
            zip(lower_ports, self._spread_ports(len(lower_ports)), strict=True)
        )
        self._upper_ports = dict(
            zip(upper_ports, self._spread_ports(len(upper_ports)), strict=True)
        )
        self.port_positions: dict[str, SheetPoint] = {
            name: (x + port_offset, y) for name, port_offset in self._lower_ports.items()
        }
        self.port_positions |= {
            ("C'" if name == "C" else name): (x + at, y + SPOOL_HEIGHT)
            for name, at in self._upper_ports.items()
        }

    def _spread_ports(self, count: int) -> list[float]:
        half_range = 0.35 * self._width
        return [half_range * (2 * i / (count - 1) - 1) for i in range(count)]

    def draw(self, canvas: CircuitCanvas, component: str) -> None:
        """Draw it."""
        x, y, w = self._x, self._y, self._width
        first, last = x - 1.5 * w, x + (2.5 if self._has_float_position else 1.5) * w
        corners = [(first, y), (last, y), (last, y + SPOOL_HEIGHT), (first, y + SPOOL_HEIGHT)]
        canvas.draw_shape(corners, gid=component)
        for k in range(1, 4 if self._has_float_position else 3):
            canvas.draw_line([(first + k * w, y), (first + k * w, y + SPOOL_HEIGHT)])
        for height in (y - 1.8, y + SPOOL_HEIGHT + 1.8):  # of a proportional valve
            canvas.draw_line([(first, height), (last, height)], linewidth=0.6)
        for end_x, sign in ((first, -1), (last, 1)):
            canvas.draw_spring(
                (end_x, y + 0.74 * SPOOL_HEIGHT),
                (end_x + sign * _END_WIDTH, y + 0.74 * SPOOL_HEIGHT),
                half_width=3.0,
            )
            box = sorted((end_x, end_x + sign * _END_WIDTH))
            box_bottom, box_top = y + 1.5, y + 0.46 * SPOOL_HEIGHT
            canvas.draw_shape(
                [(box[0], box_bottom), (box[1], box_bottom), (box[1], box_top), (box[0], box_top)]
            )
            canvas.draw_arrow(
                (box[0] - 0.5, box_bottom - 1.5), (box[1] + 0.5, box_top + 1.5), size=3.0
            )
            canvas.draw_line(
                [
                    (end_x + sign * 0.3 * _END_WIDTH, box_bottom),
                    (end_x + sign * 0.7 * _END_WIDTH, box_top),
                ]
            )
        tank_a = "Ta" if "Ta" in self._lower_ports else "T"
        self._draw_flow_paths(canvas, x - w, [("P", "A"), ("B", "T")], set())
        self._draw_middle_position(canvas, x)
        self._draw_flow_paths(canvas, x + w, [("P", "B"), ("A", tank_a)], set())
        if self._has_float_position:
            self._draw_float_position(canvas, x + 2 * w)

    def _draw_flow_paths(
        self,
        canvas: CircuitCanvas,
        x: float,
        flow_paths: list[tuple[str, str]],
        used_ports: set[str],
    ) -> None:
        for source, target in flow_paths:
            start, end = self._port_position(x, source), self._port_position(x, target)
            canvas.draw_arrow(start, end, size=4.0)
            used_ports |= {source, target}
        self._draw_closed_ports(canvas, x, used_ports | {"LS"})

    def _port_position(self, x: float, name: str) -> SheetPoint:
        if name in self._upper_ports:
            return x + self._upper_ports[name], self._y + SPOOL_HEIGHT
        return x + self._lower_ports[name], self._y

    def _draw_closed_ports(self, canvas: CircuitCanvas, x: float, used_ports: set[str]) -> None:
        """What is closed."""
        for row, level, sign in (
            (self._lower_ports, self._y, 1),
            (self._upper_ports, self._y + SPOOL_HEIGHT, -1),
        ):
            for name, position in row.items():
                if name in used_ports:
                    continue
                end = level + sign * 5
                canvas.draw_line([(x + position, level), (x + position, end)])
                canvas.draw_line([(x + position - 2, end), (x + position + 2, end)])

    def _draw_middle_position(self, canvas: CircuitCanvas, x: float) -> None:
        used_ports = {"LS"}
        if "C" in self._lower_ports:
            start, end = (
                (x + self._lower_ports["C"], self._y),
                (x + self._upper_ports["C"], self._y + SPOOL_HEIGHT),
            )
            canvas.draw_arrow(start, end, size=4.0)
            used_ports.add("C")
        self._draw_closed_ports(canvas, x, used_ports)

    def _draw_float_position(self, canvas: CircuitCanvas, x: float) -> None:
        connection_height = self._y + 0.55 * SPOOL_HEIGHT
        connected_ports = [
            name
            for name in ("A", "B", "Ta", "T")
            if name in {**self._upper_ports, **self._lower_ports}
        ]
        for name in connected_ports:
            position = self._port_position(x, name)
            canvas.draw_line([position, (position[0], connection_height)])
        port_x = [self._port_position(x, name)[0] for name in connected_ports]
        canvas.draw_line([(min(port_x), connection_height), (max(port_x), connection_height)])
        self._draw_closed_ports(canvas, x, {*connected_ports, "LS"})
