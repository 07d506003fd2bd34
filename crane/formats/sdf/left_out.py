"""What SDF says and a machine does not have: noted, to be told in one line."""

import warnings
from collections.abc import Mapping
from difflib import get_close_matches

from lxml import etree

from crane.common.errors import CraneWarning
from crane.formats.sdf.scope import Scope
from crane.formats.sdf.values import Item
from crane.formats.xml import XmlFile

_SHOWN = 4  # names in a line

# What is read, and what simulators and viewers have.
_READ: Mapping[str, set[str]] = {
    "joint": {
        "parent", "child", "axis", "axis2", "pose", "gearbox_ratio", "gearbox_reference_body",
        "thread_pitch", "screw_thread_pitch", "physics", "sensor", "frame", "plugin",
    },
    "axis": {
        "xyz", "limit", "dynamics", "mimic", "use_parent_model_frame", "initial_position",
    },
    "limit": {"lower", "upper", "effort", "velocity", "stiffness", "dissipation"},
    "dynamics": {"damping", "friction", "spring_stiffness", "spring_reference"},
    "inertial": {
        "pose", "mass", "inertia", "density", "fluid_added_mass", "frame", "auto_inertia_params",
    },
    "inertia": {"ixx", "ixy", "ixz", "iyy", "iyz", "izz"},
    "mimic": {"multiplier", "offset", "reference"},
    "link": {
        "pose", "inertial", "visual", "collision", "sensor", "plugin", "gravity", "self_collide",
        "kinematic", "must_be_base_link", "velocity_decay", "enable_wind", "projector", "battery",
        "light", "particle_emitter", "audio_sink", "audio_source", "frame", "max_contacts",
    },
}  # fmt: skip
_TOLD = {"sensor": "sensors", "plugin": "plugins", "gripper": "grippers"}


class LeftOut:
    """Notes on a file.

    Args:
        xml: The file.
    """

    def __init__(self, xml: XmlFile):
        self._xml = xml
        self._lost: dict[str, list[str]] = {}
        self._otherwise: dict[str, list[str]] = {}

    def lose(self, what: str, name: str = "") -> None:
        """Note what is left out."""
        self._lost.setdefault(what, []).append(name)

    def differ(self, what: str, *names: str) -> None:
        """Note what is taken otherwise than SDF has it."""
        self._otherwise.setdefault(what, []).extend(names)

    def of_model(self, scope: Scope) -> None:
        """Note what a model has that no machine has, and slips of known names."""
        item = scope.item
        for element in item.element.iter(*_TOLD):
            if _is_own(element, item.element):
                self.lose(_TOLD[element.tag], element.get("name", ""))
        for name, link in scope.links.items():
            if link.text("gravity").lower() in ("0", "false"):
                self.differ("links without gravity have their weight", f"{scope.prefix}{name}")
        for part in (*scope.links.values(), *scope.joints.values()):
            self._check(part)

    def _check(self, part: Item) -> None:
        for element in part.element.iter(etree.Element):
            tag = "axis" if element.tag == "axis2" else element.tag
            tags = _READ.get(tag)
            parent = element.getparent()
            if tags is None or (parent is not None and parent.tag in ("ode", "physics", "sensor")):
                continue
            for child in element:
                name = child.tag
                if isinstance(name, str) and name not in tags and not name.startswith("{"):
                    self._tell_stranger(part, child, tags)

    def _tell_stranger(self, part: Item, child: etree._Element, tags: set[str]) -> None:
        near = get_close_matches(child.tag.lower(), sorted(tags), 1, 0.75)
        elsewhere = [parent for parent, inside in _READ.items() if child.tag in inside]
        if not near and not elsewhere:
            return
        hint = f"did you mean <{near[0]}>?" if near else f"it belongs into <{elsewhere[0]}>"
        parent = child.getparent().tag
        warnings.warn(
            f"{part.xml.where(child)}: unknown <{child.tag}> in <{parent}> of {part.what}, it is "
            f"left out, {hint}",
            CraneWarning,
            stacklevel=2,
        )

    def tell(self) -> None:
        """Warn of all that has been noted, in a line of each kind."""
        for head, noted in (
            ("left out of what SDF has", self._lost),
            ("otherwise than in SDF", self._otherwise),
        ):
            words = [f"{what}{_listed(names)}" for what, names in noted.items()]
            if words:
                text = f"{self._xml.file.name}: {head}: {'; '.join(words)}"
                warnings.warn(text, CraneWarning, stacklevel=2)


def _is_own(element: etree._Element, model: etree._Element) -> bool:
    """Whether an element is in this model and in none within it."""
    parent = element.getparent()
    while parent is not None and parent.tag != "model":
        parent = parent.getparent()
    return parent is model


def _listed(names: list[str]) -> str:
    """Names, the first of many."""
    found = [name for name in dict.fromkeys(names) if name]
    more = [f"{len(found) - _SHOWN} more"] if len(found) > _SHOWN else []
    return f" ({', '.join(found[:_SHOWN] + more)})" if found else ""
