"""Findings of `crane check`, line by line."""

import math
import re
import shlex
from dataclasses import dataclass
from pathlib import Path

import misfit_linkages
import pytest
from broken_machines import (
    GROUND,
    LOOPED,
    MACHINE,
    MINI,
    ROCKER,
    Edit,
    copy_machine,
    swap,
    whole,
    with_line,
)
from command_line import typed
from executed_lines import at_most

import crane
from crane.common.errors import SimulationError
from crane.control.levers import LeverPhases
from crane.description import bundled_machines, example_robots
from crane.description.specification import Phase
from crane.formats import check, write_machine
from crane.formats.checks.check_report import CheckReport

CHAIN_B1 = "urdf/mini_forwarder/chain_b1.urdf"
CHAIN_B2 = "urdf/mini_forwarder/chain_b2.urdf"

CRANK_INERTIA = '<inertia ixx="0.001" ixy="0" ixz="0" iyy="0.006" iyz="0" izz="0.006"/>'
ROCKER_LINK = '  <link name="rocker_arm">\n'
DRAWN = """<visual><origin xyz="0.15 0 0" rpy="0 1.5708 0"/>
  <geometry><cylinder radius="0.01" length="0.3"/></geometry></visual>
"""
MESHES = """<visual><geometry><mesh filename="package://gone/link.stl"/></geometry></visual>
<visual><geometry><mesh filename="broken.stl"/></geometry></visual>
<visual><geometry><mesh filename="big.obj"/></geometry></visual>
<collision><geometry><mesh filename="package://gone/link.stl"/></geometry></collision>
"""
BIG = "v 0 0 0\nv 300 0 0\nv 0 20 0\nv 0 0 20\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"


@dataclass(frozen=True)
class Checked:
    """A broken machine and the lines of its findings."""

    lines: list[str]
    edits: tuple[Edit, ...]
    machine: str


def seen(lines: list[str], *edits: Edit, machine: str = MACHINE):
    return pytest.param(Checked(lines, edits, machine), id=re.sub(r"\W+", "-", lines[0])[:60])


def checked(machine: str, edits: tuple[Edit, ...], folder: Path) -> CheckReport:
    path = copy_machine(machine, folder)
    for edit in edits:
        edit.apply(folder)
    return check(path)


NUMBERS = [
    seen(
        [
            "ground.urdf:21: error: ixx=\"a\" of the inertia of link 'crank_arm' is not a "
            "number, write digits",
            "ground.urdf:21: error: ixy=\"\" of the inertia of link 'crank_arm' has 0 "
            "numbers, give 1",
            "ground.urdf:21: error: ixz=\"1,0\" of the inertia of link 'crank_arm' is not a "
            "number, write a decimal point",
            "ground.urdf:21: error: iyy=\"nan\" of the inertia of link 'crank_arm' is not "
            "finite, give a number",
            "ground.urdf:21: error: iyz=\"1 2\" of the inertia of link 'crank_arm' has 2 "
            "numbers, give 1",
            "ground.urdf:21: error: the inertia of link 'crank_arm' has no izz, add izz=\"...\"",
        ],
        swap(CRANK_INERTIA, '<inertia ixx="a" ixy="" ixz="1,0" iyy="nan" iyz="1 2"/>', GROUND),
    ),
    seen(
        [
            "four_bar.yaml:15: error: 'crank' of 'home' is '1,2', give a number with a "
            "decimal point",
            "four_bar.yaml:21: error: 'viscous' of friction of 'coupler' is nan, give a "
            "finite number",
            "four_bar.yaml:27: error: 'stiffness' of end stop of 'crank' is -1, give at least 0",
            "four_bar.yaml:34: error: 'duration' of task 'swing' is 'two', give a number "
            "in s, as in 5 ms",
        ],
        swap("  crank: 1.2", "  crank: 1,2"),
        swap("viscous: 0.01", "viscous: .nan"),
        swap("stiffness: 1e4", "stiffness: -1"),
        swap("duration: 2", "duration: two"),
    ),
    seen(
        [
            "four_bar.yaml:16: error: joint 'couple' is unknown, did you mean 'coupler'?",
            "four_bar.yaml:20: error: unknown key 'colomb' in friction of 'crank', did you "
            "mean 'coulomb'?",
            "four_bar.yaml:29: error: the tip frame 'coupler_pn' is unknown, did you mean "
            "'coupler_pin'?",
            "four_bar.yaml:38: error: task 'reach' takes no time, give a duration",
            "ground.urdf:20: error: link 'crank_arm' has the mass -1.5 kg, give a positive one",
            "rocker.urdf:17: error: xyz=\"0.3 0\" of the origin of joint 'rocker_pin_fixed' "
            "has 2 numbers, give 3",
        ],
        swap('<mass value="1.5"/>', '<mass value="-1.5"/>', GROUND),
        swap('<origin xyz="0.3 0 0"/>', '<origin xyz="0.3 0"/>', ROCKER),
        swap("tip: coupler_pin", "tip: coupler_pn"),
        swap("coulomb: 0.3", "colomb: 0.3"),
        swap("duration: 1\n", "duration: 0\n"),
        swap("  coupler: -1.0", "  couple: -1.0"),
    ),
]

GRAPH = [
    seen(
        [
            "ground.urdf:45: error: 2 links have no parent (ground, lost): join all but one",
            "ground.urdf:47: error: link 'a' is its own ancestor: cut the ring of joints ab, ba at"
            " 'ba' and close it as a loop",
        ],
        swap(
            "</robot>",
            '<link name="lost"/><link name="a"/><link name="b"/>\n<joint name="ab"'
            ' type="fixed"><parent link="a"/><child link="b"/></joint>\n'
            '<joint name="ba" type="fixed"><parent link="b"/><child link="a"/></joint></robot>',
            GROUND,
        ),
    ),
    seen(
        [
            "ground.urdf:7: error: joint 'pin_B_fixed' has the unknown child 'pin_C', did "
            "you mean 'pin_B'?",
            "ground.urdf:27: error: joint 'coupler' has the unknown parent 'crank_am', did "
            "you mean 'crank_arm'?",
        ],
        swap('<parent link="crank_arm"/>', '<parent link="crank_am"/>', GROUND),
        swap('<child link="pin_B"/>', '<child link="pin_C"/>', GROUND),
    ),
    seen(
        [
            "rocker.urdf:19: error: joint 'rocker_pin_fixed' has the unknown child "
            "'roker_pin', did you mean 'rocker_pin'?"
        ],
        swap('<child link="rocker_pin"/>', '<child link="roker_pin"/>', ROCKER),
    ),
    seen(
        [
            "ground.urdf:45: error: link 'coupler_arm' has two parents, joints 'coupler' "
            "and 'c': keep one and close the other as a loop",
            "ground.urdf:46: error: joint 'd' joins link 'pin_B' to itself, change one end",
        ],
        swap(
            "</robot>",
            '<joint name="c" type="fixed"><parent link="ground"/><child'
            ' link="coupler_arm"/></joint>\n'
            '<joint name="d" type="fixed"><parent link="pin_B"/><child link="pin_B"/></joint>'
            "</robot>",
            GROUND,
        ),
    ),
    seen(
        [
            "ground.urdf:45: error: link 'pin_B' is there twice (first in line 3), rename one",
            "ground.urdf:46: error: joint 'crank' is there twice (first in line 10), rename one",
        ],
        swap(
            "</robot>",
            '<link name="pin_B"/>\n<joint name="crank" type="fixed"><parent'
            ' link="ground"/><child link="pin_B"/></joint></robot>',
            GROUND,
        ),
    ),
    seen(
        [
            'ground.urdf:3: error: a link has no name, add name="..."',
            'rocker.urdf:3: error: a joint has no name, add name="..."',
        ],
        swap('<link name="pin_B"/>', "<link/>", GROUND),
        swap('<joint name="rocker" type', "<joint type", ROCKER),
    ),
    seen(
        ["rocker.urdf:8: error: link 'crank_arm' is also in ground.urdf:17, rename one"],
        swap('<link name="rocker_arm">', '<link name="crank_arm">', ROCKER),
        swap('<child link="rocker_arm"/>', '<child link="crank_arm"/>', ROCKER),
        swap('<parent link="rocker_arm"/>', '<parent link="crank_arm"/>', ROCKER),
    ),
    seen(
        [
            "four_bar.yaml:7: error: chain 'rocker': there is no file "
            "'four_bar/roker.urdf', give its path from this folder"
        ],
        swap("four_bar/rocker.urdf", "four_bar/roker.urdf"),
    ),
    seen(
        [
            "ground.urdf:1: error: not XML, Start tag expected, '<' not found, correct it",
            "rocker.urdf: error: the file is empty, write a <robot> in it",
        ],
        whole(b"\xff\xfe\x00", GROUND),
        whole("", ROCKER),
    ),
    seen(
        [
            "ground.urdf:10: error: joint 'crank' has the type 'revolut', which is not "
            "supported, did you mean 'revolute'?",
            "rocker.urdf:3: error: joint 'rocker' has the type 'hinge', which is not "
            "supported, known: continuous, fixed, floating, planar, prismatic, revolute, "
            "spherical",
        ],
        swap('type="revolute"', 'type="revolut"', GROUND),
        swap('name="rocker" type="continuous"', 'name="rocker" type="hinge"', ROCKER),
    ),
]

SLIPS = [
    seen(
        [
            "ground.urdf:14: error: the limits of joint 'crank' are reversed (-1.5 > -2.5),"
            " swap them",
            "ground.urdf:14: error: unknown uper=\"...\" in <limit>, did you mean 'upper'?",
            "ground.urdf:15: error: damping or friction of joint 'crank' is negative, make "
            "it positive",
            "ground.urdf:15: error: unknown dampng=\"...\" in <dynamics>, did you mean 'damping'?",
            "ground.urdf:26: error: unknown <orign> in <joint>, did you mean 'origin'?",
            "ground.urdf:26: error: xyz=\"0.2 0\" of the origin of joint 'coupler' has 2 "
            "numbers, give 3",
        ],
        swap('<origin xyz="0.2 0 0"/>\n    <parent', '<orign xyz="0.2 0"/>\n    <parent', GROUND),
        swap('lower="-1.5" upper="2.5"', 'lower="-1.5" uper="-2.5"', GROUND),
        swap('damping="0.2"', 'dampng="-0.2"', GROUND),
    ),
    seen(
        [
            "four_bar.yaml:14: error: unknown key 'hoem' in the machine file, did you mean "
            "'home'?",
            "four_bar.yaml:15: error: home of 'crank' is 2.6, outside of its limits -1.5 to"
            " 2.5 (ground.urdf:14), choose one within them",
            "four_bar.yaml:21: error: 'viscous' of friction of 'coupler' is -0.01, give at "
            "least 0",
            "four_bar.yaml:21: error: unknown key 'visous' in friction of 'coupler', did "
            "you mean 'viscous'?",
            "four_bar.yaml:42: error: 'kp' of control of 'crank' is -50, give at least 0",
            "four_bar.yaml:42: error: unknown key 'kP' in control of 'crank', known: ki, kp",
        ],
        swap("home:\n  crank: 1.2", "hoem:\n  crank: 2.6"),
        swap("kp: 50", "kP: -50"),
        swap("viscous: 0.01", "visous: -0.01"),
    ),
    seen(
        [
            "four_bar.yaml:16: error: key 3 is not a name, write names in quotes, and "
            "decimals with a point",
            "four_bar.yaml:30: error: key 'tip' is there twice (first in line 29), keep one",
        ],
        swap("tip: coupler_pin", "tip: coupler_pin\ntip: rocker_pin"),
        swap("  coupler: -1.0", "  3: -1.0"),
    ),
    seen(
        [
            "ground.urdf:3: error: <mass> has no place in <link>, move it",
            "ground.urdf:20: error: link 'crank_arm' has 2 <mass>, keep one",
            'rocker.urdf:10: error: unknown quat_xyzw="..." in <origin>, known: rpy, xyz',
        ],
        swap('<link name="pin_B"/>', '<link name="pin_B"><mass value="1"/></link>', GROUND),
        swap('<mass value="1.5"/>', '<mass value="1.5"/><mass value="1.5"/>', GROUND),
        swap('<origin xyz="0.15 0 0"/>', '<origin xyz="0.15 0 0" quat_xyzw="0 0 0 1"/>', ROCKER),
    ),
]

INERTIAS = [
    seen(
        [
            "ground.urdf:21: error: link 'crank_arm' has a mass but no inertia, give at "
            "least a small sphere's",
            "ground.urdf:35: error: link 'coupler_arm' has an inertia of no possible body: "
            'principal moments 0.03 + 0.03 < 0.1 kg m2, the nearest possible is ixx="0.1" ixy="0" '
            'ixz="0" iyy="0.05" iyz="0" izz="0.05", correct it',
            "rocker.urdf:12: error: link 'rocker_arm' has the negative principal moment of "
            "inertia -0.0946 kg m2, correct it",
        ],
        swap(CRANK_INERTIA, '<inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/>', GROUND),
        swap(
            'ixx="0.001" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.03"',
            'ixx="0.1" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.03"',
            GROUND,
        ),
        swap(
            'ixx="0.001" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"',
            'ixx="0.001" ixy="0.1" ixz="0" iyy="0.01" iyz="0" izz="0.01"',
            ROCKER,
        ),
    ),
    seen(
        [
            "ground.urdf:18: error: the inertial of link 'crank_arm' has no <mass>, add it",
            "ground.urdf:32: error: the inertial of link 'coupler_arm' has no <inertia>, add it",
        ],
        swap('<mass value="1.5"/>', "", GROUND),
        swap('<inertia ixx="0.001" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.03"/>', "", GROUND),
    ),
    seen(
        [
            "ground.urdf:21: warning: link 'crank_arm' has a radius of gyration of 63.2 m, "
            "and its joints and its centre of mass are at most 0.2 m from its origin, correct "
            "the inertia (kg m2, about the centre of mass) or the mass (kg)"
        ],
        swap(
            CRANK_INERTIA,
            '<inertia ixx="1e3" ixy="0" ixz="0" iyy="6e3" iyz="0" izz="6e3"/>',
            GROUND,
        ),
    ),
    seen(
        [
            "ground.urdf:21: warning: link 'crank_arm' has a radius of gyration of 8.16e-05"
            " m, and its joints and its centre of mass are at most 0.2 m from its origin, correct "
            "the inertia (kg m2, about the centre of mass) or the mass (kg)"
        ],
        swap(
            CRANK_INERTIA,
            '<inertia ixx="1e-8" ixy="0" ixz="0" iyy="1e-8" iyz="0" izz="1e-8"/>',
            GROUND,
        ),
    ),
    seen(
        [
            "rocker.urdf:14: warning: link 'rocker_arm' has a radius of gyration of 3.16 m "
            "and is drawn 0.301 m large, correct the inertia (kg m2, about the centre of "
            "mass) or the mass (kg)"
        ],
        swap('<mass value="1.0"/>', '<mass value="0.001"/>', ROCKER),
        swap(ROCKER_LINK, ROCKER_LINK + DRAWN, ROCKER),
    ),
    seen(
        [
            "rocker.urdf:12: warning: link 'rocker_arm' has its centre of mass 14.7 m "
            "outside of what is drawn, which is 0.301 m large, correct one of them (m, in "
            "the link's frame)"
        ],
        swap('<origin xyz="0.15 0 0"/>', '<origin xyz="15 0 0"/>', ROCKER),
        swap(ROCKER_LINK, ROCKER_LINK + DRAWN, ROCKER),
    ),
    seen(
        [
            "rocker.urdf:13: warning: link 'rocker_arm' has 1000 kg in a box of 0.00012 m3,"
            " denser than any metal, write kilograms if these are grams"
        ],
        swap('<mass value="1.0"/>', '<mass value="1000"/>', ROCKER),
        swap(
            'ixx="0.001" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"',
            'ixx="1" ixy="0" ixz="0" iyy="10" iyz="0" izz="10"',
            ROCKER,
        ),
        swap(ROCKER_LINK, ROCKER_LINK + DRAWN, ROCKER),
    ),
]

UNITS = [
    seen(
        [
            *(
                f"ground.urdf:{where} m in <origin> is a long way for a machine, write "
                "metres if these are millimetres"
                for where in ("5: warning: 400", "26: warning: 200", "41: warning: 400")
            ),
            "rocker.urdf:17: warning: 300 m in <origin> is a long way for a machine, write "
            "metres if these are millimetres",
        ],
        swap(
            '<origin xyz="0.2 0 0"/>\n    <parent', '<origin xyz="200 0 0"/>\n    <parent', GROUND
        ),
        swap(
            '<origin xyz="0.4 0 0"/>\n    <parent link="ground"/>',
            '<origin xyz="400 0 0"/>\n    <parent link="ground"/>',
            GROUND,
        ),
        swap(
            '<origin xyz="0.4 0 0"/>\n    <parent link="coupler_arm"/>',
            '<origin xyz="400 0 0"/>\n    <parent link="coupler_arm"/>',
            GROUND,
        ),
        swap('<origin xyz="0.3 0 0"/>', '<origin xyz="300 0 0"/>', ROCKER),
    ),
    seen(
        [
            "four_bar.yaml:14: error: the loops close only far from the home of the file: rocker "
            "is 1.53 rad off; at the home of the file loop 'pin' is 367 mm open, and would close "
            "with no other length alone; correct home or the frames; if what was found is meant, "
            "keep it with crane check --write-home, or take it with --arg nearest_assembly:=true "
            "(arguments={'nearest_assembly': True} in Python)",
            "four_bar.yaml:14: warning: loop 'pin' can be assembled another way at home, and the "
            "file does not say which is meant; under 'home:' write coupler: 1.045, rocker: "
            "-0.5914 for the other (rocker 2.09 rad off) or coupler: -0.5875, rocker: 3.031 to "
            "keep this one (rocker 1.53 rad off what it says)",
            "four_bar.yaml:15: warning: home of 'crank' is 69 rad, many turns, write "
            "radians if these are degrees",
            'ground.urdf:5: warning: rpy="0 0 90" turns more than once, write radians if '
            "these are degrees",
            "ground.urdf:14: warning: the limit 143 rad of joint 'crank' is many turns, "
            "write radians if these are degrees, or make it continuous",
        ],
        swap("  crank: 1.2", "  crank: 69"),
        swap('lower="-1.5" upper="2.5"', 'lower="-90" upper="143"', GROUND),
        swap(
            '<origin xyz="0.4 0 0"/>\n    <parent link="ground"/>',
            '<origin xyz="0.4 0 0" rpy="0 0 90"/>\n    <parent link="ground"/>',
            GROUND,
        ),
    ),
    seen(
        [
            "chain_b1.urdf:57: warning: the limit 300 m of joint 'X1' is a long way, write "
            "metres if these are millimetres"
        ],
        swap('lower="0" upper="0.030"', 'lower="0" upper="300"', CHAIN_B1),
        machine=MINI,
    ),
]

MESHES = [
    seen(
        [
            "rocker.urdf:9: warning: mesh file 'package://gone/link.stl' is not there, "
            "correct its path or install the package that has it; a box is drawn instead",
            "rocker.urdf:10: warning: mesh file 'broken.stl' cannot be read (no triangles in it), "
            "export it again; a box is drawn instead",
            "rocker.urdf:11: warning: mesh 'big.obj' is 300 m large, give it scale=\"0.001 "
            '0.001 0.001" if it is in millimetres',
        ],
        swap(ROCKER_LINK, ROCKER_LINK + MESHES, ROCKER),
        whole("solid", "four_bar/broken.stl"),
        whole(BIG, "four_bar/big.obj"),
    ),
]

MECHANISM = [
    seen(
        [
            "four_bar.yaml:10: error: loop 'pin' cannot be closed from the home guess "
            "(crank = 1.2): its smallest gap is 10 mm and 5.73 deg, correct the frames or "
            "the guess"
        ],
        swap('<origin xyz="0.3 0 0"/>', '<origin xyz="0.3 0 0.01" rpy="0.1 0 0"/>', ROCKER),
    ),
    seen(
        [
            "four_bar.yaml:11: error: loop 'again' locks nothing that the joints do not "
            "lock already: remove it",
            "four_bar.yaml:13: warning: 2 active joints for 1 degree of freedom: coupler shares "
            "the load with the others; name them as active and free",
        ],
        swap(
            "successor: rocker_pin}\n",
            "successor: rocker_pin}\n  - {name: again, type: revolute, predecessor:"
            " pin_B, successor: rocker_arm}\n",
        ),
        swap("active: [crank]", "active: [crank, coupler]"),
        swap("control:\n  crank: {kp: 50, ki: 20}\n", ""),
        swap(
            "    active:\n      crank: [1.2, 0.4, -0.2]\n", "    tip: {x: [0], y: [0], z: [0]}\n"
        ),
    ),
    seen(
        [
            "four_bar.yaml:10: error: loop 'pin' cannot be closed from the home guess "
            "(crank = 1.2): its smallest gap is 102 mm and 0.0723 deg, correct the frames or the "
            "guess",
            "four_bar.yaml:20: error: 'coulomb' of friction of 'crank' is -0.3, give at least 0",
            "four_bar.yaml:38: error: 'duration' of task 'reach' is 'soon', give a number "
            "in s, as in 5 ms",
            "four_bar.yaml:42: error: 'ki' of control of 'crank' is -20, give at least 0",
        ],
        swap("type: revolute", "type: fixed"),
        swap("coulomb: 0.3", "coulomb: -0.3"),
        swap("duration: 1\n", "duration: soon\n"),
        swap("ki: 20", "ki: -20"),
    ),
    seen(
        [
            "four_bar.yaml:15: error: home of 'crank' is 2.6, outside of its limits -1.5 to"
            " 2.5 (ground.urdf:14), choose one within them"
        ],
        swap("  crank: 1.2", "  crank: 2.6"),
    ),
    seen(
        [
            "rocker.urdf:3: warning: passive joint 'rocker' is at 1.378 with the loops "
            "closed at home, outside of its limits 0 to 0.5, widen them or correct the home or "
            "what is locked"
        ],
        swap('name="rocker" type="continuous"', 'name="rocker" type="revolute"', ROCKER),
        swap(
            '<axis xyz="0 0 1"/>',
            '<axis xyz="0 0 1"/><limit lower="0" upper="0.5" effort="1" velocity="1"/>',
            ROCKER,
        ),
    ),
    seen(
        [
            "mini_forwarder.yaml:{line of - {name: A1}: error: loop 'A1_eye' cannot be "
            "closed from the home "
            "guess (q1 = 0, X1 = 0.0221, X2 = 0.0108): its smallest gap is 100 mm, "
            "correct the frames or the guess",
            "mini_forwarder.yaml:{line of - {name: K}: error: loop 'K' stays open,"
            " too: its smallest gap is 50 mm",
        ],
        swap('<origin xyz="0.0825 0 0"/>', '<origin xyz="0.0825 0 0.1"/>', CHAIN_B1),
        swap('<origin xyz="0.0431 0 0"/>', '<origin xyz="0.0431 0 0.05"/>', CHAIN_B2),
        machine=MINI,
    ),
]

SECTIONS = [
    seen(
        [
            "four_bar.yaml:12: error: joint 'crnk' is unknown, did you mean 'crank'?",
            "four_bar.yaml:12: error: joint 'rocker_pin_fixed' is fixed, name a moving one",
            "four_bar.yaml:24: error: joint 'roker' is unknown, did you mean 'rocker'?",
        ],
        swap("active: [crank]", "active: [crnk, rocker_pin_fixed]"),
        swap("{joint: rocker,", "{joint: roker,"),
    ),
    seen(
        [
            "four_bar.yaml:9: error: 'loops' is 'pin', give a list, its items with '- '",
            "four_bar.yaml:11: error: 'active' of the machine file is 'crank', give a list "
            "such as [q1, q2]",
            "four_bar.yaml:13: error: 'home' is a list, give a mapping 'name: value'",
        ],
        swap("active: [crank]", "active: crank"),
        swap(
            "loops:\n  - {name: pin, type: revolute, predecessor: coupler_pin,"
            " successor: rocker_pin}\n",
            "loops: pin\n",
        ),
        swap("home:\n  crank: 1.2\n  coupler: -1.0\n  rocker: 1.5", "home: [1.2]"),
    ),
    seen(
        [
            "four_bar.yaml:10: error: 'name' of a loop is 4, give text (or quote it)",
            "four_bar.yaml:10: error: 'type' of a loop: 'hinge' is unknown, known: "
            "cylindrical, fixed, planar, prismatic, revolute, spherical",
            "four_bar.yaml:10: error: a loop has the unknown predecessor 'coupler_pn', did "
            "you mean 'coupler_pin'?",
            "four_bar.yaml:10: error: the axis of a loop is no direction, give three "
            "numbers, not all zero",
        ],
        swap(
            "{name: pin, type: revolute, predecessor: coupler_pin, successor: rocker_pin}",
            "{name: 4, type: hinge, predecessor: coupler_pn, successor: rocker_pin, axis: [0, 0]}",
        ),
    ),
]

LOOPS = [
    seen(
        [
            "four_bar_loop.urdf:5: error: independent=\"yes\" of joint 'crank' is neither "
            "true nor false",
            "four_bar_loop.urdf:46: error: loop 'pin' has the unknown predecessor "
            "'coupler_am', did you mean 'coupler_arm'?",
            'four_bar_loop.urdf:46: error: xyz="0,4 0 0" of the origin of the predecessor '
            "of loop 'pin' is not a number, write a decimal point",
            "four_bar_loop.urdf:48: error: the axis of loop 'pin' is zero, give a direction",
        ],
        swap(
            '<predecessor link="coupler_arm"><origin xyz="0.4 0 0"/>',
            '<predecessor link="coupler_am"><origin xyz="0,4 0 0"/>',
            LOOPED,
        ),
        swap('<axis xyz="0 0 2"/>', '<axis xyz="0 0 0"/>', LOOPED),
        swap(' independent="true"', ' independent="yes"', LOOPED),
        machine=LOOPED,
    ),
]


@pytest.mark.parametrize(
    "case",
    [*NUMBERS, *GRAPH, *SLIPS, *INERTIAS, *UNITS, *MESHES, *MECHANISM, *SECTIONS, *LOOPS],
)
def test_says_all_at_once(case, tmp_path):
    report = checked(case.machine, case.edits, tmp_path)
    lines = [str(finding) for finding in report.findings]
    assert lines == [with_line(line, tmp_path) for line in case.lines]
    assert all(line.isprintable() for line in lines)


@pytest.mark.parametrize("name", bundled_machines())
def test_bundled_machines_are_clean(name):
    report = check(name)
    assert report.findings == ()
    assert f"{report.summary}".endswith("m at home")


ARMS = (
    "kinova", "panda", "panda_collision", "so100", "TwoDofs", "ur10_joint_limited_robot",
    "ur10_robot", "ur3_gripper", "ur3_joint_limited_robot", "ur3_robot", "ur5_gripper",
    "ur5_joint_limited_robot", "ur5_robot", "xarm7", "z1",
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.skipif(not example_robots(), reason="example-robot-data is not installed")
@pytest.mark.parametrize("name", ARMS)
def test_arms_give_no_false_alarm(name):
    assert check(name).findings == ()


@pytest.mark.skipif(not example_robots(), reason="example-robot-data is not installed")
@pytest.mark.slow
@pytest.mark.parametrize("every", [4, pytest.param(1, marks=pytest.mark.long)])
def test_published_robots_load_where_they_are_not_refused(every):
    for name in sorted(example_robots())[::every]:
        report = check(name)
        try:
            crane.load(name, strict=True)
        except crane.CraneError as error:
            assert any(finding.message in str(error) for finding in report.findings), name
        else:
            assert report.errors == 0, (name, report.findings)


def run(*arguments, cwd=None):
    return typed("check", *arguments, cwd=cwd)


def test_status_and_counts_of_a_clean_machine(tmp_path):
    result = run(copy_machine(MACHINE, tmp_path))
    assert (result.returncode, result.stderr) == (0, "")
    assert result.stdout.startswith("four_bar: 3 joints, 1 loops, 1 degrees of freedom, loops ")
    next_line = result.stdout.splitlines()[1]
    assert next_line == f"next: crane simulate {tmp_path / MACHINE} --task swing --out swing"
    assert result.stdout.count("\n") == 2


WORLD = """<sdf version="1.9"><world name="w">{}{}</world></sdf>"""
MODEL = """<model name="{}"><link name="base"><inertial><mass>5</mass></inertial></link>
<link name="arm"><inertial><pose>0.3 0 0 0 0 0</pose><mass>2</mass>
<inertia><ixx>0.01</ixx><iyy>0.1</iyy><izz>0.1</izz></inertia></inertial></link>
<joint name="turn" type="revolute"><parent>base</parent><child>arm</child>
<axis><xyz>0 1 0</xyz></axis></joint></model>"""


@pytest.mark.parametrize("floating", [[], ["--floating"]])
@pytest.mark.filterwarnings("ignore::crane.CraneWarning")
def test_the_next_command_loads_the_same_machine(tmp_path, floating):
    """Its command loads one of several models of a world with the given options."""
    (tmp_path / "a world").mkdir()
    path = tmp_path / "a world" / "two.sdf"
    path.write_text(WORLD.format(MODEL.format("one arm"), MODEL.format("other")))
    options = ["--arg", "model:=one arm", "--packages", str(path.parent), "--active", "turn"]
    result = run(path, *options, *floating, cwd=tmp_path)
    assert result.returncode < 2, result.stdout
    line = result.stdout.splitlines()[-1].removeprefix("next: crane ")
    done = typed(*shlex.split(line), cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    words = shlex.split(line)
    assert [x for x in (*options, *floating) if x not in words] == []
    machine = crane.load(path, changes={"arm.mass": 3}, arguments={"model": "other"})
    words = shlex.split(machine.command_line_arguments)
    assert words[1:] == ["--set", "arm.mass=3.0", "--arg", "model:=other"]
    assert typed("convert", *words, tmp_path / "other").returncode == 0
    assert crane.load(tmp_path / "other" / "other.yaml").tree.links["arm"].inertial.mass == 3
    with pytest.raises(crane.CraneError, match="--arg model:=other --names lists"):
        crane.load(path, changes={"arm.weight": 3}, arguments={"model": "other"})


BARS = """<robot name="bars" xmlns:xacro="http://ros.org/wiki/xacro">
<xacro:arg name="far" default="9"/><link name="base"/>
<xacro:macro name="bar" params="name on at kind:=continuous">
<link name="${name}"><xacro:if value="${kind != 'fixed'}"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></xacro:if></link>
<joint name="turn_${name}" type="${kind}"><parent link="${on}"/>
<child link="${name}"/><origin xyz="${at}"/><axis xyz="0 0 1"/></joint></xacro:macro>
<xacro:bar name="crank" on="base" at="0 0 0"/><xacro:bar name="coupler" on="crank" at="0 0.3 0"/>
<xacro:bar name="rocker" on="base" at="0.4 0 0"/>
<xacro:bar name="pin_a" on="coupler" at="$(arg far) 0 0" kind="fixed"/>
<xacro:bar name="pin_b" on="rocker" at="0 0.3 0" kind="fixed"/></robot>"""


def test_the_next_command_closes_the_same_open_machine(tmp_path):
    """Of a xacro whose argument makes the ends of a loop meet."""
    path = tmp_path / "bars.xacro"
    path.write_text(BARS)
    line = run(path, "--arg", "far:=0.4", cwd=tmp_path).stdout.splitlines()[-1]
    assert line == f"next: crane add loops {path} --arg far:=0.4"
    done = typed(*shlex.split(line.removeprefix("next: crane ")), cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert crane.load(tmp_path / "bars_closed.yaml").closure.degrees_of_freedom == 1


def test_status_and_counts_with_errors(tmp_path):
    path = copy_machine(MACHINE, tmp_path)
    swap("coulomb: 0.3", "coulomb: -0.3, coulomb_offset: 0.4").apply(tmp_path)
    swap("viscous: 0.01", "viscous: 0.01, viscous_offset: 1").apply(tmp_path)
    swap("  crank: 1.2", "  crank: up").apply(tmp_path)
    result = run(path)
    assert (result.returncode, result.stderr) == (2, "")
    assert [line.split(": ")[1] for line in result.stdout.splitlines()[:-2]] == [
        "error", "error", "warning",
    ]  # fmt: skip
    counts, then = result.stdout.splitlines()[-2:]
    assert counts == "2 errors, 1 warning"
    assert then == f"next: crane check {path} again, once the errors are mended"


def test_findings_of_one_kind_are_one_line_on_one_screen(tmp_path):
    """A robot of 30 joints whose exporter left the limits out and the meshes behind."""
    parts = ['<robot name="many"><link name="l0"/>']
    for i in range(30):
        parts.append(
            f'<link name="l{i + 1}"><visual><geometry><mesh filename="{i}.stl"/></geometry>'
            "</visual>"
            '<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'
            f'</inertial></link>\n<joint name="j{i}" type="revolute"><parent link="l{i}"/>'
            f'<child link="l{i + 1}"/><limit effort="1" velocity="1"/></joint>'
        )
    (tmp_path / "many.urdf").write_text("\n".join(parts) + "</robot>")
    report = check(tmp_path / "many.urdf")
    assert len(report.findings) == 60
    lines = run(tmp_path / "many.urdf").stdout.splitlines()
    assert len(lines) == 5
    assert sum("(30 such, lines " in line for line in lines) == 2


def test_folder_and_missing_file_are_no_machines(tmp_path):
    (tmp_path / "folder.yaml").mkdir()
    for name in ("folder.yaml", "nothing.urdf", str(tmp_path), "none"):
        result = run(name, cwd=tmp_path)
        assert (result.returncode, result.stdout) == (2, "")
        assert result.stderr.startswith("error: ") and result.stderr.count("\n") == 1


ROW = (
    '<link name="l{0}"><inertial><mass value="{1}"/>'
    '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>'
    '<joint name="j{0}" type="continuous"><parent link="l{2}"/><child link="l{0}"/></joint>\n'
)


def tree(count, parent, mass="1"):
    rows = "".join(ROW.format(i, mass, parent(i)) for i in range(1, count + 1))
    return f'<robot name="r"><link name="l0"/>\n{rows}</robot>'


ODD = {
    "empty.yaml": b"",
    "empty.urdf": b" \n",
    "zeros.yaml": b"\0" * 1000,
    "zeros.urdf": b"\0" * 1000,
    "bytes.yaml": bytes(range(256)) * 100,
    "bytes.urdf": bytes(range(256)) * 100,
    "utf16.yaml": "name: krän\n".encode("utf-16"),
    "utf16.urdf": '<robot name="krän"><link name="a"/></robot>'.encode("utf-16"),
    "mark.yaml": b"\xef\xbb\xbfname: x\n",
    "mark.urdf": b'\xef\xbb\xbf<robot name="r"><link name="a"/></robot>',
    "latin.urdf": b'<?xml version="1.0" encoding="iso-8859-1"?><robot name="kr\xe4n"/>',
    "encoding.urdf": b'<?xml version="1.0" encoding="nonsense"?><robot/>',
    "surrogate.yaml": b'name: "\\ud800"\nchains: [{name: a, urdf: "\\ud800.urdf"}]\n',
    "recursive.yaml": b"name: &a {x: *a}\n",
    "number.yaml": b"name: x\nhome: {a: " + b"9" * 5000 + b"}\n",
    "kinds.yaml": (
        b"name: 1\nchains: 5\nloops: 3\nactive: {a: 1}\ntip: [1]\ntasks: 4\nhome: 1e999\n"
    ),
    "nested.yaml": b"[" * 600,
    "nested.urdf": b'<robot name="r">' + b"<a>" * 100_000 + b"</a>" * 100_000 + b"</robot>",
    "deep.urdf": tree(3_000, lambda i: i - 1).encode(),
    "wide.urdf": tree(3_000, lambda i: 0, "1,5").encode(),
    "strangers.urdf": tree(3_000, lambda i: f"x{i}").encode(),
    "large.yaml": b"name: x\n" + b"# comment\n" * 1_000_000,
}


@pytest.mark.parametrize("name", ODD)
def test_odd_files_are_findings_soon(name, tmp_path):
    path = tmp_path / name
    path.write_bytes(ODD[name])
    with at_most(5000 + 5 * len(ODD[name])):  # work that grows as the file does
        report = check(path)
    assert report.status == 2
    assert all(finding.file in (name, "") for finding in report.findings)
    assert all(str(finding).isprintable() for finding in report.findings)


def test_many_findings_end_somewhere(tmp_path):
    path = tmp_path / "wide.urdf"
    path.write_bytes(ODD["wide.urdf"])
    report = check(path)
    assert report.errors == 200
    assert report.counts == "200 errors, no warnings; there may be more, correct these first"


def test_links_in_a_row_need_no_stack(tmp_path):
    """A pendulum of 3000 links, all but the first joint fixed: m = 3000, I = 3000 * 1."""
    path = tmp_path / "deep.urdf"
    text = tree(3_000, lambda i: i - 1).replace("continuous", "fixed")
    path.write_text(text.replace("fixed", "continuous", 1))
    machine = crane.load(path)
    assert machine.model.inertias[1].mass == 3_000
    assert crane.Dynamics(machine).mass_matrix([0.3])[0, 0] == pytest.approx(3_000, rel=1e-12)
    assert len(crane.load(write_machine(machine, tmp_path / "again")).tree.links) == 3_001


def test_collecting_leaves_nothing_behind(tmp_path):
    path = copy_machine(MACHINE, tmp_path)
    swap("kp: 50, ki: 20", "kp: -50, ki: -20").apply(tmp_path)
    assert check(path).errors == 2
    with pytest.raises(crane.CraneError, match="'kp' of control of 'crank' is -50"):
        crane.load(path)


# --- strokes ------------------------------------------------------------------------------------


VIA = (
    "tasks:\n  out:\n    via:\n      - {{time: 0, lift_stroke: 0.4}}\n"
    "      - {{time: 2, lift_stroke: {}}}\n"
)


def boom(folder, limits="", more=""):
    path = misfit_linkages.LINKAGES["boom"].write(folder)
    urdf = folder / "linkage.urdf"
    if limits:
        urdf.write_text(urdf.read_text().replace('lower="-9" upper="9"', limits))
    path.write_text(path.read_text() + more)
    return path


def told(path):
    return [finding.message for finding in check(path).findings]


def test_a_via_point_beyond_the_stroke_is_told(tmp_path):
    path = boom(tmp_path, 'lower="0.1" upper="0.6"', VIA.format(800))
    assert told(path) == [
        "task 'out' has 'lift_stroke' at 800 m at t = 2 s, beyond its limits 0.1 to 0.6 m, choose "
        "a position within them"
    ]
    assert told(boom(tmp_path, 'lower="0.1" upper="0.6"', VIA.format(0.5))) == []


def test_a_tip_beyond_all_links_is_told(tmp_path):
    tip = "tip: boom_eye\ntasks:\n  out:\n    via:\n      - {time: 0, x: 1, y: 0, z: 1.3}\n"
    path = boom(
        tmp_path, 'lower="0.1" upper="0.6"', tip + "      - {time: 1, x: 800, y: 0, z: 0}\n"
    )
    (line,) = told(path)
    assert line.startswith("task 'out' has its tip 800 m from the root at t = 1 s")


def test_the_part_of_the_strokes_that_does_not_close_is_told(tmp_path):
    """A triangle of pins 0.7616 and 1.2 m closes up to their sum, by hand."""
    pin, base, eye = (0.0, 0.8), (0.3, 0.2), (1.0, 1.3)
    longest = math.dist(pin, base) + math.dist(pin, eye) - 0.9
    shortest = abs(math.dist(pin, base) - math.dist(pin, eye)) - 0.9
    lower, upper = 0.1, 1.5
    path = boom(tmp_path, f'lower="{lower}" upper="{upper}"')
    (line,) = told(path)
    share = (upper - longest + max(0.0, shortest - lower)) / (upper - lower)
    found = re.match(r"(\d+) % of the strokes within the limits of lift_stroke lie beyond", line)
    assert abs(float(found[1]) - 100 * share) < 1.5
    last = float(re.search(r"closes is at lift_stroke = ([\d.]+)", line)[1])
    assert last == pytest.approx(longest, abs=1e-4) and "loop 'eye'" in line


@pytest.mark.parametrize("name", bundled_machines())
def test_bundled_machines_close_all_over_their_strokes(name):
    assert not [line for line in told(name) if "strokes" in line or "task" in line]


def test_a_dead_centre_in_the_way_of_a_phase_is_named(tmp_path):
    """The boom's pins are 2.5463 m and 0.9657 m from its cylinder's: it ends at their sum."""
    machine = crane.load("excavator", changes={"X_boom.upper": 3.0})
    up = Phase("up", {"X_boom": 1.0}, {"X_boom": 2.5}, 0.3)
    with pytest.raises(SimulationError) as caught:
        crane.simulate(machine, LeverPhases(machine, [up]), step=1e-2)
    text = str(caught.value)
    assert "'up' has not ended within 0.3 s" in text and "a dead centre is in between" in text
    assert "loop 'boom_eye' cannot be closed at" in text and "give a position before it" in text
