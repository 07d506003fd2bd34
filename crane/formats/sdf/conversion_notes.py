"""What SDF says and a machine does not have: noted, to be told in one line."""

import warnings
from collections.abc import Mapping
from difflib import get_close_matches

from lxml import etree

from crane.common.errors import CraneWarning
from crane.formats.sdf.model_scope import ModelScope
from crane.formats.sdf.sdf_element import SdfElement
from crane.formats.xml_file import XmlFile

_MAX_SHOWN_NAMES = 4  # names in a line

# What is read, and what simulators and viewers have.
_KNOWN_CHILDREN: Mapping[str, set[str]] = {
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
_NOTED_ELEMENTS = {"sensor": "sensors", "plugin": "plugins", "gripper": "grippers"}


class ConversionNotes:
    """Notes on a file.

    Args:
        xml: The file.
    """

    def __init__(self, xml: XmlFile):
        self._xml = xml
        self._unsupported_features: dict[str, list[str]] = {}
        self._differences: dict[str, list[str]] = {}

    def note_unsupported(self, feature: str, name: str = "") -> None:
        """Note what is left out."""
        self._unsupported_features.setdefault(feature, []).append(name)

    def note_difference(self, difference: str, *names: str) -> None:
        """Note what is taken otherwise than SDF has it."""
        self._differences.setdefault(difference, []).extend(names)

    def check_model(self, scope: ModelScope) -> None:
        """Note what a model has that no machine has, and slips of known names."""
        item = scope.item
        for element in item.element.iter(*_NOTED_ELEMENTS):
            if _is_own(element, item.element):
                self.note_unsupported(_NOTED_ELEMENTS[element.tag], element.get("name", ""))
        for name, link in scope.links.items():
            if link.text("gravity").lower() in ("0", "false"):
                self.note_difference(
                    "links without gravity have their weight", f"{scope.prefix}{name}"
                )
        for part in (*scope.links.values(), *scope.joints.values()):
            self._check_children(part)

    def _check_children(self, part: SdfElement) -> None:
        for element in part.element.iter(etree.Element):
            tag = "axis" if element.tag == "axis2" else element.tag
            tags = _KNOWN_CHILDREN.get(tag)
            parent = element.getparent()
            if tags is None or (parent is not None and parent.tag in ("ode", "physics", "sensor")):
                continue
            for child in element:
                name = child.tag
                if isinstance(name, str) and name not in tags and not name.startswith("{"):
                    self._warn_about_unknown_child(part, child, tags)

    def _warn_about_unknown_child(
        self, part: SdfElement, child: etree._Element, tags: set[str]
    ) -> None:
        similar = get_close_matches(child.tag.lower(), sorted(tags), 1, 0.75)
        other_parents = [
            parent for parent, inside in _KNOWN_CHILDREN.items() if child.tag in inside
        ]
        if not similar and not other_parents:
            return
        hint = (
            f"did you mean <{similar[0]}>?" if similar else f"it belongs into <{other_parents[0]}>"
        )
        parent = child.getparent().tag
        warnings.warn(
            f"{part.xml.source_location(child)}: unknown <{child.tag}> in <{parent}> of "
            f"{part.label}, it is "
            f"left out, {hint}",
            CraneWarning,
            stacklevel=2,
        )

    def warn_about_notes(self) -> None:
        """Warn of all that has been noted, in a line of each kind."""
        for heading, notes in (
            ("left out of what SDF has", self._unsupported_features),
            ("otherwise than in SDF", self._differences),
        ):
            words = [f"{what}{_list_names(names)}" for what, names in notes.items()]
            if words:
                text = f"{self._xml.file.name}: {heading}: {'; '.join(words)}"
                warnings.warn(text, CraneWarning, stacklevel=2)


def _is_own(element: etree._Element, model: etree._Element) -> bool:
    """Whether an element is in this model and in none within it."""
    parent = element.getparent()
    while parent is not None and parent.tag != "model":
        parent = parent.getparent()
    return parent is model


def _list_names(names: list[str]) -> str:
    """Names, the first of many."""
    found = [name for name in dict.fromkeys(names) if name]
    remainder = [f"{len(found) - _MAX_SHOWN_NAMES} more"] if len(found) > _MAX_SHOWN_NAMES else []
    return f" ({', '.join(found[:_MAX_SHOWN_NAMES] + remainder)})" if found else ""
