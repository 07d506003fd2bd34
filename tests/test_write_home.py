"""The home configuration written into files: other text stays, loading needs no search."""

import os
import re

import numpy as np
import pytest
import yaml
from broken_machines import DATA, LOOPED, MACHINE, copy_machine, swap
from command_line import typed

import crane
from crane.common.errors import CraneError, OutputError
from crane.formats import write_home
from crane.formats.machine_file.machine_reader import read_machine_spec

pytestmark = pytest.mark.filterwarnings("ignore::crane.common.errors.CraneWarning")

NUMBERS = """home:
    crank: 1.2   # held
    coupler: -1.0
    # and this
    rocker: 1.5
"""
SOME = """home:                # some
  crank: 1.2
  # and no more
"""
STATE = """<group_state name="home">
    <!-- held -->
    <joint name="crank" value = '0.25'/>
  </group_state>"""


def again(path):
    """The machine as written: the posture of before, without search."""
    before = crane.load(path, arguments={"nearest_assembly": True})
    assert write_home(path) == path.resolve()
    after = crane.load(path)
    assert after.closure.home_search is None
    np.testing.assert_allclose(
        after.home, before.home, rtol=0, atol=4e-16
    )  # wound up to half a turn
    return after


def four_bar(folder, home, end="\n"):
    """The four-bar linkage with another text for its home."""
    path = copy_machine(MACHINE, folder)
    text = path.read_text()
    (old,) = re.findall(r"^home:.*\n(?:  .*\n)+", text, re.MULTILINE)
    path.write_bytes(text.replace(old, home).replace("\n", end).encode())
    return path


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize(
    ("home", "then"),
    [
        (NUMBERS, NUMBERS.replace("-1.0", "X").replace("1.5", "X")),
        (SOME, SOME.replace("1.2\n", "1.2\n  coupler: X\n  rocker: X\n")),
        ("home: {crank: 1.2}  # flow\n", "home: {crank: 1.2, coupler: X, rocker: X}  # flow\n"),
        ("home: {}\n", "home: {crank: X, coupler: X, rocker: X}\n"),
    ],
)  # fmt: skip
def test_a_machine_file_keeps_its_other_text(home, then, end, tmp_path):
    path = four_bar(tmp_path, home, end)
    around = path.read_bytes().decode().split(home.replace("\n", end))
    machine = again(path)
    text = path.read_bytes().decode()
    assert text.startswith(around[0]) and text.endswith(around[1])
    written = text[len(around[0]) : len(text) - len(around[1])]
    for joint in ("coupler", "rocker", *(["crank"] if "crank: X" in then else [])):
        value = yaml.safe_load(written)["home"][joint]
        assert abs(value - machine.home[machine.column(joint)]) < 4e-16
        then = then.replace(f"{joint}: X", f"{joint}: {value!r}")
    assert written == then.replace("\n", end)


def test_units_of_home_stay(tmp_path):
    path = tmp_path / "home.yaml"
    path.write_text(
        "extends: patu655\nhome: {slew: 30 deg, q3: -45 °, X_lift: 117 mm}\n", encoding="utf-8"
    )
    machine = crane.load(path)
    write_home(path)
    text = path.read_text(encoding="utf-8")
    assert "slew: 30 deg" in text and "X_lift: 117 mm" in text
    assert re.search(r"q3: -45\.0\d+ °, X_lift", text)
    read = read_machine_spec(path).home
    assert [read[joint] for joint in machine.joints] == machine.home.tolist()


def test_a_machine_file_without_home_gets_one(tmp_path):
    path = four_bar(tmp_path, "")
    before = path.read_text()
    machine = again(path)
    added = path.read_text().removeprefix(before)
    home = yaml.safe_load(added)["home"]
    assert tuple(home) == machine.joints
    np.testing.assert_allclose(list(home.values()), machine.home, rtol=0, atol=4e-16)


def test_one_line_of_yaml(tmp_path):
    path = four_bar(tmp_path, "")
    path.write_text(str(yaml.safe_dump(yaml.safe_load(path.read_text()), default_flow_style=True)))
    again(path)


def test_numbers_that_yaml_would_read_as_text(tmp_path):
    """1e-05 is a word there."""
    path = four_bar(tmp_path, "home: {crank: 1.0e-5, coupler: -1.0, rocker: 1.5}\n")
    assert again(path).home[0] == 1e-5


def test_shared_values_are_refused_and_the_file_stays(tmp_path):
    path = four_bar(tmp_path, "home: {crank: &x 1.2, coupler: -1.0, rocker: 1.5}\n")
    before = path.read_bytes()
    with pytest.raises(OutputError, match="shares values with other keys"):
        write_home(path)
    assert path.read_bytes() == before and os.listdir(tmp_path).count(path.name) == 1


@pytest.mark.parametrize(
    "state",
    [
        "",
        '<group_state name="home" group="all"/>',
        STATE,
        '<group_state name="home"><joint value="0.25" name=" crank "></joint></group_state>',
        '<group_state name="rest"><joint name="crank" value="9"/></group_state>',
    ],
)  # fmt: skip
def test_a_urdf_keeps_its_other_text(state, tmp_path):
    path = copy_machine(LOOPED, tmp_path)
    swap("</robot>", f"<!-- ü > ' -->\n{state}</robot>", LOOPED).apply(tmp_path)
    before = path.read_text()
    again(path)
    after = path.read_text()
    assert after.startswith(before[: before.index("<!-- ü")])
    for kept in re.findall(r"<!--.*?-->", before, re.DOTALL):
        assert kept in after
    assert ('value="9"' in after) == ('value="9"' in before)


def test_robot_yaml(tmp_path):
    (tmp_path / "robot.urdf").write_text((DATA / "delta" / "robot.urdf").read_text())
    (tmp_path / "robot.yaml").write_text((DATA / "delta" / "robot.yaml").read_text())
    again(tmp_path / "robot.yaml")
    assert crane.load(tmp_path).home.any()


def test_packages_and_mjcf_are_left_alone():
    for name in ("mini_forwarder", "panda"):
        with pytest.raises(
            CraneError, match=f"belongs to a package, .*crane convert {name} FOLDER"
        ):
            write_home(name)
    pytest.importorskip("mujoco")
    with pytest.raises(OutputError, match=r"stewart\.xml: is a MJCF, write it into a copy"):
        write_home(DATA / "stewart.xml")


def test_the_command(tmp_path):
    path = copy_machine(LOOPED, tmp_path)
    swap('rpy="0 0 1.4"', 'rpy="0 0 0"', LOOPED).apply(tmp_path)
    told = typed("check", path)
    assert told.returncode == 1 and "can be assembled another way" in told.stdout
    done = typed("check", path, "--write-home")
    assert done.stdout.startswith(f"home written to {path}\n")
    assert done.returncode == 0 and "another way" not in done.stdout and "closed to" in done.stdout
    missing = typed("check", tmp_path / "no.urdf", "--write-home")
    assert missing.returncode == 2 and "written" not in missing.stdout
