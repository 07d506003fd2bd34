"""Reach and stroke ends in studies against closed forms, not against a grid."""

import numpy as np
import pytest
from warned import quiet

import crane
from crane.common.errors import ClosureError
from crane.studies.measures import measure_strokes

pytestmark = pytest.mark.slow

BASE, ARMS = np.array([0.3, 1.0]), (2.5, 1.6, 1.1)  # joint of the first arm, lengths [m]
EYE = np.array([0.5, 0.4])  # of the rods, on the arm that they move
MOUNTS = ((0.1, -0.9), (-0.7, 0.5), (-0.6, 0.55))  # of the barrels, from the arm's joint
STROKE = 0.25  # each way


def distance(mount, turn):
    """Length of a cylinder, the arm turned up by an angle."""
    c, s = np.cos(turn), np.sin(turn)
    return float(np.hypot(*(EYE @ [[c, s], [-s, c]] - mount)))


def body(name, length):
    return (
        f'<link name="{name}"><inertial><origin xyz="{length / 2} 0 0"/><mass value="20"/>'
        '<inertia ixx="1" ixy="0" ixz="0" iyy="4" iyz="0" izz="4"/></inertial></link>'
    )


def joint(name, kind, parent, child, xyz, axis, more=""):
    return (
        f'<joint name="{name}" type="{kind}"{more}><origin xyz="{xyz[0]} 0 {xyz[1]}"/>'
        f'<parent link="{parent}"/><child link="{child}"/><axis xyz="{axis}"/>'
        f'<limit lower="{-STROKE}" upper="{STROKE}" effort="1e5" velocity="1"/></joint>'
    )


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    """Three arms in a row in a vertical plane, a cylinder for each; strokes are zero in line."""
    parts, home = ['<link name="ground"/>'], []
    before, place = "ground", BASE
    for i, (length, mount) in enumerate(zip(ARMS, MOUNTS, strict=True), 1):
        eye = EYE - mount
        turn = np.arctan2(eye[1], eye[0])
        parts += [body(f"arm{i}", length), body(f"barrel{i}", 0.3), body(f"rod{i}", 0.3)]
        parts.append(joint(f"q{i}", "continuous", before, f"arm{i}", place, "0 -1 0"))
        parts.append(joint(f"b{i}", "continuous", before, f"barrel{i}", place + mount, "0 -1 0"))
        parts.append(
            joint(f"X{i}", "prismatic", f"barrel{i}", f"rod{i}", (distance(mount, 0), 0), "1 0 0",
                  ' independent="true"')
        )  # fmt: skip
        parts.append(
            f'<loop name="eye{i}" type="revolute"><predecessor link="rod{i}"/>'
            f'<successor link="arm{i}"><origin xyz="{EYE[0]} 0 {EYE[1]}"/></successor>'
            '<axis xyz="0 1 0"/></loop>'
        )
        home.append(f'<joint name="b{i}" value="{turn}"/><joint name="q{i}" value="0"/>')
        before, place = f"arm{i}", np.array([length, 0.0])
    parts.append('<link name="tip"/>')
    parts.append(
        f'<joint name="tip_fixed" type="fixed"><origin xyz="{ARMS[2]} 0 0"/>'
        '<parent link="arm3"/><child link="tip"/></joint>'
    )
    parts.append('<end_effector name="tip" group="tip" parent_link="tip"/>')
    states = f'<group_state name="home">{"".join(home)}</group_state>'
    file = tmp_path_factory.mktemp("arm") / "arm.urdf"
    file.write_text(f'<robot name="arm">{"".join(parts)}{states}</robot>')
    machine = quiet(crane.load, file)
    assert machine.active == ("X1", "X2", "X3") and machine.tip == "tip"
    return file


def test_reach_of_three_cylinders_is_that_in_line(arm):
    """Equal geometry has equal reach, whatever the mounting points and strokes."""
    wanted = BASE[0] + sum(ARMS)
    for change in ({}, {"barrel1.x": 0.08}, {"barrel2.z": 0.47}, {"X1.lower": -0.21}):
        found = measure_strokes(crane.load(arm, change))
        assert found["reach"] == pytest.approx(wanted, abs=1e-9), change


def test_a_study_orders_by_the_true_reach(arm):
    """Variants by a millimetre, where a grid of ten values per stroke errs by centimetres.

    The second arm is stopped before it is in line: a bent elbow, by the limit of X2, and the last
    arm in line with the first joint and the elbow's far end, level.
    """
    upper = np.linspace(-0.13, -0.10, 7)
    random = np.random.default_rng(3)
    order = random.permutation(len(upper))
    found = crane.study(arm, {"X2.upper": upper[order]}, measures=["reach"])
    mount = np.array(MOUNTS[1])

    def bend(stroke):
        # law of cosines in joint, barrel's pin and eye
        a, b, c = np.hypot(*EYE), np.hypot(*mount), distance(mount, 0) + stroke
        between = np.arccos((a * a + b * b - c * c) / (2 * a * b))
        straight = np.arccos((a * a + b * b - distance(mount, 0) ** 2) / (2 * a * b))
        return between - straight

    one, two, three = ARMS
    wanted = np.array(
        [
            BASE[0] + np.sqrt(one**2 + two**2 + 2 * one * two * np.cos(bend(x))) + three
            for x in upper
        ]
    )
    assert np.ptp(wanted) < 0.05
    assert found.columns["reach"] == pytest.approx(wanted[order], abs=1e-9)
    best = np.argsort(order)[np.argsort(wanted)[::-1]]
    assert found.rank("reach") == best.tolist()


@pytest.mark.slow
def test_equal_reach_gives_equal_numbers(arm):
    study = crane.study(arm, {"barrel3.z": np.linspace(0.52, 0.57, 5)}, measures=["reach"])
    assert np.ptp(study.columns["reach"]) < 1e-9


@pytest.mark.filterwarnings("ignore::crane.CraneWarning")
def test_ends_of_strokes_are_where_the_branch_ends():
    """By halving the way to where the loops no longer close, at any other stroke."""
    machine = crane.load("mini_forwarder", {"link3_G.x": 0.11, "link3_G.y": -0.01})
    closes, opens = 0.012, 0.0
    while closes - opens > 1e-12:
        middle = (closes + opens) / 2
        try:
            machine.closure.solve([0.0, 0.015, middle])
            closes = middle
        except ClosureError:
            opens = middle
    found = measure_strokes(machine)
    assert found["lower_X2"] == pytest.approx(closes, abs=1e-9)
    assert found["upper_X2"] == 0.03 and found["lower_X1"] == 0.0


@pytest.mark.slow
def test_reach_of_the_big_crane_is_that_of_its_workspace():
    machine = crane.load("patu655")
    space = crane.workspace(machine, 1000)
    assert measure_strokes(machine)["reach"] == pytest.approx(
        space.extreme("largest radius").value, abs=1e-9
    )


def test_the_share_says_how_fine_it_is(arm):
    study = crane.study(arm, {"X2.upper": [0.1, 0.2]}, measures=["range"])
    assert "range is counted on 10 values of each of 3 strokes" in study.to_text()
    assert "range" not in crane.study(arm, {"X2.upper": [0.1]}, measures=["reach"]).to_text()


def test_reach_ends_with_the_branch(tmp_path):
    """A slider pulls a crank into its dead centre: a tip on the crank would go on beyond it.

    The tip, at the angle 0.5 from the crank, is farthest from the axis' vertical plane where the
    crank is in line, x = 0.4 cos 0.5; on the other branch it would reach 0.4.
    """
    crank, rod, home = 0.3, 0.7, 0.8

    def slide(turn):
        return crank * np.cos(turn) + np.sqrt(rod**2 - (crank * np.sin(turn)) ** 2)

    lean = -np.arcsin(crank * np.sin(home) / rod)
    mass = '<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'  # noqa: E501
    tip = 0.4 * np.array([np.cos(0.5), np.sin(0.5)])
    (tmp_path / "slider.urdf").write_text(
        f'<robot name="slider"><link name="ground"/><link name="crank">{mass}</link>'
        f'<link name="rod">{mass}</link><link name="block">{mass}</link><link name="tip"/>'
        '<joint name="phi" type="continuous"><parent link="ground"/><child link="crank"/>'
        '<axis xyz="0 0 1"/></joint>'
        f'<joint name="psi" type="continuous"><origin xyz="{crank} 0 0"/><parent link="crank"/>'
        '<child link="rod"/><axis xyz="0 0 1"/></joint>'
        '<joint name="s" type="prismatic" independent="true"><parent link="ground"/>'
        f'<child link="block"/><axis xyz="1 0 0"/><limit lower="{slide(1.0)}" upper="1.2" '
        'effort="9" velocity="9"/></joint>'
        f'<joint name="tip_fixed" type="fixed"><origin xyz="{tip[0]} {tip[1]} 0"/>'
        '<parent link="crank"/><child link="tip"/></joint>'
        '<end_effector name="tip" group="tip" parent_link="tip"/>'
        f'<loop name="pin" type="revolute"><predecessor link="rod"><origin xyz="{rod} 0 0"/>'
        '</predecessor><successor link="block"/><axis xyz="0 0 1"/></loop>'
        f'<group_state name="home"><joint name="phi" value="{home}"/>'
        f'<joint name="psi" value="{lean - home}"/><joint name="s" value="{slide(home)}"/>'
        "</group_state></robot>"
    )
    machine = crane.load(tmp_path / "slider.urdf")
    # the horizontal distance is the same for all: it is seen along x, gravity taken as along y
    machine.model.gravity.linear = np.array([0.0, -9.81, 0.0])
    found = measure_strokes(machine)
    assert found["reach"] == pytest.approx(0.4 * np.cos(0.5), abs=1e-9)
    assert found["upper_s"] == pytest.approx(crank + rod, abs=1e-9)
    assert found["lower_s"] == slide(1.0)
