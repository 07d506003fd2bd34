"""Numbers with units: in machine files, changes, options and columns, and as they are written."""

import json
import math
import subprocess
import sys
from fractions import Fraction

import jsonschema
import numpy as np
import pytest
import yaml
from command_line import typed
from hypothesis import example, given
from hypothesis import strategies as st

import crane
from crane.common import unit_conversions
from crane.common.errors import CraneError, DescriptionError
from crane.common.unit_conversions import (
    COMMON_UNITS,
    UnitError,
    WrittenNumber,
    column_conversion,
    parse_quantity,
    unit_size,
)
from crane.description.machine_parameters import parameters
from crane.formats.machine_file.json_schema import schema_text
from crane.formats.machine_file.machine_reader import read_machine_spec
from crane.formats.machine_file.machine_writer import write_machine
from crane.formats.machine_file.yaml_text import parse_yaml_file
from crane.identification.mechanics.identifiability import read_priors

# a machine in units, and the same numbers in SI units
IN_UNITS = """
extends: patu655
name: in_units
home: {slew: 90 deg, X_lift: 117 mm}
friction:
  slew: {coulomb: 0.2 kNm, viscous: 500 N m s/rad}
  X_lift: {coulomb: 210 N, stiction: 0.09 kN, stribeck: 5 mm/s, viscous: 0.33 N/(mm/s)}
forces:
- {joint: X_tilt, stiffness: 2 N/mm, rest: 12.3 cm}
- {between: [tip, pillar_cylinder], damping: 3 N·s/mm}
- {joint: slew, stiffness: 2 kN m/rad, rest: 180°}
loads:
- {frame: tip, force: [0, 0, -1.5 kN], moment: [0, 1 kNm, 0]}
ropes:
- {between: [tip, pillar_cylinder], length: 4 m, stiffness: 12 kN/m}
hydraulics:
  supply: {pressure: 92.5 bar, flow: 99 l/min, droop: 0.21 MPa, volume: 1.9 l, slip: 1 cm³/(s bar)}
  oil: {bulk_modulus: 1.6 GPa, air: 0.5 %}
  cylinders:
    X_lift: {area_a: null, area_b: null, bore: 100 mm, rod: 56 mm, hose_a: 190.02 cm3}
    slew: {area_a: 14 cm2 m/rad}
  valves:
    all: {hysteresis: 1.3 %}
    slew: {bandwidth: 10 rad/s, delay: 20 ms}
    X_ext: {flow: 36 l/min, meter_out: null, margin: 7 bar}
sensors:
  X_lift: {zero: 3.3 mm, delay: 20 ms}
identification: {bandwidth: 5 Hz, min_speed: {X_lift: 1 mm/s}}
tasks:
  via:
    via:
    - {time: 0 s, slew: 0, X_lift: 200 mm, X_tilt: 0.25, X_ext: 0.1}
    - {time: 0.1 min, slew: 3, X_lift: 10 in, X_tilt: 0.25, X_ext: 0.1, rates: {X_lift: 1 cm/s}}
  poly:
    duration: 1e1
    active: {slew: [0], X_lift: [0.117, 3 mm/s, 1 mm/s^2], X_tilt: [0.246], X_ext: [10 cm]}
  levers:
    duration: 12 s
    joystick: {X_lift: [0 s, 0, 2 s, 60 %]}
"""
IN_SI = """
extends: patu655
name: in_units
home: {slew: 1.5707963267948966, X_lift: 0.117}
friction:
  slew: {coulomb: 200, viscous: 500}
  X_lift: {coulomb: 210, stiction: 90, stribeck: 0.005, viscous: 330}
forces:
- {joint: X_tilt, stiffness: 2000, rest: 0.123}
- {between: [tip, pillar_cylinder], damping: 3000}
- {joint: slew, stiffness: 2000, rest: 3.141592653589793}
loads:
- {frame: tip, force: [0, 0, -1500], moment: [0, 1000, 0]}
ropes:
- {between: [tip, pillar_cylinder], length: 4, stiffness: 12000}
hydraulics:
  supply: {pressure: 9.25e6, flow: 1.65e-3, droop: 2.1e5, volume: 1.9e-3, slip: 1e-11}
  oil: {bulk_modulus: 1.6e9, air: 0.005}
  cylinders:
    X_lift: {area_a: null, area_b: null, bore: 0.1, rod: 0.056, hose_a: 190.02e-6}
    slew: {area_a: 0.0014}
  valves:
    all: {hysteresis: 0.013}
    slew: {bandwidth: 10, delay: 0.02}
    X_ext: {flow: 6e-4, meter_out: null, margin: 7e5}
sensors:
  X_lift: {zero: 0.0033, delay: 0.02}
identification: {bandwidth: 5, min_speed: {X_lift: 0.001}}
tasks:
  via:
    via:
    - {time: 0, slew: 0, X_lift: 0.2, X_tilt: 0.25, X_ext: 0.1}
    - {time: 6, slew: 3, X_lift: 0.254, X_tilt: 0.25, X_ext: 0.1, rates: {X_lift: 0.01}}
  poly:
    duration: 10
    active: {slew: [0], X_lift: [0.117, 0.003, 0.001], X_tilt: [0.246], X_ext: [0.1]}
  levers:
    duration: 12
    joystick: {X_lift: [0, 0, 2, 0.6]}
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "in_units.yaml"
    path.write_text(IN_UNITS, encoding="utf-8")
    return path


def numbers(value):
    """All numbers of a description, as bits."""
    return repr(value).replace("-0.0", "0.0")


def described(path):
    spec = read_machine_spec(path)
    parts = "home", "friction", "forces", "ropes", "end_stops", "hydraulics", "tasks", "sensors"
    loads = [(x.frame, x.values.tolist()) for x in spec.external_forces]
    return [numbers(getattr(spec, part)) for part in (*parts, "estimation")] + [loads]


def test_units_are_the_si_numbers_to_the_last_bit(file, tmp_path):
    plain = tmp_path / "plain" / "in_units.yaml"
    plain.parent.mkdir()
    plain.write_text(IN_SI, encoding="utf-8")
    for with_units, without in zip(described(file), described(plain), strict=True):
        assert with_units == without


def test_a_written_machine_keeps_units_and_bits(file, tmp_path):
    changes = {"friction.X_lift.coulomb": 1234.5678901234567, "supply.pressure": "95 bar",
               "cylinder.X_lift.hose_a": 2e-4 / 3}  # fmt: skip
    machine = crane.load(file, changes)
    written = write_machine(machine, tmp_path / "out", {"supply.pressure": "fitted ±1e4"})
    assert "pressure: 95 bar  # 9.5e+06 in SI units, fitted ±1e4\n" in written.read_text()
    again = crane.load(written)
    read = parameters(read_machine_spec(written))
    assert machine.hydraulics == again.hydraulics
    assert machine.friction == again.friction and machine.forces == again.forces
    assert machine.estimation == again.estimation
    home = read_machine_spec(written).home
    assert [home[joint] for joint in machine.joints] == machine.home.tolist()
    assert read["friction.X_lift.coulomb"] == changes["friction.X_lift.coulomb"]
    data = parse_yaml_file(written)
    circuit, lift = data["hydraulics"], data["hydraulics"]["cylinders"]["X_lift"]
    assert circuit["supply"]["pressure"] == "95 bar" and circuit["supply"]["flow"] == "99 l/min"
    assert (lift["bore"], lift["rod"]) == ("100 mm", "56 mm") and "area_a" not in lift
    assert lift["hose_a"].endswith(" cm3") and float(lift["hose_a"][:-4]) == pytest.approx(200 / 3)
    assert circuit["valves"]["X_ext"]["flow"] == "36 l/min"
    assert data["friction"]["X_lift"]["viscous"] == "0.33 N/(mm/s)"
    assert data["friction"]["X_tilt"]["viscous"] == 330.0
    assert data["forces"][2] == {"joint": "slew", "stiffness": "2 kN m/rad", "rest": "180 °"}
    assert data["loads"][0]["force"] == [0.0, 0.0, "-1.5 kN"]
    assert data["tasks"]["via"]["via"][1]["X_lift"] == "10 in"
    assert data["tasks"]["poly"]["active"]["X_lift"] == [0.117, "3 mm/s", "1 mm/s^2"]
    assert data["tasks"]["levers"]["joystick"]["X_lift"] == ["0 s", 0.0, "2 s", "60 %"]


def test_a_note_is_of_the_parameter_itself(file, tmp_path):
    """Beside an area or a flow, also where the file has a bore or a displacement."""
    pump = "displacement: 45 cm3/rev, speed: 2200 rpm"
    file.write_text(IN_UNITS.replace("flow: 99 l/min", f"flow: null, {pump}"), encoding="utf-8")
    machine = crane.load(file, {"cylinder.X_lift.area_a": 8e-3, "valve.X_ext.c1": 8e-7})
    names = "cylinder.X_lift.area_a", "supply.flow", "valve.X_ext.c1"
    written = write_machine(machine, tmp_path / "out", dict.fromkeys(names, "fitted"))
    text = written.read_text(encoding="utf-8")
    for line in ("area_a: 0.008  # fitted", "flow: 0.00165  # fitted", "c1: 8.0e-07  # fitted"):
        assert line in text
    assert not any(key in text for key in ("bore", "displacement"))
    assert crane.load(written).hydraulics == machine.hydraulics


def test_units_stay_with_their_elements_where_others_are_locked(file, tmp_path):
    machine = crane.load(file, lock={"X_tilt": "246 mm"})
    data = parse_yaml_file(write_machine(machine, tmp_path / "out"))
    assert data["forces"][-1]["rest"] == "180 °"
    assert {x.get("joint") for x in data["forces"]} == {None, "slew"}


@given(st.floats(-1e15, 1e15), st.sampled_from([*COMMON_UNITS, "N/mm", "l/min/bar^0.5", "in"]))
@example(0.0, "deg")
@example(5e-324, "bar")
def test_any_number_is_written_so_that_it_is_read_again(value, unit):
    si_unit = COMMON_UNITS.get(unit, ({"N/mm": "N/m", "in": "m"}.get(unit, "m3/(s Pa^0.5)"), 0))[0]
    text = WrittenNumber(1.0, unit, unit_size(unit, si_unit)).write(value)
    assert parse_quantity(text, (si_unit,)).value == value


def test_usual_units_are_those_of_the_library_and_cost_nothing():
    for unit, (si_unit, size) in COMMON_UNITS.items():
        if si_unit:
            found, wanted = map(unit_conversions._dimension, (unit, si_unit))
            assert found[1] == wanted[1] and found[0] / wanted[0] == size, unit
    program = (
        "import sys, crane; from crane.common.unit_conversions import *;"
        "parse_quantity('200 bar', ('Pa',)); parse_quantity('45 cm3/rev', ('m3/rad',));"
        "parse_quantity('3:1', ('',)); column_conversion('deg');"
        "assert 'pint' not in sys.modules; parse_quantity('5 N/mm', ('N/m',));"
        "assert 'pint' in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=120)


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("200 bar", "Pa", 2e7),
        ("100 l/min", "m3/s", 1e-1 / 60),
        ("2200 rpm", "rad/s", 2200 * math.pi / 30),
        ("45 cm3/rev", "m3/rad", 45e-6 / (2 * math.pi)),
        ("30 deg", "rad", math.pi / 6),
        ("5 Hz", "rad/s", 10 * math.pi),
        ("5 Hz", "Hz", 5.0),
        ("31.4 rad/s", "Hz", 31.4 / (2 * math.pi)),
        ("2.5 t", "kg", 2500.0),
        ("60%", "", 0.6),
        ("3:1", "", 3.0),
        ("1:20", "", 0.05),
        ("1e-3 psi", "Pa", 6.894757293168361),
        ("210 g/kWh", "kg/J", 210e-3 / 3.6e6),
        ("450 Nm", "N m", 450.0),
        ("35 kNm/deg", "N m/rad", 35e3 * 180 / math.pi),
        ("7 1/s", "1/s", 7.0),
        ("7 s^-1", "1/s", 7.0),
        ("3 mm/s²", "m/s2", 3e-3),
        ("1 gpm", "m3/s", 6.30901964e-5),
        ("15.119 l/min/bar^0.5", "m3/(s Pa^0.5)", 15.119 / 6e4 / math.sqrt(1e5)),
    ],
)
def test_what_units_mean(text, unit, value):
    assert parse_quantity(text, (unit,)).value == pytest.approx(value, rel=1e-15)


@pytest.mark.parametrize(
    ("text", "unit", "message"),
    [
        # angles are a dimension: neither of these is off by 2 pi
        (
            "45 cm3",
            "m3/rad",
            "'cm3' is a unit of something else, give a number in m3/rad, as in 5 cm3/rev",
        ),
        (
            "50 1/s",
            "rad/s",
            "'1/s' is a unit of something else, give a number in rad/s, as in 5 deg/s",
        ),
        (
            "5 N m",
            "N m/rad",
            "'N m' is a unit of something else, give a number in N m/rad",
        ),
        ("30 deg", "", "'deg' is a unit of something else, give a number without a unit"),
        ("3:1", "Pa", "':1' is a unit of something else, give a number in Pa, as in 5 bar"),
        ("20 degC", "Pa", "'degC' is no known unit, give a number in Pa"),
        ("5 barg", "Pa", "'barg' is no known unit, give a number in Pa, as in 5 bar"),
        ("5 bar(g)", "Pa", "'bar(g)' is a unit of something else"),
        ("5 m^9^9^9", "m", "'m^9^9^9' is no known unit"),
        ("5 (m", "m", "'(m' is no known unit"),
        ("5 m)(m", "m2", "'m)(m' is no known unit"),
        ("5 __import__('os')", "m", "is no known unit"),
        ("5e99999 bar", "Pa", "give a number in Pa"),
        ("5e999 bar", "Pa", "give a smaller number"),
        ("bar", "Pa", "give a number in Pa, as in 5 bar"),
        ("1_000 bar", "Pa", "give a number in Pa"),
        ("200 Bar", "Pa", "'Bar' is no known unit, did you mean 'bar'?, give a number in Pa"),
        ("5 KN", "N", "did you mean 'kN'?"),
        ("٣ bar", "Pa", "give a number in Pa"),
        ("1:0", "", "give a number without a unit"),
        ("5 " + "m" * 1000, "m", "give a number in m"),
    ],
)
def test_what_is_no_unit_of_a_quantity(text, unit, message):
    with pytest.raises(UnitError) as caught:
        parse_quantity(text, (unit,))
    assert message in str(caught.value) and "\n" not in str(caught.value)


ERRORS = {
    "supply: {pressure: 92.5 bar": (
        "supply: {pressure: 92.5 kg",
        "in_units.yaml:17: 'pressure' of 'supply' is '92.5 kg', and 'kg' is a unit of something "
        "else, give a number in Pa, as in 5 bar",
    ),
    "slew: 90 deg": ("slew: 90 mm", "4: 'slew' of 'home' is '90 mm', and 'mm' is a unit of"),
    "coulomb: 210 N,": ("coulomb: 210 Nm,", "7: 'coulomb' of friction of 'X_lift' is '210 Nm'"),
    "rest: 12.3 cm": ("rest: 12.3 deg", "9: 'rest' of force element of 'X_tilt' is '12.3 deg'"),
    "stiffness: 2 kN m/rad": ("stiffness: 2 N/mm", "11: 'stiffness' of force element of 'slew'"),
    "-1.5 kN": ("-1.5 t", "13: 'force' of a load is '-1.5 t'"),
    "bore: 100 mm": ("bore: 100 cm2", "20: 'bore' of cylinder of 'X_lift' is '100 cm2'"),
    "area_a: 14 cm2 m/rad": ("area_a: 14 cm2", "21: 'area_a' of cylinder of 'slew' is '14 cm2'"),
    "hysteresis: 1.3 %": ("hysteresis: 2 mm", "23: 'hysteresis' of valve of 'slew' is '2 mm'"),
    "zero: 3.3 mm": ("zero: 3.3 bar", "27: 'zero' of sensor 'X_lift' is '3.3 bar'"),
    "min_speed: {X_lift: 1 mm/s": (
        "min_speed: {X_lift: 1 mm",
        "28: 'X_lift' of 'min_speed' is '1 mm'",
    ),
    "10 in,": ("10 deg,", "33: 'X_lift' of a via point of task 'via' is '10 deg'"),
    "3 mm/s, 1": ("3 mm, 1", "36: 'X_lift' of 'active' of task 'poly' is '3 mm'"),
    "2 s, 60 %": ("2 s, 60 s", "39: 'X_lift' of 'joystick' is '60 s'"),
}


@pytest.mark.parametrize("right", ERRORS)
def test_another_quantity_is_refused_with_its_place(right, tmp_path):
    wrong, message = ERRORS[right]
    assert IN_UNITS.count(right) == 1
    path = tmp_path / "in_units.yaml"
    path.write_text(IN_UNITS.replace(right, wrong), encoding="utf-8")
    with pytest.raises(CraneError) as caught:
        crane.load(path)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_numbers_are_those_of_yaml_1_2(tmp_path):
    path = tmp_path / "numbers.yaml"
    texts = ["3:1", "1:30:00", "012", "1e6", "1E6", "-.5", "+3", "1.", ".inf", "1_000", "0x1F"]
    path.write_text("\n".join(f"k{i}: {text}" for i, text in enumerate(texts)))
    read = list(parse_yaml_file(path).values())
    assert read == ["3:1", "1:30:00", 12, 1e6, 1e6, -0.5, 3, 1.0, math.inf, "1_000", "0x1F"]
    assert yaml.safe_load("a: 3:1") == {"a": 181}  # for which the resolver is replaced
    valve = "counterbalance_a: {pressure: 200 bar, pilot_ratio: 3:1, range: 30 bar, "
    valve += "coefficient: 15 l/min/bar^0.5}"
    path.write_text(f"extends: patu655\nhydraulics: {{cylinders: {{X_ext: {{{valve}}}}}}}\n")
    holding = crane.load(path).hydraulics.cylinders["X_ext"].counterbalance_a
    assert (holding.pilot_ratio, holding.pressure) == (3.0, 2e7)


def test_a_pump_has_displacement_and_speed(tmp_path):
    path, head = tmp_path / "pump.yaml", "extends: patu655\nhydraulics:\n  supply: {flow: null, "
    size = "displacement: 45 cm3/rev"
    path.write_text(f"{head}{size}, speed: 2200 rpm}}\n")
    machine = crane.load(path)
    assert machine.hydraulics.supply.flow == pytest.approx(45e-6 * 2200 / 60, rel=1e-15)
    data = parse_yaml_file(write_machine(machine, tmp_path / "out"))["hydraulics"]["supply"]
    assert (data["displacement"], data["speed"]) == ("45 cm3/rev", "2200 rpm")
    assert "flow" not in data
    again = crane.load(tmp_path / "out" / "patu655.yaml")
    assert again.hydraulics == machine.hydraulics
    other = crane.load(path, {"supply.flow": "90 l/min"})
    data = parse_yaml_file(write_machine(other, tmp_path / "other"))["hydraulics"]["supply"]
    again = crane.load(tmp_path / "other" / "patu655.yaml")
    assert again.hydraulics == other.hydraulics and data["speed"] == "2200 rpm"
    engine = "engine: {speed: 2200 rpm, torque: 300 Nm, inertia: 2 kg m2}"
    path.write_text(f"{head}{size}}}\n  {engine}\n")
    assert crane.load(path).hydraulics.supply == machine.hydraulics.supply
    slower = crane.load(path, {"engine.speed": "1100 rpm"})  # the flow follows
    assert slower.hydraulics.supply.flow == pytest.approx(45e-6 * 1100 / 60, rel=1e-15)
    data = parse_yaml_file(write_machine(slower, tmp_path / "slower"))["hydraulics"]
    assert data["supply"]["displacement"] == "45 cm3/rev" and "speed" not in data["supply"]
    assert data["engine"]["speed"] == "1100 rpm"
    for rest, message in (
        (f"{size}}}", "pump.yaml:3: 'supply' has a displacement and no speed"),
        (f"{size}, flow: 1e-3}}", "'flow' stands beside 'displacement', keep one of them"),
        ("speed: 2200 rpm}", "'speed' of 'supply' goes with 'displacement', give it"),
    ):
        path.write_text(
            head.replace("flow: null, ", "" if "flow" in rest else "flow: null, ") + rest
        )
        with pytest.raises(CraneError, match=message):
            crane.load(path)


def test_editors_validate_units():
    validator = jsonschema.Draft202012Validator(json.loads(schema_text()))

    def is_valid(key, value):
        data = {"extends": "patu655", "hydraulics": {"supply": {key: value}}}
        return validator.is_valid(data)

    assert all(is_valid("pressure", x) for x in (2e7, "2e7", "200 bar", "20 MPa", "3 kp/cm^2"))
    assert all(is_valid("flow", x) for x in (1e-3, "100 l/min", "100 l / min", "3 gpm", "1 m3/s"))
    assert not any(is_valid("pressure", x) for x in ("200 kg", "bar", "200 %", "3:1"))
    assert (
        is_valid("least", "5 %") and not is_valid("least", "5 mm") and not is_valid("flow", "5 %")
    )
    assert validator.is_valid(yaml.safe_load(IN_UNITS))
    assert "1 l/min" in validator.schema["$defs"]["number_m3_per_s"]["examples"]


def test_changes_locks_and_options_take_units(tmp_path):
    machine = crane.load("patu655", {"payload.mass": "0.2 t"}, {"slew": "30 deg"})
    assert machine.parameter_changes == {"payload.mass": 200.0}
    assert machine.locked_joints == {"slew": math.radians(30)}
    for arguments, message in (
        (
            ["--set", "supply.pressure=200kg"],
            "parameter 'supply.pressure' is '200kg', and 'kg' is",
        ),
        (
            ["--set", "suply.pressure=200bar"],
            "parameter 'suply.pressure' is unknown, did you mean",
        ),
        (["--set", "control.X_lift.kp=2 N/m"], "parameter 'control.X_lift.kp' is unknown"),
        (
            ["--lock", "slew=30mm"],
            "the coordinate to lock 'slew' at is '30mm', and 'mm' is a unit",
        ),
        (["--at", "slew=10mm"], "--at is 'slew=10mm', and 'mm' is a unit of something else"),
        (["--velocity", "X_lift=3deg/s"], "--velocity is 'X_lift=3deg/s', and 'deg/s' is a unit"),
        (["--vary", "supply.pressure=3 bar:2 kg:5"], "'kg' is a unit of something else"),
    ):
        done = typed("modes", "patu655", *arguments)
        assert done.returncode == 2 and message in done.stderr, done.stderr
    done = typed("simulate", "patu655", "--task", "reach", "--duration", "2 kg")
    assert done.returncode == 2 and "'2 kg', and 'kg' is a unit of something else" in done.stderr
    out = tmp_path / "run"
    typed("simulate", "mini_forwarder", "--task", "lift", "--duration", "20 ms", "--step", "1 ms",
          "--load", "link7_tip=0,0,-0.01 kN", "--out", str(out))  # fmt: skip
    assert crane.Recording.read(out / "recording.csv").time[-1] == pytest.approx(0.02)


def test_curves_and_their_files_have_units(tmp_path):
    path = tmp_path / "valve.yaml"
    (tmp_path / "flow.csv").write_text("u [%], flow [l/min]\n10, 0\n\n100, 20\n")
    edge = "{valves: {X_ext: {type: orifice, margin: null, flow: null, meter_out: null, "
    edge += "c1: [[10 %, 0], [1, 20 l/min/bar^0.5]], c4: 6 l/min/bar^0.5, "
    edge += "c2: {flow: [[0.1, 0], [100 %, 20 l/min]], drop: 4 bar}, "
    path.write_text(
        f"extends: patu655\nhydraulics: {edge}c3: {{file: flow.csv, drop: 4 bar}}}}}}}}"
    )
    valve = crane.load(path).hydraulics.valves["X_ext"]
    unit = 1 / 6e4 / math.sqrt(1e5)
    expected = [20 * unit, 10 * unit, 10 * unit, 6 * unit]
    assert [valve.c1, valve.c2, valve.c3, valve.c4] == pytest.approx(expected, rel=1e-14)
    for edge in ("c1", "c2", "c3"):
        assert valve.curves[edge].points == ((0.1, 0.0), (1.0, 1.0))
    (tmp_path / "flow.csv").write_text("u [%], flow [bar]\n10, 0\n100, 20\n")
    with pytest.raises(
        CraneError, match="flow.csv:2 has '10, 0', and 'bar' is a unit of something else"
    ):
        crane.load(path)


def test_columns_in_any_unit(tmp_path):
    assert column_conversion("psi")[0] == "Pa" and column_conversion("kp")[0] == "N"
    assert column_conversion("degC") == ("degC", Fraction(1))
    assert column_conversion("1/min") == ("1/min", Fraction(1))
    path = tmp_path / "log.csv"
    path.write_text("time [min],p [psi],q [gpm],n [rpm],a [g]\n0,100,2,30,4\n1,200,2,30,4\n")
    from crane.recordings.table_reader import read_csv

    table = read_csv(path)
    assert table.units == {"time": "s", "p": "Pa", "q": "m3/s", "n": "rad/s", "a": "g"}
    expected = [60.0, 200 * 6894.757293168361, 2 * 6.30901964e-5, math.pi, 4.0]
    np.testing.assert_allclose(table.values[1], expected, rtol=1e-14)


def test_terms_and_priors_of_an_identification_take_units(tmp_path):
    """By the kind of the parameter and the joint: q1 turns, X1 slides."""
    path, base = tmp_path / "units.yaml", crane.load("mini_forwarder").path
    lines = {
        "terms": "{X1.presliding: 0.1 mm, q1.memory: [300 ms, 2 deg/s], q1.stiction: [45 deg/s]}",
        "prior": "{X1.viscous: 0.8 +- 0.1 kN s/m, q1.coulomb: 5 N cm, link4.m: 200 g, "
        "q1.viscous: 0.1 N m s/rad +- 10 %, bodies: 20 %}",
    }

    def load(**changed):
        section = ", ".join(f"{key}: {text}" for key, text in (lines | changed).items())
        path.write_text(f"extends: {base}\nidentification: {{{section}}}\n")
        return crane.load(path)

    machine = load()
    known, turn = machine.estimation.prior, np.pi / 180
    assert machine.estimation.terms == {
        "X1.presliding": (1e-4,), "q1.memory": (0.3, 2 * turn), "q1.stiction": (np.pi / 4,)
    }  # fmt: skip
    assert (known["X1.viscous"].mean, known["X1.viscous"].std) == (800.0, 100.0)
    assert (known["q1.coulomb"].std, known["link4.m"].std) == (0.05, 0.2)
    assert known["q1.viscous"].mean == 0.1 and known["q1.viscous"].relative
    written = write_machine(machine, tmp_path / "written")
    text = written.read_text()
    for words in ("0.1 mm", "300 ms", "2 deg/s", "0.8 +- 0.1 kN s/m", "5 N cm", "200 g"):
        assert words in text
    assert crane.load(written).estimation == machine.estimation
    for changed, told in (
        ({"terms": "{X1.presliding: 0.1 deg}"}, "'0.1 deg', and 'deg' is a unit of something"),
        ({"terms": "{q1.memory: [0.3, 5 mm/s]}"}, "'5 mm/s', and 'mm/s' is a unit of something"),
        ({"prior": "{X1.viscous: 0.8 +- 0.1 kN}"}, "'kN' is a unit of something else, give a"),
        ({"prior": "{X1.viscous: 0.8 kN s/m +- 5}"}, "give the standard deviation a unit, too"),
        ({"prior": "{bodies: 5 kg}"}, "'kg' is a unit of something else, give a number without"),
        ({"prior": "{q1.coulomb: 5 Nmm3}"}, "'Nmm3' is no known unit"),
    ):
        with pytest.raises(DescriptionError, match=told) as caught:
            load(**changed)
        assert str(caught.value).startswith("units.yaml:2: ")
    machine = load()
    (prior,) = read_priors({"X1.coulomb": "20 +- 5 kN"}, machine).values()
    assert (prior.mean, prior.std) == (2e4, 5e3)
    for option, told in (
        ("--prior=X1.coulomb=5 kg", "--prior X1.coulomb: it is '5 kg', and 'kg' is a unit of"),
        ("--term=q1.presliding=1 mm", "--term is 'q1.presliding=1 mm', and 'mm' is a unit of"),
        ("--try=X1.coulomb=5 N,6 Nm", "and 'Nm' is a unit of something else"),
    ):
        done = typed("identify", path, tmp_path / "none.csv", option)
        assert done.returncode == 2 and told in done.stderr, done.stderr
