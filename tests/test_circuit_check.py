"""`crane check` on circuits: unconnected ports, return lines, regulators, units."""

import re
from dataclasses import fields

import pytest
import yaml
from command_line import typed
from hydraulic_rig import COMPENSATED, ORIFICE, rig
from warned import without_a_word

import crane
from crane.common.errors import DescriptionError
from crane.common.plausible_ranges import (
    PLAUSIBLE_RANGES,
    RANGES_BY_COMPONENT,
    implausible_value_text,
    plausible_range,
)
from crane.description.circuit_schema import MOTOR
from crane.formats import check
from crane.hydraulics.circuit_elements import (
    Accumulator,
    CircuitElement,
    CircuitLine,
    Engine,
    Supply,
    parameter_names,
)
from crane.hydraulics.components import CounterbalanceValve, Cylinder, Valve
from crane.hydraulics.hydraulic_circuit import (
    Oil,
    connected_nodes,
    nodes_draining_to_tank,
    nodes_fed_by_pumps,
)

SENSING = {"control": "load-sensing", "flow": 3e-3, "pressure": 2.8e7, "margin": 2e6}
SECOND = {"pressure": 2e7, "flow": 2e-3}
GAS = {"volume": 2.5e-3, "precharge": 8e6}
RETURN = {"type": "check", "from": "back", "to": "tank", "coefficient": 1e-6, "pressure": 2e5}


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    """A machine file with a circuit of one joint, as plain data, and its folder."""
    folder = tmp_path_factory.mktemp("base")
    rig(folder)
    return folder, yaml.safe_load((folder / "rig.yaml").read_text())


def written(base, **changed):
    """The file with sections of its circuit put over the given ones."""
    folder, data = base
    circuit = {**data["hydraulics"], **changed}
    path = folder / "changed.yaml"
    path.write_text(yaml.dump({**data, "hydraulics": circuit}, sort_keys=False))
    return path


def findings(base, **changed):
    return list(check(written(base, **changed)).findings)


def line_of(base, text):
    """Number of the only line that has a text behind blanks."""
    lines = (base[0] / "changed.yaml").read_text().splitlines()
    (found,) = [i for i, line in enumerate(lines, 1) if line.strip() == text]
    return found


def valve(**more):
    return {"valves": {"x": ORIFICE | more}}


ERRORS = [
    ({"lines": {"back": {"volume": 1e-3}}}, "back:",
     "nothing is joined to the line 'back', name it as 'from' or 'to' of an element"),
    ({"accumulators": {"store": GAS}}, "store:", "nothing is joined to the accumulator 'store'"),
    ({"supplies": {"second": SECOND}}, "second:",
     "nothing is joined to the supply 'second', name it as 'supply' of a valve or 'from' of"),
    ({"lines": {"back": {"volume": 1e-3}}, **valve(return_b="back")}, "back:",
     "what x give into the line 'back' never gets to the tank, add an element from 'back' to"),
    # the other way round: it lets nothing out
    ({"lines": {"back": {"volume": 1e-3}}, **valve(return_b="back"),
      "elements": {"in": RETURN | {"from": "tank", "to": "back"}}}, "back:",
     "what x give into the line 'back' never gets to the tank"),
]  # fmt: skip


@pytest.mark.parametrize(("circuit", "where", "line"), ERRORS)
def test_loose_ends_are_errors(base, circuit, where, line):
    (finding,) = findings(base, **circuit)
    assert finding.is_error and finding.message.startswith(line)
    assert (finding.file, finding.line) == ("changed.yaml", line_of(base, where))
    with pytest.raises(DescriptionError) as refused:
        crane.load(base[0] / "changed.yaml")
    assert str(refused.value) == f"changed.yaml:{finding.line}: {finding.message}"


WARNINGS = [
    ({"accumulators": {"store": GAS},
      "elements": {"charge": {"type": "check", "from": "supply", "to": "store",
                              "coefficient": 1e-6}}}, "store:",
     "what gets into the accumulator 'store' never leaves it, add an orifice or a relief"),
    ({"lines": {"dead": {"volume": 1e-3}},
      "elements": {"in": {"type": "check", "from": "x.a", "to": "dead", "coefficient": 1e-6}}},
     "dead:", "what gets into the line 'dead' never leaves it"),
    ({"lines": {"sump": {"volume": 1e-3}},
      "elements": {"in": {"type": "check", "from": "tank", "to": "sump", "coefficient": 1e-6}}},
     "sump:", "no pump feeds the line 'sump', only a check valve from the tank feeds it"),
    ({"lines": {"out": {"volume": 1e-3}},
      "elements": {"in": {"type": "relief", "from": "out", "to": "tank", "gain": 1e-9}}},
     "out:", "no pump feeds the line 'out', add an element that leads into it"),
    ({"supplies": {"second": SECOND}, "lines": {"pilot": {"volume": 1e-3}},
      "elements": {"in": {"type": "check", "from": "second", "to": "pilot",
                          "coefficient": 1e-6}}}, "second:",
     "no way leads from 'second' to the tank, it only fills what it feeds"),
    ({"supplies": {"second": SECOND}, **valve(supply="second")}, "supply:",
     "nothing is joined to 'supply', let it feed a valve"),
    ({"supplies": {"second": SECOND}, "supply": SENSING, **valve(supply="second"),
      "elements": {"rest": {"type": "orifice", "from": "supply", "to": "tank",
                            "coefficient": 1e-6}}}, "supply:",
     "'supply' senses the load of its valves and has none, so that it stays at its standby"),
    ({"supply": {"control": "negative", "flow": 3e-3, "pressure": 2.8e7, "signal": 3e6,
                 "throttle": 1e-6, "relief": 3.2e7}}, "supply:",
     "'supply' senses the flow through open centres and no valve of it has one"),
    ({"supplies": {"second": SECOND | {"control": "positive", "relief": 2.5e7}},
      "elements": {"rest": {"type": "orifice", "from": "second", "to": "tank",
                            "coefficient": 1e-6}}}, "second:",
     "'second' gives what its valves ask for and has none, so that it gives nothing"),
    ({"supply": SENSING | {"relief": 2e7}}, "supply:",
     "relief of 'supply' is 2e+07 Pa, not above its pressure of 2.8e+07 Pa"),
    # 3e-3 m3/s for 0.1 s into 2 l
    ({"supply": SENSING | {"response": 0.1}}, "supply:",
     "nothing relieves 'supply', which swings back within 0.1 s: once its valves close or what "
     "they feed stalls, its line rises by up to 1.8e+08 Pa over its 2.8e+07 Pa, give 'relief'"),
]  # fmt: skip


@pytest.mark.parametrize(("circuit", "where", "line"), WARNINGS)
def test_what_is_odd_is_a_warning(base, circuit, where, line):
    found = findings(base, **circuit)
    assert not [x for x in found if x.is_error], found
    (finding,) = [x for x in found if x.message.startswith(line)]
    assert (finding.file, finding.line) == ("changed.yaml", line_of(base, where))
    # what follows from a pump without a way back is told of what it feeds, too
    assert len(found) == 1 or "it only fills" in line


@pytest.mark.parametrize(
    "circuit",
    [
        {"lines": {"back": {"volume": 1e-3}}, "elements": {"filter": RETURN},
         **valve(return_a="back", return_b="back")},
        {"supply": SENSING | {"relief": 3.2e7}},
        {"supply": SENSING | {"relief": 3.2e7, "response": 0.1}},
        {"supply": SENSING | {"response": 0.001}},
        {"supply": SENSING | {"response": 0.1},
         "elements": {"main": {"type": "relief", "from": "supply", "to": "tank", "gain": 1e-8,
                               "pressure": 3e7}}},
        # a ride control: through the boom's chamber and its valve back to the tank
        {"accumulators": {"store": GAS},
         "elements": {"ride": {"type": "orifice", "from": "x.a", "to": "store",
                               "coefficient": 1e-7}}},
        {"supplies": {"second": SECOND},
         "elements": {"merge": {"type": "check", "from": "second", "to": "supply",
                                "coefficient": 1e-5}}},
        {"supply": {"control": "negative", "flow": 3e-3, "pressure": 2.8e7, "signal": 3e6,
                    "throttle": 1e-6, "relief": 3.2e7}, **valve(centre=2e-6)},
        {"engine": {"speed": 188.0, "torque": 600.0, "inertia": 2.0, "speed_droop": 10.0}},
        {"elements": {"pre": {"type": "check", "from": "x.a", "to": "x.b", "coefficient": 1e-6,
                              "pressure": 3.5e4}}},
    ],
)  # fmt: skip
def test_what_makes_sense_is_not_told(base, circuit):
    assert findings(base, **circuit) == []
    without_a_word(crane.load, base[0] / "changed.yaml")


def test_what_nothing_relieves_rises_as_far_as_is_told(base):
    """A pump at full flow whose valve is shut at once: all that it still gives is in its line."""
    pump = {"pressure": 2e7, "flow": 1e-3, "response": 0.1}
    wide = {"type": "orifice"} | dict.fromkeys(("c1", "c2", "c3", "c4"), 2e-6)
    path = written(base, supply=pump, valves={"x": wide})
    (finding,) = check(path).findings
    told = re.search("up to (.*) Pa over its (.*) Pa", finding.message).groups()
    machine = crane.load(path)
    time, signal = [0.0, 0.1, 0.1001, 0.8, 0.8001, 1.6], [0.0, 0.0, 10.0, 10.0, 0.0, 0.0]
    run = crane.simulate(
        machine, crane.control.ValveSignals(machine, time, {"x": signal}), duration=1.6
    )
    assert run.channels["share_supply"].max() > 0.999
    peak = run.channels["pressure_supply"].max()
    assert 0.99 < peak / sum(map(float, told)) < 1.0


def test_nodes_of_a_circuit(base):
    """By hand: what is joined, what gets to the tank, what a pump feeds."""
    path = written(
        base, lines={"back": {"volume": 1e-3}, "sump": {"volume": 1e-3}},
        accumulators={"store": GAS}, **valve(return_b="back"),
        elements={
            "filter": RETURN,
            "charge": {"type": "check", "from": "supply", "to": "store", "coefficient": 1e-6},
            "in": {"type": "check", "from": "tank", "to": "sump", "coefficient": 1e-6},
        },
    )  # fmt: skip
    circuit = crane.load(path).hydraulics
    assert connected_nodes(circuit) == {"supply", "tank", "back", "store", "sump"}
    assert nodes_draining_to_tank(circuit) == {"tank", "supply", "back", "x.a", "x.b"}
    assert nodes_fed_by_pumps(circuit) == {"supply", "x.a", "x.b", "back", "store"}


def test_locked_joints_leave_no_error(tmp_path):
    """Who locks the joint that an accumulator hangs on still has a machine."""
    rig(tmp_path, joints=("x", "y"))
    base = tmp_path, yaml.safe_load((tmp_path / "rig.yaml").read_text())
    path = written(
        base, accumulators={"store": GAS},
        elements={"ride": {"type": "orifice", "from": "x.a", "to": "store", "coefficient": 1e-7}},
    )  # fmt: skip
    locked = crane.load(path, lock={"x": 0.2}).hydraulics
    assert locked.joints == ("y",) and not locked.elements


def test_valves_that_take_more_than_the_pump_gives_are_a_note(base):
    """40 l/min each way; no finding, and the exit status stays 0."""
    circuit = {"supply": {"pressure": 9.25e6, "flow": 0.5e-3}, "valves": {"x": COMPENSATED}}
    report = check(written(base, **circuit))
    assert report.notes == (
        "hydraulics: fully open valves of pump 'supply' need 40 l/min together, it delivers "
        "at most 30 l/min",
    )
    assert report.status == 0
    done = typed("check", base[0] / "changed.yaml")
    assert report.notes[0] in done.stdout.splitlines() and done.returncode == 0
    assert check(written(base, supply={"pressure": 9.25e6, "flow": 1e-3}, **valve())).notes == ()


KINDS = (
    Supply,
    Engine,
    CircuitLine,
    Accumulator,
    CircuitElement,
    Cylinder,
    Valve,
    CounterbalanceValve,
    Oil,
)
# signals in volts, ratios, damping and brakes, of which anything is usual
UNJUDGED = {("valve", "neutral"), ("valve", "full"), ("valve", "damping"),
            ("cylinder", "damping"), ("accumulator", "exponent"),
            ("cylinder", "brake"), ("motor", "brake")}  # fmt: skip
# refused beyond a limit with a message of their own
SHARES = {("valve", "dead_band"), ("valve", "hysteresis"), ("valve", "float_from")}


def test_all_numbers_of_a_circuit_are_in_the_table():
    names = {
        (kind.__name__.removeprefix("Circuit").lower(), name)
        for kind in KINDS
        for name in parameter_names(kind)
    }
    names |= {("motor", name) for name in MOTOR.keys}
    lacking = {(kind, name) for kind, name in names if plausible_range(name, False, kind) is None}
    assert lacking == UNJUDGED | SHARES
    assert {kind for kind, _ in RANGES_BY_COMPONENT} <= {kind for kind, _ in names}


@pytest.mark.parametrize("kind", KINDS)
def test_defaults_are_usual(kind):
    for entry in fields(kind):
        if entry.name in parameter_names(kind) and isinstance(entry.default, float):
            for turning in (False, True):
                text = implausible_value_text(
                    entry.name,
                    entry.default,
                    turning,
                    kind.__name__.removeprefix("Circuit").lower(),
                )
                assert not text, (kind, entry.name)


UNITS = [
    ("supply", SENSING | {"margin": 20}, "'margin' of 'supply' is 20 Pa", "bar, write 20e5"),
    ("supply", SENSING | {"relief": 320}, "relief of the supply is 320 Pa", "bar, write 320e5"),
    ("supply", SENSING | {"slip": 0.01}, "'slip' of 'supply'", "l/min per bar, write 1.667e-12"),
    ("supplies", {"second": {"pressure": 350, "flow": 1e-3}}, "is 350 Pa", "bar, write 350e5"),
    ("engine", {"speed": 1800, "torque": 600, "inertia": 2}, "'speed' of 'engine' is 1800 rad/s",
     "rpm, write 188.5"),
    ("engine", {"speed": 188, "torque": 600, "inertia": 2, "speed_droop": 100},
     "'speed_droop' of 'engine' is 100 rad/s", "rpm, write 10.47"),
    ("lines", {"back": {"volume": 0.5}}, "'volume' of line 'back' is 0.5 m3", "l, write 0.5e-3"),
    ("accumulators", {"store": GAS | {"volume": 0.75}}, "'volume' of accumulator 'store'",
     "l, write 0.75e-3"),
    ("elements", {"e": {"type": "check", "from": "x.a", "to": "tank", "coefficient": 12}},
     "'coefficient' of element 'e'", "l/min per root of bar"),
    ("oil", {"air": 1}, "'air' of 'oil' is 1", "percent, write 1e-2"),
    ("motors", {"displacement": 28, "volume": 1e-4}, "'displacement' of motor of 'x' is 28",
     "cm3 per turn, write 4.456e-06"),
    ("motors", {"displacement": 4.5e-6, "volume": 1e-4, "relief": 250},
     "relief of the cylinder of 'x' is 250 Pa", "bar, write 250e5"),
    ("valves", {"x": ORIFICE | {"centre": 40}}, "'centre' of valve of 'x' is 40",
     "l/min per root of bar"),
]  # fmt: skip


@pytest.mark.parametrize(("key", "numbers", "what", "unit"), UNITS)
def test_units_that_people_write_are_told(base, key, numbers, what, unit):
    changed = {key: numbers}
    if key == "motors":
        changed = {"motors": {"x": numbers}, "cylinders": {}}
    if key == "lines":
        changed |= {"elements": {"filter": RETURN}} | valve(return_a="back")
    if key == "accumulators":
        changed["elements"] = {
            "ride": {"type": "orifice", "from": "x.a", "to": "store", "coefficient": 1e-7}
        }
    if key == "supplies":
        changed |= valve(supply="second")
    texts = [x.message for x in findings(base, **changed)]
    (told,) = [text for text in texts if what in text]
    assert unit in told


def test_the_note_on_a_bundled_circuit():
    assert check("patu655").notes == (
        "hydraulics: fully open valves of pump 'supply' need 160 l/min together, it delivers "
        "at most 100 l/min",
    )


def test_the_table_has_no_unknown_names():
    names = {name for kind in KINDS for name in parameter_names(kind)} | set(MOTOR.keys)
    assert set(PLAUSIBLE_RANGES) - names <= {"meter_out", "bore", "rod", "stroke"}
