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

from crane.common.errors import known
from crane.common.packages import URDF_CONSTRAINT, asked
from crane.description.findings import recoverable
from crane.formats.xml import XmlFile

HINT = (
    f"read it by --arg {URDF_CONSTRAINT}:=true, arguments={{'{URDF_CONSTRAINT}': True}} in Python"
)
_LOOPS = {
    "revolute": "revolute", "prismatic": "prismatic", "spherical": "spherical", "link": "fixed",
}  # fmt: skip
_ENDS = {"parent": "predecessor", "child": "successor"}
_CHILDREN = {
    "constraint": {f"{end}{part}" for end in _ENDS for part in ("", "_origin", "_axis")}
}  # fmt: skip
_ATTRIBUTES = {"constraint": {"name", "type"}} | {
    f"{end}{part}": keys
    for end in _ENDS
    for part, keys in (("", {"link"}), ("_origin", {"xyz", "rpy"}), ("_axis", {"xyz"}))
}
_X = (1.0, 0.0, 0.0)  # an axis that is left out
_PARALLEL = 1e-9


def read_constraints(xml: XmlFile) -> None:
    """Make a `<loop>` of each `<constraint>`, in its place, where that is asked for.

    Raises:
        DescriptionError: One is malformed, or of a type that no `<loop>` has.
        InputError: The argument that asks for it is neither true nor false.
    """
    if not asked(URDF_CONSTRAINT):
        return
    for element in xml.root.findall("constraint"):
        with recoverable():
            _translate(xml, element)
            continue
        xml.root.remove(element)  # what is wrong with it was noted


def _translate(xml: XmlFile, element: etree._Element) -> None:
    if not (name := element.get("name", "").strip()):
        raise xml.fail(element, 'a constraint has no name, add name="..."')
    what = f"constraint '{name}'"
    xml.check(element, _CHILDREN, _ATTRIBUTES, set(_ATTRIBUTES) - {"constraint"})
    element.set("type", _type(xml, element, what))
    _check_axes(xml, element, what)
    for end, tag in _ENDS.items():
        link = xml.only(element, end, what)
        if link is None or not link.get("link", "").strip():
            raise xml.fail(element, f'{what} has no {end}, add <{end} link="..."/>')
        if (origin := xml.only(element, f"{end}_origin", what)) is not None:
            origin.tag = "origin"
            link.append(origin)
        link.tag = tag
    for axis in element.findall("parent_axis"):
        axis.tag = "axis"
    element.tag = "loop"


def _type(xml: XmlFile, element: etree._Element, what: str) -> str:
    """The type of the loop that a constraint is."""
    kind = element.get("type", "")
    plain = kind if kind == "link_joint" else kind.removesuffix("_joint")
    if plain == "universal":
        raise xml.fail(
            element,
            f"{what} is universal, which no loop is: hang a link without mass on its parent by "
            "a continuous joint about parent_axis, and close to that, with revolute",
        )
    if plain not in _LOOPS:
        problem = f"the unknown type '{kind}'" if kind else "no type"
        raise xml.fail(element, f"{what} has {problem}, {known(_LOOPS, plain or None)}")
    return _LOOPS[plain]


def _check_axes(xml: XmlFile, element: etree._Element, what: str) -> None:
    """A loop has one axis in both frames, so that of the child has to be that of the parent."""
    parent, child = (xml.only(element, f"{end}_axis", what) for end in _ENDS)
    if child is None:
        return
    one, two = (
        _X if axis is None else xml.vector(axis, "xyz", f"an axis of {what}", 3)
        for axis in (parent, child)
    )
    across = np.linalg.norm(np.cross(one, two))
    if not across <= _PARALLEL * np.linalg.norm(one) * np.linalg.norm(two):
        raise xml.fail(
            child,
            f"the child_axis of {what} is another than parent_axis, turn the child's frame by "
            "the rpy of child_origin and leave child_axis out",
        )
    element.remove(child)
