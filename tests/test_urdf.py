"""Errors of broken URDF files, including the loops of URDF+, line by line."""

import os

import pytest
from broken_machines import GROUND, LOOPED, Broken, assert_refused, case, swap, whole

import crane
from crane.formats.xml_file import XmlFile

pytestmark = pytest.mark.filterwarnings("ignore::crane.common.errors.CraneWarning")

# What is not XML, or not the XML of a robot.
XML = [
    case("empty file", "ground.urdf: the file is empty, write a <robot> in it", whole("", GROUND)),
    case(
        "not XML",
        "ground.urdf:1: not XML, Start tag expected, '<' not found, correct it",
        whole("name: four_bar\n", GROUND),
    ),
    case(
        "tag not closed",
        "ground.urdf:30: not XML, Opening and ending tag mismatch: parent line 27 "
        "and joint, correct it",
        swap('<parent link="crank_arm"/>', '<parent link="crank_arm">', GROUND),
    ),
    case(
        "wrong root",
        "ground.urdf:1: a URDF starts with <robot>, this file with <world>",
        whole("<world/>", GROUND),
    ),
    case(
        "no links",
        "ground.urdf:1: no <link> in this file, add one",
        whole('<robot name="r"/>', GROUND),
    ),
    case(
        "not UTF-8",
        "ground.urdf:1: not UTF-8, save it as UTF-8 or declare its encoding",
        whole(b'<robot name="kr\xe4n"/>', GROUND),
    ),
    case(
        "binary",
        "ground.urdf:2: not UTF-8, save it as UTF-8 or declare its encoding",
        whole(bytes(range(256)), GROUND),
    ),
    case(
        "namespace",
        "ground.urdf:1: a URDF starts with <robot>, this file with <{http://x.org}robot>",
        swap("<robot name", '<robot xmlns="http://x.org" name', GROUND),
    ),
    case(
        "external entity",
        "ground.urdf:1: <!DOCTYPE> is not supported, remove it",
        swap(
            '<robot name="four_bar_ground">',
            '<!DOCTYPE robot [<!ENTITY x SYSTEM "file:///etc/passwd">]>\n'
            '<robot name="four_bar_ground">&x;',
            GROUND,
        ),
    ),
    case(
        "external document type",
        "ground.urdf:1: <!DOCTYPE> is not supported, remove it",
        swap(
            '<robot name="four_bar_ground">',
            '<!DOCTYPE robot SYSTEM "http://localhost/x.dtd">\n<robot name="four_bar_ground">',
            GROUND,
        ),
    ),
    case(
        "misspelt tag",
        "ground.urdf:26: unknown <orign> in <joint>, did you mean 'origin'?",
        swap(
            '<origin xyz="0.2 0 0"/>\n    <parent', '<orign xyz="0.2 0 0"/>\n    <parent', GROUND
        ),
    ),
    case(
        "upper case tag",
        "ground.urdf:26: unknown <ORIGIN> in <joint>, did you mean 'origin'?",
        swap(
            '<origin xyz="0.2 0 0"/>\n    <parent', '<ORIGIN xyz="0.2 0 0"/>\n    <parent', GROUND
        ),
    ),
    case(
        "misspelt inertial",
        "ground.urdf:18: unknown <intertial> in <link>, did you mean 'inertial'?",
        swap(
            '<inertial>\n      <origin xyz="0.1 0 0" rpy="0 0 0"/>',
            '<intertial>\n      <origin xyz="0.1 0 0" rpy="0 0 0"/>',
            GROUND,
        ),
        swap(
            'iyy="0.006" iyz="0" izz="0.006"/>\n    </inertial>',
            'iyy="0.006" iyz="0" izz="0.006"/>\n    </intertial>',
            GROUND,
        ),
    ),
    case(
        "misspelt link",
        "ground.urdf:3: unknown <lnk> in <robot>, did you mean 'link'?",
        swap('<link name="pin_B"/>', '<lnk name="pin_B"/>', GROUND),
    ),
    case(
        "tag in a wrong place",
        "ground.urdf:3: <mass> has no place in <link>, move it",
        swap('<link name="pin_B"/>', '<link name="pin_B"><mass value="3"/></link>', GROUND),
    ),
    case(
        "origin of a link",
        "ground.urdf:3: link 'pin_B' has an <origin>, which is its joint's: move it there",
        swap('<link name="pin_B"/>', '<link name="pin_B"><origin xyz="0 0 1"/></link>', GROUND),
    ),
    case(
        "misspelt attribute",
        'ground.urdf:26: unknown xzy="..." in <origin>, known: rpy, xyz',
        swap(
            '<origin xyz="0.2 0 0"/>\n    <parent', '<origin xzy="0.2 0 0"/>\n    <parent', GROUND
        ),
    ),
    case(
        "quaternion",
        'ground.urdf:26: unknown quat_xyzw="..." in <origin>, known: rpy, xyz',
        swap(
            '<origin xyz="0.2 0 0"/>\n    <parent',
            '<origin xyz="0.2 0 0" quat_xyzw="0 0 0 1"/>\n    <parent',
            GROUND,
        ),
    ),
    case(
        "misspelt type",
        "ground.urdf:10: unknown typ=\"...\" in <joint>, did you mean 'type'?",
        swap('name="crank" type="revolute"', 'name="crank" typ="revolute"', GROUND),
    ),
    case(
        "misspelt izz",
        "ground.urdf:21: unknown Izz=\"...\" in <inertia>, did you mean 'izz'?",
        swap(
            '<inertia ixx="0.001" ixy="0" ixz="0" iyy="0.006" iyz="0" izz="0.006"/>',
            '<inertia ixx="0.001" ixy="0" ixz="0" iyy="0.006" iyz="0" Izz="0.006"/>',
            GROUND,
        ),
    ),
    case(
        "misspelt upper",
        "ground.urdf:14: unknown uper=\"...\" in <limit>, did you mean 'upper'?",
        swap(
            '<limit lower="-1.5" upper="2.5" effort="10" velocity="5"/>',
            '<limit lower="-1.5" uper="2.5"/>',
            GROUND,
        ),
    ),
    case(
        "misspelt damping",
        "ground.urdf:15: unknown dampng=\"...\" in <dynamics>, did you mean 'damping'?",
        swap('damping="0.2"', 'dampng="0.2"', GROUND),
    ),
]

# Masses and inertias of no body.
BODIES = [
    case(
        "negative mass",
        "ground.urdf:20: link 'crank_arm' has the mass -1.5 kg, give a positive one",
        swap('<mass value="1.5"/>', '<mass value="-1.5"/>', GROUND),
    ),
    case(
        "nan mass",
        "ground.urdf:20: value=\"nan\" of the mass of link 'crank_arm' is not finite,"
        " give a number",
        swap('<mass value="1.5"/>', '<mass value="nan"/>', GROUND),
    ),
    case(
        "infinite mass",
        "ground.urdf:20: value=\"inf\" of the mass of link 'crank_arm' is not finite,"
        " give a number",
        swap('<mass value="1.5"/>', '<mass value="inf"/>', GROUND),
    ),
    case(
        "decimal comma",
        "ground.urdf:20: value=\"1,5\" of the mass of link 'crank_arm' is not a "
        "number, write a decimal point",
        swap('<mass value="1.5"/>', '<mass value="1,5"/>', GROUND),
    ),
    case(
        "mass in words",
        "ground.urdf:20: value=\"heavy\" of the mass of link 'crank_arm' is not a "
        "number, write digits",
        swap('<mass value="1.5"/>', '<mass value="heavy"/>', GROUND),
    ),
    case(
        "xacro",
        "ground.urdf:20: value=\"${m}\" of the mass of link 'crank_arm' is not a "
        "number, expand the file with xacro",
        swap('<mass value="1.5"/>', '<mass value="${m}"/>', GROUND),
    ),
    case(
        "empty mass",
        "ground.urdf:20: value=\"\" of the mass of link 'crank_arm' has 0 numbers, give 1",
        swap('<mass value="1.5"/>', '<mass value=""/>', GROUND),
    ),
    case(
        "no mass",
        "ground.urdf:18: the inertial of link 'crank_arm' has no <mass>, add it",
        swap('<mass value="1.5"/>', "", GROUND),
    ),
    case(
        "mass without value",
        "ground.urdf:20: the mass of link 'crank_arm' has no value, add value=\"...\"",
        swap('<mass value="1.5"/>', "<mass/>", GROUND),
    ),
    case(
        "two masses",
        "ground.urdf:20: link 'crank_arm' has 2 <mass>, keep one",
        swap('<mass value="1.5"/>', '<mass value="1.5"/><mass value="1.5"/>', GROUND),
    ),
    case(
        "zero inertia",
        "ground.urdf:21: link 'crank_arm' has a mass but no inertia, give at least "
        "a small sphere's",
        swap(
            '<inertia ixx="0.001" ixy="0" ixz="0" iyy="0.006" iyz="0" izz="0.006"/>',
            '<inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/>',
            GROUND,
        ),
        strict=True,
    ),
    case(
        "negative moment",
        "ground.urdf:21: link 'crank_arm' has the negative principal moment of "
        "inertia -0.001 kg m2, correct it",
        swap(
            '<inertia ixx="0.001" ixy="0" ixz="0" iyy="0.006" iyz="0" izz="0.006"/>',
            '<inertia ixx="-0.001" ixy="0" ixz="0" iyy="0.006" iyz="0" izz="0.006"/>',
            GROUND,
        ),
    ),
    case(
        "negative principal moment",
        "ground.urdf:21: link 'crank_arm' has the negative principal moment of "
        "inertia -0.006808 kg m2, correct it",
        swap(
            '<inertia ixx="0.001" ixy="0" ixz="0" iyy="0.006" iyz="0" izz="0.006"/>',
            '<inertia ixx="0.001" ixy="0.01" ixz="0" iyy="0.006" iyz="0" izz="0.006"/>',
            GROUND,
        ),
    ),
    case(
        "triangle inequality",
        "ground.urdf:21: link 'crank_arm' has an inertia of no possible body: "
        'principal moments 0.006 + 0.006 < 0.1 kg m2, the nearest possible is ixx="0.1" ixy="0" '
        'ixz="0" iyy="0.05" iyz="0" izz="0.05", correct it',
        swap(
            '<inertia ixx="0.001" ixy="0" ixz="0" iyy="0.006" iyz="0" izz="0.006"/>',
            '<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.006" iyz="0" izz="0.006"/>',
            GROUND,
        ),
        strict=True,
    ),
    case(
        "nan inertia",
        "ground.urdf:21: izz=\"NaN\" of the inertia of link 'crank_arm' is not "
        "finite, give a number",
        swap(
            '<inertia ixx="0.001" ixy="0" ixz="0" iyy="0.006" iyz="0" izz="0.006"/>',
            '<inertia ixx="0.001" ixy="0" ixz="0" iyy="0.006" iyz="0" izz="NaN"/>',
            GROUND,
        ),
    ),
    case(
        "no inertia",
        "ground.urdf:18: the inertial of link 'crank_arm' has no <inertia>, add it",
        swap('<inertia ixx="0.001" ixy="0" ixz="0" iyy="0.006" iyz="0" izz="0.006"/>', "", GROUND),
    ),
    case(
        "no izz",
        "ground.urdf:21: the inertia of link 'crank_arm' has no izz, add izz=\"...\"",
        swap(
            '<inertia ixx="0.001" ixy="0" ixz="0" iyy="0.006" iyz="0" izz="0.006"/>',
            '<inertia ixx="0.001" ixy="0" ixz="0" iyy="0.006" iyz="0"/>',
            GROUND,
        ),
    ),
    case(
        "fixed parts that add up to no body",
        "ground.urdf:31: link 'coupler_arm' with what is fixed to it has an inertia"
        " of no possible body: principal moments 1.034 + 1.034 < 10 kg m2, the nearest possible "
        'is ixx="10.001" ixy="0" ixz="0" iyy="5.0005" iyz="0" izz="5.0005", correct it',
        swap(
            '<link name="coupler_pin"/>',
            '<link name="coupler_pin"><inertial><mass value="0.1"/><inertia ixx="10" '
            'ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>',
            GROUND,
        ),
        strict=True,
    ),
]

# Joints that cannot be.
JOINTS = [
    case(
        "misspelt joint type",
        "ground.urdf:10: joint 'crank' has the type 'revolut', which is not "
        "supported, did you mean 'revolute'?",
        swap('type="revolute"', 'type="revolut"', GROUND),
    ),
    case(
        "unknown type",
        "ground.urdf:10: joint 'crank' has the type 'screw', which is not supported, known: "
        "continuous, fixed, floating, planar, prismatic, revolute, spherical",
        swap('type="revolute"', 'type="screw"', GROUND),
    ),
    case(
        "no type",
        "ground.urdf:10: joint 'crank' has no type, known: continuous, fixed, floating, planar, "
        "prismatic, revolute, spherical",
        swap(' type="revolute"', "", GROUND),
    ),
    case(
        "mimic",
        "ground.urdf:14: joint 'crank' mimics the unknown joint 'rocker', known: coupler, crank",
        swap(
            '<limit lower="-1.5" upper="2.5" effort="10" velocity="5"/>',
            '<limit lower="-1.5" upper="2.5" effort="10" velocity="5"/><mimic joint="rocker"/>',
            GROUND,
        ),
    ),
    case(
        "mimic of itself",
        "ground.urdf:14: joint 'crank' mimics itself, name another",
        swap(
            '<limit lower="-1.5" upper="2.5" effort="10" velocity="5"/>',
            '<limit lower="-1.5" upper="2.5" effort="10" velocity="5"/><mimic joint="crank"/>',
            GROUND,
        ),
    ),
    case(
        "limits reversed",
        "ground.urdf:14: the limits of joint 'crank' are reversed (2.5 > -1.5), swap them",
        swap(
            '<limit lower="-1.5" upper="2.5" effort="10" velocity="5"/>',
            '<limit lower="2.5" upper="-1.5"/>',
            GROUND,
        ),
    ),
    case(
        "limits equal",
        "ground.urdf:14: lower and upper limit of joint 'crank' are both 1, widen "
        "them or make it fixed",
        swap(
            '<limit lower="-1.5" upper="2.5" effort="10" velocity="5"/>',
            '<limit lower="1" upper="1"/>',
            GROUND,
        ),
    ),
    case(
        "infinite limit",
        "ground.urdf:14: lower=\"-inf\" of the limit of joint 'crank' is not finite, "
        "give a number",
        swap(
            '<limit lower="-1.5" upper="2.5" effort="10" velocity="5"/>',
            '<limit lower="-inf" upper="inf"/>',
            GROUND,
        ),
    ),
    case(
        "negative effort",
        "ground.urdf:14: the effort limit of joint 'crank' is negative, make it positive",
        swap(
            '<limit lower="-1.5" upper="2.5" effort="10" velocity="5"/>',
            '<limit lower="-1.5" upper="2.5" effort="-1"/>',
            GROUND,
        ),
    ),
    case(
        "zero axis",
        "ground.urdf:13: the axis of joint 'crank' is zero, give a direction",
        swap('<axis xyz="0 0 1"/>\n    <limit', '<axis xyz="0 0 0"/>\n    <limit', GROUND),
    ),
    case(
        "axis of two numbers",
        "ground.urdf:13: xyz=\"0 1\" of the axis of joint 'crank' has 2 numbers, give 3",
        swap('<axis xyz="0 0 1"/>\n    <limit', '<axis xyz="0 1"/>\n    <limit', GROUND),
    ),
    case(
        "axis without numbers",
        "ground.urdf:13: the axis of joint 'crank' has no xyz, add xyz=\"...\"",
        swap('<axis xyz="0 0 1"/>\n    <limit', "<axis/>\n    <limit", GROUND),
    ),
    case(
        "origin of four numbers",
        "ground.urdf:26: xyz=\"0.2 0 0 0\" of the origin of joint 'coupler' has 4 numbers, give 3",
        swap(
            '<origin xyz="0.2 0 0"/>\n    <parent',
            '<origin xyz="0.2 0 0 0"/>\n    <parent',
            GROUND,
        ),
    ),
    case(
        "two origins",
        "ground.urdf:26: joint 'coupler' has 2 <origin>, keep one",
        swap(
            '<origin xyz="0.2 0 0"/>\n    <parent',
            '<origin xyz="0.2 0 0"/><origin xyz="0.2 0 0"/>\n    <parent',
            GROUND,
        ),
    ),
    case(
        "negative damping",
        "ground.urdf:15: damping or friction of joint 'crank' is negative, make it positive",
        swap('damping="0.2"', 'damping="-0.2"', GROUND),
    ),
    case(
        "damping in words",
        "ground.urdf:15: damping=\"low\" of the dynamics of joint 'crank' is not a "
        "number, write digits",
        swap('damping="0.2"', 'damping="low"', GROUND),
    ),
]

# Links and joints that do not make a tree.
TREE = [
    case(
        "two parents",
        "ground.urdf:45: link 'coupler_arm' has two parents, joints 'coupler' and "
        "'second': keep one and close the other as a loop",
        swap(
            "</robot>",
            '  <joint name="second" type="continuous">\n'
            '    <parent link="ground"/>\n'
            '    <child link="coupler_arm"/>\n'
            "  </joint>\n"
            "</robot>",
            GROUND,
        ),
    ),
    case(
        "two roots",
        "ground.urdf:45: 2 links have no parent (ground, lost): join all but one",
        swap("</robot>", '<link name="lost"/>\n</robot>', GROUND),
    ),
    case(
        "ring",
        "ground.urdf:40: link 'coupler_pin' is its own ancestor: cut the ring of "
        "joints crank, coupler, coupler_pin_fixed at 'coupler_pin_fixed' and close it as a loop",
        swap('<link name="ground"/>', "", GROUND),
        swap(
            '<parent link="ground"/>\n    <child link="pin_B"/>',
            '<parent link="coupler_pin"/>\n    <child link="pin_B"/>',
            GROUND,
        ),
        swap(
            '<parent link="ground"/>\n    <child link="crank_arm"/>',
            '<parent link="coupler_pin"/>\n    <child link="crank_arm"/>',
            GROUND,
        ),
    ),
    case(
        "ring beside the tree",
        "ground.urdf:47: link 'a' is its own ancestor: cut the ring of joints "
        "ab, ba at 'ba' and close it as a loop",
        swap(
            "</robot>",
            '  <link name="a"/><link name="b"/>\n'
            '  <joint name="ab" type="fixed"><parent link="a"/><child link="b"/></joint>\n'
            '  <joint name="ba" type="fixed"><parent link="b"/><child link="a"/></joint>\n'
            "</robot>",
            GROUND,
        ),
    ),
    case(
        "joint from a link to itself",
        "ground.urdf:25: joint 'coupler' joins link 'coupler_arm' to itself, change one end",
        swap('<parent link="crank_arm"/>', '<parent link="coupler_arm"/>', GROUND),
    ),
    case(
        "unknown parent",
        "ground.urdf:27: joint 'coupler' has the unknown parent 'crank_am', did you"
        " mean 'crank_arm'?",
        swap('<parent link="crank_arm"/>', '<parent link="crank_am"/>', GROUND),
    ),
    case(
        "unknown child",
        "ground.urdf:28: joint 'coupler' has the unknown child 'boom', known: "
        "coupler_arm, coupler_pin, crank_arm, ground, pin_B",
        swap('<child link="coupler_arm"/>', '<child link="boom"/>', GROUND),
    ),
    case(
        "no child",
        "ground.urdf:25: joint 'coupler' has no child link, add <child link=\"...\"/>",
        swap('<child link="coupler_arm"/>', "", GROUND),
    ),
    case(
        "two children",
        "ground.urdf:28: joint 'coupler' has 2 <child>, keep one",
        swap(
            '<child link="coupler_arm"/>',
            '<child link="coupler_arm"/><child link="pin_B"/>',
            GROUND,
        ),
    ),
    case(
        "link twice",
        "ground.urdf:45: link 'ground' is there twice (first in line 2), rename one",
        swap("</robot>", '<link name="ground"/>\n</robot>', GROUND),
    ),
    case(
        "joint twice",
        "ground.urdf:25: joint 'crank' is there twice (first in line 10), rename one",
        swap('name="coupler" type', 'name="crank" type', GROUND),
    ),
    case(
        "link without name",
        'ground.urdf:3: a link has no name, add name="..."',
        swap('<link name="pin_B"/>', "<link/>", GROUND),
    ),
    case(
        "joint without name",
        'ground.urdf:25: a joint has no name, add name="..."',
        swap('<joint name="coupler" type', "<joint type", GROUND),
    ),
    case(
        "coupling",
        "ground.urdf:45: coupling 'c' has no predecessor, add <predecessor link=\"...\"/>",
        swap("</robot>", '<coupling name="c"/>\n</robot>', GROUND),
    ),
    case(
        "nothing moves",
        "four_bar.yaml:5: no joint of these chains moves, add one",
        swap("  - {name: rocker, urdf: four_bar/rocker.urdf, parent: pin_B}\n", ""),
        swap('type="revolute"', 'type="fixed"', GROUND),
        swap('type="continuous"', 'type="fixed"', GROUND),
    ),
]

# Loops in the way of URDF+.
LOOPS = [
    case(
        "independent yes",
        "four_bar_loop.urdf:5: independent=\"yes\" of joint 'crank' is neither true nor false",
        swap(' independent="true"', ' independent="yes"', LOOPED),
        machine=LOOPED,
    ),
    case(
        "misspelt independent",
        'four_bar_loop.urdf:5: unknown independant="..." in <joint>, did you mean '
        "'independent'?",
        swap(' independent="true"', ' independant="true"', LOOPED),
        machine=LOOPED,
    ),
    case(
        "fixed joint is independent",
        "four_bar_loop.urdf:19: joint 'coupler' is fixed and independent, keep one of the two",
        swap(
            'name="coupler" type="continuous"',
            'name="coupler" type="fixed" independent="true"',
            LOOPED,
        ),
        machine=LOOPED,
    ),
    case(
        "misspelt loop type",
        "four_bar_loop.urdf:45: loop 'pin' has the unknown type 'revolut', did you "
        "mean 'revolute'?",
        swap('<loop name="pin" type="continuous">', '<loop name="pin" type="revolut">', LOOPED),
        machine=LOOPED,
    ),
    case(
        "unknown loop type",
        "four_bar_loop.urdf:45: loop 'pin' has the unknown type 'hinge', known: "
        "continuous, cylindrical, fixed, planar, prismatic, revolute, spherical",
        swap('<loop name="pin" type="continuous">', '<loop name="pin" type="hinge">', LOOPED),
        machine=LOOPED,
    ),
    case(
        "no loop type",
        "four_bar_loop.urdf:45: loop 'pin' has no type, known: continuous, "
        "cylindrical, fixed, planar, prismatic, revolute, spherical",
        swap('<loop name="pin" type="continuous">', '<loop name="pin">', LOOPED),
        machine=LOOPED,
    ),
    case(
        "tip without a link",
        'four_bar_loop.urdf:50: the tip has no link, write parent_link="LINK", known: '
        "coupler_arm, crank_arm, ground, rocker_arm",
        swap("</robot>", '<end_effector name="tip" link="ground"/></robot>', LOOPED),
        machine=LOOPED,
    ),
    case(
        "loop without name",
        'four_bar_loop.urdf:45: a loop has no name, add name="..."',
        swap('<loop name="pin" type="continuous">', '<loop type="revolute">', LOOPED),
        machine=LOOPED,
    ),
    case(
        "loop twice",
        "four_bar_loop.urdf:50: loop 'pin' is there twice (first in line 45), rename one",
        swap(
            "</robot>",
            '  <loop name="pin" type="continuous">\n'
            '    <predecessor link="coupler_arm"><origin xyz="0.4 0 0"/></predecessor>\n'
            '    <successor link="rocker_arm"><origin xyz="0.3 0 0"/></successor>\n'
            '    <axis xyz="0 0 2"/>\n'
            "  </loop>\n"
            "</robot>",
            LOOPED,
        ),
        machine=LOOPED,
    ),
    case(
        "unknown predecessor",
        "four_bar_loop.urdf:46: loop 'pin' has the unknown predecessor "
        "'coupler_am', did you mean 'coupler_arm'?",
        swap('<predecessor link="coupler_arm">', '<predecessor link="coupler_am">', LOOPED),
        machine=LOOPED,
    ),
    case(
        "no successor",
        "four_bar_loop.urdf:45: loop 'pin' has no successor, add <successor link=\"...\"/>",
        swap('    <successor link="rocker_arm"><origin xyz="0.3 0 0"/></successor>\n', "", LOOPED),
        machine=LOOPED,
    ),
    case(
        "misspelt successor",
        "four_bar_loop.urdf:47: unknown <sucessor> in <loop>, did you mean 'successor'?",
        swap(
            '<successor link="rocker_arm"><origin xyz="0.3 0 0"/></successor>',
            '<sucessor link="rocker_arm"/>',
            LOOPED,
        ),
        machine=LOOPED,
    ),
    case(
        "zero axis of a loop",
        "four_bar_loop.urdf:48: the axis of loop 'pin' is zero, give a direction",
        swap('xyz="0 0 2"', 'xyz="0 0 0"', LOOPED),
        machine=LOOPED,
    ),
    case(
        "origin of a loop of two numbers",
        'four_bar_loop.urdf:47: xyz="0.3 0" of the origin of the successor of loop '
        "'pin' has 2 numbers, give 3",
        swap('<origin xyz="0.3 0 0"/>', '<origin xyz="0.3 0"/>', LOOPED),
        machine=LOOPED,
    ),
    case(
        "loop within a body",
        "four_bar_loop.urdf:45: loop 'pin' joins 'pin_predecessor' and "
        "'pin_successor', both on the body 'coupler_arm': choose frames of two "
        "bodies",
        swap(
            '<successor link="rocker_arm"><origin xyz="0.3 0 0"/>',
            '<successor link="coupler_arm"><origin xyz="0.3 0 0"/>',
            LOOPED,
        ),
        machine=LOOPED,
    ),
    case(
        "loop within a body over a fixed joint",
        "four_bar_loop.urdf:45: loop 'pin' joins 'pin_predecessor' and "
        "'pin_successor', both on the body 'coupler_arm': choose frames of two "
        "bodies",
        swap(
            '<successor link="rocker_arm"><origin xyz="0.3 0 0"/>',
            '<successor link="extra"><origin xyz="0.3 0 0"/>',
            LOOPED,
        ),
        swap(
            "</robot>",
            '<link name="extra"/><joint name="extra_fixed" type="fixed"><parent '
            'link="coupler_arm"/><child link="extra"/></joint></robot>',
            LOOPED,
        ),
        machine=LOOPED,
    ),
    case(
        "link named as a loop frame",
        "four_bar_loop.urdf:50: link 'pin_successor' has the name of a frame of "
        "loop 'pin', rename one",
        swap(
            "</robot>",
            '<link name="pin_successor"/><joint name="x" type="fixed"><parent '
            'link="coupler_arm"/><child link="pin_successor"/></joint></robot>',
            LOOPED,
        ),
        machine=LOOPED,
    ),
    case(
        "joint named as a loop frame",
        "four_bar_loop.urdf:50: joint 'pin_successor_fixed' has the name of a loop's, rename it",
        swap(
            "</robot>",
            '<link name="extra"/><joint name="pin_successor_fixed" type="fixed"><parent'
            ' link="coupler_arm"/><child link="extra"/></joint></robot>',
            LOOPED,
        ),
        machine=LOOPED,
    ),
    case(
        "loop beside the plane",
        "four_bar_loop.urdf:45: loop 'pin' cannot be closed from the home guess "
        "(crank = 0): it stays 0.1 m open, correct the frames or the guess",
        swap('<origin xyz="0.3 0 0"/>', '<origin xyz="0.3 0 0.1"/>', LOOPED),
        machine=LOOPED,
    ),
    case(
        "loop about a wrong axis",
        "four_bar_loop.urdf:45: loop 'pin': its axis is 90 degrees off those of its neighbours "
        'crank, coupler, rocker, so that it cannot move with them: turn it to <axis xyz="0 0 1"/>',
        swap('    <axis xyz="0 0 2"/>\n', "", LOOPED),
        machine=LOOPED,
    ),
]


@pytest.mark.parametrize("broken", [*XML, *BODIES, *JOINTS, *TREE, *LOOPS])
def test_is_refused(broken, tmp_path):
    assert_refused(broken, tmp_path)


LAUGHS = '<!DOCTYPE robot [<!ENTITY a "ha">{}]>'.format(
    "".join(
        f'<!ENTITY {b} "{f"&{a};" * 10}">' for a, b in zip("abcdefghi", "bcdefghij", strict=True)
    )
)


@pytest.mark.parametrize("place", ['<robot name="four_bar_ground">&j;', '<robot name="&j;">'])
def test_entities_are_not_expanded(place, tmp_path):
    """Nine entities, each ten times the one before, would be two gigabytes."""
    edit = swap('<robot name="four_bar_ground">', LAUGHS + place, GROUND)
    message = "ground.urdf:1: <!DOCTYPE> is not supported, remove it"
    assert_refused(Broken("laughs", message, (edit,)), tmp_path)


@pytest.mark.parametrize(
    ("encoding", "written"),
    [
        ("utf-8", None), ("utf-16", None), ("utf-16-le", None), ("utf-16-be", None),
        ("utf-32", None), ("utf-7", None), ("utf-7", "+ADwAIQ-DOCTYPE"),
    ],
)  # fmt: skip
def test_document_types_are_refused_in_every_encoding(tmp_path, encoding, written):
    text = f'<?xml version="1.0" encoding="{encoding}"?>{LAUGHS}<robot name="&j;"/>'
    data = text.encode(encoding)
    if written is not None:
        data = data.replace(b"<!DOCTYPE", written.encode())
    (tmp_path / "robot.urdf").write_bytes(data)
    with pytest.raises(crane.CraneError, match="^robot.urdf:1: <!DOCTYPE> is not supported"):
        crane.load(tmp_path / "robot.urdf")


def test_a_document_type_that_is_only_spoken_of_is_none(tmp_path):
    text = '<robot name="r"><!-- <!DOCTYPE robot> --><link name="a"/></robot>'
    (tmp_path / "robot.urdf").write_text(text)
    assert XmlFile(tmp_path / "robot.urdf").root.tag == "robot"


def test_files_without_end_are_refused(tmp_path):
    (tmp_path / "large.urdf").touch()
    os.truncate(tmp_path / "large.urdf", 10**12)  # which takes no space
    (tmp_path / "zero.urdf").symlink_to("/dev/zero")
    with pytest.raises(crane.CraneError, match=r"cannot be read \(1e\+06 MB, more than 50\)"):
        XmlFile(tmp_path / "large.urdf")
    with pytest.raises(crane.CraneError, match="it is no plain file, copy it into one"):
        XmlFile(tmp_path / "zero.urdf")


def test_files_are_not_fetched(tmp_path):
    (tmp_path / "secret").write_text("secret")
    entity = f'<!DOCTYPE robot [<!ENTITY x SYSTEM "file://{tmp_path}/secret">]>'.encode("utf-16")
    path = tmp_path / "robot.urdf"
    path.write_bytes(entity + '<robot name="r">&x;<link name="&x;"/></robot>'.encode("utf-16")[2:])
    with pytest.raises(crane.CraneError) as caught:
        crane.load(path)
    assert "secret" not in str(caught.value)
