"""The element `<constraint>` that is proposed for URDF, read as another spelling of `<loop>`.

Proposed as ros/urdfdom#264 and ros/urdfdom_headers#108 ("Add constraints to describe closed
loops", open since 8 June 2026), there in these words:

    <constraint name="Name" type="Type">
    <parent link="Parent_Name"/>
    <parent_origin xyz="Offset_Child" rpy="RPY_Parent"/>
    <parent_axis xyz="Joint_Axis_Parent"/>
    <child link="Child_Name"/>
    <child_origin xyz="Offset_Child" rpy="RPY_Child"/>
    <child_axis xyz="Joint_Axis_Child"/>
    </constraint>

By the parser of the proposal, `urdf_parser/src/constraint.cpp`, types are revolute, prismatic,
universal and spherical, each also with `_joint` behind it, and link, a link that was cut; origins
that are left out are the identity, an axis is 1 0 0, and `child_axis` counts for universal alone.
As long as that is not accepted it may change, so it is read only where that is asked for.
"""

import numpy as np
from lxml import etree

from crane.common.errors import suggest_names
from crane.common.package_search import URDF_CONSTRAINT, asked
from crane.description.findings import error_recovery
from crane.formats.xml_file import XmlFile

CONSTRAINT_HINT = (
    f"read it by --arg {URDF_CONSTRAINT}:=true, arguments={{'{URDF_CONSTRAINT}': True}} in Python"
)
_LOOP_TYPES = {
    "revolute": "revolute", "prismatic": "prismatic", "spherical": "spherical", "link": "fixed",
}  # fmt: skip
_END_TAGS = {"parent": "predecessor", "child": "successor"}
_CHILDREN = {
    "constraint": {f"{end}{part}" for end in _END_TAGS for part in ("", "_origin", "_axis")}
}  # fmt: skip
_ATTRIBUTES = {"constraint": {"name", "type"}} | {
    f"{end}{part}": keys
    for end in _END_TAGS
    for part, keys in (("", {"link"}), ("_origin", {"xyz", "rpy"}), ("_axis", {"xyz"}))
}
_DEFAULT_AXIS = (1.0, 0.0, 0.0)  # an axis that is left out
_PARALLEL_TOLERANCE = 1e-9


def read_constraints(xml: XmlFile) -> None:
    """Make a `<loop>` of each `<constraint>`, in its place, where that is asked for.

    Raises:
        DescriptionError: One is malformed, or of a type that no `<loop>` has.
        InputError: The argument that asks for it is neither true nor false.
    """
    if not asked(URDF_CONSTRAINT):
        return
    for element in xml.root.findall("constraint"):
        with error_recovery():
            _convert_to_loop(xml, element)
            continue
        xml.root.remove(element)  # what is wrong with it was noted


def _convert_to_loop(xml: XmlFile, element: etree._Element) -> None:
    if not (name := element.get("name", "").strip()):
        raise xml.error_at(element, 'a constraint has no name, add name="..."')
    label = f"constraint '{name}'"
    xml.check_elements(element, _CHILDREN, _ATTRIBUTES, set(_ATTRIBUTES) - {"constraint"})
    element.set("type", _loop_type(xml, element, label))
    _check_axes(xml, element, label)
    for end, tag in _END_TAGS.items():
        link = xml.single_child(element, end, label)
        if link is None or not link.get("link", "").strip():
            raise xml.error_at(element, f'{label} has no {end}, add <{end} link="..."/>')
        if (origin := xml.single_child(element, f"{end}_origin", label)) is not None:
            origin.tag = "origin"
            link.append(origin)
        link.tag = tag
    for axis in element.findall("parent_axis"):
        axis.tag = "axis"
    element.tag = "loop"


def _loop_type(xml: XmlFile, element: etree._Element, label: str) -> str:
    """The type of the loop that a constraint is."""
    kind = element.get("type", "")
    base_type = kind if kind == "link_joint" else kind.removesuffix("_joint")
    if base_type == "universal":
        raise xml.error_at(
            element,
            f"{label} is universal, which no loop is: hang a link without mass on its parent by "
            "a continuous joint about parent_axis, and close to that, with revolute",
        )
    if base_type not in _LOOP_TYPES:
        problem = f"the unknown type '{kind}'" if kind else "no type"
        raise xml.error_at(
            element, f"{label} has {problem}, {suggest_names(_LOOP_TYPES, base_type or None)}"
        )
    return _LOOP_TYPES[base_type]


def _check_axes(xml: XmlFile, element: etree._Element, label: str) -> None:
    """A loop has one axis in both frames, so that of the child has to be that of the parent."""
    parent, child = (xml.single_child(element, f"{end}_axis", label) for end in _END_TAGS)
    if child is None:
        return
    parent_axis, child_axis = (
        _DEFAULT_AXIS if axis is None else xml.vector(axis, "xyz", f"an axis of {label}", 3)
        for axis in (parent, child)
    )
    cross_norm = np.linalg.norm(np.cross(parent_axis, child_axis))
    if not cross_norm <= _PARALLEL_TOLERANCE * np.linalg.norm(parent_axis) * np.linalg.norm(
        child_axis
    ):
        raise xml.error_at(
            child,
            f"the child_axis of {label} is another than parent_axis, turn the child's frame by "
            "the rpy of child_origin and leave child_axis out",
        )
    element.remove(child)
