"""Machines in the convention of Gepetto's example-parallel-robots."""

import re

import numpy as np
import pytest
from broken_machines import DATA

import crane
from crane.common.errors import CraneError, CraneWarning


def delta(folder, *changes):
    """The delta robot with its yaml changed."""
    (folder / "robot.urdf").write_text((DATA / "delta" / "robot.urdf").read_text())
    text = (DATA / "delta" / "robot.yaml").read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / "robot.yaml").write_text(text)
    return folder


def test_folder_and_yaml_are_the_same_machine(tmp_path):
    one, two = crane.load(DATA / "delta"), crane.load(DATA / "delta" / "robot.yaml")
    assert one.path == two.path and one.name == "delta"
    other = crane.load(delta(tmp_path, ("UJOINT_XY", "CARDAN")))  # its older name
    assert other.joints == one.joints


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("'SPHERICAL'", "'BALL'", "joint type 'BALL' is unknown, known: CARDAN, FIXED, SPHERICAL"),
        ("'SPHERICAL'", "'UJOINT_XX'", "joint type 'UJOINT_XX' is unknown, did you mean 'UJOINT_"),
        (", 'SPHERICAL'", "", "6 joint types for 7 joints, give one of each"),
        ("['3d', '3D'", "['5d', '3D'", "a closed loop has the type '5d', write 3d or 6d"),
        ("['3d', '3D'", "['3D'", "4 types for 5 closed loops, give each one"),
        ("'closedloop1_A'", "'closedlop1_A'", "the frame 'closedlop1_A' is unknown, did you mean"),
        ("['closedloop1_A', ", "[", "'closed_loop' lists a list, write pairs as [a, b]"),
        ("'motor3'", "'elbow1a'", "the motor 'elbow1a' is UJOINT_XY, drive a joint with one fre"),
        ("'motor3'", "'motor4'", "joint 'motor4' is unknown, did you mean 'motor3'?"),
        ("name_mot", "name_motor", "unknown key 'name_motor' in the machine file, did you mean"),
        ("'elbow1b'", "'elbow9b'", "joint 'elbow9b' is unknown, did you mean 'elbow"),
    ],
)
def test_bad_parallel_robots_are_refused(old, new, line, tmp_path):
    folder = delta(tmp_path, (old, new))
    with pytest.raises(CraneError) as caught:
        crane.load(folder)
    assert line in str(caught.value)
    assert str(caught.value).startswith("robot.yaml:")


def test_a_yaml_without_its_urdf(tmp_path):
    delta(tmp_path)
    (tmp_path / "robot.urdf").unlink()
    with pytest.raises(CraneError, match=r"robot\.yaml: there is no robot\.urdf beside it"):
        crane.load(tmp_path)


def test_six_d_locks_all_and_is_the_default(tmp_path):
    """A crank whose rod is cut rigidly in the middle: the same as one without the cut."""
    urdf = (DATA / "four_bar_loop.urdf").read_text()
    urdf = re.sub(r"<loop.*</loop>", "", urdf, flags=re.DOTALL).replace(' independent="true"', "")
    extra = (
        '<link name="cut_A"/><joint name="cut_A_fixed" type="fixed"><origin xyz="0.4 0 0" '
        'rpy="0 0 0.3"/><parent link="coupler_arm"/><child link="cut_A"/></joint>'
        '<link name="eye"><inertial><mass value="0.1"/><inertia ixx="1e-5" iyy="1e-5" izz="1e-5" '
        'ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="pin" type="continuous">'
        '<origin xyz="0.3 0 0"/><parent link="rocker_arm"/><child link="eye"/><axis xyz="0 0 1"/>'
        "</joint></robot>"
    )
    (tmp_path / "robot.urdf").write_text(urdf.replace("</robot>", extra))
    (tmp_path / "robot.yaml").write_text("closed_loop: [[cut_A, eye]]\nname_mot: [crank]\n")
    machine = crane.load(tmp_path)
    assert [loop.type for loop in machine.closure.equations.loops] == ["fixed"]
    same = crane.load(DATA / "four_bar_loop.urdf")
    q = machine.closure.solve([0.2])
    columns = [machine.column(joint) for joint in same.joints]
    np.testing.assert_allclose(q[columns], same.closure.solve([0.2]), atol=1e-9)


def test_fixed_joints(tmp_path):
    """A joint that is really none: the same as the machine with that joint locked at zero."""
    urdf = (DATA / "four_bar_loop.urdf").read_text().replace(' independent="true"', "")
    (tmp_path / "robot.urdf").write_text(re.sub(r"<loop.*</loop>", "", urdf, flags=re.DOTALL))
    (tmp_path / "open.urdf").write_text((tmp_path / "robot.urdf").read_text())
    (tmp_path / "robot.yaml").write_text(
        "name_mot: [crank, rocker]\njoint_name: [coupler]\njoint_type: [FIXED]\n"
    )
    machine = crane.load(tmp_path)
    same = crane.load(tmp_path / "open.urdf", lock={"coupler": 0.0})
    assert machine.joints == same.joints == ("crank", "rocker")
    for q_a in np.random.default_rng(3).uniform(-1, 1, (3, 2)):
        np.testing.assert_allclose(
            crane.Dynamics(machine).mass_matrix(q_a), crane.Dynamics(same).mass_matrix(q_a)
        )


def test_motors_are_proposed_where_none_are_named(tmp_path):
    with pytest.warns(CraneWarning, match="3 degrees of freedom and no active joints named"):
        crane.load(delta(tmp_path, ("name_mot: ['motor1', 'motor2', 'motor3']\n", "")))
