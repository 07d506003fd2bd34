"""Loops of an open description: proposed, added by a command, hinted at by a file."""

import os
import re
import warnings
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import yaml
from command_line import typed
from excavators import planar
from warned import without_a_word

import crane
from crane.common.errors import CraneError, CraneWarning
from crane.formats import check

MODELS = Path(__file__).parents[1] / "models"
ROBOTS = Path(__file__).parents[2] / "shared/data/third_party/parallel_robots"

pytestmark = pytest.mark.filterwarnings("ignore::crane.CraneWarning")


def opened(name, folder, without=None):
    """A bundled machine without its loops, or without one; the machine file."""
    text = (MODELS / f"{name}.yaml").read_text()
    text = text.replace("urdf/", f"{MODELS}/urdf/")
    data = yaml.safe_load(text)
    data["loops"] = [loop for loop in data["loops"] if without not in (None, loop["name"])]
    for key in ("loops", "tasks", "control", "hydraulics", "end_stops", "friction", "gas_springs"):
        if key != "loops" or not data["loops"]:
            data.pop(key, None)
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


def joined(loops):
    """By frames, in either order, what loops are."""
    return {frozenset((one.predecessor, one.successor)): (one.type, one.axis) for one in loops}


@pytest.mark.parametrize("name", ["mini_forwarder", "patu655", "kr300"])
def test_loops_that_were_removed_are_proposed(name, tmp_path):
    whole = crane.load(name)
    report = check(opened(name, tmp_path))
    found = [one.loop for one in report.proposals]
    assert joined(found) == joined(whole.closure.equations.loops)
    assert yaml.safe_load("\n".join(report.proposed_loop_lines))["loops"] == [
        {
            "name": one.name, "type": one.type, "predecessor": one.predecessor,
            "successor": one.successor, "axis": [0, 0, 1],
        }
        for one in found
    ]  # fmt: skip
    assert report.next_command == f"crane add loops {tmp_path / name}.yaml"


@pytest.mark.parametrize("loop", ["A1_eye", "A2_eye", "J", "K"])
def test_one_loop_that_was_removed_is_proposed(loop, tmp_path):
    wanted = joined(x for x in crane.load("mini_forwarder").closure.equations.loops
                    if x.name == loop)  # fmt: skip
    report = check(opened("mini_forwarder", tmp_path, loop))
    assert joined(one.loop for one in report.proposals) == wanted


def test_the_gap_is_that_of_the_frames(tmp_path):
    """By frames; a slide that ends in one of them covers what is along it."""
    path = opened("mini_forwarder", tmp_path)
    machine, report = crane.load(path), check(path)
    data = machine.model.createData()
    pin.forwardKinematics(machine.model, data, machine.home)

    def at(link):
        return pin.updateFramePlacement(machine.model, data, machine.frame(link)).translation

    gaps = {one.loop.successor: one for one in report.proposals}
    two = gaps["link5_J"]
    assert two.gap == pytest.approx(np.linalg.norm(at("link4_J") - at("link5_J")), rel=1e-9)
    slide = machine.model.getJointId("X1")
    along = data.oMi[slide].rotation @ machine.tree.joints["X1"].axis
    way = at("link2_D") - at("A1_eye")
    beside = np.linalg.norm(np.cross(way, along))
    assert gaps["link2_D"].gap == pytest.approx(beside, rel=1e-9)
    assert beside < 0.99 * np.linalg.norm(way)


def test_the_machine_with_the_proposed_loops_is_the_whole_one(tmp_path):
    added = crane.formats.add_loops(
        opened("mini_forwarder", tmp_path), out=tmp_path / "closed.yaml"
    )
    closed, whole = crane.load(added.path), crane.load("mini_forwarder")
    assert closed.active == whole.active and added.mobility == 3
    rng = np.random.default_rng(0)
    home = whole.home[whole.closure.active]
    q_a = home + rng.uniform(-1, 1, (20, 3)) * [1, 0.003, 0.003]
    v = rng.uniform(-1, 1, (20, 3)) * [1, 0.05, 0.05]
    one, two = (crane.Dynamics(x).inverse(q_a, v, 0 * v) for x in (whole, closed))
    assert two == pytest.approx(one, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("mass", ["", "1e-9"])
def test_frames_without_names_that_meet(mass, tmp_path):
    """Of a linkage as CAD exporters leave it: ends that coincide, perhaps with a dummy mass."""
    text = five_bar("tcp_a", "tcp_b").replace("0.3 0 0", "0.15 0.1 0", 1)
    text = text.replace('"0.3 0 0" rpy', '"0.3 0 0"')
    body = f'<inertial><mass value="{mass}"/><inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" '
    body += 'iyz="0"/></inertial>'
    text = re.sub(r'<link name="(tcp_.)"/>', rf'<link name="\1">{body * bool(mass)}</link>', text)
    text = re.sub(r'(tcp_b_frame.*?xyz=)"[^"]*"', r'\1"-0.15 0.1 0"', text, flags=re.DOTALL)
    (tmp_path / "bars.urdf").write_text(text)
    (proposal,) = check(tmp_path / "bars.urdf").proposals
    assert (proposal.loop.type, proposal.loop.axis) == ("revolute", (0, 0, 1))
    assert proposal.gap == pytest.approx(0, abs=1e-15)
    added = crane.formats.add_loops(tmp_path / "bars.urdf", out=tmp_path / "bars.yaml")
    assert added.mobility == 2


HUNG = """<link name="{0}"><inertial><origin xyz="0.3 0 0"/><mass value="5"/><inertia ixx="0.01"
 iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="{0}_pin" type="continuous"><origin xyz="{1}" rpy="0 {2} 0"/><parent link="{3}"/>
 <child link="{0}"/><axis xyz="0 1 0"/></joint>"""


def test_a_barrel_and_a_rod_that_hang_on_two_bodies_slide_in_each_other(tmp_path):
    """Drawn by hand: barrel on the house, rod on the boom, along the line between their pins."""
    foot, eye = np.array([0.6, 0, 0.7]), np.array([1.9, 0, 1.8])
    pitch = -np.arctan2(*(eye - foot)[[2, 0]])
    more = HUNG.format("lift_barrel", "0.6 0 0.7", pitch, "house")
    more += HUNG.format("lift_rod", "1.9 0 0.3", pitch, "boom")
    path = planar(tmp_path, more=more)
    (proposal,) = check(path).proposals
    loop = proposal.loop
    assert (loop.type, loop.predecessor) == ("prismatic", "lift_barrel")
    assert loop.successor == "lift_rod"
    assert loop.axis == pytest.approx((1, 0, 0), abs=1e-9)
    machine = crane.load(crane.formats.add_loops(path, out=tmp_path / "d.yaml").path)
    assert machine.closure.degrees_of_freedom == 2
    lift = crane.load(tmp_path / "d.yaml", active=["lift", "fold"])
    q = lift.closure.solve(np.array([-0.4, 1.0]))
    data = lift.model.createData()
    pin.forwardKinematics(lift.model, data, q)
    barrel, rod = (
        pin.updateFramePlacement(lift.model, data, lift.frame(x))
        for x in ("lift_barrel", "lift_rod")
    )
    along = barrel.rotation[:, 0]
    way = rod.translation - barrel.translation
    assert np.linalg.norm(way - (way @ along) * along) < 1e-12
    assert rod.rotation == pytest.approx(barrel.rotation, abs=1e-12)


def test_open_machines_have_no_proposals(tmp_path):
    assert check("tx40").proposals == ()
    report = check(planar(tmp_path))
    assert report.proposals == () and report.proposed_loop_lines == []
    assert report.next_command.startswith("crane simulate ")


@pytest.mark.parametrize("name", ["5bar_linkage_iso6d", "robot_delta", "wl16_like"])
def test_robots_of_other_people_close_by_one_command(name, tmp_path):
    """The loops of the file beside them are found from the URDF alone."""
    if not ROBOTS.is_dir():
        pytest.skip(f"{ROBOTS} is not there")
    said = yaml.safe_load((ROBOTS / name / "robot.yaml").read_text())["closed_loop"]
    added = crane.formats.add_loops(ROBOTS / name / "robot.urdf", out=tmp_path / "robot.yaml")
    assert len(added.loops) == len(said)
    machine = crane.load(added.path)
    assert machine.closure.residual(machine.home) < 1e-10
    whole = crane.load(ROBOTS / name / "robot.yaml")
    assert machine.closure.degrees_of_freedom == whole.closure.degrees_of_freedom


def test_what_cannot_be_is_refused_in_one_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    planar(tmp_path)
    done = typed("add", "loops", "digger.urdf", cwd=tmp_path)
    assert done.returncode == 2 and done.stderr.splitlines()[-1] == (
        "error: 'digger' has no frames that look like ends of a loop and meet at home: give a "
        'home where they do (<group_state name="home">), or write loops in a machine file'
    )
    (tmp_path / "far.urdf").write_text(
        five_bar("closing_foot_1", "closing_foot_2").replace("0.3 0 0", "5 0 0", 1)
    )
    with warnings.catch_warnings(), pytest.raises(CraneError) as caught:
        warnings.simplefilter("ignore", CraneWarning)
        crane.formats.add_loops("far.urdf", out="far.yaml")
    assert str(caught.value).startswith(
        "the machine does not close with the proposed loops foot: far.yaml:"
    )
    assert sorted(os.listdir(tmp_path)) == ["digger.urdf", "far.urdf"]


def test_the_command(tmp_path):
    (tmp_path / "bars.urdf").write_text(five_bar("closing_foot_1", "closing_foot_2"))
    done = typed("add", "loops", "bars.urdf", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0].startswith("- {name: foot, type: revolute, predecessor: closing_foot_1, ")
    assert lines[1].startswith("2 degrees of freedom, driven by ")
    assert lines[2] == "written to bars_closed.yaml"
    again = typed("add", "loops", "bars.urdf", cwd=tmp_path)
    assert again.returncode == 2 and "exists already" in again.stderr


# --- loops that a file hints at -----------------------------------------------------------------


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
    machine = without_a_word(crane.load, tmp_path / "bars.yaml")
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
    without_a_word(crane.load, tmp_path / "bars.urdf")


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
        return [x.message for x in check(path).findings if "no joint closes" in x.message]

    (line,) = told(tmp_path / "robot.urdf")
    assert f"looks like {count} loops" in line
    closing = (ROBOTS / name / "robot.yaml").read_text()
    (tmp_path / "robot.yaml").write_text(closing)
    left = count - len(yaml.safe_load(closing)["closed_loop"])
    assert [f"looks like {left} loop" in line for line in told(tmp_path / "robot.yaml")] == (
        [True] if left else []
    )
