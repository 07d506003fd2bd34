"""Errors of valid parts that make no machine, line by line."""

import pytest
from broken_machines import GROUND, MINI, ROCKER, assert_refused, case, copy_machine, swap

import crane
from crane.common.errors import CraneError

CHAIN_B1 = "urdf/mini_forwarder/chain_b1.urdf"
CHAIN_C = "urdf/mini_forwarder/chain_c.urdf"

# A wheel that no loop holds.
WHEEL = """<link name="wheel">
    <inertial>
      <mass value="1"/>
      <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>
    </inertial>
  </link>
  <joint name="spin" type="continuous">
    <parent link="rocker_pin"/>
    <child link="wheel"/>
  </joint>
</robot>"""

ROD_INERTIAL = """    <inertial>
      <origin xyz="-0.02544736842105262 0 0"/>
      <mass value="0.00646"/>
      <inertia ixx="0" ixy="0" ixz="0" iyy="1.3944309649122797e-06" iyz="0"
               izz="1.3944309649122797e-06"/>
    </inertial>
"""

pytestmark = pytest.mark.filterwarnings("ignore::crane.common.errors.CraneWarning")

# A four-bar linkage.
MECHANISM = [
    case(
        "active joints that cannot drive",
        "four_bar.yaml:12: the active joints crank, coupler cannot drive spin: choose others, "
        "such as [coupler, spin] (condition 1.47), or [crank, spin] (condition 1.6)",
        swap("</robot>", WHEEL, ROCKER),
        swap("active: [crank]", "active: [crank, coupler]"),
        swap("control:\n  crank: {kp: 50, ki: 20}\n", ""),
        swap(
            "    active:\n      crank: [1.2, 0.4, -0.2]\n", "    tip: {x: [0], y: [0], z: [0]}\n"
        ),
    ),
    case(
        "no freedom left",
        "four_bar.yaml:12: the loops leave crank no freedom to move: check the "
        "types and axes of the loops, and the axes of the joints",
        swap('<axis xyz="0 0 1"/>\n    <limit', '<axis xyz="0 1 0"/>\n    <limit', GROUND),
        swap("type: revolute", "type: spherical"),
    ),
    case(
        "joint about a wrong axis",
        "ground.urdf:10: joint 'crank': its axis is 90 degrees off those of its neighbours "
        "coupler, rocker, loop pin, so that it cannot move with them: turn it to "
        '<axis xyz="0 0 1"/>',
        swap('<axis xyz="0 0 1"/>\n    <limit', '<axis xyz="0 1 0"/>\n    <limit', GROUND),
    ),
    case(
        "loop about an axis that is a little off",
        "four_bar.yaml:10: loop 'pin': its axis is 5.71 degrees off those of its neighbours "
        "crank, coupler, rocker, so that it cannot move with them: turn it to axis: [0, 0, 1]",
        swap("successor: rocker_pin}", "successor: rocker_pin, axis: [0.1, 0, 1]}"),
    ),
    case(
        "loop that locks nothing",
        "four_bar.yaml:11: loop 'again' locks nothing that the joints do not lock "
        "already: remove it",
        swap(
            "successor: rocker_pin}\n",
            "successor: rocker_pin}\n"
            "  - {name: again, type: revolute, predecessor: pin_B, successor: rocker_arm}\n",
        ),
    ),
    case(
        "all loops lock nothing",
        "four_bar.yaml:10: loop 'pin' locks nothing that the joints do not lock "
        "already: remove it",
        swap(
            "predecessor: coupler_pin, successor: rocker_pin}\n",
            "predecessor: pin_B, successor: rocker_arm}\n",
        ),
        swap("active: [crank]", "active: [crank, coupler, rocker]"),
        swap("control:\n  crank: {kp: 50, ki: 20}\n", ""),
        swap(
            "    active:\n      crank: [1.2, 0.4, -0.2]\n", "    tip: {x: [0], y: [0], z: [0]}\n"
        ),
    ),
    case(
        "loop too tight",
        "four_bar.yaml:10: loop 'pin' cannot be closed from the home guess (crank ="
        " 1.2): it stays 0.101 m open, correct the frames or the guess",
        swap("type: revolute", "type: fixed"),
    ),
    case(
        "links too short",
        "four_bar.yaml:10: loop 'pin' cannot be closed from the home guess (crank ="
        " 1.2): it stays 3.35 m open, correct the frames or the guess",
        swap('<origin xyz="0.3 0 0"/>', '<origin xyz="0.05 0 0"/>', ROCKER),
        swap(
            '<origin xyz="0.4 0 0"/>\n    <parent link="ground"/>',
            '<origin xyz="4 0 0"/>\n    <parent link="ground"/>',
            GROUND,
        ),
    ),
    case(
        "frames beside each other",
        "four_bar.yaml:10: loop 'pin' cannot be closed from the home guess (crank ="
        " 1.2): it stays 0.01 m open, correct the frames or the guess",
        swap('<origin xyz="0.3 0 0"/>', '<origin xyz="0.3 0 0.01"/>', ROCKER),
    ),
    case(
        "axes at an angle",
        "four_bar.yaml:10: loop 'pin' cannot be closed from the home guess (crank ="
        " 1.2): it stays 0.0961 rad open, correct the frames or the guess",
        swap('<origin xyz="0.3 0 0"/>', '<origin xyz="0.3 0 0" rpy="0.1 0 0"/>', ROCKER),
    ),
    case(
        "axes opposed",
        "four_bar.yaml:10: loop 'pin' closes at home with its axes opposed: turn a "
        "frame over, or guess its joints better",
        swap(
            '<origin xyz="0.3 0 0"/>',
            '<origin xyz="0.3 0 0" rpy="3.141592653589793 0 0"/>',
            ROCKER,
        ),
    ),
    case(
        "home out of reach",
        "four_bar.yaml:10: loop 'pin' cannot be closed at home (crank = 1.2): it "
        "stays 0.0132 m open, choose other values or guess more passive joints",
        swap('<origin xyz="0.3 0 0"/>', '<origin xyz="0.01 0 0"/>', ROCKER),
    ),
    case(
        "home outside of limits",
        "four_bar.yaml:15: home of 'crank' is 2.6, outside of its limits -1.5 to "
        "2.5 (ground.urdf:14), choose one within them",
        swap("  crank: 1.2", "  crank: 2.6"),
    ),
    case(
        "home singular",
        "four_bar.yaml:14: the home configuration (crank = 0) is at the edge of the "
        "branch: choose another under 'home'",
        swap('<origin xyz="0.3 0 0"/>', '<origin xyz="0.2 0 0"/>', ROCKER),
        swap(
            "  crank: 1.2\n  coupler: -1.0\n  rocker: 1.5", "  crank: 0\n  coupler: 0\n  rocker: 0"
        ),
    ),
    case(
        "home near singular",
        "four_bar.yaml:14: the home configuration (crank = 0) is at the edge of the "
        "branch: choose another under 'home'",
        swap('<origin xyz="0.3 0 0"/>', '<origin xyz="0.2 0 0"/>', ROCKER),
        swap(
            "  crank: 1.2\n  coupler: -1.0\n  rocker: 1.5",
            "  crank: 0\n  coupler: 0.1\n  rocker: 0.1",
        ),
    ),
]

# The bundled crane.
MINI_FORWARDER = [
    case(
        "chain left out",
        "mini_forwarder.yaml:{line of - {name: A1}: loop 'A1_eye' has the unknown "
        "successor 'A1_eye', did you mean 'A2_eye'?",
        swap(
            "  - {name: B1, urdf: urdf/mini_forwarder/chain_b1.urdf, parent: link1_B}\n", "", MINI
        ),
        machine=MINI,
    ),
    case(
        "chains in a wrong order",
        "mini_forwarder.yaml:{line of - {name: B2}: chain 'B2' hangs from "
        "'link2_F', no frame of an earlier chain, known: A1_barrel, A1_base, "
        "A1_eye, A1_rod, base, link1, link1_B, link1_C, link3, link3_G, link3_H, "
        "link3_elbow, link7, link7_K, link7_tip",
        swap(
            "  - {name: C, urdf: urdf/mini_forwarder/chain_c.urdf, parent: link1_C}\n"
            "  - {name: B2, urdf: urdf/mini_forwarder/chain_b2.urdf, parent: link2_F}\n",
            "  - {name: B2, urdf: urdf/mini_forwarder/chain_b2.urdf, parent: link2_F}\n"
            "  - {name: C, urdf: urdf/mini_forwarder/chain_c.urdf, parent: link1_C}\n",
            MINI,
        ),
        machine=MINI,
    ),
    case(
        "chain on a wrong pin",
        "mini_forwarder.yaml:{line of active:}: the active joints q1, X1, X2 cannot"
        " drive q4, q9, q2: choose others, such as [q1, q4, q3] (condition 1.76), or [q1, q9, q3] "
        "(condition 1.76)",
        swap("chain_b1.urdf, parent: link1_B", "chain_b1.urdf, parent: link1_C", MINI),
        machine=MINI,
    ),
    case(
        "loop about a wrong axis",
        "mini_forwarder.yaml:{line of - {name: A1}: loop 'A1_eye': its axis is 90 degrees off "
        "those of its neighbours q4, q9, so that it cannot move with them: turn it to axis: "
        "[0, 0, 1]",
        swap("successor: A1_eye, axis: [0, 0, 1]", "successor: A1_eye, axis: [0, 1, 0]", MINI),
        machine=MINI,
    ),
    case(
        "loop named by its link",
        "mini_forwarder.yaml:{line of - {name: A1}: loop 'A1_eye' has the unknown "
        "predecessor 'link_2D', did you mean 'link2_D'?",
        swap("predecessor: link2_D", "predecessor: link_2D", MINI),
        machine=MINI,
    ),
    case(
        "loop within one body",
        "mini_forwarder.yaml:{line of - {name: A1}: loop 'A1_eye' joins 'link2_D' "
        "and 'link2_F', both on the body 'link2': choose frames of two bodies",
        swap(
            "predecessor: link2_D, successor: A1_eye",
            "predecessor: link2_D, successor: link2_F",
            MINI,
        ),
        machine=MINI,
    ),
    case(
        "two strokes of one actuator",
        "mini_forwarder.yaml:{line of active:}: 'active' lists 'X1' twice, list it once",
        swap("active: [q1, X1, X2]", "active: [q1, X1, X1]", MINI),
        machine=MINI,
    ),
    case(
        "joint that follows is active",
        "mini_forwarder.yaml:{line of active:}: the active joints q1, X1, q9 cannot"
        " drive q10, X2, q6, q7, q2, q11, q3: choose others, such as [q1, X1, X2] "
        "(condition 2.71), or [q1, X1, q3] (condition 1.62)",
        swap("active: [q1, X1, X2]", "active: [q1, X1, q9]", MINI),
        swap("  X2: {kp: 18000, ki: 20000}\n", "  q9: {kp: 18000, ki: 20000}\n", MINI),
        machine=MINI,
    ),
    case(
        "lower case joint",
        "mini_forwarder.yaml:{line of active:}: joint 'x1' is unknown, known: X1, "
        "X2, q1, q10, q11, q2, q3, q4, q6, q7, q9",
        swap("active: [q1, X1, X2]", "active: [q1, x1, X2]", MINI),
        machine=MINI,
    ),
    case(
        "home in millimetres",
        "mini_forwarder.yaml:{line of X1: 22}: home of 'X1' is 22.1, outside of its"
        " limits 0 to 0.03 (chain_b1.urdf:57), choose one within them",
        swap("  X1: 0.0221", "  X1: 22.1", MINI),
        machine=MINI,
    ),
    case(
        "gains of one joint missing",
        "mini_forwarder.yaml:{line of control}: no gains for X2, give kp and ki of each",
        swap("  X2: {kp: 18000, ki: 20000}\n", "", MINI),
        machine=MINI,
    ),
    case(
        "tip is a joint",
        "mini_forwarder.yaml:{line of tip: q3}: the tip frame 'q3' is unknown, "
        "the nearest of 31 known ones are link3, link3_G, link3_H, link3_elbow, A1_barrel, "
        "A1_base, A1_eye, A1_rod",
        swap("tip: link7_tip", "tip: q3", MINI),
        machine=MINI,
    ),
    case(
        "rod in grams",
        'chain_b1.urdf:{line of <mass value="6}: value="6,46" of the mass of link '
        "'A1_rod' is not a number, write a decimal point",
        swap('<mass value="0.00646"/>', '<mass value="6,46"/>', CHAIN_B1),
        machine=MINI,
    ),
    case(
        "stroke reversed",
        "chain_b1.urdf:{line of <limit}: the limits of joint 'X1' are reversed "
        "(0.03 > 0), swap them",
        swap('lower="0" upper="0.030"', 'lower="0.030" upper="0"', CHAIN_B1),
        machine=MINI,
    ),
    case(
        "printed inertia misread",
        'chain_c.urdf:{line of <inertia ixx="0" ixy="0" ixz="0" iyy="0}: link '
        "'link2' has an inertia of no possible body: principal moments 0 + 8.17e-06"
        ' < 8.17e-05 kg m2, the nearest possible is ixx="3.6765e-05" ixy="0" ixz="0" '
        'iyy="4.4935e-05" iyz="0" izz="8.17e-05", correct it',
        swap(
            'iyy="0.0817e-3" iyz="0" izz="0.0817e-3"',
            'iyy="0.00817e-3" iyz="0" izz="0.0817e-3"',
            CHAIN_C,
        ),
        machine=MINI,
        strict=True,
    ),
    case(
        "joint axis out of the plane",
        "chain_c.urdf:{line of <joint name=\"q9}: joint 'q9': its axis is 90 degrees off those "
        "of its neighbours q4, loop A1_eye, so that it cannot move with them: turn it to "
        '<axis xyz="0 0 1"/>',
        swap(
            '    <child link="link2"/>\n    <axis xyz="0 0 1"/>',
            '    <child link="link2"/>\n    <axis xyz="0 1 0"/>',
            CHAIN_C,
        ),
        machine=MINI,
    ),
]


@pytest.mark.parametrize("broken", [*MECHANISM, *MINI_FORWARDER])
def test_is_refused(broken, tmp_path):
    assert_refused(broken, tmp_path)


@pytest.mark.parametrize("loop", ["A1_eye", "A2_eye", "J", "K"])
@pytest.mark.parametrize(("axis", "angle"), [("0, 1, 0", "90"), ("0.3, 0, 0.4", "36.9")])
def test_any_loop_about_a_wrong_axis_is_suspected_first(loop, axis, angle, tmp_path):
    path = copy_machine(MINI, tmp_path)
    lines = path.read_text().splitlines(keepends=True)
    number = next(i for i, line in enumerate(lines) if f"name: {loop}, type" in line)
    lines[number] = lines[number].replace("axis: [0, 0, 1]", f"axis: [{axis}]")
    path.write_text("".join(lines))
    with pytest.raises(CraneError) as caught:
        crane.load(path)
    start = f"mini_forwarder.yaml:{number + 1}: loop '{loop}': its axis is {angle} degrees off "
    assert str(caught.value).startswith(start)
    assert str(caught.value).endswith("turn it to axis: [0, 0, 1]")


@pytest.mark.parametrize("axis", ["0 0 1", "0 1 0", "1 0 0"])
@pytest.mark.parametrize("coupled", [False, True])
def test_one_joint_with_a_loop_is_refused_in_one_line(axis, coupled, tmp_path):
    """Pinocchio's Jacobian of one joint is a vector."""
    body = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    ends = '<predecessor link="base"/><successor link="arm"/>'
    gear = f'<coupling name="gear">{ends}</coupling>' * coupled
    path = tmp_path / "one.urdf"
    path.write_text(
        f'<robot name="one"><link name="base"/><link name="arm">{body}</inertial></link>'
        '<joint name="j" type="continuous" independent="true"><parent link="base"/>'
        '<child link="arm"/><axis xyz="0 0 1"/></joint>'
        f'<loop name="pin" type="revolute">{ends}<axis xyz="{axis}"/></loop>{gear}</robot>'
    )
    with pytest.raises(CraneError) as caught:
        crane.load(path)
    assert str(caught.value).startswith("one.urdf") and str(caught.value).isprintable()
