"""Inertial, visual and collision elements of links of SDF, as elements of URDF."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pinocchio as pin
from lxml import etree

from crane.common.errors import warn
from crane.description.kinematic_tree import TENSOR_ATTRIBUTES, Inertial
from crane.description.pinocchio_conversion import inertial_from_inertia, xyz_rpy_from_se3
from crane.formats.sdf.frame_poses import SdfFramePoses
from crane.formats.sdf.model_scope import ModelScope, NoteFunction, SdfElement
from crane.formats.visuals.urdf_shapes import find_mesh_file, read_meshes
from crane.formats.xml_file import add_inertial, add_origin

_DEFAULT_DENSITY = 1000.0  # [kg/m3], default of SDF


def add_link_inertial(
    element: etree._Element,
    scope: ModelScope,
    link: SdfElement,
    frames: SdfFramePoses,
    is_moving: bool,
) -> None:
    """Add the `<inertial>` of a link, with the defaults of SDF: 1 kg, 1 kg m2.

    With `auto="true"` the inertia is that of the collisions, each of one density; if there is a
    `<mass>`, scaled to it. A moving link without `<inertial>` is warned about.

    Raises:
        DescriptionError: A number is malformed, or the volume of a shape is unknown.
    """
    inertial_element = link.single_child("inertial")
    if inertial_element is None and is_moving:
        warn(
            f"{link.source_location}: {link.label} has no <inertial>, which SDF takes as 1 kg "
            "and 1 kg m2: write what it has"
        )
    inertial_element = inertial_element or link.wrap(etree.Element("inertial"), link.label)
    tensor_element = inertial_element.single_child("inertia") or link.wrap(
        etree.Element("inertia"), link.label
    )
    if any(
        x.attribute("auto").lower() in ("true", "1") for x in (inertial_element, tensor_element)
    ):
        inertial = _collision_inertial(scope, link, inertial_element, frames)
    else:
        placement, _ = inertial_element.read_pose()
        tensor = (tensor_element.number(key, float(key[1] == key[2])) for key in TENSOR_ATTRIBUTES)
        inertial = Inertial(
            inertial_element.number("mass", 1.0), *xyz_rpy_from_se3(placement), tuple(tensor)
        )
    add_inertial(element, inertial)


def _collision_inertial(
    scope: ModelScope, link: SdfElement, inertial_element: SdfElement, frames: SdfFramePoses
) -> Inertial:
    """Return the inertial of the collisions of a link, filled with their densities."""
    density = inertial_element.number("density", _DEFAULT_DENSITY)
    total_inertia = pin.Inertia.Zero()
    for child in link.element.iterfind("collision"):
        shape = link.wrap(child, f"a collision of {link.label}")
        shape_pose = frames.pose_on_link(scope, link, shape)
        total_inertia += shape_pose.act(solid_inertia(shape, shape.number("density", density)))
    computed_inertial = inertial_from_inertia(total_inertia)
    if computed_inertial is None:
        raise link.xml.error_at(
            inertial_element.element, f"{link.label} has no collision to take its mass from"
        )
    mass = inertial_element.number("mass", computed_inertial.mass)
    tensor = tuple(x * mass / computed_inertial.mass for x in computed_inertial.tensor)
    return dataclasses.replace(computed_inertial, mass=mass, tensor=tensor)


_SOLID_TYPES = ("box", "capsule", "cone", "cylinder", "ellipsoid", "mesh", "sphere")


def solid_inertia(shape: SdfElement, density: float) -> pin.Inertia:
    """Return the inertia of a `<collision>` of one density [kg/m3], in the frame of its geometry.

    Raises:
        DescriptionError: The volume is unknown: another shape, or a mesh that is not closed or
            cannot be read.
    """
    solid_element = _geometry_shape(shape)
    tag = "" if solid_element is None else solid_element.element.tag
    if solid_element is None or tag not in _SOLID_TYPES:
        raise _unknown_volume_error(shape, f"is no {', '.join(_SOLID_TYPES)}")
    if tag == "mesh":
        return _mesh_inertia(solid_element, density)
    if tag == "box":
        x, y, z = _read_sizes(solid_element, "size", 3)
        return pin.Inertia.FromBox(density * x * y * z, x, y, z)
    if tag in ("ellipsoid", "sphere"):
        key, count = ("radii", 3) if tag == "ellipsoid" else ("radius", 1)
        radii = _read_sizes(solid_element, key, count) * (3 // count)
        mass = density * 4 / 3 * math.pi * float(np.prod(radii))
        return pin.Inertia.FromEllipsoid(mass, *radii)
    (radius,), (length,) = (_read_sizes(solid_element, key, 1) for key in ("radius", "length"))
    mass = density * math.pi * radius**2 * length
    if tag == "cylinder":
        return pin.Inertia.FromCylinder(mass, radius, length)
    if tag == "capsule":  # its length is between the centres of the spheres
        return pin.Inertia.FromCapsule(
            mass + (density * 4 / 3 * math.pi * radius**3), radius, length
        )
    transverse_factor = 3 / 80 * (4 * radius**2 + length**2)  # a cone with its tip at length / 2
    moments = mass / 3 * np.diag([transverse_factor, transverse_factor, 0.3 * radius**2])
    return pin.Inertia(mass / 3, np.array([0.0, 0.0, -length / 4]), moments)


def _unknown_volume_error(item: SdfElement, reason: str) -> Exception:
    hint = "write its <mass> and <inertia> instead of auto"
    return item.error(f"{item.label} {reason}, so that its volume is unknown: {hint}")


def _read_sizes(element: SdfElement, tag: str, count: int) -> tuple[float, ...]:
    sizes = element.numbers(tag, count, (1.0,) * count)
    if min(sizes) <= 0:
        raise element.error(f"<{tag}> of {element.label} is not positive, give metres")
    return sizes


def _mesh_inertia(mesh_element: SdfElement, density: float) -> pin.Inertia:
    import trimesh  # slow to import, and few files have inertias of meshes

    name, file = _find_mesh(mesh_element)
    if mesh_element.single_child("submesh") is not None:
        raise _unknown_volume_error(mesh_element, f"takes a part of the mesh '{name}'")
    if file is None:
        raise _unknown_volume_error(mesh_element, f"has the mesh '{name}', which is not there")
    parts = read_meshes([file])[file]
    if isinstance(parts, str):
        raise _unknown_volume_error(
            mesh_element, f"has the mesh '{name}', which cannot be read ({parts})"
        )
    scale = np.array(mesh_element.numbers("scale", 3, (1.0, 1.0, 1.0)))
    triangles = np.concatenate([part.vertices[part.faces] for part in parts]) * scale
    centroid = triangles.reshape(-1, 3).mean(axis=0)  # as origin it reduces rounding errors
    corners = (triangles - centroid).reshape(-1, 3)
    # equal vertices are merged: formats such as STL contain each several times
    mesh = trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3))
    if edges := len(trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)):
        raise _unknown_volume_error(
            mesh_element, f"has the mesh '{name}', which {edges} edges leave open"
        )
    if not mesh.is_winding_consistent:
        raise _unknown_volume_error(
            mesh_element, f"has the mesh '{name}', whose triangles do not all face outwards"
        )
    if mesh.volume < 0:  # its triangles face inwards
        mesh.invert()
    mesh.density = density
    if not mesh.mass > 0:
        raise _unknown_volume_error(mesh_element, f"has the mesh '{name}', which is flat")
    return pin.Inertia(mesh.mass, centroid + mesh.center_mass, mesh.moment_inertia)


_SIZE_ATTRIBUTES = {
    "box": ("size",), "cylinder": ("radius", "length"), "sphere": ("radius",),
    "capsule": ("radius", "length"),
}  # fmt: skip
_WORLD_SHAPES = ("plane", "heightmap", "empty")  # shapes of the ground


def add_shapes(
    element: etree._Element,
    scope: ModelScope,
    link: SdfElement,
    frames: SdfFramePoses,
    note: NoteFunction,
) -> None:
    """Add visuals and collisions of a link; `note` receives shapes that URDF does not have."""
    for child in link.element:
        if child.tag not in ("visual", "collision"):
            continue
        shape = link.wrap(child, f"a {child.tag} of {link.label}")
        if (geometry := _shape_element(shape, note)) is None:
            continue
        added = etree.SubElement(element, child.tag)
        add_origin(added, *xyz_rpy_from_se3(frames.pose_on_link(scope, link, shape)))
        etree.SubElement(added, "geometry").append(geometry)
        material = shape.single_child("material") if child.tag == "visual" else None
        if material is not None and (text := material.text("diffuse") or material.text("ambient")):
            words = text.split()
            rgba = " ".join([*words, "1"] if len(words) == 3 else words)
            etree.SubElement(etree.SubElement(added, "material", name=""), "color", rgba=rgba)


def _geometry_shape(item: SdfElement) -> SdfElement | None:
    geometry = item.single_child("geometry")
    tags = [] if geometry is None else [x.tag for x in geometry.element]
    return geometry.single_child(tags[0]) if geometry is not None and tags else None


def _shape_element(item: SdfElement, note: NoteFunction) -> etree._Element | None:
    """Return the shape of a visual or collision as an element of URDF, None if it has none."""
    shape = _geometry_shape(item)
    if shape is None or (tag := shape.element.tag) in _WORLD_SHAPES:
        return None
    made = etree.Element(tag)
    if tag == "mesh":
        name, file = _find_mesh(shape)  # an absolute path: included models have other folders
        made.set("filename", name if file is None else str(file))
        if scale := shape.text("scale"):
            made.set("scale", scale)
        return made
    if tag not in _SIZE_ATTRIBUTES:
        note("shapes", tag)
        return None
    for key in _SIZE_ATTRIBUTES[tag]:
        made.set(key, shape.text(key, "1 1 1" if key == "size" else "1"))
    return made


def _find_mesh(shape: SdfElement) -> tuple[str, Path | None]:
    """Return the name of a mesh, and its file if that exists."""
    name = shape.text("uri") or shape.text("filename")
    return name, find_mesh_file(name, shape.xml.file.parent) if name else None
