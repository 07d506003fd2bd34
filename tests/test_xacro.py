"""xacro files expand as with xacro itself, with packages found by this program's rules."""

import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
from command_line import typed

import crane
from crane.common.errors import CraneError, CraneWarning, InputError
from crane.formats import robot_files

xacro = pytest.importorskip("xacro")

SHARED = Path(__file__).parents[2] / "shared" / "data" / "third_party" / "zx200" / "zx200.xacro"

MACROS = """<robot xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:property name="sizes" value="${xacro.load_yaml(package + '/config/sizes.yaml')}"/>
  <xacro:macro name="segment" params="name length mass:=1.5 *place">
    <link name="${name}">
      <inertial><origin xyz="0 0 ${length / 2}"/><mass value="${mass}"/>
        <inertia ixx="${mass * length**2 / 12}" ixy="0" ixz="0" iyy="${mass * length**2 / 12}"
          iyz="0" izz="${0.01 * mass}"/></inertial>
    </link>
    <joint name="${name}_joint" type="continuous">
      <xacro:insert_block name="place"/><child link="${name}"/><axis xyz="0 1 0"/>
    </joint>
  </xacro:macro>
</robot>
"""
ROBOT = """<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:arg name="long" default="false"/>
  <xacro:property name="package" value="$(find arm_parts)"/>
  <xacro:include filename="$(find arm_parts)/urdf/macros.xacro"/>
  <link name="base"/>
  <xacro:segment name="upper" length="${sizes['upper']}"><parent link="base"/></xacro:segment>
  <xacro:if value="$(arg long)">
    <xacro:segment name="lower" length="0.4" mass="${2 * sizes['weight']}">
      <parent link="upper"/>
    </xacro:segment>
  </xacro:if>
</robot>
"""


def load(path, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        return crane.load(path, **options)


@pytest.fixture
def arm(tmp_path):
    """A robot whose macros are in another package beside its own, which has another name."""
    parts, robot = tmp_path / "src" / "parts", tmp_path / "src" / "arm_robot"
    for folder in (parts / "urdf", parts / "config", robot / "urdf"):
        folder.mkdir(parents=True)
    (parts / "package.xml").write_text("<package><name>arm_parts</name></package>")
    (robot / "package.xml").write_text("<package><name>arm_robot</name></package>")
    (parts / "urdf" / "macros.xacro").write_text(MACROS)
    (parts / "config" / "sizes.yaml").write_text("upper: 0.6\nweight: 1.25\n")
    path = robot / "urdf" / "arm.urdf.xacro"
    path.write_text(ROBOT)
    return path


def test_includes_properties_and_yaml(arm):
    machine = load(arm)
    assert machine.joints == ("upper_joint",)
    inertial = machine.tree.links["upper"].inertial
    assert (inertial.mass, inertial.com) == (1.5, (0, 0, 0.3))
    assert inertial.tensor[0] == pytest.approx(1.5 * 0.36 / 12, rel=1e-15)


@pytest.mark.parametrize("value", [True, "true", 1])
def test_arguments(arm, value):
    machine = load(arm, arguments={"long": value})
    assert machine.joints == ("upper_joint", "lower_joint")
    assert machine.tree.links["lower"].inertial.mass == 2.5
    again = crane.formats.load_from_expression(machine.load_expression)
    assert again.joints == machine.joints and again.load_expression == machine.load_expression


def test_argument_that_the_file_does_not_have(arm):
    with pytest.raises(InputError) as caught:
        load(arm, arguments={"lang": 1})
    assert str(caught.value) == "arm.urdf.xacro has no argument 'lang', did you mean 'long'?"


@pytest.mark.parametrize("how", ["given", "above", "ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH"])
def test_where_packages_are_found(arm, how, tmp_path, monkeypatch):
    """Outside of its packages the file needs a package path."""
    away = tmp_path / "elsewhere" / "deep"
    away.mkdir(parents=True)
    path = Path(shutil.move(arm, away / "arm.xacro"))
    with pytest.raises(CraneError) as caught:
        load(path)
    assert str(caught.value) == (
        "arm.xacro: package 'arm_parts' is not found, say where it is: --packages FOLDER, "
        "packages=[...] in Python"
    )
    options = {"packages": [tmp_path / "src"]} if how == "given" else {}
    if how == "above":
        (tmp_path / "src" / "parts").rename(tmp_path / "elsewhere" / "arm_parts")
    elif how == "ROS_PACKAGE_PATH":
        monkeypatch.setenv(how, str(tmp_path / "src"))
    elif how == "AMENT_PREFIX_PATH":
        (tmp_path / "install" / "share").mkdir(parents=True)
        (tmp_path / "src" / "parts").rename(tmp_path / "install" / "share" / "arm_parts")
        monkeypatch.setenv(how, str(tmp_path / "install"))
    assert load(path, **options).joints == ("upper_joint",)


def test_include_by_package_scheme(arm):
    text = ROBOT.replace("$(find arm_parts)/urdf", "package://arm_parts/urdf")
    arm.write_text(text)
    assert load(arm).joints == ("upper_joint",)


def test_same_as_xacro_itself(tmp_path):
    """Expanded by xacro's own command and read as URDF."""
    text = ROBOT.replace("$(find arm_parts)", ".").replace("./urdf/", "")
    (tmp_path / "config").mkdir()
    (tmp_path / "config" / "sizes.yaml").write_text("upper: 0.6\nweight: 1.25\n")
    (tmp_path / "macros.xacro").write_text(MACROS)
    (tmp_path / "arm.xacro").write_text(text)
    plain = xacro.process_file(str(tmp_path / "arm.xacro"), mappings={"long": "true"}).toxml()
    (tmp_path / "arm.urdf").write_text(plain)
    one = load(tmp_path / "arm.xacro", arguments={"long": "true"})
    assert one.model == load(tmp_path / "arm.urdf").model


def test_a_urdf_with_xacro_in_it_is_expanded(arm):
    path = arm.rename(arm.with_name("arm.urdf"))
    assert load(path).joints == ("upper_joint",)


REFUSED = {
    "a mass in a macro": (
        ("mass=\"${2 * sizes['weight']}\"", 'mass="-1"'),
        "macros.xacro:5: link 'lower' has the mass -1 kg, give a positive one",
    ),
    "a joint": (
        ('<parent link="base"/>', '<parent link="bose"/>'),
        "arm.urdf.xacro:6: joint 'upper_joint' has the unknown parent 'bose', did you mean "
        "'base'?",
    ),
    "a name": (
        ("sizes['upper']", "size"),
        "arm.urdf.xacro: xacro refuses it (name 'size' is not defined when evaluating expression "
        "'size'), correct it",
    ),
    "a file": (
        ("urdf/macros.xacro", "urdf/macro.xacro"),
        None,
    ),
    "broken": (
        ('<link name="base"/>', '<link name="base">'),
        "arm.urdf.xacro:12: not XML, Opening and ending tag mismatch: link line 5 and robot, "
        "mend it",
    ),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_is_refused(kind, arm):
    (old, new), message = REFUSED[kind]
    assert ROBOT.count(old) == 1
    arm.write_text(ROBOT.replace(old, new))
    with pytest.raises(CraneError) as caught:
        load(arm, arguments={"long": True})
    if message is None:
        assert "No such file or directory" in str(caught.value)
    else:
        assert str(caught.value) == message
    assert typed("check", arm, "--arg", "long:=true").returncode == 2


def test_macros_without_end(tmp_path):
    path = tmp_path / "ring.xacro"
    path.write_text(
        '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:macro name="m" params="">'
        "<xacro:m/></xacro:macro><xacro:m/></robot>"
    )
    with pytest.raises(
        CraneError, match=r"ring.xacro: xacro refuses it \(its macros or files use"
    ):
        load(path)


def test_without_xacro(arm, monkeypatch):
    monkeypatch.setattr(robot_files, "_run_xacro_process", lambda _: {"missing": True})
    with pytest.raises(CraneError) as caught:
        load(arm)
    assert str(caught.value) == (
        "arm.urdf.xacro: is written with xacro, install it in the repository's folder: "
        "pip install '.[xacro]'"
    )


def test_home_is_written_into_it(arm):
    """Two bars about one pin, the second of which a loop holds level."""
    loop = (
        '<loop name="pin" type="revolute"><predecessor link="lower"><origin xyz="0 0 0.4"/>'
        '</predecessor><successor link="base"><origin xyz="0.4 0 0"/></successor>'
        '<axis xyz="0 1 0"/></loop><group_state name="home"><joint name="upper_joint" '
        'value="0.5"/></group_state></robot>'
    )
    arm.write_text(ROBOT.replace("</robot>", loop))
    sought = load(arm, arguments={"long": True})
    done = typed("check", arm, "--arg", "long:=true", "--write-home")
    assert "home written" in done.stdout, done.stderr
    assert "$(find arm_parts)" in arm.read_text()
    assert np.abs(load(arm, arguments={"long": True}).home - sought.home).max() < 1e-12


@pytest.mark.skipif(not SHARED.is_file(), reason="the excavator, ../shared/data, is not there")
def test_excavator_as_it_comes():
    machine = load(SHARED)
    assert machine.joints[:4] == ("swing_joint", "boom_joint", "arm_joint", "bucket_joint")
    assert typed("check", SHARED).returncode == 1
