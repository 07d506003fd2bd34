"""The section `home` of machine files and of robot.yaml."""

from crane.description.findings import recoverable
from crane.formats.machine_file.section import Section
from crane.formats.machine_file.tree_builder import TreeBuilder


def read_home(top: Section, tree: TreeBuilder) -> tuple[dict[str, float], dict[str, str]]:
    """Coordinates of the home posture, and where each was written."""
    home, where = {}, {}
    section = None
    with recoverable():
        section = top.section("home", "'home'")
    for joint in section or ():
        assert section is not None
        with recoverable():
            tree.check_joint(joint, section.where(joint))
            home[joint] = section.number(joint)
            where[joint] = section.where(joint)
    return home, where
