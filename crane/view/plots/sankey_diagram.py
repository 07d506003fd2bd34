"""Sankey diagram of the energy of a hydraulic run."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch, Polygon, Rectangle
from matplotlib.path import Path as Outline
from matplotlib.patheffects import withStroke

from crane.common.units import format_number
from crane.hydraulics.circuit_equations import SHAFT_POWER
from crane.recordings.recording_summary import result_title
from crane.studies.power_balance_result import (
    LOAD,
    PowerBalance,
    part_class,
    part_kind,
    part_owner,
)
from crane.view.plots.figure_style import INK_COLOUR, escape_label, figure_style
from crane.view.plots.power_figure import CLASS_COLOURS

_TOTAL_HEIGHT = 4.2  # of all that is given [inch]
_LABEL_HEIGHT, _LABEL_GAP, _GROUP_GAP = (
    0.19,
    0.05,
    0.42,
)  # of a label, between labels, between groups [inch]
_COLUMN_POSITIONS = (1.35, 3.1, 5.5, 8.1)  # where bars stand [inch]
_FIGURE_WIDTH, _BAR_WIDTH, _TOP_MARGIN, _BOTTOM_MARGIN, _RETURN_ARROW_LENGTH = (
    10.2,
    0.14,
    0.3,
    0.3,
    0.32,
)  # [inch]
_MIN_RIBBON_SHARE, _MIN_OTHERS_SHARE = (
    4e-3,
    1e-3,
)  # shares of all that have a ribbon of their own, and one at all
_NEUTRAL_COLOUR = "#8c9aa8"


@dataclass
class _SankeyRibbon:
    """One ribbon on the right.

    Attributes:
        label: Label of the ribbon.
        energy: [J].
        color: Its colour.
        centre: Height of its middle [inch].
    """

    label: str
    energy: float
    color: str
    centre: float = 0.0


@dataclass
class _SankeyGroup:
    """Energy of one owner, by ribbon.

    Attributes:
        label: Name of the owner.
        ribbons: Ribbons of the owner's energy.
        returned_energy: Energy that does not come from the pumps [J].
        top: Height of its top [inch].
    """

    label: str
    ribbons: list[_SankeyRibbon]
    returned_energy: float
    top: float = 0.0

    @property
    def total_energy(self) -> float:
        """Energy of all ribbons [J]."""
        return sum(item.energy for item in self.ribbons)


@figure_style
def sankey_figure(balance: PowerBalance) -> Figure:
    """Return the energies from the shafts by pump and joint to losses and loads, in kJ and %.

    Energy that a load returns while it drives its cylinder enters its joint from the left.
    Energies of less than 0.4 % are summed as others, which are left out below 0.1 %. Percentages
    are of the energy of the shafts.
    """
    return _SankeyDiagram(balance).figure


class _SankeyDiagram:
    """The drawing.

    Args:
        balance: The power balance.
    """

    def __init__(self, balance: PowerBalance):
        energies = balance.energies
        self._balance = balance
        self._shaft_energies = {x: energies[f"{x}.{SHAFT_POWER}"] for x in balance.pumps
                       if energies.get(f"{x}.{SHAFT_POWER}", 0.0) > 0}  # fmt: skip
        self._total_energy = sum(self._shaft_energies.values())
        pump_loss_names = [x for x in balance.powers if part_owner(x) in balance.pumps
                 and part_kind(x) in ("friction", "slip")]  # fmt: skip
        names = [
            x for x in balance.powers if part_kind(x) != SHAFT_POWER and x not in pump_loss_names
        ]
        self._pump_group = self._create_group("pumps", pump_loss_names)
        self._pump_losses = {
            pump: sum(energies[x] for x in pump_loss_names if part_owner(x) == pump)
            for pump in self._shaft_energies
        }
        groups = [
            self._create_group(joint, [x for x in names if part_owner(x) == joint])
            for joint in balance.joints
        ]
        groups.append(
            self._create_group(
                "circuit", [x for x in names if part_owner(x) not in balance.joints]
            )
        )
        # groups that return more than they receive become sources
        self._returning_groups: dict[str, float] = {}
        for group in [x for x in groups if x.returned_energy > x.total_energy]:
            if group.returned_energy > _MIN_RIBBON_SHARE * self._total_energy:
                self._returning_groups[f"{escape_label(group.label)}\ngives back"] = (
                    group.returned_energy
                )
            group.returned_energy = 0.0
        self._owner_groups = [
            group
            for group in groups
            if group.total_energy > _MIN_RIBBON_SHARE * self._total_energy
        ]
        self.figure = self._draw_figure()

    def _create_group(self, owner: str, names: list[str]) -> _SankeyGroup:
        balance, ribbons, returned_energy, small_energy = self._balance, [], 0.0, 0.0
        min_energy = _MIN_RIBBON_SHARE * self._total_energy
        for name in names:
            power, kind, part_owner_name = balance.powers[name], part_kind(name), part_owner(name)
            energy, returned = balance.integrate_energy(power), 0.0
            if kind == LOAD:
                returned = balance.integrate_energy(np.maximum(-power, 0.0))
            if kind != LOAD and energy < 0:
                returned = -energy
            energy, returned_energy = energy + returned, returned_energy + returned
            label = f"{part_owner_name} {kind}"
            if kind == "element":
                label = part_owner_name
            if kind not in ("element", "stored") and (
                owner == part_owner_name or len(self._shaft_energies) == 1
            ):
                label = kind
            if energy < min_energy:
                small_energy += energy
            if energy > 0 and energy >= min_energy:
                ribbons.append(
                    _SankeyRibbon(
                        escape_label(label), energy, CLASS_COLOURS[part_class(balance, name)]
                    )
                )
        if small_energy > _MIN_OTHERS_SHARE * self._total_energy:
            ribbons.append(_SankeyRibbon("others", small_energy, _NEUTRAL_COLOUR))
        return _SankeyGroup(owner, ribbons, returned_energy)

    def _draw_figure(self) -> Figure:
        groups = ([self._pump_group] if self._pump_group.ribbons else []) + self._owner_groups
        scale = _TOTAL_HEIGHT / max(
            self._total_energy + sum(self._returning_groups.values()), 1e-9
        )
        figure_height = self._place_groups(groups, scale)
        figure = Figure(figsize=(_FIGURE_WIDTH, figure_height))
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.set(xlim=(0.0, _FIGURE_WIDTH), ylim=(-figure_height, 0.0))
        axes.axis("off")
        self._axes, self._scale = axes, scale
        axes.text(
            0.1,
            -0.1,
            escape_label(
                result_title(
                    self._balance.machine_name, f"{self._balance.task_name} energy".strip()
                )
            ),
            fontsize=11,
            fontweight="bold",
            va="top",
        )
        if not self._total_energy > 0 or not self._owner_groups:
            axes.text(0.1, -0.6, "no energy", va="top")
            return figure
        self._draw_sources(self._draw_hydraulic_bar(groups))
        for group in groups:
            self._draw_group(group)
        return figure

    def _place_groups(self, groups: list[_SankeyGroup], scale: float) -> float:
        """Place all groups downwards, and return the height of the figure [inch]."""
        y = -_TOP_MARGIN
        for group in groups:
            y -= _GROUP_GAP
            group_start = y
            for ribbon in group.ribbons:
                ribbon_height = max(scale * ribbon.energy, _LABEL_HEIGHT)
                ribbon.centre = y - 0.5 * ribbon_height
                y -= ribbon_height + _LABEL_GAP
            y += _LABEL_GAP
            group.top = 0.5 * (group_start + y + scale * group.total_energy)
        return max(_BOTTOM_MARGIN - y, _TOP_MARGIN + _TOTAL_HEIGHT + 1.2)

    def _draw_hydraulic_bar(self, groups: list[_SankeyGroup]) -> float:
        """Draw the hydraulic bar and its ribbons, and return its top [inch]."""
        scale, (_, x, target_x, _) = self._scale, _COLUMN_POSITIONS
        first_centre, last_centre = (
            self._owner_groups[0].ribbons[0].centre,
            self._owner_groups[-1].ribbons[-1].centre,
        )
        flow = sum(group.total_energy - group.returned_energy for group in self._owner_groups)
        top = 0.5 * (first_centre + last_centre + scale * flow)
        self._draw_text(
            x - 0.04,
            top - 0.5 * scale * flow,
            f"hydraulic {self._energy_text(flow)}",
            "right",
            "center",
            is_vertical=True,
        )
        groups = self._owner_groups
        flows = [(x.total_energy - x.returned_energy, x.top, _NEUTRAL_COLOUR) for x in groups]
        self._draw_flows(x, top, target_x, flows)
        return top

    def _draw_sources(self, bar_top: float) -> None:
        scale, (x, bar_x, group_x, _) = self._scale, _COLUMN_POSITIONS
        target_top, loss_top = bar_top, self._pump_group.top
        sources = {f"{escape_label(pump)}\nshaft": (energy, self._pump_losses[pump])
                 for pump, energy in self._shaft_energies.items()}  # fmt: skip
        sources |= {words: (energy, 0.0) for words, energy in self._returning_groups.items()}
        y = bar_top + scale * next(iter(sources.values()))[1]
        y += 0.5 * _GROUP_GAP * (len(sources) - 1)
        for label, (energy, loss) in sources.items():
            self._draw_text(
                x - 0.08,
                y - 0.5 * scale * energy,
                f"{label}\n{self._energy_text(energy)}",
                ha="right",
                va="center",
            )
            self._draw_flows(x, y, group_x, [(loss, loss_top, CLASS_COLOURS["pump"])])
            self._draw_flows(
                x, y - scale * loss, bar_x, [(energy - loss, target_top, _NEUTRAL_COLOUR)]
            )
            loss_top -= scale * loss
            target_top -= scale * (energy - loss)
            y -= scale * energy + _GROUP_GAP

    def _draw_flows(
        self, x: float, top: float, target_x: float, flows: Iterable[tuple[float, float, str]]
    ) -> None:
        """Draw a bar and its ribbons: energies [J], tops of their targets [inch], colours."""
        for energy, target_top, colour in flows:
            height = self._scale * energy
            self._draw_bar(x, top, height, INK_COLOUR)
            self._draw_ribbon((x + _BAR_WIDTH, top), (target_x, target_top), height, colour)
            top -= height

    def _draw_group(self, group: _SankeyGroup) -> None:
        scale, (_, _, x, target_x) = self._scale, _COLUMN_POSITIONS
        bar_height, return_height = scale * group.total_energy, scale * group.returned_energy
        label = f"{escape_label(group.label)}\n{self._energy_text(group.total_energy)}"
        self._draw_text(x, group.top + 0.05, label, weight="bold")
        if group.returned_energy > _MIN_RIBBON_SHARE * self._total_energy:
            bar_bottom = group.top - bar_height
            left, arrow_tip = x - _RETURN_ARROW_LENGTH, x - 0.5 * _RETURN_ARROW_LENGTH
            corners = [
                (left, bar_bottom),
                (arrow_tip, bar_bottom),
                (x, bar_bottom),
                (x, bar_bottom + return_height),
                (left, bar_bottom + return_height),
            ]
            corners.append((left + 0.1, bar_bottom + 0.5 * return_height))
            self._axes.add_patch(
                Polygon(
                    corners,
                    facecolor=CLASS_COLOURS[
                        LOAD if group.label in self._balance.joints else "stored"
                    ],
                    alpha=0.5,
                    linewidth=0,
                )
            )
            label = f"gives back {self._kilojoule_text(group.returned_energy)}"
            self._draw_text(
                left - 0.05, bar_bottom + 0.5 * return_height, label, ha="right", va="center"
            )
        tops = [ribbon.centre + 0.5 * scale * ribbon.energy for ribbon in group.ribbons]
        flows = [(x.energy, end, x.color) for x, end in zip(group.ribbons, tops, strict=True)]
        self._draw_flows(x, group.top, target_x, flows)
        for ribbon, ribbon_top in zip(group.ribbons, tops, strict=True):
            self._draw_bar(target_x, ribbon_top, scale * ribbon.energy, ribbon.color)
            self._draw_text(
                target_x + _BAR_WIDTH + 0.07,
                ribbon.centre,
                f"{ribbon.label}  {self._energy_text(ribbon.energy)}",
                va="center",
            )

    def _energy_text(self, energy: float) -> str:
        return (
            f"{self._kilojoule_text(energy)} "
            f"({format_number(100 * energy / self._total_energy, 2)} %)"
        )

    def _kilojoule_text(self, energy: float) -> str:
        return f"{format_number(1e-3 * energy)} kJ"

    def _draw_text(
        self, x: float, y: float, text: str, ha: str = "left", va: str = "bottom",
        weight: str = "normal", is_vertical: bool = False,
    ) -> None:  # fmt: skip
        self._axes.text(
            x, y, text, ha=ha, va=va, fontsize=8, fontweight=weight,
            rotation=90 if is_vertical else 0, zorder=3,
            path_effects=[withStroke(linewidth=2.0, foreground="white", alpha=0.8)],
        )  # fmt: skip

    def _draw_bar(self, x: float, top: float, size: float, color: str) -> None:
        self._axes.add_patch(
            Rectangle((x, top - size), _BAR_WIDTH, size, facecolor=color, linewidth=0, zorder=2)
        )

    def _draw_ribbon(
        self, start: tuple[float, float], end: tuple[float, float], size: float, color: str
    ) -> None:
        """Draw a ribbon between two top edges."""
        (x, y), (end_x, end_y) = start, end
        middle_x = 0.5 * (x + end_x)
        points = [
            (x, y),
            (middle_x, y),
            (middle_x, end_y),
            (end_x, end_y),
            (end_x, end_y - size),
            (middle_x, end_y - size),
            (middle_x, y - size),
            (x, y - size),
            (x, y),
        ]
        curve = [Outline.CURVE4] * 3
        codes = [Outline.MOVETO, *curve, Outline.LINETO, *curve, Outline.CLOSEPOLY]
        self._axes.add_patch(
            PathPatch(Outline(points, codes), facecolor=color, alpha=0.45, linewidth=0)
        )
