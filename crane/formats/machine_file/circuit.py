"""The section `hydraulics` of a machine file."""

import itertools
import math
import string
import warnings
from collections.abc import Callable
from dataclasses import MISSING, fields
from typing import Any, TypeVar

from crane.common.errors import CraneWarning, InputError, known
from crane.common.magnitudes import doubt
from crane.description.findings import Anything, FollowUpError, flag, recoverable
from crane.formats.machine_file.curves import read_curve
from crane.formats.machine_file.section import Section
from crane.formats.machine_file.tree_builder import TreeBuilder
from crane.hydraulics.components import (
    HOLDING,
    Counterbalance,
    Cylinder,
    Hydraulics,
    Oil,
    PDGains,
    Spool,
    Valve,
    check_relief,
    check_tank,
)
from crane.hydraulics.connections import drained, joined
from crane.hydraulics.elements import Accumulator, Element, Line
from crane.hydraulics.numbers import PartError, PlacedError, number_names
from crane.hydraulics.sources import MAIN, Engine, Supply

Made = TypeVar("Made")
Part = TypeVar("Part")

_TOGETHER = ("tank", "relief")  # looked at with other parts
_NAME = set(string.ascii_letters + string.digits + "_")
_KINDS = ("orifice", "compensated", "sharing")
_COMPENSATED = ("flow", "margin", "meter_out")  # what only these have
_NODES = {"supplies": "supply", "lines": "line", "accumulators": "accumulator"}
_EDGES = ("c1", "c2", "c3", "c4")
_CURVED = (*_EDGES, "centre")
_BORED = ("bore", "rod", "count")
_REGULATED = ("control", "summed")
MOTOR = {  # keys, and what they are of `Cylinder`
    "displacement": None, "gear": None, "volume": None,
    **{name: name for name in ("leakage", "leakage_a", "leakage_b", "relief", "relief_gain",
                               "cross_relief", "refill", "gas_a", "gas_b", "seal_friction",
                               "brake", "brake_release")},
}  # fmt: skip


def read_hydraulics(top: Section, tree: TreeBuilder, active: tuple[str, ...]) -> Hydraulics | None:
    """The circuit of a machine file, None where it has none.

    Raises:
        DescriptionError: With file, line, and what is wrong.
    """
    section = top.section("hydraulics", "'hydraulics'")
    if section is None:
        return None
    section.only(
        "supply", "supplies", "engine", "oil", "lines", "accumulators", "elements", "cylinders",
        "motors", "valves", "control",
    )  # fmt: skip
    supply = None
    with recoverable():
        supply_section = section.section("supply", "'supply'")
        if supply_section is None:
            raise section.fail(None, "'hydraulics' has no 'supply', give its pressure")
        supply_section.only(*number_names(Supply), *_REGULATED)
        supply = _supply(supply_section)
    oil = Oil()
    with recoverable():
        oil_section = section.section("oil", "'oil'")
        if oil_section is not None:
            oil_section.only(*number_names(Oil))
            oil = part_of(oil_section, Oil)
    if supply is not None and supply_section is not None:
        with recoverable():
            checked(supply_section, check_tank, supply, oil)
            warn_of_unit(supply_section, "tank", supply.tank)
    for key in ("cylinders", "motors"):
        section.spread(key, section.listed(key))
    for key in ("valves", "control"):
        section.spread(key, [*section.listed("cylinders"), *section.listed("motors")])
    driving = section.judged("cylinders") + section.judged("motors")
    gains = section.judged("control")
    named = {"cylinder": driving, "valve": section.judged("valves")}
    cylinders: dict[str, Cylinder] = {}
    keys: tuple[str, ...] = (*number_names(Cylinder), *HOLDING, *_BORED)
    for joint, item in section.mappings("cylinders", "cylinder of", *keys):
        with recoverable():
            check_active(joint, item, active)
            cylinders[joint] = _cylinder(joint, item, tree)
            _check_relief(item, supply, cylinders[joint])
    keys = tuple(MOTOR)
    for joint, item in section.mappings("motors", "motor of", *keys):
        with recoverable():
            check_active(joint, item, active)
            if joint in cylinders:
                raise item.fail(None, f"'{joint}' has a cylinder and a motor, keep one of them")
            cylinders[joint] = _motor(joint, item)
            _check_relief(item, supply, cylinders[joint])
    valves: dict[str, Valve] = {}
    given = (*number_names(Valve), "type", "flow", "meter_out", "supply", "return_a", "return_b",
             "priority", "spool_b")  # fmt: skip
    for joint, item in section.mappings("valves", "valve of", *given):
        with recoverable():
            check_active(joint, item, active)
            valves[joint] = _valve(item, joint)
    driven = (*driving, *named["valve"])
    for joint, what in itertools.product(driven, ("cylinder", "valve")):
        if joint not in named[what]:
            flag(section.fail(f"{what}s", f"'{joint}' has no {what}, add it"))
    control: dict[str, PDGains] = {}
    for joint, item in section.mappings("control", "control of", *number_names(PDGains)):
        with recoverable():
            check_active(joint, item, active)
            control[joint] = part_of(item, PDGains)
    known_all = not isinstance(gains + driving, Anything)
    if known_all and gains and {*gains} != {*driving}:
        listed = ", ".join(driving)
        flag(section.fail("control", f"give gains of all of {listed}, or none"))
    if not driving:
        flag(section.fail(None, "'hydraulics' drives nothing, give cylinders and valves"))
    others = read_network(section)
    lack = control and not cylinders.keys() <= control.keys()
    if supply is None or lack or not cylinders.keys() == valves.keys() <= set(active):
        raise FollowUpError("the circuit is not complete")
    order = [joint for joint in active if joint in cylinders]
    made = checked(
        section,
        Hydraulics,
        supply,
        oil,
        {joint: cylinders[joint] for joint in order},
        {joint: valves[joint] for joint in order},
        {joint: control[joint] for joint in order if control},
        **others,
    )
    _check_connections(section, made)
    return made


def circuit_places(top: Section) -> dict[str, str]:
    """File and line of each pump, line and accumulator, as "supply NAME" and so on."""
    section = top.section("hydraulics", "'hydraulics'")
    if section is None:
        return {}
    found = {f"supply {MAIN}": section.where("supply")}
    for key, kind in _NODES.items():
        outer = section.section(key, f"'{key}'")
        if outer is not None:
            found |= {f"{kind} {name}": outer.where(name) for name in outer}
    return found


def _check_connections(section: Section, hydraulics: Hydraulics) -> None:
    """Note nodes that hang on nothing, and returns from which no oil gets to the tank."""
    together, emptied = joined(hydraulics), drained(hydraulics)
    for key, kind in _NODES.items():
        outer = section.section(key, f"'{key}'")
        for name in outer or ():
            assert outer is not None
            if name in together:
                continue
            how = "'supply' of a valve or 'from'" if key == "supplies" else "'from' or 'to'"
            problem = f"nothing is joined to the {kind} '{name}', name it as {how} of an element"
            flag(outer.fail(name, f"{problem}, or remove it"), harmless=True)
    outer = section.section("lines", "'lines'")
    for name in outer or ():
        assert outer is not None
        given = [joint for joint, valve in hydraulics.valves.items()
                 if name in (valve.return_a, valve.return_b)]  # fmt: skip
        if given and name not in emptied:
            problem = f"what {' and '.join(given)} give into the line '{name}' never gets to the "
            problem += f"tank, add an element from '{name}' to 'tank'"
            flag(outer.fail(name, problem), harmless=True)


def check_active(joint: str, item: Section, active: tuple[str, ...]) -> None:
    """Raise for an item of a joint that is not active.

    Raises:
        DescriptionError: With file and line, and the joints that are.
    """
    if joint not in active:
        raise item.fail(None, f"'{joint}' is not an active joint, {known(active, joint)}")


def _turns(tree: TreeBuilder, joint: str) -> bool:
    return joint in tree.joints and tree.joints[joint].kind == "revolute"


def part_of(section: Section, kind: type[Part], turning: bool = False, /, **given: Any) -> Part:
    """A part whose remaining numbers stand in a section."""
    numbers: Any = fields(kind)  # type: ignore[arg-type]
    own = [x for x in numbers if x.name in number_names(kind) and x.name not in given]
    for entry in own:
        least = -math.inf if entry.metadata.get("signed") else 0.0
        if entry.default is MISSING:
            given[entry.name] = section.number(entry.name, minimum=least)
        else:
            given[entry.name] = section.number(entry.name, float(entry.default), minimum=least)
    part = checked(section, kind, **given)
    for entry in own:
        if entry.name in section and entry.name not in _TOGETHER:
            warn_of_unit(section, entry.name, given[entry.name], turning, kind.__name__.lower())
    return part


def checked(section: Section, make: Callable[..., Made], *items: object, **given: Any) -> Made:
    """What is made of a section's numbers, or its error with file and line."""
    try:
        return make(*items, **given)
    except PartError as error:
        raise section.fail(error.key, str(error)) from None
    except PlacedError as error:
        *path, key = error.path
        for name in path:
            section = section.section(name, name) or section
        raise section.fail(key, str(error)) from None
    except InputError as error:
        raise section.fail(None, str(error)) from None


def warn_of_unit(
    section: Section, key: str, value: float, turning: bool = False, kind: str = ""
) -> None:
    """Warn of a number that can be, and hardly is in its SI unit."""
    if text := doubt(key, value, turning, kind):
        what = f"{section.where(key)}: '{key}' of {section.title} {text}"
        warnings.warn(what, CraneWarning, stacklevel=2)


def _check_relief(section: Section, supply: Supply | None, cylinder: Cylinder) -> None:
    """A cylinder's relief beside the supply, which may have been refused."""
    if supply is None:
        return
    checked(section, check_relief, supply, cylinder)
    warn_of_unit(section, "relief", cylinder.relief)
    if 0 < cylinder.relief <= supply.pressure and not doubt("relief", cylinder.relief):
        what = (
            f"{section.where('relief')}: 'relief' of {section.title} is {cylinder.relief:g} Pa, "
            f"not above the supply's {supply.pressure:g} Pa: what the pump gives flows off there "
            "before it can press, give a higher one"
        )
        warnings.warn(what, CraneWarning, stacklevel=2)


def _cylinder(joint: str, item: Section, tree: TreeBuilder) -> Cylinder:
    if lack := tree.unlimited(joint):
        problem = f"joint '{joint}' {lack}, a cylinder needs the limits of its stroke"
        flag(item.fail(None, problem))
    turning = _turns(tree, joint)
    return part_of(item, Cylinder, turning, joint=joint, **_areas(item, turning), **_holding(item))


def _areas(item: Section, turning: bool) -> dict[str, Any]:
    """How many cylinders there are side by side, and their areas if bore and rod are given."""
    count = item.number("count", 1.0)
    if not count.is_integer() or count < 1:
        raise item.fail("count", f"'count' of {item.title} is {count:g}, give a whole number")
    if turning:
        for key in (*_BORED, "tube"):
            if key in item and (key != "tube" or item.number(key)):
                raise item.fail(
                    key, f"{item.title} turns its joint, give area_a and area_b [m3/rad]"
                )
    given = {"count": int(count)}
    if "bore" not in item:
        if "rod" in item:
            raise item.fail("rod", f"'rod' of {item.title} goes with 'bore', give it")
        return given
    bore, rod = item.number("bore"), item.number("rod", 0.0, minimum=0.0)
    if not bore > rod:
        raise item.fail("bore", f"'bore' of {item.title} is {bore:g} m, give more than the rod")
    for key in ("area_a", "area_b"):
        if key in item:
            raise item.fail(key, f"'{key}' stands beside 'bore', keep one of them")
    for key, value in (("bore", bore), ("rod", rod)):
        warn_of_unit(item, key, value)
    area = count * math.pi / 4.0
    return given | {"area_a": area * bore**2, "area_b": area * (bore**2 - rod**2)}


def _holding(item: Section) -> dict[str, Counterbalance]:
    found = {}
    for name in HOLDING:
        section = item.section(name, f"'{name}'")
        if section is not None:
            section.only(*number_names(Counterbalance))
            found[name] = part_of(section, Counterbalance)
    return found


def _supply(section: Section) -> Supply:
    given: dict[str, Any] = {"control": section.text("control", "pressure")}
    if "summed" in section:
        given["summed"] = section.names("summed")
    supply = part_of(section, Supply, **given)
    if "relief" in section:
        warn_of_unit(section, "relief", supply.relief)
    return supply


def _motor(joint: str, item: Section) -> Cylinder:
    """A motor by its displacement [m3/rad]; its joint turns slower by the gear."""
    displacement = item.number("displacement", minimum=0.0)
    gear = item.number("gear", 1.0, minimum=0.0)
    volume = item.number("volume", minimum=0.0)
    for key, value in (("displacement", displacement), ("gear", gear), ("volume", volume)):
        if value == 0:
            raise item.fail(key, f"'{key}' of {item.title} is 0, give it")
        warn_of_unit(item, key, value, kind="motor")
    given: dict[str, Any] = dict.fromkeys(("area_a", "area_b"), displacement * gear)
    given |= dict.fromkeys(("hose_a", "hose_b"), volume)
    return part_of(item, Cylinder, joint=joint, motor=True, **given)


def read_network(section: Section) -> dict[str, Any]:
    """What a circuit has beside first pump, cylinders and valves, by fields of `Hydraulics`."""
    found: dict[str, Any] = {}
    for key, title, kind in (
        ("supplies", "supply", Supply), ("lines", "line", Line),
        ("accumulators", "accumulator", Accumulator), ("elements", "element", Element),
    ):  # fmt: skip
        parts: dict[str, Any] = {}
        more = {Supply: _REGULATED, Element: ("type", "from", "to", "joints", "side")}
        keys = [name for name in number_names(kind) if (kind, name) != (Supply, "tank")]
        for name, item in section.mappings(key, title, *keys, *more.get(kind, ())):
            with recoverable():
                if not name or not set(name) <= _NAME:
                    raise item.fail(None, f"a {title} is called '{name}', use letters, digits, _")
                parts[name] = (
                    _element(item)
                    if kind is Element
                    else (_supply(item) if kind is Supply else part_of(item, kind))
                )
        found[key] = parts
    engine = section.section("engine", "'engine'")
    if engine is not None:
        with recoverable():
            engine.only(*number_names(Engine))
            found["engine"] = part_of(engine, Engine)
    return found


def _element(item: Section) -> Element:
    given: dict[str, Any] = {
        "kind": item.text("type"), "source": item.text("from"), "target": item.text("to"),
        "side": item.text("side", "both"),
    }  # fmt: skip
    if "joints" in item:
        given["joints"] = item.names("joints")
    return part_of(item, Element, **given)


def _valve(item: Section, joint: str) -> Valve:
    kind = item.text("type")
    if kind not in _KINDS:
        raise item.fail("type", f"valve type '{kind}' is unknown, {known(_KINDS, kind)}")
    for name in _COMPENSATED:
        if kind != "compensated" and name in item:
            raise item.fail(name, f"'{name}' is for valves of type 'compensated', remove it")
    given: dict[str, Any] = {
        key: item.text(key) for key in ("supply", "return_a", "return_b") if key in item
    }
    if "priority" in item:
        given["priority"] = item.raw("priority")
        if not isinstance(given["priority"], bool):
            raise item.fail("priority", f"'priority' of {item.title} is neither yes nor no")
    curves = {}
    for name in _CURVED:
        if name in item and (found := read_curve(item, name)) is not None:
            given[name], curves[name] = found
    given["curves"] = curves
    if (second := item.section("spool_b", f"'spool_b' of {item.title}")) is not None:
        second.only(*number_names(Spool))
        given["spool_b"] = _spool(second, item, joint)
    if kind != "compensated":
        return part_of(item, Valve, joint=joint, sharing=kind == "sharing", **given)
    margin = item.number("margin", minimum=0.0)
    if margin == 0:
        raise item.fail("margin", "'margin' is 0, give the pressure drop that is kept")
    edges = [name for name in _EDGES if name in item]
    if edges:
        for name in ("flow", "meter_out"):
            if name in item:
                raise item.fail(name, f"'{name}' stands beside '{edges[0]}', keep one of them")
        return part_of(item, Valve, joint=joint, **given)
    flow = item.number("flow", minimum=0.0)
    if flow == 0:
        raise item.fail("flow", "'flow' is 0, give the flow at full stroke")
    inlet = flow / math.sqrt(margin)
    outlet = item.number("meter_out", inlet, minimum=0.0)
    warn_of_unit(item, "flow", flow)
    if "meter_out" in item:
        warn_of_unit(item, "meter_out", outlet)
    given |= {"c1": inlet, "c2": outlet, "c3": outlet, "c4": inlet}
    return part_of(item, Valve, joint=joint, **given)


def _spool(section: Section, valve: Section, joint: str) -> Spool:
    """A second spool, which is moved as the first one where it does not say how itself."""
    numbers, usual = {}, Spool(joint)
    for entry in fields(Spool):
        if entry.name != "joint":
            of = section if entry.name in section else valve
            least = -math.inf if entry.metadata.get("signed") else 0.0
            numbers[entry.name] = of.number(entry.name, getattr(usual, entry.name), minimum=least)
    spool = checked(section, Spool, joint, **numbers)
    for name in number_names(Spool):
        if name in section:
            warn_of_unit(section, name, numbers[name], kind="spool")
    return spool
