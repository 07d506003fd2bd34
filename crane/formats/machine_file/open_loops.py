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
from typing import TYPE_CHECKING

import numpy as np

from crane.common.errors import CraneWarning
from crane.description.rigid import se3
from crane.description.spec import MachineSpec
from crane.description.tree import Joint, Tree

if TYPE_CHECKING:
    import pinocchio as pin

_END = re.compile(r"((?:closing_|closed?_?loop|loop_?clos).*?)_?([12AB])", re.IGNORECASE)
_SIDES = ({"1", "2"}, {"A", "B"})
_SHOWN = 4  # pairs in a line


def warn_of_open_loops(spec: MachineSpec) -> None:
    """Warn of pairs of frames that are named like the two ends of a loop that nothing closes."""
    above = {joint.child: joint for joint in spec.tree.joints.values()}
    closed = {
        frozenset(body_of(above, end) for end in (loop.predecessor, loop.successor))
        for loop in spec.loops
    }
    pairs = [
        (name, one, two) for name, one, two in named_pairs(spec.tree)
        if body_of(above, one) != body_of(above, two)
        and frozenset({body_of(above, one), body_of(above, two)}) not in closed
    ]  # fmt: skip
    if not pairs:
        return
    told = [f"{one} and {two}{_gap(above, one, two)}" for _, one, two in pairs[:_SHOWN]]
    written = [
        f"{{name: {name}, type: revolute, predecessor: {one}, successor: {two}}}"
        for name, one, two in pairs[:_SHOWN]
    ]
    more = [f"{len(pairs) - _SHOWN} more"] if len(pairs) > _SHOWN else []
    dots = ["..."] * bool(more)
    place = spec.tree.links[pairs[0][1]].where
    warnings.warn(
        f"{place}: nothing closes what looks like {len(pairs)} "
        f"loop{'s' * (len(pairs) > 1)}, {', '.join(told + more)}: write loops: "
        f"[{', '.join(written + dots)}] in a machine file (revolute about z of the frames, or "
        "another type), or rename the frames",
        CraneWarning,
        stacklevel=2,
    )


def named_pairs(tree: Tree) -> list[tuple[str, str, str]]:
    """A name for each loop, and its two links, which have the names themselves or their joints."""
    named = {name: name for name in tree.links}
    for name, joint in tree.joints.items():
        named.setdefault(name, joint.child)
    ends: dict[str, dict[str, str]] = {}
    for name, link in named.items():
        if match := _END.fullmatch(name):
            ends.setdefault(match[1], {})[match[2].upper()] = link
    return [
        (name.removeprefix("closing_"), sides[min(sides)], sides[max(sides)])
        for name, sides in ends.items()
        if set(sides) in _SIDES
    ]


def body_of(above: Mapping[str, Joint], link: str) -> str:
    """The link that moves with a link, nearest to the root."""
    seen = {link}
    while link in above and not above[link].moves:
        link = above[link].parent
        if link in seen:
            break
        seen.add(link)
    return link


def _gap(above: Mapping[str, Joint], one: str, two: str) -> str:
    """How far two frames are apart with all joints at zero, in words."""
    import pinocchio as pin

    place, other = _place_at_zero(above, one), _place_at_zero(above, two)
    if place is None or other is None:
        return ""
    between = place.actInv(other)
    distance = float(np.linalg.norm(between.translation))
    angle = math.degrees(float(np.linalg.norm(pin.log3(between.rotation))))
    return f" ({1e3 * distance:.3g} mm and {angle:.3g} deg apart at zero)"


def _place_at_zero(above: Mapping[str, Joint], link: str) -> "pin.SE3 | None":
    """Where a link is with all joints at zero, None where that cannot be said."""
    import pinocchio as pin

    place, seen = pin.SE3.Identity(), {link}
    while link in above:
        joint = above[link]
        if not np.isfinite((*joint.xyz, *joint.rpy)).all():  # which has been told
            return None
        place, link = se3(joint.xyz, joint.rpy) * place, joint.parent
        if link in seen:
            return None
        seen.add(link)
    return place
