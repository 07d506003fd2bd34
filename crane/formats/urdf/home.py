"""Home posture and tip in a URDF, for which URDF+ has no place: elements of SRDF."""

from collections.abc import Collection, Container, Mapping

from lxml import etree

from crane.common.errors import DescriptionError, known
from crane.description.findings import recoverable
from crane.formats.xml import XmlFile

_HOME, _TIP = "home", "tip"


def read_home(xml: XmlFile, joints: Collection[str]) -> tuple[dict[str, float], dict[str, str]]:
    """Coordinates of `<group_state name="home">`, and where each was written.

    Args:
        xml: The file.
        joints: Names of its moving joints.

    Raises:
        DescriptionError: A joint is unknown, does not move, is there twice or has no number.
    """
    home: dict[str, float] = {}
    where: dict[str, str] = {}
    given = [
        joint
        for state in xml.root.iterfind("group_state")
        if state.get("name", "").strip() == _HOME
        for joint in state.iterfind("joint")
    ]
    for joint in given:
        with recoverable():
            name, value = _coordinate(xml, joint, joints, home)
            home[name], where[name] = value, xml.where(joint)
    return home, where


def read_tip(xml: XmlFile, links: Mapping[str, etree._Element]) -> str | None:
    """The link of `<end_effector name="tip" parent_link="LINK"/>`, None where there is none.

    Args:
        xml: The file.
        links: Its `<link>` elements by name.

    Raises:
        DescriptionError: The link is unknown.
    """
    tips = [x for x in xml.root.iterfind("end_effector") if x.get("name", "").strip() == _TIP]
    if not tips:
        return None
    link: str = tips[0].get("parent_link", "").strip()
    if not link:
        raise xml.fail(tips[0], f'the tip has no link, write parent_link="LINK", {known(links)}')
    if link not in links:
        raise xml.fail(tips[0], f"the tip is the unknown link '{link}', {known(links, link)}")
    return link


def _coordinate(
    xml: XmlFile, joint: etree._Element, joints: Collection[str], before: Container[str]
) -> tuple[str, float]:
    name = joint.get("name", "").strip()
    if name not in joints:
        hint = known(joints, name)
        what = f"home names the joint '{name}', which is unknown or does not move, {hint}"
        error: DescriptionError = xml.fail(joint, what)
        raise error
    value = xml.number(joint, "value", f"home of '{name}'")
    if name in before:
        raise xml.fail(joint, f"home of '{name}' is there twice, keep one")
    return name, value
