"""The proposed URDF element `<constraint>` is equivalent to `<loop>`."""

import numpy as np
import pytest
from broken_machines import DATA, LOOPED
from command_line import typed

import crane
from crane.common.errors import CraneWarning, DescriptionError, InputError
from crane.common.package_search import use_load_options
from crane.formats.checks import check
from crane.formats.urdf.urdf_reader import read_urdf

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
