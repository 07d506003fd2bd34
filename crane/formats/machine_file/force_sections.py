"""The sections of a machine file on forces: of joints, between frames, and external ones."""

import dataclasses
from typing import Any

from crane.common.errors import InputError, warn
from crane.description.external_force_schema import CONTACT, CONTACT_LAW_KEYS, CUTTER, GROUND, LOAD
from crane.description.external_forces import ExternalForce, PhasedWrench, Wrench
from crane.description.findings import FollowUpError, error_recovery
from crane.description.force_elements import (
    EndStop,
    ForceElement,
    Friction,
    GasSpring,
    Rope,
    element_name,
)
from crane.description.ground_contact import Contact, Ground
from crane.description.soil_cutting import SOILS, Soil, SoilCutting
from crane.formats.machine_file.structure_sections import TreeBuilder
from crane.formats.machine_file.yaml_section import YamlSection


def read_friction(top: YamlSection, tree: TreeBuilder) -> dict[str, Friction]:
    """Friction by joint."""

    def read_law(joint: str, item: YamlSection) -> Friction:
        values = item.values()
        is_drive_intended = values.pop("is_driving", False)
        law = Friction(**values)
        if (kind := law.driving_kind) and not is_drive_intended:
            mean, offset = getattr(law, kind), getattr(law, f"{kind}_offset")
            warn(
                f"{item.source_location()}: friction of '{joint}' drives the joint in one "
                f"direction (|{kind}_offset| {abs(offset):g} > {kind} {mean:g}), a constant "
                "force may hide in it; write drives: true if it is meant",
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
            raise item.error_at(
                None, f"the {element_name(element)} does nothing, give stiffness, damping or force"
            )
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
            raise item.error_at(
                None, f"joint '{joint}' {missing_limit}, a stop needs limits: {hint}"
            )
        return EndStop(joint, **item.values())

    return tuple(top.read_map("end_stops", read_stop, tree.check_joint).values())


def read_external_forces(
    top: YamlSection, tree: TreeBuilder
) -> tuple[Wrench | Contact | SoilCutting, ...]:
    """External forces of a machine file."""
    section, ground = top.section("ground"), None
    contact_law = {key: GROUND.keys[key].default for key in CONTACT_LAW_KEYS}
    if section is not None:
        with error_recovery():
            values = section.values()
            contact_law |= {key: values.pop(key) for key in CONTACT_LAW_KEYS if key in values}
            ground = section.create(
                Ground,
                profile=tuple(
                    map(tuple, (section.rows("profile") if "profile" in section else ()))
                ),
                **values,
            )

    def read_contact(item: YamlSection) -> Contact:
        frame = _read_moving_frame(item, tree)
        _check_section(top, item, "contacts without a ground", "ground", "{height: 0}")
        return item.create(Contact, frame, ground, **contact_law | item.values("frame"))

    soil_section, soil = top.section("soil"), None
    if soil_section is not None:
        with error_recovery():
            soil = _read_soil(soil_section)

    def read_cutter(item: YamlSection) -> SoilCutting:
        frame = _read_moving_frame(item, tree)
        _check_section(top, item, "cutters without ground", "ground", "{height: 0}")
        _check_section(top, item, "cutters without soil", "soil", "{kind: sandy loam}")
        if soil is None:
            raise FollowUpError("the soil is refused")
        return item.create(SoilCutting, frame, soil, ground=ground, **item.values("frame"))

    return (
        *read_loads(top, tree),
        *top.read_items("contacts", read_contact),
        *top.read_items("cutters", read_cutter),
    )


def _read_moving_frame(item: YamlSection, tree: TreeBuilder) -> str:
    frame: str = item.text("frame")
    tree.check_link(frame, item.source_location("frame"), "the frame")
    if not tree.is_movable(frame):
        raise tree.unknown_name_error(
            str(item.error_at("frame", f"'{frame}' does not move, a load on it does nothing"))
        )
    return frame


def _check_section(
    top: YamlSection, item: YamlSection, problem: str, key: str, example: str
) -> None:
    if key not in top:
        raise item.error_at(None, f"{problem}, add '{key}: {example}'")


def read_loads(
    top: YamlSection, tree: TreeBuilder, allows_phases: bool = False
) -> tuple[Wrench, ...]:
    """The section `loads` of a machine or of a task, which may have phases."""

    def read_wrench(item: YamlSection) -> Wrench:
        if not allows_phases:
            item.check_keys(LOAD.keys)
        frame = _read_moving_frame(item, tree)
        if "force" not in item and "moment" not in item:
            raise item.error_at(None, f"the load on '{frame}' does nothing, give force or moment")
        values = item.values("frame")
        for key in ("force", "moment"):
            rows = item.rows(key) if key in item else [[0.0, 0.0, 0.0]]
            values[key] = rows[0] if len(rows) == 1 else rows
        return item.create(PhasedWrench if "phases" in item else Wrench, frame, **values)

    return top.read_items("loads", read_wrench)


def _read_soil(section: YamlSection) -> Soil:
    """A soil of the table, or one of other parameters, or one of the table with some others."""
    values = section.values()
    kind = values.pop("kind", None)
    if kind is None:
        for key in ("unit_weight", "cohesion", "friction"):
            values[key] = section.number(key)
        return section.create(Soil, **values)
    return section.create(dataclasses.replace, SOILS[kind], **values)


def external_force_data(forces: tuple[ExternalForce, ...]) -> dict[str, Any]:
    """The sections of external forces.

    Raises:
        InputError: One is a function, or there are several grounds or soils.
    """
    data: dict[str, Any] = {
        "loads": [], "ground": None, "contacts": [], "soil": None, "cutters": []
    }  # fmt: skip
    grounds = {force.ground for force in forces if isinstance(force, Contact | SoilCutting)}
    soils = {force.soil for force in forces if isinstance(force, SoilCutting)}
    if len(grounds) > 1:
        raise InputError("contacts and cutters have several grounds, a machine file has one")
    if len(soils) > 1:
        raise InputError("cutters are in several soils, a machine file has one")
    for soil in soils:
        data["soil"] = dataclasses.asdict(soil)
    for ground in grounds:
        data["ground"] = GROUND.values_of(ground) or {"height": 0.0}
    for force in forces:
        if type(force) not in (Wrench, Contact, SoilCutting):
            raise InputError(
                f"the load '{force.name}' is a {type(force).__name__}, which no file holds: leave "
                "it out, or give a Wrench by time"
            )
        if type(force) is Wrench:
            data["loads"].append(load_data(force))
        if type(force) is Contact:
            data["contacts"].append(
                (
                    CONTACT.values_of(force, "name")
                    | ({key: getattr(force, key) for key in CONTACT_LAW_KEYS})
                )
                | _name_data(force)
            )
        if type(force) is SoilCutting:
            data["cutters"].append(CUTTER.values_of(force, "name") | _name_data(force))
    return data


def load_data(force: Wrench) -> dict[str, Any]:
    """A load as the file has it."""
    data: dict[str, Any] = {"frame": force.frame, "axes": force.axes} | _name_data(force)
    is_time_series = len(force.times) > 1
    for key, part in (("force", force.values[:, :3]), ("moment", force.values[:, 3:])):
        data[key] = part.tolist() if is_time_series else part[0].tolist()
    return data | (
        {("phases" if isinstance(force, PhasedWrench) else "times"): force.times.tolist()}
        if is_time_series
        else {}
    )


def _name_data(force: ExternalForce) -> dict[str, str]:
    return {"name": force.name} if force.name != force.frame else {}
