"""What links of SDF look like and touch with, as elements of URDF."""

from lxml import etree

from crane.common.package_search import find_file
from crane.description.pinocchio_conversion import xyz_rpy_from_se3
from crane.formats.sdf.frame_poses import SdfFramePoses
from crane.formats.sdf.model_scope import ModelScope, NoteFunction
from crane.formats.sdf.sdf_element import SdfElement

_SIZE_ATTRIBUTES = {
    "box": ("size",), "cylinder": ("radius", "length"), "sphere": ("radius",),
    "capsule": ("radius", "length"),
}  # fmt: skip
_WORLD_SHAPES = ("plane", "heightmap", "empty")  # of worlds, which machines do not have


def add_shapes(
    element: etree._Element,
    scope: ModelScope,
    link: SdfElement,
    frames: SdfFramePoses,
    note: NoteFunction,
) -> None:
    """Visuals and collisions of a link that URDF can say; `note` takes the others."""
    link_pose = frames.element_pose(scope, link, link.base_frame)
    for child in link.element:
        if child.tag in ("visual", "collision"):
            shape = SdfElement(link.xml, child, f"a {child.tag} of {link.label}", link.base_frame)
            geometry = _shape_element(shape, note)
            if geometry is None:
                continue
            made = etree.SubElement(element, child.tag)
            xyz, rpy = xyz_rpy_from_se3(
                link_pose.actInv(frames.element_pose(scope, shape, link.name))
            )
            etree.SubElement(made, "origin", xyz=_format_numbers(xyz), rpy=_format_numbers(rpy))
            etree.SubElement(made, "geometry").append(geometry)
            _add_colour(made, shape)


def _shape_element(item: SdfElement, note: NoteFunction) -> etree._Element | None:
    geometry = item.single_child("geometry")
    shapes = [] if geometry is None else [x for x in geometry.element if isinstance(x.tag, str)]
    if not shapes or shapes[0].tag in _WORLD_SHAPES:
        return None
    shape = SdfElement(item.xml, shapes[0], item.label)
    tag = shape.element.tag
    if tag == "mesh":
        return _mesh_element(shape)
    if tag not in _SIZE_ATTRIBUTES:
        note("shapes", tag)
        return None
    made = etree.Element(tag)
    for key in _SIZE_ATTRIBUTES[tag]:
        made.set(key, shape.text(key, "1 1 1" if key == "size" else "1"))
    return made


def _mesh_element(shape: SdfElement) -> etree._Element:
    """A mesh by its whole path where it is there: an included model has another folder."""
    name = shape.text("uri") or shape.text("filename")
    file = find_file(name, shape.xml.file.parent) if name else None
    is_file = file is not None and file.is_file()
    made = etree.Element("mesh", filename=str(file) if is_file else name)
    if scale := shape.text("scale"):
        made.set("scale", scale)
    return made


def _add_colour(visual: etree._Element, item: SdfElement) -> None:
    """The diffuse colour, else the ambient one."""
    material = item.single_child("material")
    if material is None or visual.tag != "visual":
        return
    text = material.text("diffuse") or material.text("ambient")
    if not text:
        return
    words = text.split()
    rgba = " ".join([*words, "1"][:4] if len(words) == 3 else words)
    etree.SubElement(etree.SubElement(visual, "material", name=""), "color", rgba=rgba)


def _format_numbers(values: tuple[float, ...]) -> str:
    return " ".join(map(repr, values))
