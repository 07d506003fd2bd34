"""How large links are drawn."""

from collections.abc import Sequence

import numpy as np
from lxml import etree

from crane.common.samples import Array
from crane.formats.visuals.urdf_shapes import Visual

Bounds = tuple[Array, Array]


def read_numbers(element: etree._Element | None, key: str, count: int) -> Array | None:
    """Finite numbers of an attribute; None where they are not."""
    text = None if element is None else element.get(key)
    try:
        found = np.array([float(word) for word in (text or "").split()])
    except ValueError:
        return None
    return found if found.shape == (count,) and np.isfinite(found).all() else None


def bounds_by_link(visuals: Sequence[Visual]) -> dict[str, Bounds]:
    """By link the lowest and highest corner (3,) of what is drawn on it, in its frame [m]."""
    corners: dict[str, list[Array]] = {}
    for visual in visuals:
        corners.setdefault(visual.link, []).append(visual.bounding_corners())
    points = {link: np.concatenate(found) for link, found in corners.items()}
    return {link: (found.min(axis=0), found.max(axis=0)) for link, found in points.items()}
