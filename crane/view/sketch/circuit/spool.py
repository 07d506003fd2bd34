"""The symbol of a proportional directional valve."""

from collections.abc import Sequence

from crane.view.sketch.circuit.ink import Ink, Point

HEIGHT = 20.0
_END = 12.0  # of springs and signals


class Spool:
    """A valve's boxes: straight, middle, crossed, and floating where it floats.

    Args:
        x: Middle of the middle box.
        y: Lower edge.
        below: Its ports below from the left, of "Ta", "LS", "P", "C", "T".
        above: Those above, of "A", "C", "B".
        floats: Whether it has a floating position.

    Attributes:
        ports: By name, with "C'" for the open centre's outlet above.
    """

    def __init__(
        self, x: float, y: float, below: Sequence[str], above: Sequence[str], floats: bool
    ):
        self._x, self._y, self._floats = x, y, floats
        self._width = 15.0 if floats else 20.0
        self._below = dict(zip(below, self._spread(len(below)), strict=True))
        self._above = dict(zip(above, self._spread(len(above)), strict=True))
        self.ports: dict[str, Point] = {name: (x + at, y) for name, at in self._below.items()}
        self.ports |= {
            ("C'" if name == "C" else name): (x + at, y + HEIGHT)
            for name, at in self._above.items()
        }

    def _spread(self, count: int) -> list[float]:
        reach = 0.35 * self._width
        return [reach * (2 * i / (count - 1) - 1) for i in range(count)]

    def draw(self, ink: Ink, part: str) -> None:
        """Draw it."""
        x, y, w = self._x, self._y, self._width
        first, last = x - 1.5 * w, x + (2.5 if self._floats else 1.5) * w
        corners = [(first, y), (last, y), (last, y + HEIGHT), (first, y + HEIGHT)]
        ink.shape(corners, gid=part)
        for k in range(1, 4 if self._floats else 3):
            ink.line([(first + k * w, y), (first + k * w, y + HEIGHT)])
        for height in (y - 1.8, y + HEIGHT + 1.8):  # of a proportional valve
            ink.line([(first, height), (last, height)], linewidth=0.6)
        for end, sign in ((first, -1), (last, 1)):
            ink.spring((end, y + 0.74 * HEIGHT), (end + sign * _END, y + 0.74 * HEIGHT), half=3.0)
            box = sorted((end, end + sign * _END))
            low, high = y + 1.5, y + 0.46 * HEIGHT
            ink.shape([(box[0], low), (box[1], low), (box[1], high), (box[0], high)])
            ink.arrow((box[0] - 0.5, low - 1.5), (box[1] + 0.5, high + 1.5), size=3.0)
            ink.line([(end + sign * 0.3 * _END, low), (end + sign * 0.7 * _END, high)])
        tank_a = "Ta" if "Ta" in self._below else "T"
        self._arrows(ink, x - w, [("P", "A"), ("B", "T")], set())
        self._middle(ink, x)
        self._arrows(ink, x + w, [("P", "B"), ("A", tank_a)], set())
        if self._floats:
            self._joined(ink, x + 2 * w)

    def _arrows(self, ink: Ink, x: float, ways: list[tuple[str, str]], used: set[str]) -> None:
        for one, other in ways:
            start, end = self._point(x, one), self._point(x, other)
            ink.arrow(start, end, size=4.0)
            used |= {one, other}
        self._stubs(ink, x, used | {"LS"})

    def _point(self, x: float, name: str) -> Point:
        if name in self._above:
            return x + self._above[name], self._y + HEIGHT
        return x + self._below[name], self._y

    def _stubs(self, ink: Ink, x: float, used: set[str]) -> None:
        """What is closed."""
        for row, level, sign in ((self._below, self._y, 1), (self._above, self._y + HEIGHT, -1)):
            for name, at in row.items():
                if name in used:
                    continue
                end = level + sign * 5
                ink.line([(x + at, level), (x + at, end)])
                ink.line([(x + at - 2, end), (x + at + 2, end)])

    def _middle(self, ink: Ink, x: float) -> None:
        used = {"LS"}
        if "C" in self._below:
            start, end = (x + self._below["C"], self._y), (x + self._above["C"], self._y + HEIGHT)
            ink.arrow(start, end, size=4.0)
            used.add("C")
        self._stubs(ink, x, used)

    def _joined(self, ink: Ink, x: float) -> None:
        middle = self._y + 0.55 * HEIGHT
        joined = [name for name in ("A", "B", "Ta", "T") if name in {**self._above, **self._below}]
        for name in joined:
            at = self._point(x, name)
            ink.line([at, (at[0], middle)])
        ends = [self._point(x, name)[0] for name in joined]
        ink.line([(min(ends), middle), (max(ends), middle)])
        self._stubs(ink, x, {*joined, "LS"})
