"""The mechanism of a machine as a figure: what every text on it begins with."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from numpy.typing import ArrayLike

from crane.common.errors import InputError
from crane.common.samples import Array
from crane.machine import Machine
from crane.view.plots.recording import STYLE, write_figure
from crane.view.plots.text import plain
from crane.view.sketch.canvas import CENTRE, DOT, JOINT, QUARTERS, RING, Canvas, hull, mark
from crane.view.sketch.labels import Label, clear_spot, place_labels
from crane.view.sketch.mechanism import SAME, project
from crane.view.sketch.parts import Body, Mechanism, Pin, Slide
from crane.view.sketch.plane import find_plane
from crane.view.sketch.sheet import lay_out, symbol

CHAINS = (
    "#1f5fa8", "#d0661c", "#2f8050", "#8a4a9c", "#b03a48", "#2b8c9c", "#8c7a1e", "#5a5f66",
)  # fmt: skip
REGIONS = ("#e4edf7", "#fbeadb", "#e2f1e4", "#f0e6f4", "#f9e4e6", "#e0f0f3", "#f3efd9", "#ebecee")
GROUND, GHOST = "#777777", "#9a4d6f"
_DASHES = ((0, (5, 2)), (0, (1.5, 1.5)), (0, (6, 2, 1.5, 2)), (0, (3, 4)))
_THIN = 7.0  # width below which a polygon is drawn as a line [points]
_ROOM = 9.0  # what the number of a loop needs around it [points]


def sketch(
    machine: Machine,
    path: str | Path,
    q_a: ArrayLike | None = None,
    plane: str | None = None,
    com: bool = False,
    others: Sequence[Array] = (),
) -> None:
    """Write a sketch of the mechanism to a file.

    Args:
        machine: The machine.
        path: Where to write; its suffix .png, .svg or .pdf chooses the format.
        q_a: (n,) active coordinates within their limits [m], [rad]; home if not given.
        plane: "xy", "xz" or "yz" to look along an axis of the world; the plane that the machine
            moves in if not given.
        com: Whether to mark the centres of mass.
        others: Postures (nq,) to be drawn dashed behind it, such as other assemblies.

    Raises:
        OutputError: The suffix is another one, or the file cannot be written.
        InputError: Wrong shape or not finite, unknown view, or a machine that moves in no plane.
        LimitError: A coordinate lies outside of its limits.
        ClosureError: The loops cannot be closed there.
    """
    write_figure(path, lambda: sketch_figure(machine, q_a, plane, com, others))


def sketch_figure(
    machine: Machine,
    q_a: ArrayLike | None = None,
    plane: str | None = None,
    com: bool = False,
    others: Sequence[Array] = (),
) -> Figure:
    """The figure of a mechanism; see `sketch`.

    Bodies are lines and polygons between their pins in the colours of the sub-chains, those that
    carry the tip with wider lines. Pins of the tree are circles, pins that close a loop are rings
    with a dot, joints about a line in the plane are boxes on that line, prismatic joints are
    cylinders. Each loop has a number and a tint. Axes are equal, in metres.
    """
    if machine.coordinates.floating:
        columns = [at + i for at in machine.coordinates.floating for i in range(6)]
        held = " ".join(f"--lock {machine.joints[i]}={machine.home[i]:.6g}" for i in columns)
        raise InputError(f"'{machine.name}' floats, sketch it where it is held: {held}")
    q = machine.home
    if q_a is not None:
        q = machine.closure.solve(machine.check_limits(q_a))
    seen = find_plane(machine, q, plane)
    mechanism = project(machine, q, seen)
    ghosts = [project(machine, other, seen) for other in others]
    with mpl.rc_context(STYLE):
        legend = _legend(machine, com) + [(_ghost_line(i),) for i in range(len(ghosts))]
        figure, canvas = lay_out(mechanism, seen, machine, q, legend, ghosts)
        _draw_regions(canvas, mechanism)
        for i, ghost in enumerate(ghosts):
            _draw_ghost(canvas, ghost, mechanism, i)
        for body in sorted(mechanism.bodies, key=lambda body: body.boom):
            _draw_body(canvas, body)
        for slide in mechanism.slides:
            _draw_slide(canvas, slide)
        for at, down in mechanism.ground:
            canvas.ground(at, down, _gap(mechanism, at, down))
        for item in mechanism.collars:
            canvas.collar(item.name, item.at, item.along)
        if com:
            _draw_centres(canvas, mechanism)
        if mechanism.tip is not None:
            canvas.tip(mechanism.tip)
        _draw_pins(canvas, mechanism)
        _number_regions(canvas, mechanism)
        place_labels(canvas, _labels(mechanism))
    return figure


def _legend(machine: Machine, com: bool) -> list[tuple[Line2D, ...]]:
    """One entry per sub-chain and per kind of symbol, each of lines on top of each other."""
    entries: list[tuple[Line2D, ...]] = []
    for i, chain in enumerate(machine.chains):
        if not chain.joints:
            continue  # nothing has its colour
        colour = CHAINS[i % len(CHAINS)]
        entries.append((Line2D([], [], color=colour, linewidth=3.0, label=plain(chain.name)),))
    symbols: dict[str, list[Any]] = {"joint": [JOINT], "loop": [RING, DOT]}
    if com:
        symbols["centre of mass"] = [CENTRE, *QUARTERS]
    for name, looks in symbols.items():
        if name != "loop" or machine.closure.equations.loops:
            entries.append(tuple(Line2D([], [], label=name, **mark(look)) for look in looks))
    return entries


def _ghost_line(index: int, points: Array | None = None) -> Line2D:
    """A dashed line in the look of another assembly, without points that of the legend."""
    x, y = np.zeros((2, 0)) if points is None else points.T
    label = f"other assembly {index + 1}"
    style = _DASHES[index % len(_DASHES)]
    return Line2D(x, y, color=GHOST, linewidth=1.1, linestyle=style, label=label, zorder=2.2)


def _draw_ghost(canvas: Canvas, ghost: Mechanism, home: Mechanism, index: int) -> None:
    """The lines of another assembly, of what is elsewhere than at home."""
    outlines = [(x.points, y.points) for x, y in zip(ghost.bodies, home.bodies, strict=True)]
    for one, two in zip(ghost.slides, home.slides, strict=True):
        outlines.append((np.array([one.start, one.end]), np.array([two.start, two.end])))
    for there, here in outlines:
        if len(there) < 2 or np.abs(there - here).max() < 1e-6 * home.size:
            continue
        corners = hull(there)
        if len(corners) > 2:
            corners = np.vstack([corners, corners[:1]])
        line = _ghost_line(index, corners)
        line.set_gid(f"assembly {index + 1}")
        canvas.axes.add_line(line)


def _draw_regions(canvas: Canvas, mechanism: Mechanism) -> None:
    """A tint in what each loop encloses, the small ones above the large."""
    for number, corners in sorted(mechanism.regions.items(), key=lambda item: -_area(item[1])):
        colour = REGIONS[(number - 1) % len(REGIONS)]
        canvas.axes.add_patch(Polygon(corners, facecolor=colour, linewidth=0, zorder=1))


def _number_regions(canvas: Canvas, mechanism: Mechanism) -> None:
    for number, corners in mechanism.regions.items():
        smaller = [
            other for i, other in mechanism.regions.items() if i != number
            and _area(other) < _area(corners)
        ]  # fmt: skip
        lines = [*canvas.segments, *(np.array([at, at]) for at, _ in canvas.discs)]
        lines += list(np.stack([corners, np.roll(corners, -1, axis=0)], axis=1))
        spot, room = clear_spot(corners, lines, smaller)
        if room > _ROOM * canvas.point:
            canvas.number(number, spot)


def _gap(mechanism: Mechanism, at: Array, down: Array) -> float | None:
    """How far below a point the ground is [points]; None for a pin, which has a support."""
    same = SAME * mechanism.size
    if any(np.abs(shown.at - at).max() < same for shown in mechanism.pins):
        return None
    beside = any(np.abs(item.at - at).max() < same for item in mechanism.collars)
    return 7.0 if beside else 0.0


def _draw_centres(canvas: Canvas, mechanism: Mechanism) -> None:
    for body in mechanism.bodies:
        if body.chain >= 0:
            canvas.centre_of_mass(body.com)


def _draw_pins(canvas: Canvas, mechanism: Mechanism) -> None:
    for shown in mechanism.pins:
        if shown.loop:
            canvas.loop(shown.name, shown.at, shown.mate)
        else:
            canvas.joint(shown.name, shown.at)


def _draw_body(canvas: Canvas, body: Body) -> None:
    colour = GROUND if body.chain < 0 else CHAINS[body.chain % len(CHAINS)]
    order, points = 2.6 if body.boom else 2.4, body.points
    if len(points) < 2:
        return
    if _width(points) >= _THIN * canvas.point:
        canvas.polygon(hull(points), colour, 2.6 if body.boom else 1.8, 0.22, order)
        return
    along = np.linalg.svd(points - points.mean(axis=0))[2][0]
    length = float(np.ptp(points @ along)) / canvas.point
    width = min(4.2 if body.boom else 2.6, length / 2)
    canvas.line(points[np.argsort(points @ along)], colour, width, zorder=order)


def _draw_slide(canvas: Canvas, slide: Slide) -> None:
    colour, rod = (CHAINS[i % len(CHAINS)] for i in (slide.chain, slide.rod_chain))
    point, way = canvas.point, slide.mouth - slide.start
    if not way.any():  # seen along its axis
        half = np.array([5.0, 0.0]) * point
        canvas.box(slide.start - half, slide.start + half, 10.0, rod, 3)
        return
    along = way / np.linalg.norm(way)
    if slide.rail:
        down = np.array([along[1], -along[0]])
        down = down * (-1.0 if down[1] > 0 else 1.0)
        canvas.hatch(slide.start + 7 * point * down, slide.mouth + 7 * point * down, down)
        canvas.box(slide.inner - 11 * point * along, slide.inner + 11 * point * along, 14, rod, 3)
        return
    width = 10.0 if slide.boom else 8.0
    canvas.box(slide.start, slide.mouth, width, colour, 3)
    canvas.line(np.array([slide.inner, slide.end]), rod, 3.4 if slide.boom else 2.2, zorder=3.2)
    across = np.array([-along[1], along[0]]) * (width / 2 - 1.4) * point
    piston = np.array([slide.inner - across, slide.inner + across])
    canvas.axes.plot(*piston.T, color=rod, linewidth=3.0, solid_capstyle="butt", zorder=3.3)


def _labels(mechanism: Mechanism) -> list[Label]:
    """One label per joint, loop and tip; joints at the same pin share one."""
    labels = []
    left = [shown for shown in mechanism.pins if not shown.loop]
    while left:
        near = 0.002 * mechanism.size
        together = [other for other in left if np.abs(other.at - left[0].at).max() < near]
        text = ", ".join(symbol(name) for name in _in_order(together))
        labels.append(Label(text, left[0].at, 4.0, "label"))
        left = [other for other in left if other not in together]
    for shown in mechanism.pins:
        if shown.loop:
            digit = chr(0x2460 + shown.loop - 1) if shown.loop <= 20 else f"({shown.loop})"
            labels.append(Label(f"{digit} {symbol(shown.name)}", shown.at, 6.0, "label"))
    labels += [Label(symbol(item.name), item.at, 8.0, "label") for item in mechanism.collars]
    for slide in mechanism.slides:
        middle = slide.inner if slide.rail else (slide.start + slide.mouth) / 2
        labels.append(Label(symbol(slide.name), middle, 6.0, "label"))
    if mechanism.tip is not None:
        labels.append(Label("tip", mechanism.tip, 7.0, "label tip"))
    return labels


def _in_order(pins: Sequence[Pin]) -> list[str]:
    """Names with their numbers in order, q2 before q10."""
    return sorted(
        (shown.name for shown in pins),
        key=lambda name: [(x.isdigit(), x.zfill(9)) for x in re.split(r"(\d+)", name)],
    )


def _width(points: Array) -> float:
    """Extent (m) of points (k, 2) across the line through them."""
    across = np.linalg.svd(points - points.mean(axis=0))[2][-1]
    return float(np.ptp(points @ across))


def _area(corners: Array) -> float:
    x, y = corners.T
    return abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2
