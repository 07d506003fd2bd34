"""Notes and warnings about elements of an SDF model that are left out."""

import warnings
from collections.abc import Mapping
from difflib import get_close_matches

from lxml import etree

from crane.common.errors import CraneWarning
from crane.formats.conversion_notes import ConversionNotes
from crane.formats.sdf.model_scope import ModelScope
from crane.formats.sdf.sdf_element import SdfElement

# Children that are read, and those that simulators and viewers read.
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


def note_unsupported_elements(scope: ModelScope, notes: ConversionNotes) -> None:
    """Note elements of a model that no machine has, and warn of mistyped elements."""
    item = scope.item
    for element in item.element.iter(*_NOTED_ELEMENTS):
        if next(element.iterancestors("model"), None) is item.element:  # not of a nested model
            notes.note_unsupported(_NOTED_ELEMENTS[element.tag], element.get("name", ""))
    for name, link in scope.links.items():
        if link.text("gravity").lower() in ("0", "false"):
            notes.note_difference(
                "links without gravity have their weight", f"{scope.prefix}{name}"
            )
    for part in (*scope.links.values(), *scope.joints.values()):
        _check_children(part)


def _check_children(part: SdfElement) -> None:
    for element in part.element.iter(etree.Element):
        tags = _KNOWN_CHILDREN.get("axis" if element.tag == "axis2" else element.tag)
        parent = element.getparent()
        if tags is None or (parent is not None and parent.tag in ("ode", "physics", "sensor")):
            continue
        for child in element:
            name = child.tag
            if isinstance(name, str) and name not in tags and not name.startswith("{"):
                _warn_about_unknown_child(part, child, tags)


def _warn_about_unknown_child(part: SdfElement, child: etree._Element, tags: set[str]) -> None:
    similar = get_close_matches(child.tag.lower(), sorted(tags), 1, 0.75)
    other_parents = [parent for parent, inside in _KNOWN_CHILDREN.items() if child.tag in inside]
    if similar or other_parents:
        hint = (
            f"did you mean <{similar[0]}>?" if similar else f"it belongs into <{other_parents[0]}>"
        )
        warnings.warn(
            f"{part.xml.source_location(child)}: unknown <{child.tag}> in "
            f"<{child.getparent().tag}> of {part.label}, it is left out, {hint}",
            CraneWarning,
            stacklevel=2,
        )
