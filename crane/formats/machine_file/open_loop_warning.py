"""Loops that a file only hints at: pairs of frames that look like their ends.

onshape-to-robot, from whose files placo's examples are, cuts a loop into the frames
closing_NAME_1 and closing_NAME_2; example-parallel-robots into closedloopNAME_A and
closedloopNAME_B, of links or joints. Without the file that says so, such a machine is an open
tree: it loads and moves, and is another machine.
"""

import math
import re
import warnings
from collections.abc import Mapping

import numpy as np
import pinocchio as pin

from crane.common.errors import CraneWarning
from crane.description.kinematic_tree import Joint, Tree, body_of
from crane.description.pinocchio_conversion import se3_from_xyz_rpy
from crane.description.specification import MachineSpec

_LOOP_END_PATTERN = re.compile(
    r"((?:closing_|closed?_?loop|loop_?clos).*?)_?([12AB])", re.IGNORECASE
)
_END_LABELS = ({"1", "2"}, {"A", "B"})
_MAX_SHOWN = 4  # pairs in a line


def warn_about_open_loops(spec: MachineSpec) -> None:
    """Warn of pairs of frames that are named like the two ends of a loop that nothing closes."""
    parent_joints = spec.tree.parent_joints

    def bodies(*links: str) -> set[str]:
        return {body_of(parent_joints, link) for link in links}

    closed_pairs = [bodies(loop.predecessor, loop.successor) for loop in spec.loops]
    pairs = [
        ends
        for _, *ends in loop_end_pairs(spec.tree)
        if len(bodies(*ends)) == 2 and bodies(*ends) not in closed_pairs
    ]
    if not pairs:
        return
    pair_texts = [
        f"{one} and {two}{_gap_text(parent_joints, one, two)}" for one, two in pairs[:_MAX_SHOWN]
    ]
    remainder_text = [f"{len(pairs) - _MAX_SHOWN} more"] if len(pairs) > _MAX_SHOWN else []
    location = spec.tree.links[pairs[0][0]].source_location
    warnings.warn(
        f"{location}: nothing closes what looks like {len(pairs)} loop{'s' * (len(pairs) > 1)}, "
        f"{', '.join(pair_texts + remainder_text)}: close them by crane add loops, paste what "
        "crane check proposes into a machine file, or rename the frames",
        CraneWarning,
        stacklevel=2,
    )


def loop_end_pairs(tree: Tree) -> list[tuple[str, str, str]]:
    """A name for each loop, and its two links, which have the names themselves or their joints."""
    link_of_name = {name: name for name in tree.links}
    for name, joint in tree.joints.items():
        link_of_name.setdefault(name, joint.child)
    ends: dict[str, dict[str, str]] = {}
    for name, link in link_of_name.items():
        if match := _LOOP_END_PATTERN.fullmatch(name):
            ends.setdefault(match[1], {})[match[2].upper()] = link
    return [
        (
            name.removeprefix("closing_"),
            links_of_end[min(links_of_end)],
            links_of_end[max(links_of_end)],
        )
        for name, links_of_end in ends.items()
        if set(links_of_end) in _END_LABELS
    ]


def _gap_text(parent_joints: Mapping[str, Joint], first: str, second: str) -> str:
    """How far two frames are apart with all joints at zero, in words."""
    placements = []
    for link in (first, second):
        placement = pin.SE3.Identity()
        while link in parent_joints:
            joint = parent_joints[link]
            placement = se3_from_xyz_rpy(joint.xyz, joint.rpy) * placement
            link = joint.parent
        placements.append(placement)
    relative_placement = placements[0].actInv(placements[1])
    if not np.isfinite(relative_placement.homogeneous).all():  # an origin is refused
        return ""
    distance = float(np.linalg.norm(relative_placement.translation))
    angle = math.degrees(float(np.linalg.norm(pin.log3(relative_placement.rotation))))
    return f" ({1e3 * distance:.3g} mm and {angle:.3g} deg apart at zero)"
