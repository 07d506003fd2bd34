"""Comments in written machine files, which are read again with identical numbers."""

import re

import numpy as np
import pytest
import yaml
from hydraulic_rig import COMPENSATED, rig
from warned import quiet

import crane
from crane.description.machine_parameters import parameter_unit
from crane.description.parameter_changes import parameters
from crane.formats.machine_file.yaml_text import format_yaml
from crane.formats.machine_loading import MachineVariants

WORDS = "fitted ±3e-9, 95 % (was -- 1: 2)\n# no"
SAID = "fitted ±3e-9, 95 % (was -- 1: 2) # no"


def numbers(machine):
    """All that a machine says in numbers, its tree's by links and joints that a file has."""
    return parameters(MachineVariants(machine).spec)


@pytest.fixture(scope="module")
def crane_file(tmp_path_factory):
    changes = {
        "valve.X_lift.c1": 4.1e-7, "friction.X_lift.coulomb": 0.0, "sensor.X_lift.delay": 0.0,
        "lift_boom_rod.x": 0.317, "lift_boom_rod.y": 0.01, "payload.mass": 134.2,
        "oil.bulk_modulus": 0.9e9, "lift_boom.mass": 150.5, "end_stop.X_lift.stiffness": 3e8,
        "tilt_boom.com.x": 0.7,
    }  # fmt: skip
    machine = quiet(crane.load, "patu655", changes=changes, lock={"slew": 0.0, "X_ext": 0.0})
    folder = tmp_path_factory.mktemp("noted")
    return machine, crane.write_machine(machine, folder, dict.fromkeys(changes, WORDS))


def test_notes_stand_on_the_line_of_their_number(crane_file):
    machine, file = crane_file
    lines = file.read_text().splitlines()
    urdf = "".join(x.read_text() for x in file.parent.glob("*.urdf"))
    assert lines[0] == f"# payload.mass = 134.2: {SAID}"  # part of a link's mass
    assert re.findall(r"^ +(\w+): (\S+)  # fitted", "\n".join(lines), re.M) == [
        ("coulomb", "0.0"), ("stiffness", "300000000.0"), ("bulk_modulus", "900000000.0"),
        ("c1", "4.1e-07"), ("delay", "0.0"),
    ]  # fmt: skip
    xml = SAID.replace("--", "- -")
    pin = f"lift_boom_rod.x: {xml}; lift_boom_rod.y: {xml}"
    assert f'<origin xyz="0.317 0.01 0.0" rpy="0.0 0.0 0.0"/>  <!-- {pin} -->\n' in urdf
    assert f'<mass value="150.5"/>  <!-- lift_boom.mass: {xml} -->\n' in urdf
    assert re.search(r'<origin xyz="0.7 .*/>  <!-- tilt_boom.com.x: fitted', urdf)


def test_a_machine_with_notes_loads_as_it_was(crane_file, tmp_path):
    machine, file = crane_file
    plain = crane.load(crane.write_machine(machine, tmp_path / "plain"))
    again = crane.load(file)
    assert again.hydraulics == machine.hydraulics and again.friction == machine.friction
    assert again.end_stops == machine.end_stops
    assert numbers(again) == numbers(plain) | {
        f"sensor.X_lift.{what}": value
        for what, value in (("zero", 0.0), ("scale", 1.0), ("delay", 0.0), ("noise", 0.0))
    }
    assert (again.home == plain.home).all()
    for name, value in machine.parameter_changes.items():
        assert name == "payload.mass" or numbers(again)[name] == value, name


def test_notes_of_whatever_number(tmp_path):
    """Each parameter is commented once; parameters without a line are listed at the head."""
    machine = crane.load("patu655")
    every = numbers(machine)
    file = crane.write_machine(machine, tmp_path / "every", {x: f"<{x}>" for x in every})
    text = "".join(x.read_text() for x in file.parent.iterdir())
    assert all(f"<{name}>" in text for name in every)
    head = [line for line in file.read_text().splitlines() if line.startswith("# ")]
    rubbed = tuple(f"friction.{joint}." for joint in machine.friction)
    none = [x for x in every if x.startswith("friction.") and not x.startswith(rubbed)]
    gravity = [
        f"# gravity.{x} = {y}: <gravity.{x}>"
        for x, y in zip("xyz", (0.0, 0.0, -9.81), strict=True)
    ]
    plain = [f"# {name}: <{name}>" for name in (*none, "payload.mass")]
    assert head == [*plain[:-1], *gravity, plain[-1]]
    again = crane.load(file)
    assert numbers(again) == numbers(crane.load(crane.write_machine(machine, tmp_path / "plain")))
    moon = crane.load("patu655", gravity=(0, 0, -1.62))
    file = crane.write_machine(moon, tmp_path / "moon", {"gravity.z": "of the moon"})
    assert file.read_text().startswith("# gravity.z = -1.62: of the moon\n")


def test_a_number_that_a_lock_moved_is_said_at_the_head(tmp_path):
    """Where the extension stands in the file is its place and its stroke."""
    changes, lock = {"extension.x": -0.4}, {"X_ext": 0.3}
    machine = crane.load("patu655", changes=changes, lock=lock)
    assert machine.tree.joints["X_ext"].xyz[0] != -0.4
    file = crane.write_machine(machine, tmp_path / "locked", {"extension.x": "said"})
    assert file.read_text().startswith("# extension.x = -0.4: said\n")
    assert "said" not in "".join(x.read_text() for x in file.parent.glob("*.urdf"))


def test_a_compensated_valve_with_orifices_of_its_own(tmp_path):
    machine = rig(tmp_path, COMPENSATED)
    for value in np.random.default_rng(0).uniform(1e-7, 9e-7, 8).tolist():
        changes = {"valve.x.c1": value, "valve.x.c3": 2 * value}
        other = crane.load(machine.path, changes=changes)
        again = crane.load(crane.write_machine(other, tmp_path / f"{value}"))
        assert again.hydraulics == other.hydraulics
        same = crane.load(machine.path, changes={f"valve.x.c{i}": value for i in range(1, 5)})
        again = crane.load(crane.write_machine(same, tmp_path / f"same{value}"))
        assert again.hydraulics == same.hydraulics
    text = crane.write_machine(machine, tmp_path / "flow").read_text()
    assert yaml.safe_load(text)["hydraulics"]["valves"]["x"]["flow"] == COMPENSATED["flow"]


def test_text_with_notes_reads_as_without():
    data = {"a": {"x y": 1.0, "b": -2e-9, "it's: #": 3.0}, "tail": [1.0, 2.0],
            "list": [{"k": 1.0, "deep": {"z": 0.1}}]}  # fmt: skip
    notes = {("a", "x y"): "one", ("a", "it's: #"): "two\nlines", ("list", 0, "k"): "#3",
             ("list", 0, "deep", "z"): "ß"}  # fmt: skip
    text = format_yaml(data, notes, {})
    assert yaml.safe_load(text) == data == yaml.safe_load(format_yaml(data, {}, {}))
    assert "x y: 1.0  # one\n" in text and "# two lines\n" in text and "k: 1.0  # #3\n" in text


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("payload.mass", "kg"), ("lift_boom_rod.x", "m"), ("lift_boom_rod.yaw", "rad"),
        ("lift_boom.com.y", "m"), ("lift_boom.inertia.xx", "kg m2"), ("X_lift.upper", "m"),
        ("slew.rotor_inertia", "kg m2"), ("friction.X_lift.coulomb", "N"),
        ("friction.slew.coulomb", "N m"), ("friction.slew.viscous", "N m s/rad"),
        ("valve.X_lift.c1", "m3/(s Pa^0.5)"), ("valve.X_lift.c*", ""),
        ("valve.X_lift.neutral", "V"), ("cylinder.X_lift.damping", "N s/m"),
        ("valve.X_lift.damping", ""), ("oil.bulk_modulus", "Pa"), ("sensor.X_lift.delay", "s"),
        ("sensor.inclination_lift_boom.zero", "rad"), ("sensor.pressure_X_lift_a.scale", ""),
        ("valve_control.X_lift.kd", "s/m"), ("end_stop.X_lift.damping", "s/m"),
    ],
)  # fmt: skip
def test_numbers_have_units(name, unit):
    assert parameter_unit(crane.load("patu655").tree, name) == unit
