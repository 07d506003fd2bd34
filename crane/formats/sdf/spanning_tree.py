"""Which joints make the tree, and which close its loops."""

from collections.abc import Iterable, Sequence

from crane.formats.sdf.sdf_joints import SdfAxis, SdfJointEdge

_PRIORITY_CLASSES = 5


class DisjointSets:
    """Things that are joined, by union and find."""

    def __init__(self) -> None:
        self._parents: dict[str, str] = {}

    def representative(self, name: str) -> str:
        """What stands for all that a thing is joined to."""
        while (parent := self._parents.get(name, name)) != name:
            self._parents[name] = name = self._parents.get(parent, parent)
        return name

    def join(self, first: str, second: str) -> bool:
        """Join two things; whether they were not."""
        first_representative, second_representative = (
            self.representative(first),
            self.representative(second),
        )
        self._parents[second_representative] = first_representative
        return first_representative != second_representative


def _priority_class(edge: SdfJointEdge) -> int:
    """How much of a joint would be lost if it closed a loop; less is kept first."""
    axis = edge.axis
    if edge.kind == "fixed" or edge.is_coupled:
        return 0
    if axis is None:
        return (
            _PRIORITY_CLASSES - 1
        )  # a ball is three equations, and in a tree three Cardan angles
    if _has_force_or_start(axis):
        return 1
    return 2 if edge.composite_joint or abs(axis.lower) < float("inf") > abs(axis.upper) else 3


def _has_force_or_start(axis: SdfAxis) -> bool:
    """Whether a force acts along an axis, or a file says where it begins."""
    forces = (axis.damping, axis.friction, axis.stiffness)
    return any(forces) or axis.initial is not None


def spanning_tree(edges: Sequence[SdfJointEdge], root: str) -> list[SdfJointEdge]:
    """The joints of a tree, of those with more to say first, each kind breadth-first from a root.

    Args:
        edges: All joints.
        root: The node to begin with.
    """
    groups, found = DisjointSets(), []
    for rank in range(_PRIORITY_CLASSES):
        some = [edge for edge in edges if _priority_class(edge) == rank]
        found += _breadth_first(some, groups, root)
    return found


def _breadth_first(
    edges: Sequence[SdfJointEdge], groups: DisjointSets, root: str
) -> list[SdfJointEdge]:
    """Joints that join groups of nodes, the nearest to the root first."""
    edges_by_node: dict[str, list[SdfJointEdge]] = {}
    for edge in edges:
        for end in (edge.parent, edge.child):
            edges_by_node.setdefault(groups.representative(end), []).append(edge)
    found: list[SdfJointEdge] = []
    seen: set[str] = set()
    for start in (groups.representative(root), *edges_by_node):
        pending = [] if start in seen else [start]
        seen.add(start)
        for node in pending:
            for edge in edges_by_node.get(node, ()):
                ends = groups.representative(edge.parent), groups.representative(edge.child)
                other_end = ends[ends[0] == node]
                if other_end not in seen:
                    seen.add(other_end)
                    pending.append(other_end)
                    found.append(edge)
    for edge in found:
        groups.join(edge.parent, edge.child)
    return found


def order_from_root(edges: Iterable[SdfJointEdge], root: str) -> list[tuple[SdfJointEdge, bool]]:
    """The joints of a tree from the root on, and whether each goes from parent to child."""
    edges_by_node: dict[str, list[SdfJointEdge]] = {}
    for edge in edges:
        edges_by_node.setdefault(edge.parent, []).append(edge)
        edges_by_node.setdefault(edge.child, []).append(edge)
    found, seen, pending = [], {root}, [root]
    for node in pending:
        for edge in edges_by_node.get(node, ()):
            other_end = edge.child if edge.parent == node else edge.parent
            if other_end not in seen:
                seen.add(other_end)
                pending.append(other_end)
                found.append((edge, edge.parent == node))
    return found
