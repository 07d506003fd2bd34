"""Machine files that extend others."""

import shutil

import numpy as np
import pytest
from broken_machines import DATA
from command_line import typed

import crane
from crane.common.errors import CraneError


@pytest.fixture
def folder(tmp_path):
    shutil.copytree(DATA / "four_bar", tmp_path / "base" / "four_bar")
    shutil.copy(DATA / "four_bar.yaml", tmp_path / "base")
    return tmp_path


def variant(folder, text, name="own.yaml"):
    path = folder / name
    path.write_text(f"extends: base/four_bar.yaml\n{text}")
    return path


def test_a_variant_is_its_base_with_other_numbers(folder):
    """Mappings key by key, all else whole; URDFs from where they are named."""
    base = crane.load(folder / "base" / "four_bar.yaml")
    text = "name: own\nfriction: {crank: {coulomb: 0.7}}\ntasks:\n  swing: {duration: 3}\n"
    own = crane.load(variant(folder, text))
    assert own.name == "own" and own.joints == base.joints
    assert own.friction["crank"].coulomb == 0.7
    assert own.friction["crank"].viscous == base.friction["crank"].viscous > 0
    assert own.friction.keys() == base.friction.keys()
    assert own.tasks["swing"].duration == 3 and own.tasks.keys() == base.tasks.keys()
    assert own.tasks["swing"].coefficients == base.tasks["swing"].coefficients
    assert (own.home == base.home).all()


def test_an_empty_value_takes_away(folder):
    assert crane.load(folder / "base" / "four_bar.yaml").end_stops
    own = crane.load(variant(folder, "end_stops:\ntasks: {swing: }\n"))
    assert not own.end_stops and "swing" not in own.tasks and own.tasks


def test_a_variant_of_a_variant_and_of_a_bundled_machine(folder):
    variant(folder, "friction: {crank: {coulomb: 0.7}}\n")
    second = folder / "second.yaml"
    second.write_text("extends: own.yaml\nfriction: {crank: {viscous: 0.9}}\n")
    law = crane.load(second).friction["crank"]
    assert (law.coulomb, law.viscous) == (0.7, 0.9)
    third = folder / "third.yaml"
    third.write_text("extends: patu655\nname: strong\nhydraulics: {supply: {pressure: 1.6e+7}}\n")
    strong = crane.load(third)
    assert strong.hydraulics.supply.pressure == 1.6e7
    assert strong.hydraulics.supply.flow == crane.load("patu655").hydraulics.supply.flow


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("frition: {}\n", "own.yaml:2: unknown key 'frition' in the machine file, did you mean"),
        ("friction: {crank: {colomb: 1}}\n", "own.yaml:2: unknown key 'colomb' in friction of"),
        ("chains: [{name: a, urdf: four_bar/ground.urdf}]\n", "own.yaml:2: chain 'a': there is no "
         "file 'four_bar/ground.urdf'"),
        ("home: {crank: no}\n", "own.yaml:2: 'crank' of 'home' is"),
    ],
)  # fmt: skip
def test_errors_name_the_file_that_is_wrong(folder, text, line):
    with pytest.raises(CraneError) as caught:
        crane.load(variant(folder, text))
    assert str(caught.value).startswith(line)
    assert "\n" not in str(caught.value)


def test_errors_of_the_base_name_the_base(folder):
    path = folder / "base" / "four_bar.yaml"
    wrong = path.read_text().replace("coulomb: 0.3", "colomb: 0.3")
    path.write_text(wrong)
    (at,) = (i for i, line in enumerate(wrong.splitlines(), 1) if "colomb" in line)
    with pytest.raises(CraneError, match=rf"^four_bar.yaml:{at}: unknown key 'colomb'"):
        crane.load(variant(folder, "name: own\n"))


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("extends: nothing.yaml\n", "own.yaml:1: the machine file: there is no file "
         "'nothing.yaml'"),
        ("extends: own.yaml\n", "own.yaml:1: 'own.yaml' is a variant of this file itself"),
        ("extends: base/four_bar/ground.urdf\n", "own.yaml:1: 'base/four_bar/ground.urdf' is no "
         "machine file (.yaml)"),
        ("extends: 3\n", "own.yaml:1: 'extends' of the machine file is 3, give text"),
    ],
)  # fmt: skip
def test_what_cannot_be_extended_is_refused(folder, text, line):
    path = folder / "own.yaml"
    path.write_text(text)
    done = typed("info", path)
    assert done.returncode == 2
    assert done.stderr.startswith(f"error: {line}") and done.stderr.count("\n") == 1


def test_a_variant_is_written_out_and_its_home_into_its_own_file(folder):
    path = variant(folder, "name: own\nfriction: {crank: {coulomb: 0.7}}\n")
    before = (folder / "base" / "four_bar.yaml").read_text()
    machine = crane.load(path)
    again = crane.load(crane.write_machine(machine, folder / "out"))
    assert again.friction == machine.friction and again.tasks == machine.tasks
    done = typed("check", path, "--write-home")
    assert done.returncode in (0, 1), done.stderr
    assert (folder / "base" / "four_bar.yaml").read_text() == before
    np.testing.assert_allclose(crane.load(path).home, machine.home, atol=1e-12)
    assert "home:" in path.read_text()
