"""Home posture and tip in a URDF, for which URDF+ has no place: elements of SRDF."""

from collections.abc import Collection, Container, Mapping

from lxml import etree

from crane.common.errors import DescriptionError, suggest_names
from crane.description.findings import error_recovery
from crane.formats.xml_file import XmlFile

_HOME_NAME, _TIP_NAME = "home", "tip"


def read_home(xml: XmlFile, joints: Collection[str]) -> tuple[dict[str, float], dict[str, str]]:
    """Coordinates of `<group_state name="home">`, and where each was written.

    Args:
        xml: The file.
        joints: Names of its moving joints.

    Raises:
        DescriptionError: A joint is unknown, does not move, is there twice or has no number.
    """
    home: dict[str, float] = {}
    source_locations: dict[str, str] = {}
    joint_elements = [
        joint
        for state in xml.root.iterfind("group_state")
        if state.get("name", "").strip() == _HOME_NAME
        for joint in state.iterfind("joint")
    ]
    for joint in joint_elements:
        with error_recovery():
            name, value = _read_coordinate(xml, joint, joints, home)
            home[name], source_locations[name] = value, xml.source_location(joint)
    return home, source_locations


def read_tip(xml: XmlFile, links: Mapping[str, etree._Element]) -> str | None:
    """The link of `<end_effector name="tip" parent_link="LINK"/>`, None where there is none.

    Args:
        xml: The file.
        links: Its `<link>` elements by name.

    Raises:
        DescriptionError: The link is unknown.
    """
    tips = [x for x in xml.root.iterfind("end_effector") if x.get("name", "").strip() == _TIP_NAME]
    if not tips:
        return None
    link: str = tips[0].get("parent_link", "").strip()
    if not link:
        raise xml.error_at(
            tips[0], f'the tip has no link, write parent_link="LINK", {suggest_names(links)}'
        )
    if link not in links:
        raise xml.error_at(
            tips[0], f"the tip is the unknown link '{link}', {suggest_names(links, link)}"
        )
    return link


def _read_coordinate(
    xml: XmlFile, joint: etree._Element, joints: Collection[str], earlier_names: Container[str]
) -> tuple[str, float]:
    name = joint.get("name", "").strip()
    if name not in joints:
        hint = suggest_names(joints, name)
        problem = f"home names the joint '{name}', which is unknown or does not move, {hint}"
        error: DescriptionError = xml.error_at(joint, problem)
        raise error
    value = xml.number(joint, "value", f"home of '{name}'")
    if name in earlier_names:
        raise xml.error_at(joint, f"home of '{name}' is there twice, keep one")
    return name, value
