"""Errors of valid parts that make no machine, line by line."""

import pytest
from broken_machines import GROUND, MINI, ROCKER, assert_refused, case, copy_machine, swap

import crane
from crane.common.errors import CraneError

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


pytestmark = pytest.mark.filterwarnings("ignore::crane.common.errors.CraneWarning")

# A four-bar linkage.
MECHANISM = [
    case(
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
        "four_bar.yaml:12: the loops leave crank no freedom to move: check the "
        "types and axes of the loops, and the axes of the joints",
        swap('<axis xyz="0 0 1"/>\n    <limit', '<axis xyz="0 1 0"/>\n    <limit', GROUND),
        swap("type: revolute", "type: spherical"),
    ),
    case(
        "ground.urdf:10: joint 'crank': its axis is 90 degrees off those of its neighbours "
        "coupler, rocker, loop pin, so that it cannot move with them: turn it to "
        '<axis xyz="0 0 1"/>',
        swap('<axis xyz="0 0 1"/>\n    <limit', '<axis xyz="0 1 0"/>\n    <limit', GROUND),
    ),
    case(
        "four_bar.yaml:10: loop 'pin': its axis is 5.71 degrees off those of its neighbours "
        "crank, coupler, rocker, so that it cannot move with them: turn it to axis: [0, 0, 1]",
        swap("successor: rocker_pin}", "successor: rocker_pin, axis: [0.1, 0, 1]}"),
    ),
    case(
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
        "four_bar.yaml:10: loop 'pin' cannot be closed from the home guess (crank ="
        " 1.2): it stays 0.0961 rad open, correct the frames or the guess",
        swap('<origin xyz="0.3 0 0"/>', '<origin xyz="0.3 0 0" rpy="0.1 0 0"/>', ROCKER),
    ),
    case(
        "four_bar.yaml:10: loop 'pin' closes at home with its axes opposed: turn a "
        "frame over, or guess its joints better",
        swap(
            '<origin xyz="0.3 0 0"/>',
            '<origin xyz="0.3 0 0" rpy="3.141592653589793 0 0"/>',
            ROCKER,
        ),
    ),
    case(
        "four_bar.yaml:10: loop 'pin' cannot be closed at home (crank = 1.2): it "
        "stays 0.0132 m open, choose other values or guess more passive joints",
        swap('<origin xyz="0.3 0 0"/>', '<origin xyz="0.01 0 0"/>', ROCKER),
    ),
    case(
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
        "mini_forwarder.yaml:{line of active:}: the active joints q1, X1, X2 cannot"
        " drive q4, q9, q2: choose others, such as [q1, q4, q3] (condition 1.76), or [q1, q9, q3] "
        "(condition 1.76)",
        swap("chain_b1.urdf, parent: link1_B", "chain_b1.urdf, parent: link1_C", MINI),
        machine=MINI,
    ),
    case(
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
