"""How large links are drawn, and mesh files that are missing."""

from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import numpy as np
from lxml import etree

from crane.description.mesh_file import mesh_file
from crane.description.xml import XmlFile
from crane.samples import Array

Bounds = tuple[Array, Array]


def numbers(element: etree._Element | None, key: str, count: int) -> Array | None:
    """Finite numbers of an attribute; None where they are not."""
    text = None if element is None else element.get(key)
    try:
        found = np.array([float(word) for word in (text or "").split()])
    except ValueError:
        return None
    return found if found.shape == (count,) and np.isfinite(found).all() else None


@lru_cache(maxsize=1024)
def mesh_bounds(path: Path) -> Bounds | None:
    """Lowest and highest corner (3,) of a mesh, as its file has them; None if it is unreadable."""
    import trimesh

    try:
        bounds = trimesh.load_scene(path, process=False).bounds
    except Exception:  # whatever the readers of a dozen formats raise for what is none of them
        return None
    return None if bounds is None else (np.asarray(bounds[0]), np.asarray(bounds[1]))


def extent(xml: XmlFile, link: etree._Element) -> Bounds | None:
    """Lowest and highest corner (3,) of what is drawn on a link, in its frame [m].

    Visuals count; where there are none, what it collides with.
    """
    for tag in ("visual", "collision"):
        corners = [
            place for drawn in link.iterfind(tag) if (place := _corners(xml, drawn)) is not None
        ]
        if corners:
            points = np.concatenate(corners)
            return points.min(axis=0), points.max(axis=0)
    return None


def _corners(xml: XmlFile, drawn: etree._Element) -> Array | None:
    """(8, 3) corners of a box about a shape, in the link's frame."""
    from scipy.spatial.transform import Rotation

    bounds = _shape(xml, drawn.find("geometry"))
    origin = drawn.find("origin")
    if bounds is None:
        return None
    xyz, rpy = (numbers(origin, key, 3) for key in ("xyz", "rpy"))
    box = np.stack(np.meshgrid(*zip(*bounds, strict=True)), axis=-1).reshape(8, 3)
    if rpy is not None:
        box = Rotation.from_euler("xyz", rpy).apply(box)
    return box if xyz is None else box + xyz


def _shape(xml: XmlFile, geometry: etree._Element | None) -> Bounds | None:
    for shape in geometry if geometry is not None else ():
        half = None
        if shape.tag == "box" and (size := numbers(shape, "size", 3)) is not None:
            half = size / 2
        radius = numbers(shape, "radius", 1)
        if shape.tag == "sphere" and radius is not None:
            half = np.repeat(radius, 3)
        length = numbers(shape, "length", 1)
        if shape.tag in ("cylinder", "capsule") and radius is not None and length is not None:
            half = np.concatenate([radius, radius, length / 2])
        if half is not None:
            return -half, half
        if shape.tag == "mesh" and (path := mesh_file(shape.get("filename", ""), xml.file.parent)):
            return _scaled(mesh_bounds(path), numbers(shape, "scale", 3))
    return None


def _scaled(bounds: Bounds | None, scale: Array | None) -> Bounds | None:
    if bounds is None or scale is None:
        return bounds
    ends = np.stack(bounds) * scale
    return ends.min(axis=0), ends.max(axis=0)


def meshes(xml: XmlFile) -> Iterator[tuple[etree._Element, str]]:
    """Elements that name a mesh, and the name."""
    for tag in ("visual", "collision"):
        for mesh in xml.root.iterfind(f"link/{tag}/geometry/mesh"):
            if name := mesh.get("filename", ""):
                yield mesh, name
