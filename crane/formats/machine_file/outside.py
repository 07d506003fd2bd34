"""The sections of a machine file on what acts from outside: loads, ground, contacts, soil."""

import dataclasses
from collections.abc import Iterator
from typing import Any

from crane.common.errors import InputError, known
from crane.description.external import ExternalForce, PhasedWrench, Wrench
from crane.description.findings import recoverable
from crane.description.ground import DAMPING, FRICTION, SMOOTHING, STIFFNESS, Contact, Ground
from crane.description.soil import SOILS, Cutting, Soil
from crane.formats.machine_file.section import Section
from crane.formats.machine_file.tree_builder import TreeBuilder

_SURFACE = ("height", "normal", "profile")
_LAW = {"stiffness": STIFFNESS, "damping": DAMPING, "friction": FRICTION, "smoothing": SMOOTHING}
_OWN = ("radius", "area", "lateral_stiffness", "lateral_damping")
_SOIL = tuple(field.name for field in dataclasses.fields(Soil))
_BLADE = ("width", "length", "thickness", "smoothing")


def read_outside(top: Section, tree: TreeBuilder) -> tuple[Wrench | Contact | Cutting, ...]:
    """Forces from outside."""
    section = top.section("ground", "'ground'")
    ground, usual = None, _LAW
    if section is not None:
        with recoverable():
            ground, usual = _ground(section)
    return (
        *read_loads(top, tree),
        *_contacts(top, tree, ground, usual),
        *_cutters(top, tree, ground),
    )


def _frame(item: Section, tree: TreeBuilder) -> str:
    frame = item.text("frame")
    tree.check_link(frame, item.where("frame"), "the frame")
    if not tree.moves(frame):
        problem = f"'{frame}' does not move, a load on it does nothing"
        raise tree.unknown(str(item.fail("frame", problem)))
    return frame


def read_loads(top: Section, tree: TreeBuilder, phased: bool = False) -> Iterator[Wrench]:
    """The section `loads` of a machine or of a task, which may have phases."""
    clocks = ("times", *["phases"] * phased)
    for item in top.sections("loads", "load of", "frame", "force", "moment", *clocks, "axes",
                             "name"):  # fmt: skip
        with recoverable():
            yield _wrench(item, _frame(item, tree))


def _wrench(item: Section, frame: str) -> Wrench:
    if "force" not in item and "moment" not in item:
        raise item.fail(None, f"the load on '{frame}' does nothing, give force or moment")
    rows = (item.rows(key, (0.0, 0.0, 0.0)) for key in ("force", "moment"))
    force, moment = (part[0] if len(part) == 1 else part for part in rows)
    if "times" in item and "phases" in item:
        raise item.fail("phases", f"the load on '{frame}' has times and phases, give one of both")
    clock = next((key for key in ("times", "phases") if key in item), None)
    kind = PhasedWrench if clock == "phases" else Wrench
    axes, name = item.text("axes", "world"), item.text("name", "")
    try:
        return kind(frame, force, moment, clock and item.numbers(clock), axes, name)
    except InputError as error:
        raise item.fail(None, str(error)) from None


def _contacts(
    top: Section, tree: TreeBuilder, ground: Ground | None, usual: dict[str, float]
) -> Iterator[Contact]:
    for item in top.sections("contacts", "contact of", "frame", "name", *_OWN, *_LAW):
        with recoverable():
            frame = _frame(item, tree)
            if "ground" not in top:
                raise item.fail(None, "contacts without a ground, add 'ground: {height: 0}'")
            numbers = {key: item.number(key, value) for key, value in usual.items()}
            numbers |= {key: item.number(key, 0.0) for key in _OWN}
            try:
                yield Contact(frame, ground, **numbers, name=item.text("name", ""))
            except InputError as error:
                raise item.fail(None, str(error)) from None


def _cutters(top: Section, tree: TreeBuilder, ground: Ground | None) -> Iterator[Cutting]:
    section = top.section("soil", "'soil'")
    soil = None
    if section is not None:
        with recoverable():
            soil = _soil(section)
    keys = ("frame", "blade", "cutting", "name", *_BLADE)
    for item in top.sections("cutters", "cutter of", *keys):
        with recoverable():
            frame = _frame(item, tree)
            for key, hint in (("ground", "{height: 0}"), ("soil", "{kind: sandy loam}")):
                if key not in top:
                    raise item.fail(None, f"cutters without {key}, add '{key}: {hint}'")
            if soil is None:  # told above
                continue
            width, length = item.number("width"), item.number("length")
            blade, cutting = item.numbers("blade"), item.numbers("cutting")
            thickness, smoothing = (
                item.number("thickness", 0.0),
                item.number("smoothing", SMOOTHING),
            )
            try:
                yield Cutting(
                    frame, soil, width, length, blade, cutting, ground, thickness, smoothing,
                    item.text("name", ""),
                )  # fmt: skip
            except InputError as error:
                raise item.fail(None, str(error)) from None


def _soil(section: Section) -> Soil:
    """A soil of the table, or numbers, or one with other numbers."""
    section.only("kind", *_SOIL)
    usual: dict[str, float] = {}
    if "kind" in section:
        kind = section.text("kind")
        if kind not in SOILS:
            raise section.fail("kind", f"unknown soil '{kind}', {known(SOILS, kind)}")
        usual = dataclasses.asdict(SOILS[kind])
    else:
        usual = dict.fromkeys(("tool_friction", "adhesion", "surcharge"), 0.0)
    numbers = {
        key: section.number(key, usual[key]) if key in usual else section.number(key)
        for key in _SOIL
    }
    try:
        return Soil(**numbers)
    except InputError as error:
        raise section.fail(None, str(error)) from None


def _ground(section: Section) -> tuple[Ground, dict[str, float]]:
    """The surface, and its law."""
    section.only(*_SURFACE, *_LAW)
    law = {key: section.number(key, value) for key, value in _LAW.items()}
    data: dict[str, Any] = {}
    if "height" in section:
        data["height"] = section.number("height")
    if "normal" in section:
        data["normal"] = section.numbers("normal")
    if "profile" in section:
        data["profile"] = tuple(map(tuple, section.rows("profile")))
    try:
        return Ground(**data), law
    except InputError as error:
        raise section.fail(None, str(error)) from None


def outside_data(forces: tuple[ExternalForce, ...]) -> dict[str, Any]:
    """The sections of forces from outside.

    Raises:
        InputError: One is a program, not numbers, or there are several grounds or soils.
    """
    data: dict[str, Any] = {
        "loads": [], "ground": None, "contacts": [], "soil": None, "cutters": []
    }  # fmt: skip
    grounds = {force.ground for force in forces if isinstance(force, Contact | Cutting)}
    soils = {force.soil for force in forces if isinstance(force, Cutting)}
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
            item |= {key: getattr(force, key) for key in (*_LAW, *_OWN)}
            data["contacts"].append(item | _named(force))
        elif type(force) is Cutting:
            item = {"frame": force.frame, "blade": force.blade, "cutting": force.cutting}
            item |= {key: getattr(force, key) for key in _BLADE}
            data["cutters"].append(item | _named(force))
        else:
            raise InputError(
                f"the load '{force.name}' is a {type(force).__name__}, which no file holds: leave "
                "it out, or give a Wrench by time"
            )
    return data


def load_data(force: Wrench) -> dict[str, Any]:
    """A load as the file has it."""
    data: dict[str, Any] = {"frame": force.frame, "axes": force.axes} | _named(force)
    several = len(force.times) > 1
    for key, part in (("force", force.values[:, :3]), ("moment", force.values[:, 3:])):
        data[key] = part.tolist() if several else part[0].tolist()
    clock = "phases" if isinstance(force, PhasedWrench) else "times"
    return data | ({clock: force.times.tolist()} if several else {})


def _named(force: ExternalForce) -> dict[str, str]:
    return {"name": force.name} if force.name != force.frame else {}
