"""Poses of links, joints and frames of SDF, and the links that frames are fixed to.

Every pose is relative to a frame: the frame that it names, or by default the frame of the model;
for a joint its child, for a frame the frame that it is attached to, for a model the frame of the
parent model. The pose of a model with a placement frame P is that of P: X_SM = X_SP (X_MP)^-1.
"""

import pinocchio as pin

from crane.formats.sdf.model_scope import ModelScope, SdfElement, find_scope

_MODEL_FRAME, _WORLD_FRAME = "__model__", "world"
_MAX_DEPTH = 200  # of frames relative to each other


class SdfFramePoses:
    """Poses of the frames of one file."""

    def __init__(self) -> None:
        self._known_poses: dict[tuple[int, str], pin.SE3] = {}
        self._open_keys: list[tuple[int, str]] = []

    def pose_in_scope(self, scope: ModelScope, name: str, referrer: SdfElement) -> pin.SE3:
        """Return the pose of a named element relative to the frame of its scope.

        Args:
            scope: The scope.
            name: Name in the scope, which may contain `::`.
            referrer: The element that uses the name, for errors.

        Raises:
            DescriptionError: The name is unknown, or frames form a cycle.
        """
        if name in ("", _MODEL_FRAME) or (name == _WORLD_FRAME and scope.parent is None):
            return pin.SE3.Identity()
        key = (id(scope), name)
        if key in self._known_poses:
            return self._known_poses[key]
        if key in self._open_keys or len(self._open_keys) > _MAX_DEPTH:
            raise referrer.error(f"{referrer.label} is relative to '{name}' in a ring, break it")
        self._open_keys.append(key)
        try:
            self._known_poses[key] = self._find_pose(scope, name, referrer)
        finally:
            self._open_keys.pop()
        return self._known_poses[key]

    def _find_pose(self, scope: ModelScope, name: str, referrer: SdfElement) -> pin.SE3:
        inner, rest = find_scope(scope, name, referrer)
        if inner is not scope:
            model_pose = self.nested_model_pose(scope, inner, referrer)
            return model_pose * self.pose_in_scope(inner, rest, referrer)
        if rest in scope.links:
            return self.element_pose(scope, scope.links[rest], scope.links[rest].base_frame)
        if rest in scope.frames:
            frame = scope.frames[rest]
            if frame.merged_model is not None:
                return self._model_pose(scope, frame.merged_model, frame.base_frame)
            return self.element_pose(scope, frame, attached_to(frame))
        if rest in scope.models:
            model = scope.models[rest]
            return self._model_pose(scope, model, model.item.base_frame)
        joint = scope.joints[rest]
        return self.element_pose(scope, joint, joint.text("child"))

    def nested_model_pose(
        self, scope: ModelScope, inner: ModelScope, referrer: SdfElement
    ) -> pin.SE3:
        """Return the pose of a model that is nested in a scope at any depth."""
        if inner is scope or inner.parent is None:
            return pin.SE3.Identity()
        parent_pose = self.nested_model_pose(scope, inner.parent, referrer)
        return parent_pose * self.pose_in_scope(inner.parent, inner.name, referrer)

    def _model_pose(self, scope: ModelScope, model: ModelScope, base: str) -> pin.SE3:
        """Return the pose of a model's frame in the parent scope."""
        placement = self.element_pose(scope, model.pose_element, base)
        placement_frame = model.placement_frame
        if placement_frame in ("", _MODEL_FRAME):
            return placement
        return placement * self.pose_in_scope(model, placement_frame, model.item).inverse()

    def element_pose(self, scope: ModelScope, item: SdfElement, default: str) -> pin.SE3:
        """Return the pose of an element relative to the frame of its scope.

        Args:
            scope: The scope.
            item: An element that may have a `<pose>`.
            default: The frame that the pose is relative to by default.
        """
        placement, relative = item.read_pose()
        if relative == _MODEL_FRAME:
            relative = item.base_frame
        return self.pose_in_scope(scope, relative or default, item) * placement

    def pose_on_link(self, scope: ModelScope, link: SdfElement, item: SdfElement) -> pin.SE3:
        """Return the pose of an element of a link relative to the link's frame."""
        link_pose = self.element_pose(scope, link, link.base_frame)
        return link_pose.actInv(self.element_pose(scope, item, link.name))


def attached_to(frame: SdfElement) -> str:
    """Return the name that a frame is attached to."""
    given = frame.attribute("attached_to")
    return frame.base_frame if given in ("", _MODEL_FRAME) else given


def find_link(
    scope: ModelScope, name: str, referrer: SdfElement, depth: int = 0
) -> tuple[ModelScope, str] | None:
    """Find the link that a named element is, or is fixed to.

    Args:
        scope: The scope in which the name is used.
        name: The name.
        referrer: The element that uses the name, for errors.
        depth: Number of frames that were followed already.

    Returns:
        Scope and name of the link, None for the world.

    Raises:
        DescriptionError: The name is unknown, or frames form a cycle.
    """
    if depth > _MAX_DEPTH:
        raise referrer.error(f"{referrer.label} is attached to itself, break the ring")
    if name == _WORLD_FRAME and name not in scope.links:
        return None
    inner, rest = find_scope(scope, name, referrer)
    if rest in inner.links:
        return inner, rest
    if rest in inner.frames:
        frame = inner.frames[rest]
        base = attached_to(frame) if frame.merged_model is None else _MODEL_FRAME
        return find_link(inner, base, referrer, depth + 1)
    if rest in inner.joints:
        return find_link(inner, inner.joints[rest].text("child"), referrer, depth + 1)
    if rest in inner.models:
        inner, rest = inner.models[rest], _MODEL_FRAME
    return canonical_link(inner, referrer, depth)


def canonical_link(
    scope: ModelScope, referrer: SdfElement, depth: int = 0
) -> tuple[ModelScope, str] | None:
    """Find the canonical link of a model: the link that it names, else its first one.

    Raises:
        DescriptionError: The model has no link.
    """
    if given := scope.item.attribute("canonical_link"):
        return find_link(scope, given, referrer, depth + 1)
    for inner in scope.nested_scopes():
        if inner.links:
            return inner, next(iter(inner.links))
    raise scope.item.error(f"{scope.item.label} has no link, add one")
