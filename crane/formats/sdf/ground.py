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
        """Joints of the parts that no joint ties to the world.

        Where none is tied to it, all stand on the ground as they are drawn, or float if that was
        asked for; where some are, the file lets the others float.
        """
        groups = Groups()
        for edge in edges:
            groups.join(edge.parent, edge.child)
        grounded = any(WORLD in (edge.parent, edge.child) for edge in edges)
        loose = [link for link in self._roots(edges) if groups.join(WORLD, link)]
        # a single one is made to float as those of other formats are
        stands = not grounded and not (given().floating and len(loose) > 1)
        welds = [self._weld(link, stands, edges) for link in loose]
        self._tell(welds, stands)
        return welds

    def _weld(self, link: str, stands: bool, edges: list[Edge]) -> Edge:
        name = self._free_name(f"{link}_{'world' if stands else 'free'}", edges)
        kind = "fixed" if stands else "floating"
        return Edge(name, kind, WORLD, link, self._at[link], self._links[link][1])

    def _roots(self, edges: list[Edge]) -> list[str]:
        """All links, those first that a part may stand on: no joint's child, canonical ones."""
        first = canonical(self._top, self._top.item)
        chosen = "" if first is None else f"{first[0].prefix}{first[1]}"
        children = {edge.child for edge in edges}
        return sorted(self._links, key=lambda link: (link in children, link != chosen))

    def _tell(self, welds: list[Edge], stand: bool) -> None:
        if not welds or given().floating:
            return
        links = [weld.child for weld in welds]
        if not stand:
            self._notes.differ("links that no joint ties to the others float", *links)
            return
        names = ", ".join(f"'{link}'" for link in links[:_LISTED])
        warnings.warn(
            f"{welds[0].item.where}: nothing joins '{self._top.name}' to the world, it is taken "
            f"as standing on the ground by link {names}: --floating (floating=True) lets it float",
            CraneWarning,
            stacklevel=3,
        )

    def _free_name(self, name: str, edges: list[Edge]) -> str:
        taken = {edge.name for edge in edges}
        while name in taken:
            name += "_"
        return name
