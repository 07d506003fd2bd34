"""The sections of a machine file on forces along joints and between frames."""

import warnings

from crane.common.errors import CraneWarning
from crane.description.force_elements import (
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

    def read_law(joint: str, item: YamlSection) -> Friction:
        values = item.values()
        is_drive_intended = values.pop("is_driving", False)
        law = Friction(**values)
        for kind in () if is_drive_intended else ("coulomb", "viscous"):
            mean, offset = getattr(law, kind), getattr(law, f"{kind}_offset")
            if abs(offset) > mean:
                warnings.warn(
                    f"{item.source_location()}: friction of '{joint}' drives the joint in one "
                    f"direction (|{kind}_offset| {abs(offset):g} > {kind} {mean:g}), a constant "
                    "force may hide in it; write drives: true if it is meant",
                    CraneWarning,
                    stacklevel=3,
                )
        return law

    return top.read_map("friction", read_law, tree.check_joint)


def read_forces(top: YamlSection, tree: TreeBuilder) -> tuple[ForceElement, ...]:
    """Springs, dampers and constant forces."""

    def read_element(item: YamlSection) -> ForceElement:
        between = tree.read_frame_pair(item) if "between" in item else None
        if between is None:
            tree.check_joint(item.text("joint"), item.source_location("joint"))
        element = ForceElement(**item.values("between"), between=between)
        if not (element.stiffness or element.damping or element.force):
            problem = f"the {element_name(element)} does nothing, give stiffness, damping or force"
            raise item.error_at(None, problem)
        return element

    return top.read_items("forces", read_element)


def read_gas_springs(top: YamlSection, tree: TreeBuilder) -> tuple[GasSpring, ...]:
    """Enclosed gas along joints, and between frames under names of their own."""

    def read_spring(name: str, item: YamlSection) -> GasSpring:
        between = tree.read_frame_pair(item) if "between" in item else None
        if between is None:
            tree.check_joint(name, item.source_location())
        return GasSpring(name, **item.values("between"), between=between)

    return tuple(top.read_map("gas_springs", read_spring).values())


def read_ropes(top: YamlSection, tree: TreeBuilder) -> tuple[Rope, ...]:
    """Ropes between frames."""
    return top.read_items(
        "ropes", lambda item: Rope(tree.read_frame_pair(item), **item.values("between"))
    )


def read_end_stops(top: YamlSection, tree: TreeBuilder) -> tuple[EndStop, ...]:
    """Stops at the limits of joints."""

    def read_stop(joint: str, item: YamlSection) -> EndStop:
        if missing_limit := tree.missing_limit_text(joint):
            hint = "make it revolute" if missing_limit == "is continuous" else "give it both"
            problem = f"joint '{joint}' {missing_limit}, a stop needs limits: {hint}"
            raise item.error_at(None, problem)
        return EndStop(joint, **item.values())

    return tuple(top.read_map("end_stops", read_stop, tree.check_joint).values())
