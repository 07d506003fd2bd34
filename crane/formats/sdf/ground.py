"""What ties the parts of an SDF to the ground that none of its joints ties to it."""

import warnings
from collections.abc import Mapping

import pinocchio as pin

from crane.common.errors import CraneWarning
from crane.common.packages import given
from crane.formats.sdf.frames import canonical
from crane.formats.sdf.graph import Groups
from crane.formats.sdf.joints import WORLD, Edge
from crane.formats.sdf.left_out import LeftOut
from crane.formats.sdf.scope import Scope
from crane.formats.sdf.values import Item

_LISTED = 4


class Ground:
    """The world that a model stands in.

    Args:
        top: The model.
        links: Its links by name, with the scopes they are in.
        at: Their places in the model.
        notes: Takes what is taken otherwise.
    """

    def __init__(
        self,
        top: Scope,
        links: Mapping[str, tuple[Scope, Item]],
        at: Mapping[str, pin.SE3],
        notes: LeftOut,
    ):
        self._top, self._links, self._at, self._notes = top, links, at, notes

    def welds(self, edges: list[Edge]) -> list[Edge]:
        """What ties parts to the world that no joint ties to it.

        Where none is, all stand on the ground as they are drawn, or the first floats with the
        root; where some are, the file lets the others float.
        """
        groups = Groups()
        for edge in edges:
            groups.join(edge.parent, edge.child)
        grounded = any(WORLD in (edge.parent, edge.child) for edge in edges)
        welds: list[Edge] = []
        for link in self._roots(edges):
            if groups.join(WORLD, link):
                stands = not grounded and not (welds and given().floating)
                kind = "fixed" if stands else "floating"
                name = self._free_name(f"{link}_{'world' if stands else 'free'}", edges)
                place, item = self._at[link], self._links[link][1]
                welds.append(Edge(name, kind, WORLD, link, place, item))
        self._tell_of_welds(welds)
        return welds

    def _roots(self, edges: list[Edge]) -> list[str]:
        """All links, those first that a part may stand on: no joint's child, canonical ones."""
        first = canonical(self._top, self._top.item)
        chosen = "" if first is None else f"{first[0].prefix}{first[1]}"
        children = {edge.child for edge in edges}
        return sorted(self._links, key=lambda link: (link in children, link != chosen))

    def _tell_of_welds(self, welds: list[Edge]) -> None:
        standing = [weld for weld in welds if weld.kind == "fixed"]
        floating = [weld.child for weld in welds if weld.kind != "fixed"]
        if floating:
            self._notes.differ("links that no joint ties to the others float", *floating)
        if standing and not given().floating:
            names = ", ".join(f"'{weld.child}'" for weld in standing[:_LISTED])
            warnings.warn(
                f"{standing[0].item.where}: nothing joins '{self._top.name}' to the world, it is "
                f"taken as standing on the ground by link {names}: --floating (floating=True) "
                "lets it float",
                CraneWarning,
                stacklevel=3,
            )

    def _free_name(self, name: str, edges: list[Edge]) -> str:
        taken = {edge.name for edge in edges}
        while name in taken:
            name += "_"
        return name
