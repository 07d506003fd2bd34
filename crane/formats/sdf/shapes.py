"""What links of SDF look like and touch with, as elements of URDF."""

from lxml import etree

from crane.common.packages import find_file
from crane.description.rigid import placement
from crane.formats.sdf.frames import Frames
from crane.formats.sdf.scope import Note, Scope
from crane.formats.sdf.values import Item

_SIZES = {
    "box": ("size",), "cylinder": ("radius", "length"), "sphere": ("radius",),
    "capsule": ("radius", "length"),
}  # fmt: skip
_GROUND = ("plane", "heightmap", "empty")  # of worlds, which machines do not have


def add_shapes(
    element: etree._Element, scope: Scope, link: Item, frames: Frames, note: Note
) -> None:
    """Visuals and collisions of a link that URDF can say; `note` takes the others."""
    own = frames.of(scope, link, link.base)
    for child in link.element:
        if child.tag in ("visual", "collision"):
            shape = Item(link.xml, child, f"a {child.tag} of {link.what}", link.base)
            drawn = _shape(shape, note)
            if drawn is None:
                continue
            made = etree.SubElement(element, child.tag)
            xyz, rpy = placement(own.actInv(frames.of(scope, shape, link.name)))
            etree.SubElement(made, "origin", xyz=_text(xyz), rpy=_text(rpy))
            etree.SubElement(made, "geometry").append(drawn)
            _colour(made, shape)


def _shape(item: Item, note: Note) -> etree._Element | None:
    geometry = item.only("geometry")
    shapes = [] if geometry is None else [x for x in geometry.element if isinstance(x.tag, str)]
    if not shapes or shapes[0].tag in _GROUND:
        return None
    shape = Item(item.xml, shapes[0], item.what)
    tag = shape.element.tag
    if tag == "mesh":
        return _mesh(shape)
    if tag not in _SIZES:
        note("shapes", tag)
        return None
    made = etree.Element(tag)
    for key in _SIZES[tag]:
        made.set(key, shape.text(key, "1 1 1" if key == "size" else "1"))
    return made


def _mesh(shape: Item) -> etree._Element:
    """A mesh by its whole path where it is there: an included model has another folder."""
    name = shape.text("uri") or shape.text("filename")
    file = find_file(name, shape.xml.file.parent) if name else None
    is_file = file is not None and file.is_file()
    made = etree.Element("mesh", filename=str(file) if is_file else name)
    if scale := shape.text("scale"):
        made.set("scale", scale)
    return made


def _colour(made: etree._Element, item: Item) -> None:
    """The diffuse colour, else the ambient one."""
    material = item.only("material")
    if material is None or made.tag != "visual":
        return
    text = material.text("diffuse") or material.text("ambient")
    if not text:
        return
    words = text.split()
    rgba = " ".join([*words, "1"][:4] if len(words) == 3 else words)
    etree.SubElement(etree.SubElement(made, "material", name=""), "color", rgba=rgba)


def _text(values: tuple[float, ...]) -> str:
    return " ".join(map(repr, values))
