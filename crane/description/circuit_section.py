"""The section `hydraulics` of a machine file."""

import math
from dataclasses import MISSING, fields
from typing import Any, TypeVar

from crane.description.findings import FollowUpError, kept, note
from crane.description.hydraulics import (
    Counterbalance,
    Cylinder,
    Hydraulics,
    Oil,
    PDGains,
    Supply,
    Valve,
)
from crane.description.section import Section
from crane.description.tree_builder import TreeBuilder
from crane.errors import InputError, known

Part = TypeVar("Part", Oil, Supply, Counterbalance, Cylinder, Valve, PDGains)

_NOT_NUMBERS = ("joint", "counterbalance_a", "counterbalance_b")
_KINDS = ("orifice", "compensated")


def numbers_of(kind: type) -> list[str]:
    """Names of a part's numbers."""
    return [entry.name for entry in fields(kind) if entry.name not in _NOT_NUMBERS]


def read_hydraulics(top: Section, tree: TreeBuilder, active: tuple[str, ...]) -> Hydraulics | None:
    """The circuit of a machine file, None where it has none.

    Raises:
        DescriptionError: With file, line, and what is wrong.
    """
    section = top.section("hydraulics", "'hydraulics'")
    if section is None:
        return None
    section.only("supply", "oil", "cylinders", "valves", "control")
    supply = None
    with kept():
        supply_section = section.section("supply", "'supply'")
        if supply_section is None:
            raise section.fail(None, "'hydraulics' has no 'supply', give its pressure")
        supply_section.only(*numbers_of(Supply))
        supply = _part(supply_section, Supply)
    oil = Oil()
    with kept():
        oil_section = section.section("oil", "'oil'")
        if oil_section is not None:
            oil_section.only(*numbers_of(Oil))
            oil = _part(oil_section, Oil)
    named: dict[str, list[str]] = {"cylinder": [], "valve": [], "control": []}
    cylinders: dict[str, Cylinder] = {}
    holding = ("counterbalance_a", "counterbalance_b")
    keys = (*numbers_of(Cylinder), *holding)
    for joint, item in section.mappings("cylinders", "cylinder of", *keys):
        named["cylinder"].append(joint)
        with kept():
            _check_joint(joint, item, active)
            if lack := tree.unlimited(joint):
                problem = f"joint '{joint}' {lack}, a cylinder needs the limits of its stroke"
                note(item.fail(None, problem))
            cylinders[joint] = _part(item, Cylinder, joint=joint, **_holding(item, holding))
    valves: dict[str, Valve] = {}
    given = (*numbers_of(Valve), "type", "flow", "meter_out")
    for joint, item in section.mappings("valves", "valve of", *given):
        named["valve"].append(joint)
        with kept():
            _check_joint(joint, item, active)
            valves[joint] = _valve(item, joint)
    for joint in (*named["cylinder"], *named["valve"]):
        for what in ("cylinder", "valve"):
            if joint not in named[what]:
                note(section.fail(f"{what}s", f"'{joint}' has no {what}, add it"))
    control: dict[str, PDGains] = {}
    for joint, item in section.mappings("control", "control of", *numbers_of(PDGains)):
        named["control"].append(joint)
        with kept():
            _check_joint(joint, item, active)
            control[joint] = _part(item, PDGains)
    if named["control"] and set(named["control"]) != set(named["cylinder"]):
        listed = ", ".join(named["cylinder"])
        note(section.fail("control", f"give gains of all of {listed}, or none"))
    if not named["cylinder"]:
        note(section.fail(None, "'hydraulics' drives nothing, give cylinders and valves"))
    if supply is None or not cylinders.keys() == valves.keys() <= set(active):
        raise FollowUpError("the circuit is not complete")
    order = [joint for joint in active if joint in cylinders]
    return Hydraulics(
        supply,
        oil,
        {joint: cylinders[joint] for joint in order},
        {joint: valves[joint] for joint in order},
        {joint: control[joint] for joint in order if control},
    )


def _check_joint(joint: str, item: Section, active: tuple[str, ...]) -> None:
    if joint not in active:
        raise item.fail(None, f"'{joint}' is not an active joint, {known(active, joint)}")


def _part(section: Section, kind: type[Part], **given: Any) -> Part:
    """A part whose remaining numbers stand in a section."""
    for entry in fields(kind):
        if entry.name in _NOT_NUMBERS or entry.name in given:
            continue
        least = -math.inf if entry.metadata.get("signed") else 0.0
        if entry.default is MISSING:
            given[entry.name] = section.number(entry.name, minimum=least)
        else:
            given[entry.name] = section.number(entry.name, float(entry.default), minimum=least)
    try:
        return kind(**given)
    except InputError as error:
        raise section.fail(None, str(error)) from None


def _holding(item: Section, names: tuple[str, ...]) -> dict[str, Counterbalance]:
    found = {}
    for name in names:
        section = item.section(name, f"'{name}'")
        if section is not None:
            section.only(*numbers_of(Counterbalance))
            found[name] = _part(section, Counterbalance)
    return found


def _valve(item: Section, joint: str) -> Valve:
    kind = item.text("type")
    if kind not in _KINDS:
        raise item.fail("type", f"valve type '{kind}' is unknown, {known(_KINDS, kind)}")
    own = {"orifice": ("c1", "c2", "c3", "c4"), "compensated": ("flow", "margin", "meter_out")}
    for other, names in own.items():
        for name in names:
            if other != kind and name in item:
                raise item.fail(name, f"'{name}' is for valves of type '{other}', remove it")
    if kind == "orifice":
        return _part(item, Valve, joint=joint)
    flow, margin = item.number("flow", minimum=0.0), item.number("margin", minimum=0.0)
    if margin == 0:
        raise item.fail("margin", "'margin' is 0, give the pressure drop that is kept")
    inlet = flow / math.sqrt(margin)
    outlet = item.number("meter_out", inlet, minimum=0.0)
    return _part(item, Valve, joint=joint, c1=inlet, c2=outlet, c3=outlet, c4=inlet)
