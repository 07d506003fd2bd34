"""Where a run's energy went, as ribbons as wide as it is much: a Sankey diagram."""

from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch, Polygon, Rectangle
from matplotlib.path import Path as Outline
from matplotlib.patheffects import withStroke

from crane.common.units import number
from crane.hydraulics.powers import SHAFT
from crane.recordings.summary import title
from crane.studies.power import LOAD, PowerAccount, class_of, owner_of, what_of
from crane.view.plots.power import COLORS
from crane.view.plots.recording import INK, STYLE, write_figure
from crane.view.plots.text import plain

_TALL = 4.2  # of all that is given [inch]
_LINE, _GAP, _APART = 0.19, 0.05, 0.42  # of a label, between labels, between groups [inch]
_COLUMNS = (1.35, 3.1, 5.5, 8.1)  # where bars stand [inch]
_WIDE, _BAR, _TOP, _BOTTOM, _STUB = 10.2, 0.14, 0.3, 0.3, 0.32  # [inch]
_LEAST, _NOTHING = 4e-3, 1e-3  # shares of all that have a ribbon of their own, and one at all
_NEUTRAL = "#8c9aa8"


@dataclass
class _Item:
    """A ribbon on the right.

    Attributes:
        words: What it is.
        energy: [J].
        color: Its colour.
        y: Of its middle [inch].
    """

    words: str
    energy: float
    color: str
    y: float = 0.0


@dataclass
class _Group:
    """What one owner's energy goes into.

    Attributes:
        words: Whose it is.
        items: Into what.
        back: That it gets from elsewhere than the pumps [J].
        y: Of its top [inch].
    """

    words: str
    items: list[_Item]
    back: float
    y: float = 0.0

    @property
    def spent(self) -> float:
        """Energy of all its items [J]."""
        return sum(item.energy for item in self.items)


def plot_sankey(account: PowerAccount, path: str | Path) -> None:
    """Write the picture to a file.

    Args:
        account: What to show.
        path: Where to write; its suffix .png, .svg or .pdf chooses the format.

    Raises:
        OutputError: The suffix is another one, or the file cannot be written.
    """
    write_figure(path, lambda: sankey_figure(account))


def sankey_figure(account: PowerAccount) -> Figure:
    """Energies from the shafts by pump and joint into what they go into, in kJ and %.

    What a load gives back while it drives its cylinder enters its joint from the left.
    What has less than 0.4 % is drawn as others, less than 0.1 % not at all. Percentages are of
    what the shafts give.
    """
    with mpl.rc_context(STYLE):
        return _Sankey(account).figure


class _Sankey:
    """The drawing.

    Args:
        account: What to show.
    """

    def __init__(self, account: PowerAccount):
        energies = account.energies
        self._account = account
        self._given = {x: energies[f"{x}.{SHAFT}"] for x in account.pumps
                       if energies.get(f"{x}.{SHAFT}", 0.0) > 0}  # fmt: skip
        self._all = sum(self._given.values())
        pumps = [x for x in account.powers if owner_of(x) in account.pumps
                 and what_of(x) in ("friction", "slip")]  # fmt: skip
        names = [x for x in account.powers if what_of(x) != SHAFT and x not in pumps]
        self._pumps = self._group("pumps", pumps)
        self._losses = {
            pump: sum(energies[x] for x in pumps if owner_of(x) == pump) for pump in self._given
        }
        groups = [
            self._group(joint, [x for x in names if owner_of(x) == joint])
            for joint in account.joints
        ]
        others = [x for x in names if owner_of(x) not in account.joints]
        groups.append(self._group("circuit", others))
        # what gives more than it takes feeds the others
        self._sources: dict[str, float] = {}
        for group in groups:
            if group.back > group.spent:
                if group.back > _LEAST * self._all:
                    self._sources[f"{plain(group.words)}\ngives back"] = group.back
                group.back = 0.0
        self._groups = [group for group in groups if group.spent > _LEAST * self._all]
        self.figure = self._drawn()

    def _group(self, owner: str, names: list[str]) -> _Group:
        account, items, back, small = self._account, [], 0.0, 0.0
        for name in names:
            power, what = account.powers[name], what_of(name)
            energy, taken = account.energy(power), 0.0
            if what == LOAD:
                taken = account.energy(np.maximum(-power, 0.0))
            elif energy < 0:
                taken = -energy
            energy, back = energy + taken, back + taken
            whose = owner_of(name)
            alone = owner == whose or len(self._given) == 1
            words = whose if what == "element" else what if alone and what != "stored" else ""
            if energy < _LEAST * self._all:
                small += energy
            elif energy > 0:
                color = COLORS[class_of(account, name)]
                items.append(_Item(plain(words or f"{whose} {what}"), energy, color))
        if small > _NOTHING * self._all:
            items.append(_Item("others", small, _NEUTRAL))
        return _Group(owner, items, back)

    def _drawn(self) -> Figure:
        groups = ([self._pumps] if self._pumps.items else []) + self._groups
        scale = _TALL / max(self._all + sum(self._sources.values()), 1e-9)
        tall = self._placed(groups, scale)
        figure = Figure(figsize=(_WIDE, tall))
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.set_xlim(0.0, _WIDE)
        axes.set_ylim(-tall, 0.0)
        axes.axis("off")
        self._axes, self._scale = axes, scale
        words = title(self._account.machine, f"{self._account.task} energy".strip())
        axes.text(0.1, -0.1, plain(words), fontsize=11, fontweight="bold", va="top")
        if not self._all > 0 or not self._groups:
            axes.text(0.1, -0.6, "nothing is driven", va="top")
            return figure
        self._sided(self._fed(groups))
        for group in groups:
            self._draw_group(group)
        return figure

    def _placed(self, groups: list[_Group], scale: float) -> float:
        """Place all from above downwards; the height of the figure [inch]."""
        y = -_TOP
        for group in groups:
            y -= _APART
            start = y
            for item in group.items:
                size = max(scale * item.energy, _LINE)
                item.y = y - 0.5 * size
                y -= size + _GAP
            y += _GAP
            group.y = 0.5 * (start + y + scale * group.spent)
        return max(_BOTTOM - y, _TOP + _TALL + 1.2)

    def _fed(self, groups: list[_Group]) -> float:
        """Draw the bar that feeds the groups, and its ribbons; its top [inch]."""
        scale, (_, x, to, _) = self._scale, _COLUMNS
        first, last = self._groups[0].items[0].y, self._groups[-1].items[-1].y
        flow = sum(group.spent - group.back for group in self._groups)
        top = at = 0.5 * (first + last + scale * flow)
        self._bar(x, top, scale * flow, INK)
        words = f"hydraulic {self._said(flow)}"
        self._text(x - 0.04, top - 0.5 * scale * flow, words, "right", "center", turned=True)
        for group in self._groups:
            size = scale * (group.spent - group.back)
            self._ribbon((x + _BAR, at), (to, group.y), size, _NEUTRAL)
            at -= size
        return top

    def _sided(self, top: float) -> None:
        """Draw what gives, on the left, beside the bar at a height."""
        scale, (x, to, across, _) = self._scale, _COLUMNS
        inward, lost = top, self._pumps.y
        given = {f"{plain(pump)}\nshaft": (energy, self._losses[pump])
                 for pump, energy in self._given.items()}  # fmt: skip
        given |= {words: (energy, 0.0) for words, energy in self._sources.items()}
        y = top + scale * next(iter(given.values()))[1]
        y += 0.5 * _APART * (len(given) - 1)
        for words, (energy, gone) in given.items():
            self._bar(x, y, scale * energy, INK)
            at = y - 0.5 * scale * energy
            self._text(x - 0.08, at, f"{words}\n{self._said(energy)}", ha="right", va="center")
            if gone > 0:
                color = COLORS["pump"]
                self._ribbon((x + _BAR, y), (across, lost), scale * gone, color)
                lost -= scale * gone
            size = scale * (energy - gone)
            self._ribbon((x + _BAR, y - scale * gone), (to, inward), size, _NEUTRAL)
            inward -= size
            y -= scale * energy + _APART

    def _draw_group(self, group: _Group) -> None:
        scale, (_, _, x, to) = self._scale, _COLUMNS
        tall, back = scale * group.spent, scale * group.back
        self._bar(x, group.y, tall, INK)
        words = f"{plain(group.words)}\n{self._said(group.spent)}"
        self._text(x, group.y + 0.05, words, weight="bold")
        if group.back > _LEAST * self._all:
            low = group.y - tall
            left, nose = x - _STUB, x - 0.5 * _STUB
            corners = [(left, low), (nose, low), (x, low), (x, low + back), (left, low + back)]
            corners.append((left + 0.1, low + 0.5 * back))
            color = COLORS[LOAD if group.words in self._account.joints else "stored"]
            self._axes.add_patch(Polygon(corners, facecolor=color, alpha=0.5, linewidth=0))
            words = f"gives back {self._kilo(group.back)}"
            self._text(left - 0.05, low + 0.5 * back, words, ha="right", va="center")
        at = group.y
        for item in group.items:
            size = scale * item.energy
            self._ribbon((x + _BAR, at), (to, item.y + 0.5 * size), size, item.color)
            self._bar(to, item.y + 0.5 * size, size, item.color)
            self._text(to + _BAR + 0.07, item.y, f"{item.words}  {self._said(item.energy)}",
                       va="center")  # fmt: skip
            at -= size

    def _said(self, energy: float) -> str:
        return f"{self._kilo(energy)} ({number(100 * energy / self._all, 2)} %)"

    def _kilo(self, energy: float) -> str:
        return f"{number(1e-3 * energy)} kJ"

    def _text(
        self, x: float, y: float, words: str, ha: str = "left", va: str = "bottom",
        weight: str = "normal", turned: bool = False,
    ) -> None:  # fmt: skip
        halo = [withStroke(linewidth=2.0, foreground="white", alpha=0.8)]
        self._axes.text(
            x, y, words, ha=ha, va=va, fontsize=8, fontweight=weight, path_effects=halo,
            rotation=90 if turned else 0, zorder=3,
        )  # fmt: skip

    def _bar(self, x: float, top: float, size: float, color: str) -> None:
        box = Rectangle((x, top - size), _BAR, size, facecolor=color, linewidth=0, zorder=2)
        self._axes.add_patch(box)

    def _ribbon(
        self, start: tuple[float, float], end: tuple[float, float], size: float, color: str
    ) -> None:
        """From one top edge to another."""
        self._axes.add_patch(_curved(start, end, size, color))

    _axes: Axes
    _scale: float


def _curved(
    start: tuple[float, float], end: tuple[float, float], size: float, color: str
) -> PathPatch:
    (x, y), (to, goal) = start, end
    half = 0.5 * (x + to)
    points = [
        (x, y), (half, y), (half, goal), (to, goal),
        (to, goal - size), (half, goal - size), (half, y - size), (x, y - size), (x, y),
    ]  # fmt: skip
    curve = [Outline.CURVE4] * 3
    codes = [Outline.MOVETO, *curve, Outline.LINETO, *curve, Outline.CLOSEPOLY]
    return PathPatch(Outline(points, codes), facecolor=color, alpha=0.45, linewidth=0)
