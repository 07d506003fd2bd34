"""The section `home` of machine files and of robot.yaml."""

from crane.description.findings import error_recovery
from crane.formats.machine_file.tree_builder import TreeBuilder
from crane.formats.machine_file.yaml_section import YamlSection


def read_home(top: YamlSection, tree: TreeBuilder) -> tuple[dict[str, float], dict[str, str]]:
    """Coordinates of the home posture, and where each was written."""
    home, source_locations = {}, {}
    section = None
    with error_recovery():
        section = top.section("home", "'home'")
    for joint in section or ():
        assert section is not None
        with error_recovery():
            tree.check_joint(joint, section.source_location(joint))
            home[joint] = section.number(joint)
            source_locations[joint] = section.source_location(joint)
    return home, source_locations
