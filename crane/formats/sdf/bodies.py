"""Mass and inertia of links of SDF."""

import warnings

import pinocchio as pin
from lxml import etree

from crane.common.errors import CraneWarning
from crane.description.rigid import inertial, placement
from crane.formats.sdf.frames import Frames
from crane.formats.sdf.scope import Scope
from crane.formats.sdf.solids import solid
from crane.formats.sdf.values import Item

_KEYS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_WATER = 1000.0  # [kg/m3], the density that SDF takes


def add_inertial(element: etree._Element, scope: Scope, link: Item, frames: Frames) -> None:
    """The `<inertial>` of a link, whose numbers SDF completes: 1 kg, 1 kg m2.

    With `auto="true"` it is that of its collisions, of one density each; with a `<mass>` as well,
    of that mass.

    Raises:
        DescriptionError: A number is malformed, or shapes have no volume that is known.
    """
    given = link.only("inertial")
    if given is not None and _is_automatic(given):
        _add_computed(element, scope, link, given, frames)
        return
    if given is None:
        given = Item(link.xml, etree.Element("inertial"), link.what)
    place, _ = given.pose()
    mass = given.number("mass", 1.0)
    tensor = given.only("inertia") or Item(given.xml, etree.Element("inertia"), given.what)
    values = [tensor.number(key, 1.0 if key[1] == key[2] else 0.0) for key in _KEYS]
    _write(element, mass, placement(place), values)


def _is_automatic(given: Item) -> bool:
    """Whether an `<inertial>` says so, or its `<inertia>`, where some write it."""
    places = (given, given.only("inertia"))
    said = (place.element.get("auto", "").lower() for place in places if place is not None)
    return any(word in ("true", "1") for word in said)


def warn_of_no_inertial(link: Item) -> None:
    """Warn of a link that moves without saying what it weighs."""
    if link.only("inertial") is None:
        warnings.warn(
            f"{link.where}: {link.what} has no <inertial>, which SDF takes as 1 kg and 1 kg m2: "
            "write what it has",
            CraneWarning,
            stacklevel=2,
        )


def _write(
    element: etree._Element, mass: float, place: tuple[tuple[float, ...], ...], tensor: list[float]
) -> None:
    xyz, rpy = (" ".join(map(repr, part)) for part in place)
    made = etree.SubElement(element, "inertial")
    etree.SubElement(made, "origin", xyz=xyz, rpy=rpy)
    etree.SubElement(made, "mass", value=repr(mass))
    etree.SubElement(made, "inertia", dict(zip(_KEYS, map(repr, tensor), strict=True)))


def _add_computed(
    element: etree._Element, scope: Scope, link: Item, given: Item, frames: Frames
) -> None:
    density = given.number("density", _WATER)
    own = frames.of(scope, link, link.base)
    whole = pin.Inertia.Zero()
    for child in link.element.iterfind("collision"):
        shape = Item(link.xml, child, f"a collision of {link.what}", link.base)
        place = own.actInv(frames.of(scope, shape, link.name))
        whole += place.act(solid(shape, shape.number("density", density)))
    made = inertial(whole)
    if made is None:
        raise link.xml.fail(given.element, f"{link.what} has no collision to take its mass from")
    mass = given.number("mass", made.mass)
    tensor = [x * mass / made.mass for x in made.tensor]
    _write(element, mass, (made.com, made.rpy), tensor)
