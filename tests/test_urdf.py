"""Errors of broken URDF files, line by line; loops of URDF+ and of <constraint>."""

import os

import numpy as np
import pytest
from broken_machines import DATA, GROUND, LOOPED, assert_refused, case, swap, whole
from command_line import typed

import crane
from crane.common.errors import CraneWarning, DescriptionError, InputError
from crane.common.package_search import use_load_options
from crane.formats import check
from crane.formats.urdf.urdf_reader import read_urdf
from crane.formats.xml_file import XmlFile

pytestmark = pytest.mark.filterwarnings("ignore::crane.common.errors.CraneWarning")

# What is not XML, or not the XML of a robot.
XML = [
    case(
        "ground.urdf:30: not XML, Opening and ending tag mismatch: parent line 27 "
        "and joint, correct it",
        swap('<parent link="crank_arm"/>', '<parent link="crank_arm">', GROUND),
    ),
    case(
        "ground.urdf:1: a URDF starts with <robot>, this file with <world>",
        whole("<world/>", GROUND),
    ),
    case("ground.urdf:1: no <link> in this file, add one", whole('<robot name="r"/>', GROUND)),
    case(
        "ground.urdf:1: not UTF-8, save it as UTF-8 or declare its encoding",
        whole(b'<robot name="kr\xe4n"/>', GROUND),
    ),
    case(
        "ground.urdf:2: not UTF-8, save it as UTF-8 or declare its encoding",
        whole(bytes(range(256)), GROUND),
    ),
    case(
        "ground.urdf:1: a URDF starts with <robot>, this file with <{http://x.org}robot>",
        swap("<robot name", '<robot xmlns="http://x.org" name', GROUND),
    ),
    case(
        "ground.urdf:1: <!DOCTYPE> is not supported, remove it",
        swap(
            '<robot name="four_bar_ground">',
            '<!DOCTYPE robot [<!ENTITY x SYSTEM "file:///etc/passwd">]>\n'
            '<robot name="four_bar_ground">&x;',
            GROUND,
        ),
    ),
    case(
        "ground.urdf:3: link 'pin_B' has an <origin>, which is its joint's: move it there",
        swap('<link name="pin_B"/>', '<link name="pin_B"><origin xyz="0 0 1"/></link>', GROUND),
    ),
]

# Masses and inertias of no body.
BODIES = [
    case(
        "ground.urdf:20: value=\"${m}\" of the mass of link 'crank_arm' is not a "
        "number, expand the file with xacro",
        swap('<mass value="1.5"/>', '<mass value="${m}"/>', GROUND),
    ),
    case(
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
        "ground.urdf:10: joint 'crank' has no type, known: continuous, fixed, floating, planar, "
        "prismatic, revolute, spherical",
        swap(' type="revolute"', "", GROUND),
    ),
    case(
        "ground.urdf:14: joint 'crank' mimics the unknown joint 'rocker', known: coupler, crank",
        swap(
            '<limit lower="-1.5" upper="2.5" effort="10" velocity="5"/>',
            '<limit lower="-1.5" upper="2.5" effort="10" velocity="5"/><mimic joint="rocker"/>',
            GROUND,
        ),
    ),
    case(
        "ground.urdf:14: joint 'crank' mimics itself, name another",
        swap(
            '<limit lower="-1.5" upper="2.5" effort="10" velocity="5"/>',
            '<limit lower="-1.5" upper="2.5" effort="10" velocity="5"/><mimic joint="crank"/>',
            GROUND,
        ),
    ),
    case(
        "ground.urdf:14: lower and upper limit of joint 'crank' are both 1, widen "
        "them or make it fixed",
        swap(
            '<limit lower="-1.5" upper="2.5" effort="10" velocity="5"/>',
            '<limit lower="1" upper="1"/>',
            GROUND,
        ),
    ),
    case(
        "ground.urdf:14: lower=\"-inf\" of the limit of joint 'crank' is not finite, "
        "give a number",
        swap(
            '<limit lower="-1.5" upper="2.5" effort="10" velocity="5"/>',
            '<limit lower="-inf" upper="inf"/>',
            GROUND,
        ),
        alone=False,
    ),
    case(
        "ground.urdf:14: the effort limit of joint 'crank' is negative, make it positive",
        swap(
            '<limit lower="-1.5" upper="2.5" effort="10" velocity="5"/>',
            '<limit lower="-1.5" upper="2.5" effort="-1"/>',
            GROUND,
        ),
    ),
    case(
        "ground.urdf:13: the axis of joint 'crank' is zero, give a direction",
        swap('<axis xyz="0 0 1"/>\n    <limit', '<axis xyz="0 0 0"/>\n    <limit', GROUND),
    ),
    case(
        "ground.urdf:26: joint 'coupler' has 2 <origin>, keep one",
        swap(
            '<origin xyz="0.2 0 0"/>\n    <parent',
            '<origin xyz="0.2 0 0"/><origin xyz="0.2 0 0"/>\n    <parent',
            GROUND,
        ),
    ),
]

# Links and joints that do not make a tree.
TREE = [
    case(
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
        "ground.urdf:25: joint 'coupler' has no child link, add <child link=\"...\"/>",
        swap('<child link="coupler_arm"/>', "", GROUND),
    ),
    case(
        "ground.urdf:45: coupling 'c' has no predecessor, add <predecessor link=\"...\"/>",
        swap("</robot>", '<coupling name="c"/>\n</robot>', GROUND),
    ),
    case(
        "four_bar.yaml:5: no joint of these chains moves, add one",
        swap("  - {name: rocker, urdf: four_bar/rocker.urdf, parent: pin_B}\n", ""),
        swap('type="revolute"', 'type="fixed"', GROUND),
        swap('type="continuous"', 'type="fixed"', GROUND),
        alone=False,
    ),
]

# Loops in the way of URDF+.
LOOPS = [
    case(
        'four_bar_loop.urdf:5: unknown independant="..." in <joint>, did you mean '
        "'independent'?",
        swap(' independent="true"', ' independant="true"', LOOPED),
        machine=LOOPED,
    ),
    case(
        "four_bar_loop.urdf:19: joint 'coupler' is fixed and independent, keep one of the two",
        swap(
            'name="coupler" type="continuous"',
            'name="coupler" type="fixed" independent="true"',
            LOOPED,
        ),
        machine=LOOPED,
    ),
    case(
        "four_bar_loop.urdf:45: loop 'pin' has no type, known: continuous, "
        "cylindrical, fixed, planar, prismatic, revolute, spherical",
        swap('<loop name="pin" type="continuous">', '<loop name="pin">', LOOPED),
        machine=LOOPED,
    ),
    case(
        'four_bar_loop.urdf:50: the tip has no link, write parent_link="LINK", known: '
        "coupler_arm, crank_arm, ground, rocker_arm",
        swap("</robot>", '<end_effector name="tip" link="ground"/></robot>', LOOPED),
        machine=LOOPED,
    ),
    case(
        "four_bar_loop.urdf:45: loop 'pin' has no successor, add <successor link=\"...\"/>",
        swap('    <successor link="rocker_arm"><origin xyz="0.3 0 0"/></successor>\n', "", LOOPED),
        machine=LOOPED,
    ),
    case(
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
        "four_bar_loop.urdf:45: loop 'pin' cannot be closed from the home guess "
        "(crank = 0): it stays 0.1 m open, correct the frames or the guess",
        swap('<origin xyz="0.3 0 0"/>', '<origin xyz="0.3 0 0.1"/>', LOOPED),
        machine=LOOPED,
    ),
    case(
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


# --- the element <constraint> -------------------------------------------------------------------


TEXT = (DATA / LOOPED).read_text()
LOOP = TEXT[TEXT.index("  <loop") : TEXT.index("</loop>") + len("</loop>")]
FRAMES = """
    <parent link="coupler_arm"/><parent_origin xyz="0.4 0 0" rpy="0 0 0"/>
    <parent_axis xyz="0 0 2"/>
    <child link="rocker_arm"/>
    <child_origin xyz="0.3 0 0" rpy="0 0 0"/>"""
BEFORE = TEXT[: TEXT.index(LOOP)].count("\n") + 1  # line of the element
ASKED = {"urdf_constraint": True}


def written(folder, kind="revolute", frames=FRAMES, name=' name="pin"'):
    path = folder / "four_bar.urdf"
    said = f'  <constraint{name} type="{kind}">{frames}\n  </constraint>'
    path.write_text(TEXT.replace(LOOP, said))
    return path


@pytest.mark.parametrize("kind", ["revolute", "revolute_joint"])
def test_a_constraint_is_a_loop(kind, tmp_path):
    machine = crane.load(written(tmp_path, kind), arguments=ASKED)
    same = crane.load(DATA / LOOPED)
    q_a = np.linspace(-0.9, 0.9, 19)[:, None]
    assert machine.joints == same.joints and machine.active == same.active
    assert np.array_equal(machine.closure.solve(q_a), same.closure.solve(q_a))
    v_a = np.ones_like(q_a)
    forces = [crane.Dynamics(x).inverse(q_a, v_a, v_a) for x in (machine, same)]
    assert np.array_equal(*forces)
    again = crane.load(machine.load_name, arguments=machine.arguments)
    assert np.array_equal(again.home, same.home)


@pytest.mark.parametrize(
    ("kind", "loop"),
    [("prismatic_joint", "prismatic"), ("spherical", "spherical"), ("link", "fixed")],
)
def test_each_type_is_that_of_a_loop(kind, loop, tmp_path):
    path = written(tmp_path, kind, FRAMES.replace('<parent_axis xyz="0 0 2"/>', ""))
    with use_load_options(arguments=ASKED):
        (spec,) = read_urdf(path).loops
    assert (spec.name, spec.type, spec.axis) == ("pin", loop, (1.0, 0.0, 0.0))
    assert spec.source_location == f"four_bar.urdf:{BEFORE}"


def test_without_being_asked_it_is_left_out_and_the_line_says_how_to_ask(tmp_path):
    path = written(tmp_path)
    with pytest.warns(CraneWarning) as caught:
        machine = crane.load(path, active=["crank", "coupler", "rocker"])
    assert not machine.closure.equations.loops
    assert str(caught[0].message) == (
        f"four_bar.urdf:{BEFORE}: unknown <constraint> in <robot>, it is left out, read it by "
        "--arg urdf_constraint:=true, arguments={'urdf_constraint': True} in Python"
    )


def test_the_command_line_asks_by_an_argument(tmp_path):
    path = written(tmp_path)
    told = typed("convert", path, tmp_path / "loop.urdf", "--arg", "urdf_constraint:=true")
    assert told.returncode == 0
    same, machine = crane.load(DATA / LOOPED), crane.load(tmp_path / "loop.urdf")
    assert np.abs(machine.home - same.home).max() < 1e-14
    (loop,) = machine.closure.equations.loops
    assert (loop.name, loop.type) == ("pin", "revolute")


@pytest.mark.parametrize(
    ("kind", "change", "line", "error"),
    [
        ("ball", ("", ""), 0, "constraint 'pin' has the unknown type 'ball', known: link, "
         "prismatic, revolute, spherical"),
        ("sperical", ("", ""), 0, "constraint 'pin' has the unknown type 'sperical', did you "
         "mean 'spherical'?"),
        ("", ("", ""), 0, "constraint 'pin' has no type, known: link, prismatic, revolute, "
         "spherical"),
        ("universal_joint", ("", ""), 0, "constraint 'pin' is universal, which no loop is: hang a "
         "link without mass on its parent by a continuous joint about parent_axis, and close to "
         "that, with revolute"),
        ("revolute", ('<child link="rocker_arm"/>', ""), 0, "constraint 'pin' has no child, add "
         '<child link="..."/>'),
        ("revolute", ('"rocker_arm"', '"rocker"'), 3, "loop 'pin' has the unknown successor "
         "'rocker', did you mean 'rocker_arm'?"),
        ("revolute", ("child_origin", "child_orign"), 4, "unknown <child_orign> in <constraint>, "
         "did you mean 'child_origin'?"),
        ("revolute", ('0.3 0 0"', '0,3 0 0"'), 4, 'xyz="0,3 0 0" of the origin of the successor '
         "of loop 'pin' is not a number, write a decimal point"),
        ("revolute", ("xyz", "xzy"), 1, 'unknown xzy="..." in <parent_origin>, known: rpy, xyz'),
        ("revolute", ("<child ", '<child_axis xyz="0 1 1"/>\n<child '), 3, "the child_axis of "
         "constraint 'pin' is another than parent_axis, turn the child's frame by the rpy of "
         "child_origin and leave child_axis out"),
        ("revolute", ("0 0 2", "0 0 0"), 2, "the axis of loop 'pin' is zero, give a direction"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_one_line_with_its_place(kind, change, line, error, tmp_path):
    path = written(tmp_path, kind, FRAMES.replace(*change, 1) if change[0] else FRAMES)
    with pytest.raises(DescriptionError) as caught:
        crane.load(path, arguments=ASKED)
    assert str(caught.value) == f"four_bar.urdf:{BEFORE + line}: {error}"


def test_an_axis_of_the_child_that_is_the_parents_is_read(tmp_path):
    frames = FRAMES.replace("<child ", '<child_axis xyz="0 0 -1"/>\n<child ')
    machine = crane.load(written(tmp_path, frames=frames), arguments=ASKED)
    assert np.array_equal(machine.home, crane.load(DATA / LOOPED).home)


def test_check_notes_each_once(tmp_path):
    path = written(tmp_path, "revolut", FRAMES.replace('link="rocker_arm"', ""))
    report = check(path, arguments=ASKED)
    assert [str(found) for found in report.findings] == [
        f"four_bar.urdf:{BEFORE}: error: constraint 'pin' has the unknown type 'revolut', did you "
        "mean 'revolute'?"
    ]


def test_a_constraint_needs_a_name_and_the_argument_is_true_or_false(tmp_path):
    path = written(tmp_path, name="")
    with pytest.raises(DescriptionError, match=f"{BEFORE}: a constraint has no name, add name"):
        crane.load(path, arguments=ASKED)
    with pytest.raises(InputError, match="argument urdf_constraint is 'yes', give true or false"):
        crane.load(path, arguments={"urdf_constraint": "yes"})


def test_a_xacro_need_not_declare_the_argument(tmp_path):
    pytest.importorskip("xacro")
    path = written(tmp_path)
    text = path.read_text().replace(
        "<robot ", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" ', 1
    )
    path = tmp_path / "four_bar.xacro"
    path.write_text(text.replace('"0.3 0 0"', '"${0.1 * 3} 0 0"'))
    machine = crane.load(path, arguments=ASKED)
    assert np.allclose(machine.home, crane.load(DATA / LOOPED).home, atol=1e-14)
    with pytest.raises(InputError, match="four_bar.xacro has no argument 'urdf_constrain'"):
        crane.load(path, arguments={"urdf_constrain": True})
