"""Sketch of a mechanism as a figure."""

import itertools
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from numpy.typing import ArrayLike

from crane.common.errors import InputError
from crane.common.samples import Array
from crane.machine.machine import Machine
from crane.view.plots.figure_style import escape_label, figure_style, joint_symbol, write_figure
from crane.view.sketches.label_placement import SketchLabel, find_clear_point, place_labels
from crane.view.sketches.mechanism_projection import COINCIDENCE_TOLERANCE, project_mechanism
from crane.view.sketches.sketch_canvas import (
    CENTRE_MARKER,
    DOT_MARKER,
    JOINT_MARKER,
    LOOP_MARKER,
    QUARTER_MARKERS,
    TIP_MARKER,
    SketchCanvas,
    convex_hull,
    create_sketch_layout,
    marker_options,
)
from crane.view.sketches.sketch_elements import (
    SketchBody,
    SketchMechanism,
    SketchSlide,
    find_plane,
)

CHAIN_COLOURS = (
    "#1f5fa8", "#d0661c", "#2f8050", "#8a4a9c", "#b03a48", "#2b8c9c", "#8c7a1e", "#5a5f66",
)  # fmt: skip
REGION_COLOURS = (
    "#e4edf7",
    "#fbeadb",
    "#e2f1e4",
    "#f0e6f4",
    "#f9e4e6",
    "#e0f0f3",
    "#f3efd9",
    "#ebecee",
)
GROUND_COLOUR, GHOST_COLOUR = "#777777", "#9a4d6f"
_GHOST_DASHES = ((0, (5, 2)), (0, (1.5, 1.5)), (0, (6, 2, 1.5, 2)), (0, (3, 4)))
_MIN_POLYGON_WIDTH = 7.0  # width below which a polygon is drawn as a line [points]
_NUMBER_CLEARANCE = 9.0  # clearance around the number of a loop [points]


def sketch(
    machine: Machine,
    path: str | Path,
    q_a: ArrayLike | None = None,
    plane: str | None = None,
    show_centres_of_mass: bool = False,
    other_configurations: Sequence[Array] = (),
) -> None:
    """Write a sketch of the mechanism to a file.

    Args:
        machine: The machine.
        path: File to write; the suffix .png, .svg or .pdf determines the format.
        q_a: (n,) active coordinates within their limits [m], [rad]; home by default.
        plane: "xy", "xz" or "yz" for a view along an axis of the world; by default the plane in
            which the machine moves.
        show_centres_of_mass: Whether to mark the centres of mass.
        other_configurations: Configurations (nq,) that are drawn dashed, such as other assembly
            modes.

    Raises:
        OutputError: The suffix is another one, or the file cannot be written.
        InputError: A value has the wrong shape or is not finite, the view is unknown, or the
            machine does not move in a plane.
        LimitError: A coordinate lies outside of its limits.
        ClosureError: The loops cannot be closed there.
    """
    write_figure(
        path,
        lambda: sketch_figure(machine, q_a, plane, show_centres_of_mass, other_configurations),
    )


@figure_style
def sketch_figure(
    machine: Machine,
    q_a: ArrayLike | None = None,
    plane: str | None = None,
    show_centres_of_mass: bool = False,
    other_configurations: Sequence[Array] = (),
) -> Figure:
    """Return the figure of a mechanism; see `sketch`.

    Bodies are lines and polygons between their pins in the colours of the sub-chains, with wider
    lines if they carry the tip. Revolute joints of the tree are circles, loop joints are rings
    with a dot, revolute joints about a line in the plane are boxes on that line, prismatic joints
    are cylinders. Each loop has a number and a tint. Axes are equal, in metres.
    """
    if machine.coordinates.floating_base_columns:
        columns = [at + i for at in machine.coordinates.floating_base_columns for i in range(6)]
        lock_options = " ".join(
            f"--lock {machine.joints[i]}={machine.home[i]:.6g}" for i in columns
        )
        raise InputError(f"'{machine.name}' floats, sketch it where it is held: {lock_options}")
    q = machine.home
    if q_a is not None:
        q = machine.closure.solve(machine.check_limits(q_a))
    drawing_plane = find_plane(machine, q, plane)
    mechanism = project_mechanism(machine, q, drawing_plane)
    ghosts = [project_mechanism(machine, other, drawing_plane) for other in other_configurations]
    figure, canvas = create_sketch_layout(
        mechanism,
        drawing_plane,
        machine,
        q,
        _legend(machine, show_centres_of_mass) + [(_ghost_line(i),) for i in range(len(ghosts))],
        ghosts,
    )
    # small regions above large ones
    for number, corners in sorted(mechanism.regions.items(), key=lambda x: -_polygon_area(x[1])):
        canvas.axes.add_patch(
            Polygon(
                corners,
                facecolor=REGION_COLOURS[(number - 1) % len(REGION_COLOURS)],
                linewidth=0,
                zorder=1,
            )
        )
    for i, ghost in enumerate(ghosts):
        _draw_ghost(canvas, ghost, mechanism, i)
    for body in sorted(mechanism.bodies, key=lambda body: body.carries_tip):
        _draw_body(canvas, body)
    for slide in mechanism.slides:
        _draw_slide(canvas, slide)
    for position, down_direction in mechanism.ground:
        canvas.draw_ground(position, down_direction, _ground_gap(mechanism, position))
    for item in mechanism.collars:
        canvas.draw_collar(item.name, item.position, item.axis)
    for body in mechanism.bodies:
        if show_centres_of_mass and body.chain >= 0:
            _draw_centre_of_mass(canvas, body.centre_of_mass)
    if mechanism.tip is not None:
        canvas.draw_marker(mechanism.tip, 5.4, "tip", TIP_MARKER, 6.0)
    _draw_pins(canvas, mechanism)
    _number_regions(canvas, mechanism)
    place_labels(canvas, _create_labels(mechanism))
    return figure


def _legend(machine: Machine, show_centres_of_mass: bool) -> list[tuple[Line2D, ...]]:
    """Return one entry per sub-chain and kind of symbol, each of superposed lines."""
    entries: list[tuple[Line2D, ...]] = []
    for i, chain in enumerate(machine.chains):
        if chain.joints:  # or nothing has its colour
            style: Any = {"color": CHAIN_COLOURS[i % len(CHAIN_COLOURS)], "linewidth": 3.0}
            entries.append((Line2D([], [], label=escape_label(chain.name), **style),))
    symbols: dict[str, list[Any]] = {"joint": [JOINT_MARKER]}
    if machine.closure.equations.loops:
        symbols["loop"] = [LOOP_MARKER, DOT_MARKER]
    if show_centres_of_mass:
        symbols["centre of mass"] = [CENTRE_MARKER, *QUARTER_MARKERS]
    for name, styles in symbols.items():
        entries.append(tuple(Line2D([], [], label=name, **marker_options(x)) for x in styles))
    return entries


def _ghost_line(index: int, points: Array | None = None) -> Line2D:
    """Return a dashed line of another assembly mode; without points for the legend."""
    x, y = np.zeros((2, 0)) if points is None else points.T
    return Line2D(
        x,
        y,
        color=GHOST_COLOUR,
        linewidth=1.1,
        linestyle=_GHOST_DASHES[index % len(_GHOST_DASHES)],
        label=f"other assembly {index + 1}",
        zorder=2.2,
    )


def _draw_ghost(
    canvas: SketchCanvas, ghost: SketchMechanism, home_mechanism: SketchMechanism, index: int
) -> None:
    """Draw the parts of another assembly mode that are not at home."""
    for points, home_points in zip(_outlines(ghost), _outlines(home_mechanism), strict=True):
        if len(points) < 2 or np.abs(points - home_points).max() < 1e-6 * home_mechanism.size:
            continue
        corners = convex_hull(points)
        if len(corners) > 2:
            corners = np.vstack([corners, corners[:1]])
        line = _ghost_line(index, corners)
        line.set_gid(f"assembly {index + 1}")
        canvas.axes.add_line(line)


def _outlines(mechanism: SketchMechanism) -> list[Array]:
    return [
        *(body.points for body in mechanism.bodies),
        *(np.array([x.start, x.rod_outer_end]) for x in mechanism.slides),
    ]


def _number_regions(canvas: SketchCanvas, mechanism: SketchMechanism) -> None:
    for number, corners in mechanism.regions.items():
        smaller = [
            other for i, other in mechanism.regions.items() if i != number
            and _polygon_area(other) < _polygon_area(corners)
        ]  # fmt: skip
        lines = [
            *canvas.occupied_segments,
            *(np.array([position, position]) for position, _ in canvas.occupied_discs),
        ]
        lines += list(np.stack([corners, np.roll(corners, -1, axis=0)], axis=1))
        number_position, clearance = find_clear_point(corners, lines, smaller)
        if clearance > _NUMBER_CLEARANCE * canvas.point_size:
            canvas.draw_number(number, number_position)


def _ground_gap(mechanism: SketchMechanism, position: Array) -> float | None:
    """Return the distance from a point down to the ground [points]; None for a pin."""
    tolerance = COINCIDENCE_TOLERANCE * mechanism.size
    if any(np.abs(x.position - position).max() < tolerance for x in mechanism.pins):
        return None
    return (
        7.0
        if any(np.abs(x.position - position).max() < tolerance for x in mechanism.collars)
        else 0.0
    )


def _draw_centre_of_mass(canvas: SketchCanvas, position: Array) -> None:
    canvas.draw_marker(position, 5.2, "centre of mass", CENTRE_MARKER, 4.5)
    for style in QUARTER_MARKERS:
        canvas.draw_marker(position, 5.3, "centre of mass", style)


def _draw_pins(canvas: SketchCanvas, mechanism: SketchMechanism) -> None:
    """Draw revolute joints of the tree as rings, loop joints as rings with a dot."""
    for drawn_pin in mechanism.pins:
        if drawn_pin.loop_number:
            gid = f"loop {drawn_pin.name}"
            canvas.draw_marker(drawn_pin.position, 5.5, gid, LOOP_MARKER, 6.0)
            canvas.draw_marker(drawn_pin.mate_position, 6.5, f"{gid} mate", DOT_MARKER)
        else:
            gid = f"joint {drawn_pin.name}"
            canvas.draw_marker(drawn_pin.position, 6.0, gid, JOINT_MARKER, 4.0)


def _draw_body(canvas: SketchCanvas, body: SketchBody) -> None:
    colour = GROUND_COLOUR if body.chain < 0 else CHAIN_COLOURS[body.chain % len(CHAIN_COLOURS)]
    z_order, points = 2.6 if body.carries_tip else 2.4, body.points
    if len(points) < 2:
        return
    direction, normal = np.linalg.svd(points - points.mean(axis=0))[2]
    if float(np.ptp(points @ normal)) >= _MIN_POLYGON_WIDTH * canvas.point_size:
        corners = convex_hull(points)
        canvas.axes.add_patch(
            Polygon(corners, facecolor=colour, alpha=0.22, linewidth=0, zorder=z_order)
        )
        width, points = 2.6 if body.carries_tip else 1.8, np.vstack([corners, corners[:1]])
    else:
        length = float(np.ptp(points @ direction)) / canvas.point_size
        width = min(4.2 if body.carries_tip else 2.6, length / 2)
        points = points[np.argsort(points @ direction)]
    canvas.draw_line(points, colour, width, zorder=z_order)


def _draw_slide(canvas: SketchCanvas, slide: SketchSlide) -> None:
    colour, rod_colour = (
        CHAIN_COLOURS[i % len(CHAIN_COLOURS)] for i in (slide.barrel_chain, slide.rod_chain)
    )
    point, barrel = canvas.point_size, slide.mouth - slide.start
    if not barrel.any():  # the axis points towards the viewer
        half_width = np.array([5.0, 0.0]) * point
        canvas.draw_box(slide.start - half_width, slide.start + half_width, 10.0, rod_colour, 3)
        return
    direction = barrel / np.linalg.norm(barrel)
    if slide.is_rail:
        down_direction = np.array([direction[1], -direction[0]])
        down_direction = down_direction * (-1.0 if down_direction[1] > 0 else 1.0)
        canvas.draw_hatching(
            slide.start + 7 * point * down_direction,
            slide.mouth + 7 * point * down_direction,
            down_direction,
        )
        canvas.draw_box(
            slide.rod_inner_end - 11 * point * direction,
            slide.rod_inner_end + 11 * point * direction,
            14,
            rod_colour,
            3,
        )
        return
    width = 10.0 if slide.carries_tip else 8.0
    canvas.draw_box(slide.start, slide.mouth, width, colour, 3)
    canvas.draw_line(
        np.array([slide.rod_inner_end, slide.rod_outer_end]),
        rod_colour,
        3.4 if slide.carries_tip else 2.2,
        zorder=3.2,
    )
    piston_half = np.array([-direction[1], direction[0]]) * (width / 2 - 1.4) * point
    canvas.axes.plot(
        *np.array([slide.rod_inner_end - piston_half, slide.rod_inner_end + piston_half]).T,
        color=rod_colour,
        linewidth=3.0,
        solid_capstyle="butt",
        zorder=3.3,
    )


def _create_labels(mechanism: SketchMechanism) -> list[SketchLabel]:
    """Return one label per joint, loop and tip; joints at the same pin share one."""
    labels = []
    remaining = [shown for shown in mechanism.pins if not shown.loop_number]
    while remaining:
        position = remaining[0].position
        is_coincident = [
            np.abs(other.position - position).max() < 0.002 * mechanism.size for other in remaining
        ]
        names = sorted(
            (x.name for x in itertools.compress(remaining, is_coincident)),
            key=lambda name: [(x.isdigit(), x.zfill(9)) for x in re.split(r"(\d+)", name)],
        )  # in natural order, q2 before q10
        labels.append(SketchLabel(", ".join(map(joint_symbol, names)), position, 4.0, "label"))
        remaining = [x for x, is_in in zip(remaining, is_coincident, strict=True) if not is_in]
    for x in mechanism.pins:
        if number := x.loop_number:
            number_text = chr(0x2460 + number - 1) if number <= 20 else f"({number})"
            labels.append(
                SketchLabel(f"{number_text} {joint_symbol(x.name)}", x.position, 6.0, "label")
            )
    labels += [
        SketchLabel(joint_symbol(item.name), item.position, 8.0, "label")
        for item in mechanism.collars
    ]
    for slide in mechanism.slides:
        labels.append(
            SketchLabel(
                joint_symbol(slide.name),
                slide.rod_inner_end if slide.is_rail else (slide.start + slide.mouth) / 2,
                6.0,
                "label",
            )
        )
    if mechanism.tip is not None:
        labels.append(SketchLabel("tip", mechanism.tip, 7.0, "label tip"))
    return labels


def _polygon_area(corners: Array) -> float:
    x, y = corners.T
    return abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2
