"""Which joints make the tree, and which close its loops."""

from collections.abc import Iterable, Sequence

from crane.formats.sdf.joints import Axis, Edge

_CLASSES = 5


class Groups:
    """Things that are joined, by union and find."""

    def __init__(self) -> None:
        self._above: dict[str, str] = {}

    def of(self, name: str) -> str:
        """What stands for all that a thing is joined to."""
        while (above := self._above.get(name, name)) != name:
            self._above[name] = name = self._above.get(above, above)
        return name

    def join(self, one: str, two: str) -> bool:
        """Join two things; whether they were not."""
        first, second = self.of(one), self.of(two)
        self._above[second] = first
        return first != second


def _class(edge: Edge) -> int:
    """How much of a joint would be lost if it closed a loop; less is kept first."""
    axis = edge.axis
    if edge.kind == "fixed" or edge.bound:
        return 0
    if axis is None:
        return _CLASSES - 1  # a ball is three equations, and in a tree three Cardan angles
    if _acts(axis):
        return 1
    return 2 if edge.between or abs(axis.lower) < float("inf") > abs(axis.upper) else 3


def _acts(axis: Axis) -> bool:
    """Whether a force acts along an axis, or a file says where it begins."""
    forces = (axis.damping, axis.friction, axis.stiffness)
    return any(forces) or axis.initial is not None


def spanning(edges: Sequence[Edge], root: str) -> list[Edge]:
    """The joints of a tree, of those with more to say first, each kind breadth-first from a root.

    Args:
        edges: All joints.
        root: The node to begin with.
    """
    groups, found = Groups(), []
    for rank in range(_CLASSES):
        some = [edge for edge in edges if _class(edge) == rank]
        found += _breadth_first(some, groups, root)
    return found


def _breadth_first(edges: Sequence[Edge], groups: Groups, root: str) -> list[Edge]:
    """Joints that join groups of nodes, the nearest to the root first."""
    below: dict[str, list[Edge]] = {}
    for edge in edges:
        for end in (edge.parent, edge.child):
            below.setdefault(groups.of(end), []).append(edge)
    found: list[Edge] = []
    seen: set[str] = set()
    for start in (groups.of(root), *below):
        waiting = [] if start in seen else [start]
        seen.add(start)
        for at in waiting:
            for edge in below.get(at, ()):
                ends = groups.of(edge.parent), groups.of(edge.child)
                far = ends[ends[0] == at]
                if far not in seen:
                    seen.add(far)
                    waiting.append(far)
                    found.append(edge)
    for edge in found:
        groups.join(edge.parent, edge.child)
    return found


def downwards(edges: Iterable[Edge], root: str) -> list[tuple[Edge, bool]]:
    """The joints of a tree from the root on, and whether each goes from parent to child."""
    near: dict[str, list[Edge]] = {}
    for edge in edges:
        near.setdefault(edge.parent, []).append(edge)
        near.setdefault(edge.child, []).append(edge)
    found, seen, waiting = [], {root}, [root]
    for at in waiting:
        for edge in near.get(at, ()):
            far = edge.child if edge.parent == at else edge.parent
            if far not in seen:
                seen.add(far)
                waiting.append(far)
                found.append((edge, edge.parent == at))
    return found
