"""The sections of a machine file on forces along joints and between frames."""

import warnings

from crane.common.errors import CraneWarning
from crane.description.findings import error_recovery
from crane.description.specification import (
    EndStop,
    ForceElement,
    Friction,
    GasSpring,
    Rope,
    element_name,
)
from crane.formats.machine_file.tree_builder import TreeBuilder
from crane.formats.machine_file.yaml_section import YamlSection


def read_friction(top: YamlSection, tree: TreeBuilder) -> dict[str, Friction]:
    """Friction by joint."""
    found: dict[str, Friction] = {}
    keys = (
        "coulomb", "coulomb_offset", "viscous", "viscous_offset", "smoothing", "stiction",
        "stribeck", "drives",
    )  # fmt: skip
    for joint, item in top.mappings("friction", "friction of", *keys):
        with error_recovery():
            tree.check_joint(joint, item.source_location())
            found[joint] = _read_friction_law(joint, item)
    return found


def _read_friction_law(joint: str, item: YamlSection) -> Friction:
    stribeck = item.number("stribeck", Friction.stribeck, minimum=0.0)
    if stribeck == 0:
        raise item.error_at(
            "stribeck", f"'stribeck' of friction of '{joint}' is 0, give a velocity"
        )
    friction = Friction(
        coulomb=item.number("coulomb", 0.0, minimum=0.0),
        coulomb_offset=item.number("coulomb_offset", 0.0),
        viscous=item.number("viscous", 0.0, minimum=0.0),
        viscous_offset=item.number("viscous_offset", 0.0),
        smoothing=item.number("smoothing", Friction.smoothing, minimum=0.0),
        stiction=item.number("stiction", 0.0, minimum=0.0),
        stribeck=stribeck,
    )
    is_intended = item.boolean("drives", False)
    for kind in ("coulomb", "viscous"):
        mean, offset = getattr(friction, kind), getattr(friction, f"{kind}_offset")
        if abs(offset) > mean and not is_intended:
            warnings.warn(
                f"{item.source_location()}: friction of '{joint}' drives the joint in one "
                f"direction "
                f"(|{kind}_offset| {abs(offset):g} > {kind} {mean:g}), a constant force may hide "
                "in it; write drives: true if it is meant",
                CraneWarning,
                stacklevel=3,
            )
    return friction


def read_forces(top: YamlSection, tree: TreeBuilder) -> tuple[ForceElement, ...]:
    """Springs, dampers and constant forces."""
    forces = []
    keys = ("joint", "between", "stiffness", "rest", "damping", "force")
    for item in top.sections("forces", "force element of", *keys):
        with error_recovery():
            forces.append(_read_force_element(item, tree))
    return tuple(forces)


def _read_force_element(item: YamlSection, tree: TreeBuilder) -> ForceElement:
    between = tree.read_frame_pair(item) if "between" in item else None
    if between and "joint" in item:
        raise item.error_at(
            "joint", "an element is on a joint or between frames, keep one of the two"
        )
    element = ForceElement(
        "" if between else tree.read_joint_name(item),
        stiffness=item.number("stiffness", 0.0, minimum=0.0),
        rest=item.number("rest", 0.0),
        damping=item.number("damping", 0.0, minimum=0.0),
        force=item.number("force", 0.0),
        between=between,
    )
    if not (element.stiffness or element.damping or element.force):
        problem = f"the {element_name(element)} does nothing, give stiffness, damping or force"
        raise item.error_at(None, problem)
    return element


def read_rotor_inertias(top: YamlSection, tree: TreeBuilder) -> dict[str, float]:
    """Rotor inertia by joint."""
    found: dict[str, float] = {}
    section = top.section("rotor_inertia", "'rotor_inertia'")
    for joint in section or ():
        assert section is not None
        with error_recovery():
            tree.check_joint(joint, section.source_location(joint))
            found[joint] = section.number(joint, minimum=0.0)
    return found


def read_gas_springs(top: YamlSection, tree: TreeBuilder) -> tuple[GasSpring, ...]:
    """Enclosed gas along joints, and between frames under names of their own."""
    springs = []
    keys = ("area", "pressure", "volume", "rest", "exponent", "between")
    for name, item in top.mappings("gas_springs", "gas spring of", *keys):
        with error_recovery():
            between = tree.read_frame_pair(item) if "between" in item else None
            if not between:
                tree.check_joint(name, item.source_location())
            springs.append(_read_gas_spring(name, between, item))
    return tuple(springs)


def _read_gas_spring(joint: str, between: tuple[str, str] | None, item: YamlSection) -> GasSpring:
    area = item.number("area")
    volume = item.number("volume", minimum=0.0)
    exponent = item.number("exponent", GasSpring.exponent, minimum=0.0)
    for key, value in (("area", area), ("volume", volume), ("exponent", exponent)):
        if value == 0:
            raise item.error_at(key, f"'{key}' of gas spring of '{joint}' is 0, give one")
    pressure, rest = item.number("pressure", minimum=0.0), item.number("rest", 0.0)
    return GasSpring(joint, area, pressure, volume, rest, exponent, between)


def read_ropes(top: YamlSection, tree: TreeBuilder) -> tuple[Rope, ...]:
    """Ropes between frames."""
    ropes = []
    for item in top.sections("ropes", "rope", "between", "length", "stiffness", "damping"):
        with error_recovery():
            between = tree.read_frame_pair(item)
            length, stiffness = (item.number(key, minimum=0.0) for key in ("length", "stiffness"))
            for key, value in (("length", length), ("stiffness", stiffness)):
                if value == 0:
                    raise item.error_at(key, f"'{key}' of {item.title} is 0, give one")
            ropes.append(
                Rope(between, length, stiffness, item.number("damping", 0.0, minimum=0.0))
            )
    return tuple(ropes)


def read_end_stops(top: YamlSection, tree: TreeBuilder) -> tuple[EndStop, ...]:
    """Stops at the limits of joints."""
    stops = []
    for joint, item in top.mappings("end_stops", "end stop of", "stiffness", "damping"):
        with error_recovery():
            tree.check_joint(joint, item.source_location())
            stops.append(_read_end_stop(joint, item, tree))
    return tuple(stops)


def _read_end_stop(joint: str, item: YamlSection, tree: TreeBuilder) -> EndStop:
    if missing_limit := tree.missing_limit_text(joint):
        hint = "make it revolute" if missing_limit == "is continuous" else "give it both"
        raise item.error_at(None, f"joint '{joint}' {missing_limit}, a stop needs limits: {hint}")
    stiffness = item.number("stiffness", minimum=0.0)
    if stiffness == 0:
        raise item.error_at("stiffness", f"the end stop of '{joint}' has no stiffness, give one")
    return EndStop(joint, stiffness, item.number("damping", 0.0, minimum=0.0))
