"""Open loops that a file hints at are reported with the missing lines, which close them."""

import re
import warnings
from pathlib import Path

import numpy as np
import pytest
import yaml

import crane
from crane.common.errors import CraneWarning
from crane.formats.checks import check

ROBOTS = Path(__file__).parents[2] / "shared/data/third_party/parallel_robots"

LINK = """<link name="{}"><inertial><origin xyz="{} 0 0"/><mass value="1"/>
  <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
"""
JOINT = """<joint name="{}" type="{}"><origin xyz="{}"/><parent link="{}"/><child link="{}"/>
  <axis xyz="0 0 1"/><limit lower="-2" upper="3" effort="1" velocity="1"/></joint>
"""


def five_bar(one, two):
    """A five-bar linkage as onshape-to-robot leaves it: two arms whose ends should meet."""
    text = '<robot name="bars"><link name="base"/>\n'
    for side, x, end in (("l", 0.0, one), ("r", 0.3, two)):
        text += LINK.format(f"upper_{side}", 0.1) + LINK.format(f"lower_{side}", 0.15)
        text += f'<link name="{end}"/>\n'
        text += JOINT.format(f"hip_{side}", "revolute", f"{x} 0 0", "base", f"upper_{side}")
        text += JOINT.format(
            f"knee_{side}", "revolute", "0.2 0 0", f"upper_{side}", f"lower_{side}"
        )
        text += JOINT.format(f"{end}_frame", "fixed", "0.3 0 0", f"lower_{side}", end)
    return text + "</robot>"


def test_ends_that_nothing_joins(tmp_path):
    (tmp_path / "bars.urdf").write_text(five_bar("closing_foot_1", "closing_foot_2"))
    with pytest.warns(CraneWarning) as told:
        assert crane.load(tmp_path / "bars.urdf").closure.degrees_of_freedom == 4
    (line,) = (str(one.message) for one in told)
    assert line.startswith(
        "bars.urdf:6: no joint closes what looks like 1 loop, closing_foot_1 and closing_foot_2 "
        "(300 mm and 0 deg apart at zero): close them by crane add loops, paste what crane check "
    )
    assert line.isprintable()
    report = check(tmp_path / "bars.urdf")
    assert report.status == 1 and line.removeprefix("bars.urdf:6: ") == report.findings[0].message
    # what it says is what closes it
    assert report.proposed_loop_lines == [
        "loops:  # proposed, nothing closes them yet",
        "  - {name: foot, type: revolute, predecessor: closing_foot_1, successor: closing_foot_2, "
        "axis: [0, 0, 1]}  # 300 mm apart at home",
    ]
    assert report.next_command == f"crane add loops {tmp_path / 'bars.urdf'}"
    loops = yaml.safe_load("\n".join(report.proposed_loop_lines))["loops"]
    text = {
        "name": "bars", "chains": [{"name": "bars", "urdf": "bars.urdf"}], "loops": loops,
        "active": ["hip_l", "hip_r"],
        "home": {"hip_l": 2.0, "knee_l": -1.0, "hip_r": 1.1, "knee_r": 1.0},
    }  # fmt: skip
    (tmp_path / "bars.yaml").write_text(yaml.safe_dump(text))
    with warnings.catch_warnings():
        warnings.simplefilter("error", CraneWarning)
        machine = crane.load(tmp_path / "bars.yaml")
    assert machine.closure.degrees_of_freedom == 2
    assert machine.closure.residual(machine.home) < 1e-9
    assert np.ptp(machine.home) > 0


@pytest.mark.parametrize(
    ("one", "two"),
    [
        ("closing_foot_1", "closing_foot_3"), ("closing_foot_1", "closing_toe_2"),
        ("foot_1", "foot_2"), ("close_valve_1", "close_valve_2"), ("closing_1_A", "closing_1_2"),
    ],
)  # fmt: skip
def test_names_that_go_together_by_chance(one, two, tmp_path):
    (tmp_path / "bars.urdf").write_text(five_bar(one, two))
    with warnings.catch_warnings():
        warnings.simplefilter("error", CraneWarning)
        crane.load(tmp_path / "bars.urdf")


def test_frames_of_joints_and_many_loops(tmp_path):
    """example-parallel-robots names joints, too; of many loops the first are told."""
    text = five_bar("closedloop1_A", "closedloop1_B").replace("closedloop1_A_frame", "x")
    text = text.replace('"closedloop1_A"', '"sphere"').replace('name="x"', 'name="closedloop1_A"')
    for i in range(2, 9):
        for side, letter in (("l", "A"), ("r", "B")):
            name = f"closedLoop{i}_{letter}"
            text += f'<link name="{name}"/>'
            text += JOINT.format(f"f{name}", "fixed", f"0 {i} 0", f"lower_{side}", name)
    text = text.replace("</robot>", "") + "</robot>"
    (tmp_path / "bars.urdf").write_text(text)
    with pytest.warns(
        CraneWarning, match="looks like 8 loops, sphere and closedloop1_B .*, 4 more:"
    ):
        crane.load(tmp_path / "bars.urdf")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["robot_delta", "wl16_like", "digit_like_2legs"])
def test_robots_without_the_file_that_closes_them(name, tmp_path):
    """As a CAD exporter left them, with limits that can be read: told without, silent with."""
    if not ROBOTS.is_dir():
        pytest.skip(f"{ROBOTS} is not there")
    text = (ROBOTS / name / "robot.urdf").read_text()
    text = re.sub("<limit (?![^>]*lower)", '<limit lower="-3" upper="3" ', text)
    (tmp_path / "robot.urdf").write_text(text)
    count = len(set(re.findall(r'"(closedloop\d+)_[AB]"', text)))

    def told(path):
        return [x.message for x in check(path).findings if "nothing closes" in x.message]

    (line,) = told(tmp_path / "robot.urdf")
    assert f"looks like {count} loops" in line
    closing = (ROBOTS / name / "robot.yaml").read_text()
    (tmp_path / "robot.yaml").write_text(closing)
    left = count - len(yaml.safe_load(closing)["closed_loop"])
    assert [f"looks like {left} loop" in line for line in told(tmp_path / "robot.yaml")] == (
        [True] if left else []
    )
