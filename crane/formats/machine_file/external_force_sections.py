"""The sections of a machine file on what acts from outside: loads, ground, contacts, soil."""

import dataclasses
from collections.abc import Iterator
from typing import Any

from crane.common.errors import InputError, suggest_names
from crane.description.external_forces import ExternalForce, PhasedWrench, Wrench
from crane.description.findings import error_recovery
from crane.description.ground_contact import (
    DEFAULT_DAMPING,
    DEFAULT_FRICTION,
    DEFAULT_SMOOTHING,
    DEFAULT_STIFFNESS,
    Contact,
    Ground,
)
from crane.description.soil_cutting import SOILS, Soil, SoilCutting
from crane.formats.machine_file.tree_builder import TreeBuilder
from crane.formats.machine_file.yaml_section import YamlSection

_SURFACE_KEYS = ("height", "normal", "profile")
_CONTACT_DEFAULTS = {
    "stiffness": DEFAULT_STIFFNESS,
    "damping": DEFAULT_DAMPING,
    "friction": DEFAULT_FRICTION,
    "smoothing": DEFAULT_SMOOTHING,
}
_OPTIONAL_CONTACT_KEYS = ("radius", "area", "lateral_stiffness", "lateral_damping")
_SOIL_KEYS = tuple(field.name for field in dataclasses.fields(Soil))
_BLADE_KEYS = ("width", "length", "thickness", "smoothing")


def read_external_forces(
    top: YamlSection, tree: TreeBuilder
) -> tuple[Wrench | Contact | SoilCutting, ...]:
    """Forces from outside."""
    section = top.section("ground", "'ground'")
    ground, contact_defaults = None, _CONTACT_DEFAULTS
    if section is not None:
        with error_recovery():
            ground, contact_defaults = _read_ground(section)
    return (
        *read_loads(top, tree),
        *_read_contacts(top, tree, ground, contact_defaults),
        *_read_cutters(top, tree, ground),
    )


def _read_moving_frame(item: YamlSection, tree: TreeBuilder) -> str:
    frame = item.text("frame")
    tree.check_link(frame, item.source_location("frame"), "the frame")
    if not tree.is_movable(frame):
        problem = f"'{frame}' does not move, a load on it does nothing"
        raise tree.unknown_name_error(str(item.error_at("frame", problem)))
    return frame


def read_loads(
    top: YamlSection, tree: TreeBuilder, allows_phases: bool = False
) -> Iterator[Wrench]:
    """The section `loads` of a machine or of a task, which may have phases."""
    time_keys = ("times", *["phases"] * allows_phases)
    for item in top.sections("loads", "load of", "frame", "force", "moment", *time_keys, "axes",
                             "name"):  # fmt: skip
        with error_recovery():
            yield _read_wrench(item, _read_moving_frame(item, tree))


def _read_wrench(item: YamlSection, frame: str) -> Wrench:
    if "force" not in item and "moment" not in item:
        raise item.error_at(None, f"the load on '{frame}' does nothing, give force or moment")
    rows = (item.rows(key, (0.0, 0.0, 0.0)) for key in ("force", "moment"))
    force, moment = (part[0] if len(part) == 1 else part for part in rows)
    if "times" in item and "phases" in item:
        raise item.error_at(
            "phases", f"the load on '{frame}' has times and phases, give one of both"
        )
    time_key = next((key for key in ("times", "phases") if key in item), None)
    kind = PhasedWrench if time_key == "phases" else Wrench
    axes, name = item.text("axes", "world"), item.text("name", "")
    try:
        return kind(frame, force, moment, time_key and item.numbers(time_key), axes, name)
    except InputError as error:
        raise item.error_at(None, str(error)) from None


def _read_contacts(
    top: YamlSection, tree: TreeBuilder, ground: Ground | None, contact_defaults: dict[str, float]
) -> Iterator[Contact]:
    for item in top.sections(
        "contacts", "contact of", "frame", "name", *_OPTIONAL_CONTACT_KEYS, *_CONTACT_DEFAULTS
    ):
        with error_recovery():
            frame = _read_moving_frame(item, tree)
            if "ground" not in top:
                raise item.error_at(None, "contacts without a ground, add 'ground: {height: 0}'")
            numbers = {key: item.number(key, value) for key, value in contact_defaults.items()}
            numbers |= {key: item.number(key, 0.0) for key in _OPTIONAL_CONTACT_KEYS}
            try:
                yield Contact(frame, ground, **numbers, name=item.text("name", ""))
            except InputError as error:
                raise item.error_at(None, str(error)) from None


def _read_cutters(
    top: YamlSection, tree: TreeBuilder, ground: Ground | None
) -> Iterator[SoilCutting]:
    section = top.section("soil", "'soil'")
    soil = None
    if section is not None:
        with error_recovery():
            soil = _read_soil(section)
    keys = ("frame", "blade", "cutting", "name", *_BLADE_KEYS)
    for item in top.sections("cutters", "cutter of", *keys):
        with error_recovery():
            frame = _read_moving_frame(item, tree)
            for key, hint in (("ground", "{height: 0}"), ("soil", "{kind: sandy loam}")):
                if key not in top:
                    raise item.error_at(None, f"cutters without {key}, add '{key}: {hint}'")
            if soil is None:  # told above
                continue
            width, length = item.number("width"), item.number("length")
            blade, cutting = item.numbers("blade"), item.numbers("cutting")
            thickness, smoothing = (
                item.number("thickness", 0.0),
                item.number("smoothing", DEFAULT_SMOOTHING),
            )
            try:
                yield SoilCutting(
                    frame, soil, width, length, blade, cutting, ground, thickness, smoothing,
                    item.text("name", ""),
                )  # fmt: skip
            except InputError as error:
                raise item.error_at(None, str(error)) from None


def _read_soil(section: YamlSection) -> Soil:
    """A soil of the table, or numbers, or one with other numbers."""
    section.check_keys("kind", *_SOIL_KEYS)
    defaults: dict[str, float] = {}
    if "kind" in section:
        kind = section.text("kind")
        if kind not in SOILS:
            raise section.error_at("kind", f"unknown soil '{kind}', {suggest_names(SOILS, kind)}")
        defaults = dataclasses.asdict(SOILS[kind])
    else:
        defaults = dict.fromkeys(("tool_friction", "adhesion", "surcharge"), 0.0)
    numbers = {
        key: section.number(key, defaults[key]) if key in defaults else section.number(key)
        for key in _SOIL_KEYS
    }
    try:
        return Soil(**numbers)
    except InputError as error:
        raise section.error_at(None, str(error)) from None


def _read_ground(section: YamlSection) -> tuple[Ground, dict[str, float]]:
    """The surface, and its law."""
    section.check_keys(*_SURFACE_KEYS, *_CONTACT_DEFAULTS)
    contact_defaults = {
        key: section.number(key, value) for key, value in _CONTACT_DEFAULTS.items()
    }
    data: dict[str, Any] = {}
    if "height" in section:
        data["height"] = section.number("height")
    if "normal" in section:
        data["normal"] = section.numbers("normal")
    if "profile" in section:
        data["profile"] = tuple(map(tuple, section.rows("profile")))
    try:
        return Ground(**data), contact_defaults
    except InputError as error:
        raise section.error_at(None, str(error)) from None


def external_force_data(forces: tuple[ExternalForce, ...]) -> dict[str, Any]:
    """The sections of forces from outside.

    Raises:
        InputError: One is a program, not numbers, or there are several grounds or soils.
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
        data["ground"] = {"height": ground.height} | {
            key: [list(x) for x in value] if key == "profile" else list(value)
            for key, value in dataclasses.asdict(ground).items()
            if key != "height" and value
        }
    for force in forces:
        if type(force) is Wrench:
            data["loads"].append(load_data(force))
        elif type(force) is Contact:
            item: dict[str, Any] = {"frame": force.frame}
            item |= {
                key: getattr(force, key) for key in (*_CONTACT_DEFAULTS, *_OPTIONAL_CONTACT_KEYS)
            }
            data["contacts"].append(item | _name_data(force))
        elif type(force) is SoilCutting:
            item = {"frame": force.frame, "blade": force.blade, "cutting": force.cutting}
            item |= {key: getattr(force, key) for key in _BLADE_KEYS}
            data["cutters"].append(item | _name_data(force))
        else:
            raise InputError(
                f"the load '{force.name}' is a {type(force).__name__}, which no file holds: leave "
                "it out, or give a Wrench by time"
            )
    return data


def load_data(force: Wrench) -> dict[str, Any]:
    """A load as the file has it."""
    data: dict[str, Any] = {"frame": force.frame, "axes": force.axes} | _name_data(force)
    is_time_series = len(force.times) > 1
    for key, part in (("force", force.values[:, :3]), ("moment", force.values[:, 3:])):
        data[key] = part.tolist() if is_time_series else part[0].tolist()
    time_key = "phases" if isinstance(force, PhasedWrench) else "times"
    return data | ({time_key: force.times.tolist()} if is_time_series else {})


def _name_data(force: ExternalForce) -> dict[str, str]:
    return {"name": force.name} if force.name != force.frame else {}
