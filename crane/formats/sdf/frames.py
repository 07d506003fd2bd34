"""Where links, joints and frames of SDF are, and which link each is fixed to.

Every pose is relative to a frame: that which it names, or by default that of its model, for a
joint its child, for a frame what it is attached to, for a model that of the model above. A model
with a placement frame P is where its pose puts P: X_SM = X_SP (X_MP)^-1.
"""

import numpy as np
import pinocchio as pin

from crane.formats.sdf.scope import MergedFrame, Scope, lookup
from crane.formats.sdf.values import Item

_MODEL, _WORLD = "__model__", "world"
_DEEP = 200  # frames relative to each other


class Frames:
    """Poses of one file, found once each."""

    def __init__(self) -> None:
        self._found: dict[tuple[int, str], pin.SE3] = {}
        self._open: list[tuple[int, str]] = []

    def within(self, scope: Scope, name: str, asker: Item) -> pin.SE3:
        """Pose of what has a name in a scope, relative to the frame of that scope.

        Args:
            scope: The scope.
            name: A name in it, perhaps with `::`.
            asker: What names it, for errors.

        Raises:
            DescriptionError: It is unknown, or frames are relative to each other in a ring.
        """
        if name in ("", _MODEL) or (name == _WORLD and scope.above is None):
            return pin.SE3.Identity()
        key = (id(scope), name)
        if key in self._found:
            return self._found[key]
        if key in self._open or len(self._open) > _DEEP:
            raise asker.xml.fail(
                asker.element, f"{asker.what} is relative to '{name}' in a ring, break it"
            )
        self._open.append(key)
        try:
            self._found[key] = self._sought(scope, name, asker)
        finally:
            self._open.pop()
        return self._found[key]

    def _sought(self, scope: Scope, name: str, asker: Item) -> pin.SE3:
        inner, rest = lookup(scope, name, asker)
        if inner is not scope:
            return self._from(scope, inner, asker) * self.within(inner, rest, asker)
        if rest in scope.links:
            return self.of(scope, scope.links[rest], scope.links[rest].base)
        if rest in scope.frames:
            return self._frame(scope, scope.frames[rest])
        if rest in scope.models:
            model = scope.models[rest]
            return self._placed(scope, model, model.item.base)
        joint = scope.joints[rest]
        return self.of(scope, joint, joint.text("child"))

    def _from(self, scope: Scope, inner: Scope, asker: Item) -> pin.SE3:
        """Pose of a model that is anywhere within a scope."""
        steps = []
        while inner is not scope and inner.above is not None:
            steps.append((inner.above, inner.name))
            inner = inner.above
        place = pin.SE3.Identity()
        for above, name in reversed(steps):
            place = place * self.within(above, name, asker)
        return place

    def _frame(self, scope: Scope, frame: Item) -> pin.SE3:
        if isinstance(frame, MergedFrame) and frame.frame_of is not None:
            return self._placed(scope, frame.frame_of, frame.base)
        return self.of(scope, frame, attached_to(frame))

    def _placed(self, scope: Scope, model: Scope, base: str) -> pin.SE3:
        """Pose of a model's frame in the scope that it is in."""
        place = self.of(scope, model.placed, base)
        placed = model.placement_frame
        if placed in ("", _MODEL):
            return place
        return place * self.within(model, placed, model.item).inverse()

    def of(self, scope: Scope, item: Item, default: str) -> pin.SE3:
        """Pose of an element relative to the frame of its scope.

        Args:
            scope: The scope.
            item: An element that may have a `<pose>`.
            default: The frame that this is relative to if it does not say.
        """
        place, relative = item.pose()
        if relative == _MODEL:
            relative = item.base
        return self.within(scope, relative or default, item) * place

    def turn(self, scope: Scope, name: str, asker: Item) -> np.ndarray:
        """(3, 3) axes of a frame in those of its scope."""
        return np.asarray(self.within(scope, name, asker).rotation)

    def in_top(self, scope: Scope, top: Scope) -> pin.SE3:
        """Pose of a scope's frame relative to that of one above."""
        return self._from(top, scope, scope.item)


def attached_to(frame: Item) -> str:
    """What a frame is fixed to."""
    given = str(frame.element.get("attached_to", "")).strip()
    return frame.base if given in ("", _MODEL) else given


def link_of(scope: Scope, name: str, asker: Item, depth: int = 0) -> tuple[Scope, str] | None:
    """The link that a name stands for or is fixed to; None for the world.

    Raises:
        DescriptionError: It is unknown, or fixed to itself in a ring.
    """
    if depth > _DEEP:
        raise asker.xml.fail(asker.element, f"{asker.what} is attached to itself, break the ring")
    if name == _WORLD and name not in scope.links:
        return None
    inner, rest = lookup(scope, name, asker)
    if rest in inner.links:
        return inner, rest
    if rest in inner.frames:
        frame = inner.frames[rest]
        merged = isinstance(frame, MergedFrame)
        return link_of(inner, _MODEL if merged else attached_to(frame), asker, depth + 1)
    if rest in inner.joints:
        return link_of(inner, inner.joints[rest].text("child"), asker, depth + 1)
    if rest in inner.models:
        inner, rest = inner.models[rest], _MODEL
    return canonical(inner, asker, depth)


def canonical(scope: Scope, asker: Item, depth: int = 0) -> tuple[Scope, str] | None:
    """The link that a model's frame is fixed to: that which it names, else its first.

    Raises:
        DescriptionError: It has none.
    """
    if given := str(scope.item.element.get("canonical_link", "")).strip():
        return link_of(scope, given, asker, depth + 1)
    for inner in scope.every():
        if inner.links:
            return inner, next(iter(inner.links))
    raise scope.item.xml.fail(scope.item.element, f"{scope.item.what} has no link, add one")
