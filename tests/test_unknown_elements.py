"""Unknown URDF elements are reported, and mesh file names of any kind are resolved."""

import pytest
from broken_machines import DATA, LOOPED, copy_machine, swap
from warned import without_a_word

import crane
import crane.view.page.scene
from crane.common.errors import CraneWarning
from crane.formats import write_urdf_plus
from crane.formats.checks import check
from crane.formats.visuals.urdf_shapes import find_mesh_file

COUPLER = '    <parent link="crank_arm"/>\n'
LIMIT = '<limit lower="-1" upper="1" effort="10" velocity="5"/>'

SLIPS = [
    (
        [swap(COUPLER, COUPLER + '    <dampr value="2"/>\n', LOOPED)],
        ["four_bar_loop.urdf:22: unknown <dampr> in <joint>, it is left out, did you mean "
         'damping="..." of <dynamics>?'],
    ),
    (
        [swap(COUPLER, COUPLER + '    <dampr value="2"/><dampr/>\n', LOOPED)],
        ["four_bar_loop.urdf:22: unknown <dampr> in <joint> (2 such in this file), it is left "
         'out, did you mean damping="..." of <dynamics>?'],
    ),
    (
        [swap("</robot>", "<a/><b/><c/><d/><e/></robot>", LOOPED)],
        [*(f"four_bar_loop.urdf:50: unknown <{tag}> in <robot>, it is left out, known: coupling, "
           "end_effector, gazebo, group_state, joint, link, loop, material, transmission"
           for tag in "abc"),
         "four_bar_loop.urdf:50: 2 more unknown elements (<d>, <e>) are left out"],
    ),
    (
        [swap(LIMIT, '<limit lower="-1" upper="1"/>', LOOPED)],
        ["four_bar_loop.urdf:10: the limit of joint 'crank' has no effort and no velocity, "
         "nothing is limited then: add it, 1e9 for no limit"],
    ),
    (
        [swap(LIMIT, '<limit lower="-1" upper="1" velocity="5"/>', LOOPED),
         swap(COUPLER, COUPLER + '    <limit effort="1"/>\n', LOOPED)],
        ["four_bar_loop.urdf:10: the limit of joint 'crank' has no effort (2 such in this file), "
         "nothing is limited then: add it, 1e9 for no limit"],
    ),
]  # fmt: skip

FOREIGN = """<gazebo reference="x"><selfCollide/><dampr/></gazebo>
<transmission name="t"><joint name="crank"><dampr/></joint></transmission>
<ros2_control name="r" type="system"><joint name="crank"><limt/></joint></ros2_control>
<sensor name="s"><parnt link="ground"/></sensor><mujoco><compiler/></mujoco>
<drake:joint xmlns:drake="http://drake.mit.edu"><drake:parent/></drake:joint>
<link name="last"><contact/><drake:proximity xmlns:drake="http://drake.mit.edu"/></link>
<joint name="end" type="fixed"><parent link="ground"/><child link="last"/></joint>
</robot>"""


@pytest.mark.parametrize(("edits", "lines"), SLIPS)
def test_load_and_check_tell_what_is_left_out(edits, lines, tmp_path):
    path = copy_machine(LOOPED, tmp_path)
    for edit in edits:
        edit.apply(tmp_path)
    with pytest.warns(CraneWarning) as caught:
        crane.load(path)
    assert [str(warning.message) for warning in caught] == lines
    report = check(path)
    assert report.status == 1
    assert {str(f).replace(": warning: ", ": ") for f in report.findings} == set(lines)


def test_what_other_programs_write_is_no_slip(tmp_path):
    path = copy_machine(LOOPED, tmp_path)
    swap("</robot>", FOREIGN, LOOPED).apply(tmp_path)
    assert check(path).findings == ()


def test_what_is_written_is_read_without_a_word(tmp_path):
    path = copy_machine(LOOPED, tmp_path)
    swap(LIMIT, '<limit lower="-1" upper="1"/>', LOOPED).apply(tmp_path)
    with pytest.warns(CraneWarning):
        machine = crane.load(path)
    write_urdf_plus(machine, tmp_path / "written.urdf")
    again = without_a_word(crane.load, tmp_path / "written.urdf")
    assert (again.model.effortLimit == machine.model.effortLimit).all()


@pytest.mark.parametrize(
    "name",
    [
        "meshes/a.stl", "package://arm/meshes/a.stl", "package://other/b.stl", "package://c.stl",
        "file://{folder}/arm/urdf/c.stl", "{folder}/arm/urdf/c.stl", "model://meshes/a.stl",
        "../meshes/a.stl", "c.stl",
    ],
)  # fmt: skip
def test_a_mesh_is_found_by_names_of_any_kind(name, tmp_path):
    for file in ("arm/meshes/a.stl", "other/b.stl", "arm/urdf/c.stl"):
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).write_text("solid")
    found = find_mesh_file(name.format(folder=tmp_path), tmp_path / "arm" / "urdf")
    assert found is not None and found.is_file()
    assert found.name == name.rpartition("/")[2]


@pytest.mark.parametrize(
    "name", ["", "package://", "package:///", "package://x.stl", "a\0b", "x" * 5000, "://", "."]
)
def test_a_mesh_that_is_not_there_is_a_finding(name, tmp_path):
    assert find_mesh_file(name, DATA) is None
    if name.isprintable() and name:
        path = copy_machine(LOOPED, tmp_path)
        drawn = f'<visual><geometry><mesh filename="{name}"/></geometry></visual>'
        swap('<link name="ground"/>', f'<link name="ground">{drawn}</link>', LOOPED).apply(
            tmp_path
        )
        (finding,) = check(path).findings
        assert "is not there, correct its path or install the package" in finding.message
        with pytest.warns(CraneWarning, match="mesh files? "):
            crane.view.page.scene.read_visuals(crane.load(path))
