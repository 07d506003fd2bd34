"""Mass and inertia of links of SDF."""

import warnings

import pinocchio as pin
from lxml import etree

from crane.common.errors import CraneWarning
from crane.description.pinocchio_conversion import inertial_from_inertia, xyz_rpy_from_se3
from crane.formats.sdf.frame_poses import SdfFramePoses
from crane.formats.sdf.model_scope import ModelScope
from crane.formats.sdf.sdf_element import SdfElement
from crane.formats.sdf.solid_inertias import solid_inertia

_TENSOR_ATTRIBUTES = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_DEFAULT_DENSITY = 1000.0  # [kg/m3], the density that SDF takes


def add_inertial(
    element: etree._Element, scope: ModelScope, link: SdfElement, frames: SdfFramePoses
) -> None:
    """The `<inertial>` of a link, whose numbers SDF completes: 1 kg, 1 kg m2.

    With `auto="true"` it is that of its collisions, of one density each; with a `<mass>` as well,
    of that mass.

    Raises:
        DescriptionError: A number is malformed, or shapes have no volume that is known.
    """
    inertial_element = link.single_child("inertial")
    if inertial_element is not None and _is_automatic(inertial_element):
        _add_computed_inertial(element, scope, link, inertial_element, frames)
        return
    if inertial_element is None:
        inertial_element = SdfElement(link.xml, etree.Element("inertial"), link.label)
    placement, _ = inertial_element.read_pose()
    mass = inertial_element.number("mass", 1.0)
    tensor = inertial_element.single_child("inertia") or SdfElement(
        inertial_element.xml, etree.Element("inertia"), inertial_element.label
    )
    values = [tensor.number(key, 1.0 if key[1] == key[2] else 0.0) for key in _TENSOR_ATTRIBUTES]
    _add_inertial_element(element, mass, xyz_rpy_from_se3(placement), values)


def _is_automatic(inertial_element: SdfElement) -> bool:
    """Whether an `<inertial>` says so, or its `<inertia>`, where some write it."""
    elements = (inertial_element, inertial_element.single_child("inertia"))
    attribute_values = (
        place.element.get("auto", "").lower() for place in elements if place is not None
    )
    return any(word in ("true", "1") for word in attribute_values)


def warn_about_missing_inertial(link: SdfElement) -> None:
    """Warn of a link that moves without saying what it weighs."""
    if link.single_child("inertial") is None:
        warnings.warn(
            f"{link.source_location}: {link.label} has no <inertial>, which SDF takes as 1 kg "
            f"and 1 kg m2: "
            "write what it has",
            CraneWarning,
            stacklevel=2,
        )


def _add_inertial_element(
    element: etree._Element,
    mass: float,
    placement: tuple[tuple[float, ...], ...],
    tensor: list[float],
) -> None:
    xyz, rpy = (" ".join(map(repr, part)) for part in placement)
    made = etree.SubElement(element, "inertial")
    etree.SubElement(made, "origin", xyz=xyz, rpy=rpy)
    etree.SubElement(made, "mass", value=repr(mass))
    etree.SubElement(
        made, "inertia", dict(zip(_TENSOR_ATTRIBUTES, map(repr, tensor), strict=True))
    )


def _add_computed_inertial(
    element: etree._Element,
    scope: ModelScope,
    link: SdfElement,
    inertial_element: SdfElement,
    frames: SdfFramePoses,
) -> None:
    density = inertial_element.number("density", _DEFAULT_DENSITY)
    link_pose = frames.element_pose(scope, link, link.base_frame)
    total_inertia = pin.Inertia.Zero()
    for child in link.element.iterfind("collision"):
        shape = SdfElement(link.xml, child, f"a collision of {link.label}", link.base_frame)
        shape_pose = link_pose.actInv(frames.element_pose(scope, shape, link.name))
        total_inertia += shape_pose.act(solid_inertia(shape, shape.number("density", density)))
    computed_inertial = inertial_from_inertia(total_inertia)
    if computed_inertial is None:
        raise link.xml.error_at(
            inertial_element.element, f"{link.label} has no collision to take its mass from"
        )
    mass = inertial_element.number("mass", computed_inertial.mass)
    tensor = [x * mass / computed_inertial.mass for x in computed_inertial.tensor]
    _add_inertial_element(element, mass, (computed_inertial.com, computed_inertial.rpy), tensor)
