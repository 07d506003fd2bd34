"""The graph of links and joints of an SDF model: spanning tree, joints to the ground."""

from collections.abc import Mapping, Sequence

import numpy as np
import pinocchio as pin

from crane.common.errors import warn
from crane.common.package_search import load_options
from crane.description.kinematic_tree import unique_name
from crane.formats.conversion_notes import ConversionNotes
from crane.formats.sdf.frame_poses import canonical_link
from crane.formats.sdf.model_scope import ModelScope, SdfElement
from crane.formats.sdf.sdf_joints import WORLD_NODE, DisjointSets, SdfJointEdge

_PRIORITY_CLASSES = 5


def _priority_class(edge: SdfJointEdge) -> int:
    """Class of a joint by what would be lost if it closed a loop; 0 enters the tree first."""
    axis = edge.axis
    if edge.kind == "fixed" or edge.is_coupled:
        return 0
    if axis is None:
        return _PRIORITY_CLASSES - 1  # a ball is three equations, or three Cardan angles in a tree
    if axis.damping or axis.friction or axis.stiffness or axis.initial is not None:
        return 1
    is_limited = np.isfinite([axis.limits.lower, axis.limits.upper]).all()
    return 2 if edge.composite_joint or is_limited else 3


def spanning_tree(edges: Sequence[SdfJointEdge], root: str) -> list[SdfJointEdge]:
    """Return the joints of a spanning tree, by priority class and breadth-first from a root.

    Args:
        edges: All joints.
        root: The root node.
    """
    bodies, found = DisjointSets(), []
    for rank in range(_PRIORITY_CLASSES):
        found += breadth_first(
            [edge for edge in edges if _priority_class(edge) == rank], bodies, root
        )
    return found


def breadth_first(
    edges: Sequence[SdfJointEdge], bodies: DisjointSets, root: str
) -> list[SdfJointEdge]:
    """Return joints that join sets of nodes, the nearest to the root first, and join the sets."""
    edges_by_node: dict[str, list[tuple[SdfJointEdge, str]]] = {}  # with the other end
    for edge in edges:
        parent, child = bodies.representative(edge.parent), bodies.representative(edge.child)
        edges_by_node.setdefault(parent, []).append((edge, child))
        edges_by_node.setdefault(child, []).append((edge, parent))
    found: list[SdfJointEdge] = []
    for start in (bodies.representative(root), *edges_by_node):
        pending = [start]
        for node in pending:
            for edge, other_end in edges_by_node.get(node, ()):
                if bodies.join(edge.parent, edge.child):
                    pending.append(other_end)
                    found.append(edge)
    return found


_MAX_LISTED = 4


def ground_edges(
    edges: Sequence[SdfJointEdge],
    top: ModelScope,
    links: Mapping[str, SdfElement],
    link_poses: Mapping[str, pin.SE3],
    notes: ConversionNotes,
) -> list[SdfJointEdge]:
    """Return joints to the world for the parts of a model that no joint connects to it.

    If no part is connected to the world, all of them are fixed to it in their poses, or float if
    the load options request it. If some parts are connected, the others float.

    Args:
        edges: All joints.
        top: The model.
        links: Its links by name.
        link_poses: Poses of the links in the model's frame.
        notes: Receives the links that float.
    """
    bodies = DisjointSets()
    for edge in edges:
        bodies.join(edge.parent, edge.child)
    first = canonical_link(top, top.item)
    canonical_name = "" if first is None else f"{first[0].prefix}{first[1]}"
    children = {edge.child for edge in edges}
    # first those that no joint moves and the canonical link
    candidates = sorted(links, key=lambda link: (link in children, link != canonical_name))
    unattached = [link for link in candidates if bodies.join(WORLD_NODE, link)]
    is_connected = any(WORLD_NODE in (edge.parent, edge.child) for edge in edges)
    is_floating = load_options().floating_root
    # a single part floats by the joints that machines of other formats get
    is_fixed = not is_connected and not (is_floating and len(unattached) > 1)
    if unattached and not is_floating:
        if is_fixed:
            listed = ", ".join(f"'{link}'" for link in unattached[:_MAX_LISTED])
            warn(
                f"{links[unattached[0]].source_location}: nothing joins '{top.name}' to the "
                f"world, it is taken as standing on the ground by link {listed}: --floating "
                "(floating=True) lets it float",
                stacklevel=3,
            )
        else:
            notes.note_difference("links that no joint ties to the others float", *unattached)
    kind, suffix = ("fixed", "world") if is_fixed else ("floating", "free")
    used_names = {edge.name for edge in edges}
    added = []
    for link in unattached:
        name = unique_name(f"{link}_{suffix}", used_names)
        added.append(SdfJointEdge(name, kind, WORLD_NODE, link, link_poses[link], links[link]))
    return added
