"""What ties the parts of an SDF to the ground that none of its joints ties to it."""

import warnings
from collections.abc import Mapping

import pinocchio as pin

from crane.common.errors import CraneWarning
from crane.common.package_search import load_options
from crane.formats.sdf.conversion_notes import ConversionNotes
from crane.formats.sdf.frame_poses import canonical_link
from crane.formats.sdf.model_scope import ModelScope
from crane.formats.sdf.sdf_element import SdfElement
from crane.formats.sdf.sdf_joints import WORLD_NODE, SdfJointEdge
from crane.formats.sdf.spanning_tree import DisjointSets

_MAX_LISTED = 4


class GroundAttachment:
    """The world that a model stands in.

    Args:
        top: The model.
        links: Its links by name, with the scopes they are in.
        at: Their places in the model.
        notes: Takes what is taken otherwise.
    """

    def __init__(
        self,
        top: ModelScope,
        links: Mapping[str, tuple[ModelScope, SdfElement]],
        link_poses: Mapping[str, pin.SE3],
        notes: ConversionNotes,
    ):
        self._top, self._links, self._link_poses, self._notes = top, links, link_poses, notes

    def ground_edges(self, edges: list[SdfJointEdge]) -> list[SdfJointEdge]:
        """Joints of the parts that no joint ties to the world.

        Where none is tied to it, all stand on the ground as they are drawn, or float if that was
        asked for; where some are, the file lets the others float.
        """
        groups = DisjointSets()
        for edge in edges:
            groups.join(edge.parent, edge.child)
        grounded = any(WORLD_NODE in (edge.parent, edge.child) for edge in edges)
        unattached = [
            link for link in self._root_candidates(edges) if groups.join(WORLD_NODE, link)
        ]
        # a single one is made to float as those of other formats are
        is_standing = not grounded and not (load_options().floating_root and len(unattached) > 1)
        welds = [self._ground_edge(link, is_standing, edges) for link in unattached]
        self._warn_about_attachment(welds, is_standing)
        return welds

    def _ground_edge(
        self, link: str, is_standing: bool, edges: list[SdfJointEdge]
    ) -> SdfJointEdge:
        name = self._unique_name(f"{link}_{'world' if is_standing else 'free'}", edges)
        kind = "fixed" if is_standing else "floating"
        return SdfJointEdge(
            name, kind, WORLD_NODE, link, self._link_poses[link], self._links[link][1]
        )

    def _root_candidates(self, edges: list[SdfJointEdge]) -> list[str]:
        """All links, those first that a part may stand on: no joint's child, canonical ones."""
        first = canonical_link(self._top, self._top.item)
        canonical_name = "" if first is None else f"{first[0].prefix}{first[1]}"
        children = {edge.child for edge in edges}
        return sorted(self._links, key=lambda link: (link in children, link != canonical_name))

    def _warn_about_attachment(self, ground_edges: list[SdfJointEdge], is_standing: bool) -> None:
        if not ground_edges or load_options().floating_root:
            return
        links = [weld.child for weld in ground_edges]
        if not is_standing:
            self._notes.note_difference("links that no joint ties to the others float", *links)
            return
        names = ", ".join(f"'{link}'" for link in links[:_MAX_LISTED])
        warnings.warn(
            f"{ground_edges[0].item.source_location}: nothing joins '{self._top.name}' to the "
            f"world, it is taken "
            f"as standing on the ground by link {names}: --floating (floating=True) lets it float",
            CraneWarning,
            stacklevel=3,
        )

    def _unique_name(self, name: str, edges: list[SdfJointEdge]) -> str:
        used_names = {edge.name for edge in edges}
        while name in used_names:
            name += "_"
        return name
