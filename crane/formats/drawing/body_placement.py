"""Bodies that are drawn on their own, placed by the points that they share with the drawing."""

from collections.abc import Mapping
from itertools import combinations

import numpy as np
import pinocchio as pin

from crane.common.plausible_ranges import LONGEST
from crane.common.samples import Array
from crane.formats.machine_file.yaml_section import YamlSection

_FARTHEST = 5 * LONGEST  # [m], farther away than any point of a machine
_TOLERANCE = 1e-3  # of the extent of a body, up to which shared points may differ


def place_bodies(section: YamlSection, points: dict[str, Array]) -> dict[str, pin.SE3]:
    """Add points of bodies with coordinates of their own to those of the drawing.

    A body is turned about y and moved so that the sum of squared distances of the points that it
    shares is least: with p_i and q_i from their means, of the body and of the drawing, its angle
    in the plane x, z is atan2(sum p_i x q_i, sum p_i . q_i).

    Args:
        section: The section `drawing`.
        points: (3,) by name [m]; those of the bodies are added.

    Returns:
        Placement of each such body in the drawing, by name.

    Raises:
        DescriptionError: A body shares fewer than two points, or they are elsewhere.
    """
    placements = dict[str, pin.SE3]()
    bodies = section.section("bodies")
    pending = {}
    for name in () if bodies is None else section.item_names("bodies"):
        item = bodies.section(name, f"body '{name}'") if bodies is not None else None
        if item is not None and "points" in item and isinstance(item.raw_value("points"), dict):
            pending[name] = item, item.value_map("points", read_point)
    while pending:
        shared = {name: own.keys() & points.keys() for name, (_, own) in pending.items()}
        name = max(shared, key=lambda x: len(shared[x]))
        item, own = pending.pop(name)
        if len(shared[name]) < 2:
            raise item.error_at(
                "points",
                f"{item.title} shares {len(shared[name])} points with the drawing and cannot be "
                "placed by its own coordinates, give the drawing two of its points",
            )
        placement = placements[name] = _fitted_placement(own, points, sorted(shared[name]))
        extent = float(np.linalg.norm(np.ptp(list(own.values()), axis=0)))
        for pair in combinations(sorted(shared[name]), 2):
            mine, drawn = (
                float(np.linalg.norm(table[pair[1]] - table[pair[0]])) for table in (own, points)
            )
            if abs(mine - drawn) > _TOLERANCE * extent:
                raise item.error_at(
                    "points",
                    f"{item.title} shares points {pair[0]} and {pair[1]} with the drawing, but "
                    f"they are {mine:.4g} m apart in its own coordinates and {drawn:.4g} m there: "
                    "correct one of them",
                )
        if any(
            np.linalg.norm(placement.act(own[x]) - points[x]) > _TOLERANCE * extent
            for x in shared[name]
        ):
            raise item.error_at("points", f"{item.title} is drawn from the other side, mirror it")
        points |= {x: placement.act(place) for x, place in own.items() if x not in points}
    return placements


def read_point(section: YamlSection, name: str) -> Array:
    """Return a point (3,) that is given by [x, z] or [x, y, z]."""
    values = section.numbers(name)
    if len(values) not in (2, 3):
        raise section.error_at(
            name,
            f"point '{name}' has {len(values)} coordinates, give [x, z] or [x, y, z], with "
            "decimal points",
        )
    if abs(farthest := max(values, key=abs)) > _FARTHEST:
        raise section.error_at(
            name, f"point '{name}' is at {farthest:g} m: looks like mm, write {farthest:g}e-3"
        )
    return np.array(values if len(values) == 3 else (values[0], 0.0, values[1]))


def _fitted_placement(
    own: Mapping[str, Array], points: Mapping[str, Array], names: list[str]
) -> pin.SE3:
    first, second = (np.array([table[name] for name in names]) for table in (own, points))
    p, q = first - first.mean(axis=0), second - second.mean(axis=0)
    cross = p[:, 0] @ q[:, 2] - p[:, 2] @ q[:, 0]
    angle = np.arctan2(cross, p[:, 0] @ q[:, 0] + p[:, 2] @ q[:, 2])
    rotation = np.asarray(pin.exp3(np.array([0.0, -angle, 0.0])))
    return pin.SE3(rotation, second.mean(axis=0) - rotation @ first.mean(axis=0))
