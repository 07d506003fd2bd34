"""Visuals and unknown elements of URDFs are drawn or reported, and never required."""

import json
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import wheel_loader
from broken_machines import DATA, LOOPED, copy_machine, swap
from warned import without_a_word

import crane
import crane.view.page.scene
from crane.common.errors import CraneWarning
from crane.dynamics.frame_jacobians import FrameJacobians
from crane.formats import check, write_urdf_plus
from crane.formats.visuals import mesh_process, urdf_shapes
from crane.formats.visuals.urdf_shapes import (
    DEFAULT_COLOUR,
    BoxShape,
    CylinderShape,
    MeshShape,
    SphereShape,
    UrdfShapes,
    find_mesh_file,
)
from crane.formats.xml_file import XmlFile
from crane.view.page import report
from crane.view.page.scene import read_visuals

ARM = """<robot name="arm">
  <link name="foot">
{drawn}
  </link>
  <joint name="swing" type="revolute"><parent link="foot"/><child link="arm"/>
    <axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <link name="arm"><inertial><mass value="1"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
</robot>
"""
BALL = '<visual><geometry><sphere radius="0.2"/></geometry></visual>'


def arm(folder, drawn):
    (folder / "arm.urdf").write_text(ARM.format(drawn=drawn))
    return folder / "arm.urdf"


def stl(count, triangles=1):
    """A binary STL that declares a number of triangles."""
    corners = np.array([[0, 0, 1], [0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes() + b"\0\0"
    return b"\0" * 80 + struct.pack("<I", count) + corners * triangles


def glb(header):
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<4sIIII", b"glTF", 2, 20 + len(text), len(text), 0x4E4F534A) + text


FAR_GLB = {
    "asset": {"version": "2.0"},
    "accessors": [
        {"componentType": 5126, "count": 1 << 40, "type": "VEC3"},
        {"componentType": 5125, "count": 1 << 40, "type": "SCALAR"},
    ],
    "bufferViews": [],
    "buffers": [],
    "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
    "nodes": [{"mesh": 0}],
    "scenes": [{"nodes": [0]}],
}
FAR_PLY = (
    b"ply\nformat ascii 1.0\nelement vertex 99999999999\nproperty float x\nproperty float y\n"
    b"property float z\nelement face 99999999999\nproperty list uchar int vertex_indices\n"
    b"end_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
)

BAD = [  # elements of a link, what is told in line 3, whether a box stands there
    ("no shape", "<visual/>", "a visual of link 'foot' has no shape, give one of <box>, <cyl"),
    ("empty geometry", "<visual><geometry/></visual>", "a visual of link 'foot' has no shape"),
    ("cone", '<visual><geometry><cone radius="1"/></geometry></visual>', "has <cone>, give one"),
    ("nan", '<visual><geometry><box size="1 nan 1"/></geometry></visual>', 'size="1 nan 1" of a'),
    ("text", '<visual><geometry><sphere radius="r"/></geometry></visual>', "is not a number, wri"),
    ("two", '<visual><geometry><box size="1 1"/></geometry></visual>', "has 2 numbers, give 3"),
    ("flat", '<visual><geometry><box size="1 0 1"/></geometry></visual>', "is not positive, give"),
    ("huge", '<visual><geometry><sphere radius="1e300"/></geometry></visual>', "of 1e+300 m"),
    ("no radius", "<visual><geometry><capsule/></geometry></visual>", "has no radius, add radius"),
    ("no file", "<visual><geometry><mesh/></geometry></visual>", "names no mesh, add filename"),
    ("origin", '<visual><origin xyz="1 2"/></visual>', 'xyz="1 2" of the origin of a visual of'),
    (
        "scale",
        '<visual><geometry><mesh filename="a.stl" scale="0.1"/></geometry></visual>',
        "has 1 numbers, give 3",
    ),
    (
        "package without a path",
        '<visual><geometry><mesh filename="package://file.stl"/></geometry></visual>',
        "mesh file 'package://file.stl' is not there",
    ),
]


@pytest.mark.parametrize(("drawn", "line"), [x[1:] for x in BAD], ids=[x[0] for x in BAD])
def test_what_cannot_be_drawn_is_told_and_left_out(drawn, line, tmp_path):
    path = arm(tmp_path, BALL + "\n" + drawn)
    found = check(path)
    assert found.status == 1
    told = [str(finding) for finding in found.findings]
    assert all(one.startswith("arm.urdf:4: warning: ") for one in told)
    assert sum(line in one for one in told) == 1
    machine = without_a_word(crane.load, path)  # a machine moves whatever is drawn
    with pytest.warns(CraneWarning, match=r"arm\.urdf:4|package://file\.stl"):
        report(machine, None, tmp_path / "arm.html")
    with pytest.warns(CraneWarning):
        shapes = [visual.shape for visual in read_visuals(machine)]
    assert shapes[0] == SphereShape(0.2)
    assert all(isinstance(shape, BoxShape) for shape in shapes[1:])


@pytest.mark.parametrize("colour", ["255 0 0 1", "red", "nan 0 0 1", "1 0 0", ""])
def test_a_bad_colour_is_grey(colour, tmp_path):
    material = f'<material name="m"><color rgba="{colour}"/></material>'
    path = arm(tmp_path, BALL.replace("</visual>", f"{material}</visual>"))
    assert [f.line for f in check(path).findings] == [3]
    with pytest.warns(CraneWarning, match="of a colour .*; grey is drawn"):
        (visual,) = read_visuals(crane.load(path))
    assert visual.colour == DEFAULT_COLOUR


def test_colours_go_by_name_wherever_they_stand(tmp_path):
    """As other readers have it: a material may be written within the first visual that has it."""
    named = BALL.replace("</visual>", '<material name="{}"/></visual>')
    first = '<material name="red"><color rgba="1 0 0 0.5"/></material>'
    path = arm(
        tmp_path,
        "\n".join([named.format("red"), BALL.replace("</visual>", f"{first}</visual>"),
                   named.format("blue"), named.format("none")]),
    )  # fmt: skip
    blue = '<material name="blue"><color rgba="0 0 1 1"/></material>'
    path.write_text(path.read_text().replace("</robot>", f"{blue}</robot>"))
    drawn = UrdfShapes(XmlFile(path))
    assert not drawn.problems
    colours = [visual.colour for visual in drawn.shapes["visual"]]
    assert colours == [(1, 0, 0, 0.5), (1, 0, 0, 0.5), (0, 0, 1, 1), DEFAULT_COLOUR]


def test_a_capsule_is_a_cylinder_between_two_balls(tmp_path):
    """Volume by points that fall into it: pi r^2 l + 4/3 pi r^3."""
    drawn = '<visual><origin xyz="0 0 1" rpy="0 1.5707963267948966 0"/><geometry>'
    drawn += '<capsule radius="0.1" length="0.4"/></geometry></visual>'
    found = UrdfShapes(XmlFile(arm(tmp_path, drawn))).shapes["visual"]
    assert [type(visual.shape) for visual in found] == [CylinderShape, SphereShape, SphereShape]
    corners = np.concatenate([visual.bounding_corners() for visual in found])
    np.testing.assert_allclose(corners.min(axis=0), [-0.3, -0.1, 0.9], atol=1e-12)
    np.testing.assert_allclose(corners.max(axis=0), [0.3, 0.1, 1.1], atol=1e-12)
    points = np.random.default_rng(1).uniform([-0.3, -0.1, 0.9], [0.3, 0.1, 1.1], (200_000, 3))
    inside = np.zeros(len(points), dtype=bool)
    for visual in found:
        local = (points - visual.placement[:3, 3]) @ visual.placement[:3, :3]
        if isinstance(visual.shape, CylinderShape):
            inside |= (np.hypot(*local[:, :2].T) < 0.1) & (np.abs(local[:, 2]) < 0.2)
        else:
            inside |= np.linalg.norm(local, axis=1) < 0.1
    volume = np.pi * 0.1**2 * 0.4 + 4 / 3 * np.pi * 0.1**3
    assert inside.mean() * 0.6 * 0.2 * 0.2 == pytest.approx(volume, rel=0.01)


DAMAGED = {
    "short.stl": stl(7),
    "far.stl": stl(0xFFFFFFFF),
    "nan.stl": stl(1).replace(np.float32(1).tobytes(), np.float32(np.nan).tobytes()),
    "empty.stl": b"",
    "text.stl": b"solid x\nfacet\nvertex 1 2\nendsolid\n",
    "index.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 900000000\n",
    "letters.obj": b"v a b c\nf 1 2 3\n",
    "noise.glb": bytes(range(256)) * 9,
    "far.glb": glb(FAR_GLB),
    "ring.gltf": json.dumps(
        {"asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}],
         "nodes": [{"children": [1]}, {"children": [0]}]}
    ).encode(),
    "cut.dae": b"<?xml version='1.0'?><COLLADA><library_geometries>",
    "far.ply": FAR_PLY,
    "far.off": b"OFF\n99999999999 1 0\n0 0 0\n3 0 0 0\n",
    "zip.zip": b"PK\x03\x04",
    "picture.png": b"\x89PNG",
}  # fmt: skip


def test_damaged_meshes_are_boxes_with_one_line(tmp_path):
    drawn = []
    for name, data in DAMAGED.items():
        (tmp_path / name).write_bytes(data)
        drawn.append(f'<visual><geometry><mesh filename="{name}"/></geometry></visual>')
    (tmp_path / "good.stl").write_bytes(stl(1))
    drawn.append('<visual><geometry><mesh filename="good.stl"/></geometry></visual>')
    path = arm(tmp_path, "\n".join(drawn))
    lines = [str(finding) for finding in check(path).findings]
    assert len(lines) == len(DAMAGED)
    for line, (number, name) in zip(lines, enumerate(DAMAGED, start=3), strict=True):
        assert line.startswith(f"arm.urdf:{number}: warning: mesh file '{name}' cannot be read (")
        assert line.isprintable() and len(line) < 250
    with pytest.warns(CraneWarning, match=f"short.stl.*\\({len(DAMAGED)} such, crane check"):
        shapes = [visual.shape for visual in read_visuals(crane.load(path))]
    assert [type(shape) for shape in shapes] == [BoxShape] * len(DAMAGED) + [MeshShape]
    np.testing.assert_allclose(shapes[-1].vertices, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])


def test_too_large_a_mesh_is_not_opened(tmp_path):
    with (tmp_path / "large.stl").open("wb") as file:
        file.truncate(10**12)  # which takes no space
    assert urdf_shapes.read_meshes([tmp_path / "large.stl"]) == {
        tmp_path / "large.stl": "1000000 MB, more than 200"
    }


def instanced(faces, nodes):
    """A glb with different triangles, drawn by each of many nodes."""
    vertices = np.random.default_rng(0).normal(size=(3 * faces, 3)).astype("<f4").tobytes()
    numbers = np.arange(3 * faces, dtype="<u4").tobytes()
    length = len(vertices)
    about = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [*range(nodes)]}],
        "nodes": [{"mesh": 0}] * nodes,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3 * faces, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5125, "count": 3 * faces, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": length},
            {"buffer": 0, "byteOffset": length, "byteLength": len(numbers)},
        ],
        "buffers": [{"byteLength": length + len(numbers)}],
    }  # fmt: skip
    text = json.dumps(about).encode()
    text += b" " * (-len(text) % 4)
    parts = ((b"JSON", text), (b"BIN\0", vertices + numbers))
    body = b"".join(struct.pack("<I4s", len(x), kind) + x for kind, x in parts)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def test_a_small_file_that_repeats_its_parts_is_drawn_up_to_a_bound(tmp_path):
    """Instances of millions of triangles are refused, repeated screws are not."""
    (tmp_path / "bomb.glb").write_bytes(instanced(10_000, 399))
    (tmp_path / "screws.glb").write_bytes(instanced(100, 900))
    bomb, screws = urdf_shapes.read_meshes(
        [tmp_path / "bomb.glb", tmp_path / "screws.glb"]
    ).values()
    assert bomb == "it repeats its 10000 triangles to more than 100000"
    (part,) = screws  # all of one colour
    assert len(part.faces) == 90_000 and part.faces.max() == len(part.vertices) - 1


def test_what_a_mesh_holds_is_kept_by_its_content(tmp_path, place, monkeypatch):
    """A known mesh is read from the cache, also as a copy or under another name."""
    (tmp_path / "a.stl").write_bytes(stl(5, 5))
    (tmp_path / "a.off").write_bytes(stl(5, 5))
    triangle = "usemtl red\nv 0 0 0\nv 1 0 0\nv 0 2 0\nf 1 2 3\n"
    (tmp_path / "a.obj").write_text("mtllib a.mtl\n" + triangle)
    (tmp_path / "a.mtl").write_text("newmtl red\nKd 1 0 0\n")
    asked, ask = [], urdf_shapes._run_mesh_process

    def told(names):
        asked.clear()
        return list(urdf_shapes.read_meshes(tmp_path / name for name in names).values())

    def counted(files, triangles):
        asked.append([file.name for file in files])
        return ask(files, triangles)

    monkeypatch.setattr(urdf_shapes, "_run_mesh_process", counted)
    names = ["a.stl", "a.off", "a.obj"]
    (first,), wrong, (red,) = told(names)
    assert asked == [names] and isinstance(wrong, str) and red.colour == (1, 0, 0, 1)
    assert len(list(place.glob("*.mesh"))) == 1
    (tmp_path / "b.stl").write_bytes(stl(5, 5))
    (later,) = told(["b.stl"])[0]
    assert not asked and later.colour == first.colour
    assert np.array_equal(later.vertices, first.vertices)
    assert np.array_equal(later.faces, first.faces)
    # another file may colour it, and what is wrong may have been the moment's
    (tmp_path / "a.mtl").write_text("newmtl red\nKd 0 1 0\n")
    (green,) = told(names)[2]
    assert asked == [names[1:]] and green.colour == (0, 1, 0, 1)
    (tmp_path / "b.stl").write_bytes(stl(6, 6))
    assert len(told(["b.stl"])[0][0].faces) == 6 and asked == [["b.stl"]]
    for file in place.glob("*.mesh"):
        file.write_bytes(file.read_bytes()[:-1])
    assert len(told(["a.stl"])[0][0].faces) == 5 and asked == [["a.stl"]]


def test_kept_meshes_count_as_triangles_to_draw(tmp_path, place, monkeypatch):
    for faces in (30, 20):
        (tmp_path / f"{faces}.stl").write_bytes(stl(faces, faces))
    assert not isinstance(urdf_shapes.read_meshes([tmp_path / "30.stl"])[tmp_path / "30.stl"], str)
    monkeypatch.setattr(mesh_process, "MAX_TRIANGLES", 49)
    kept, wrong = urdf_shapes.read_meshes([tmp_path / "30.stl", tmp_path / "20.stl"]).values()
    assert len(kept[0].faces) == 30 and wrong.startswith("with it there are more than")


def test_a_reader_that_ends_costs_one_mesh(tmp_path, place, monkeypatch):
    """The reader process restarts after the file at which it ended."""
    source = Path(mesh_process.__file__).read_text()
    opened, imported = (
        "            header, arrays = _read_mesh(file, remaining)\n",
        "import trimesh  # noqa: F401",
    )
    assert opened in source and imported in source
    ends = "            while 'long.stl' in file: pass\n"
    ends += "            if 'end.stl' in file: os._exit(3)\n"
    triangle = "np.eye(3), np.arange(3).reshape(1, 3)"
    reads = f"            import numpy as np; arrays = [{triangle}]\n"
    reads += "            header = {'parts': [{'vertices': 3, 'faces': 1, 'colour': None}]}\n"
    source = source.replace("SECONDS = 2 << 30, 20", "SECONDS = 2 << 30, 1")
    program = tmp_path / "reader.py"
    program.write_text(source.replace(opened, ends + reads).replace(imported, "pass  #"))
    monkeypatch.setattr(mesh_process, "__file__", str(program))

    def read(*names):
        for name in names:
            (tmp_path / name).write_bytes(stl(1))
        return list(urdf_shapes.read_meshes(tmp_path / name for name in names).values())

    first, second, third, fourth, fifth = read("1.stl", "end.stl", "2.stl", "long.stl", "3.stl")
    assert second == "damaged" and fourth == "reading it takes more than 20 s"
    for (part,) in (first, third, fifth):
        assert part.vertices.tolist() == np.eye(3).tolist()
        assert part.faces.tolist() == [[0, 1, 2]]
    found = read(*(f"{i}end.stl" for i in range(5)))
    assert found == ["damaged"] * 3 + ["not tried after 3 that ended the reader"] * 2


def test_meshes_are_read_without_what_takes_long_to_import(tmp_path):
    """By the process that reads them: scipy and networkx take twice as long as trimesh itself."""
    code = (
        f"import runpy, sys; runpy.run_path({mesh_process.__file__!r}, run_name='__main__'); "
        "heavy = [m for m in ('networkx', 'rtree', 'scipy', 'shapely') if sys.modules.get(m)]; "
        "open('told', 'w').write(f\"{heavy} {'trimesh' in sys.modules}\")"
    )
    nothing = b'{"files": [], "triangles": 0}'
    subprocess.run([sys.executable, "-P", "-c", code], input=nothing, cwd=tmp_path, check=True)
    assert (tmp_path / "told").read_text() == "[] True"


def test_bodies_without_visuals_are_bars_between_their_pins(tmp_path):
    """Where others have visuals: boom, bellcrank and link of a loader whose bucket has some."""
    path = wheel_loader.write(tmp_path)
    urdf = tmp_path / "wheel_loader.urdf"
    drawn = '<visual><geometry><box size="1 2 1"/></geometry></visual></link>'
    text = urdf.read_text()
    for link in ("frame", "bucket"):
        start = text.index("</inertial></link>", text.index(f'<link name="{link}">'))
        text = f"{text[:start]}</inertial>{drawn}{text[start + len('</inertial></link>') :]}"
    urdf.write_text(text)
    machine = crane.load(path)
    frames, found = FrameJacobians(machine), {}
    frames.set_configuration(machine.home)
    for visual in read_visuals(machine):
        if isinstance(visual.shape, SphereShape):
            place = frames.frame_pose(visual.link).homogeneous @ visual.placement
            found.setdefault(visual.link, []).append(place[[0, 2], 3])
    known = {
        "boom": (wheel_loader.PIN, wheel_loader.CRANK, wheel_loader.LIFT_EYE),
        "bellcrank": (wheel_loader.EYE, wheel_loader.LINK),
        "link": (wheel_loader.BUCKET,),
    }
    for body, pins in known.items():
        gaps = np.linalg.norm(np.array(pins)[:, None] - np.array(found[body]), axis=2)
        assert gaps.min(axis=1).max() < 1e-9
    assert "bucket" not in found and "frame" not in found


# --- unknown elements, names of meshes ----------------------------------------------------------


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
        ["four_bar_loop.urdf:22: unknown <dampr> in <joint>, it is left out, did you mean "
         'damping="..." of <dynamics>?'],
    ),
    (
        [swap("</robot>", "<a/><b/><c/><d/><e/></robot>", LOOPED)],
        [*(f"four_bar_loop.urdf:50: unknown <{tag}> in <robot>, it is left out, known: coupling, "
           "end_effector, gazebo, group_state, joint, link, loop, material, transmission"
           for tag in "abcde")],
    ),
    (
        [swap(LIMIT, '<limit lower="-1" upper="1"/>', LOOPED)],
        ["four_bar_loop.urdf:10: the limit of joint 'crank' has no effort and no velocity, "
         "nothing is limited then: add it, 1e9 for no limit"],
    ),
    (
        [swap(LIMIT, '<limit lower="-1" upper="1" velocity="5"/>', LOOPED),
         swap(COUPLER, COUPLER + '    <limit effort="1"/>\n', LOOPED)],
        [f"four_bar_loop.urdf:{problem}, nothing is limited then: add it, 1e9 for no limit"
         for problem in ("10: the limit of joint 'crank' has no effort",
                         "22: the limit of joint 'coupler' has no velocity")],
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
