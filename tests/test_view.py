"""Pages of runs: placements equal forward kinematics, nothing is requested from outside."""

import base64
import dataclasses
import json
import re
from html.parser import HTMLParser

import numpy as np
import pinocchio as pin
import pytest
from warned import quiet

import crane
from crane.common.errors import CraneError, InputError, OutputError, RecordingError
from crane.formats.visuals.urdf_shapes import CylinderShape, MeshShape
from crane.recordings.recording import Recording
from crane.view.page import build_scene, report
from crane.view.page.page_motion import (
    joint_tree,
    motion_data,
    nearest_frame_rows,
    payload_frame_data,
    quantise,
)
from crane.view.page.scene import link_poses, read_visuals, skeleton_visuals

CORNERS = [[0.0, 0.0221, 0.0108], [0.4, 0.03, 0.0], [1.1, 0.0, 0.03], [-0.7, 0.002, 0.004]]

ARM = """<robot name="arm">
  <link name="foot">{foot}</link>
  <joint name="swing" type="revolute">
    <origin xyz="0 0 0.5" rpy="0 0.3 0"/>
    <parent link="foot"/><child link="arm"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/>
  </joint>
  <link name="arm">
    <inertial><mass value="1"/>
      <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <joint name="end" type="fixed">
    <origin xyz="0.4 0.1 0"/><parent link="arm"/><child link="hand"/>
  </joint>
  <link name="hand"/>
</robot>"""


@pytest.fixture(scope="module")
def machine():
    return quiet(crane.load, "mini_forwarder")


@pytest.fixture
def recording(machine):
    """Two seconds at 20 ms through corners of the stroke range, with all channels."""
    time = 3.0 + np.linspace(0, 2, 101)
    nodes = np.linspace(3.0, 5.0, len(CORNERS))
    q_a = np.column_stack([np.interp(time, nodes, column) for column in np.transpose(CORNERS)])
    q = machine.closure.solve(q_a)
    passive = [joint for joint in machine.joints if joint not in machine.active]
    tip = link_poses(machine, q, ["link7_tip"])["link7_tip"][:, :3, 3]
    channels = {joint: q[:, machine.column(joint)] for joint in passive}
    channels |= {f"reference_tip_{x}": tip[:, i] + 0.01 for i, x in enumerate("xyz")}
    return Recording(
        time=time,
        joints=machine.active,
        q=q_a,
        v=np.zeros_like(q_a),
        tau=np.zeros_like(q_a),
        units={joint: machine.unit(joint) for joint in machine.active},
        channels=channels,
        task="round the corners",
    )


def bare(recording):
    """The same recording without channels."""
    return Recording(
        recording.time, recording.joints, recording.q, recording.v, recording.tau, recording.units
    )


def world(machine, q, link):
    """(4, 4) pose of a link."""
    data = machine.model.createData()
    pin.forwardKinematics(machine.model, data, q)
    return pin.updateFramePlacement(machine.model, data, machine.frame(link)).homogeneous


def transforms(scene):
    """The transforms that are set before anything moves, by path."""
    return {
        c["path"].removeprefix("/meshcat/"): np.reshape(c["matrix"], (4, 4)).T
        for c in scene.commands
        if c["type"] == "set_transform"
    }


def displaced(joint, value):
    """(4, 4) what a joint of the page's tree does, from its axis alone (Rodrigues)."""
    pose, (x, y, z) = np.eye(4), joint["axis"]
    if joint["type"] == "prismatic":
        pose[:3, 3] = value * np.array([x, y, z])
    else:
        K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        pose[:3, :3] += np.sin(value) * K + (1 - np.cos(value)) * K @ K
    return pose


def page_poses(tree, q):
    """Poses (4, 4) of the links in a page's tree at a posture q (nq,)."""
    matrix = lambda values: np.reshape(values, (4, 4)).T  # noqa: E731
    world = [np.eye(4)]  # joint -1 is last
    for joint in tree["joints"]:
        zero = world[joint["parent"] + 1] @ matrix(joint["placement"])
        world.append(zero @ displaced(joint, q[joint["column"]]))
    return {
        link: world[place["joint"] + 1] @ matrix(place["placement"])
        for link, place in tree["links"].items()
    }


@pytest.mark.parametrize("name", ["mini_forwarder", "patu655", "kr300", "tx40", "ur5_robot"])
def test_a_page_s_tree_gives_the_poses_of_forward_kinematics(name):
    machine = quiet(crane.load, name)
    description = joint_tree(machine)
    links = [f.name for f in machine.model.frames if f.type == pin.FrameType.BODY]
    assert list(description["links"]) == links
    rng = np.random.default_rng(7)
    for q in [machine.home, *rng.uniform(-3, 3, (20, machine.model.nq))]:
        for link, pose in page_poses(description, q).items():
            np.testing.assert_allclose(pose, world(machine, q, link), atol=1e-12)


def unpacked(motion):
    """Times (N,) and postures (N, nq) of the frames in a page."""
    read = lambda text, kind: np.frombuffer(base64.b64decode(text), kind)  # noqa: E731
    time = read(motion["time"], "<f8")
    columns = [
        x["low"] + x["step"] * read(x["levels"], "<u4") if x["levels"] else 0 * time + x["low"]
        for x in motion["q"]
    ]
    return time, np.column_stack(columns)


def test_frames_are_recorded_postures(machine, recording):
    scene = build_scene(machine, recording)
    time, q = unpacked(motion_data(scene.time, scene.configurations))
    np.testing.assert_array_equal(time, recording.time[scene.frame_rows])
    np.testing.assert_allclose(q, machine.closure.solve(recording.q)[scene.frame_rows], atol=2e-9)


@pytest.mark.parametrize("span", [1e-9, 1.0, 1e4])
def test_coordinates_keep_ten_digits_of_their_range(span):
    values = 5.0 + span * np.random.default_rng(1).uniform(size=1000)
    _, q = unpacked(motion_data(np.arange(1000.0), values[:, None]))
    np.testing.assert_allclose(q[:, 0], values, rtol=0, atol=1.2e-10 * span + 1e-15)
    assert quantise(np.full(3, 0.7)) == {"low": 0.7, "step": 0.0, "levels": ""}


def test_loops_are_closed_where_channels_are_missing(machine, recording):
    full, closed = (build_scene(machine, r).configurations for r in (recording, bare(recording)))
    np.testing.assert_allclose(full, closed, atol=1e-10)


def test_a_channel_in_another_unit_is_no_coordinate(machine, recording):
    """Angles in degrees, as they stand in a file of unknown units, are not taken for radians."""
    other = dataclasses.replace(recording, channel_units={"q2": "grad"})
    np.testing.assert_allclose(
        build_scene(machine, other).configurations,
        build_scene(machine, recording).configurations,
        atol=1e-10,
    )


def test_the_box_holds_the_machine_in_every_frame(machine, recording):
    scene = build_scene(machine, recording)
    for q in scene.configurations:
        tip = world(machine, q, "link7_tip")[:3, 3]
        assert (scene.lower <= tip + 1e-9).all()
        assert (tip - 1e-9 <= scene.upper).all()


MAST = """<robot name="mast">
  <link name="base">{fixed}</link>
  <link name="arm">
    <inertial><mass value="1"/>
      <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
    <visual><origin xyz="1 0 0"/><geometry><box size="2 0.1 0.1"/></geometry></visual>
  </link>
  <joint name="lift" type="revolute"><origin xyz="0 0 1"/><parent link="base"/><child link="arm"/>
    <axis xyz="0 -1 0"/><limit lower="-1.57" upper="1.57" effort="1" velocity="1"/></joint>
</robot>"""
PLINTH = '<visual><origin xyz="0 0 {}"/><geometry><box size="1 1 0.5"/></geometry></visual>'


@pytest.mark.parametrize(
    ("fixed", "ground"), [(PLINTH.format(0.25), 0.0), (PLINTH.format(-0.4), -0.65), ("", 0.0)]
)
def test_the_ground_is_where_the_machine_stands_however_low_its_tip_reaches(
    tmp_path, fixed, ground
):
    path = tmp_path / "mast.urdf"
    path.write_text(MAST.format(fixed=fixed))
    mast = crane.load(path)
    down = np.array([[0.0], [-1.5]])
    moves = Recording([0, 1], ("lift",), down, 0 * down, 0 * down, {"lift": "rad"})
    scene = build_scene(mast, moves)
    assert scene.ground_height == pytest.approx(ground, abs=1e-12)
    assert scene.lower[2] < -0.9  # the tip digs, and stays in view
    assert (
        f'"ground":{scene.ground_height!r}' in report(mast, moves, tmp_path / "a.html").read_text()
    )


@pytest.mark.parametrize(("step", "frames"), [(1e-3, 301), (5e-2, 201), (1.0, 11)])
def test_frames_are_the_nearest_samples(step, frames):
    time = 7.0 + step * np.arange(round(10 / step) + 1)
    rows = nearest_frame_rows(time, 30)
    assert len(rows) == frames
    assert rows[0] == 0
    assert rows[-1] == len(time) - 1
    if step < 1 / 30:
        film = 7.0 + np.arange(len(rows)) / 30
        np.testing.assert_allclose(time[rows], film, atol=step / 2 * (1 + 1e-9))


@pytest.mark.parametrize("changes", [{"payload.mass": 211.4}, {"payload.mass": 20.0}])
def test_the_payload_s_mark_is_its_centre_of_mass(changes):
    """What the payload adds to the machine's moment of mass."""
    loaded, empty = crane.load("patu655", changes), crane.load("patu655")
    here = payload_frame_data(loaded)
    inertias = [m.model.inertias[here["joint"] + 1] for m in (loaded, empty)]
    moment = inertias[0].mass * inertias[0].lever - inertias[1].mass * inertias[1].lever
    expected = moment / (inertias[0].mass - inertias[1].mass)
    np.testing.assert_allclose(here["placement"][12:15], expected, atol=1e-9)
    assert payload_frame_data(empty) is None


def test_what_is_not_finite_is_refused(machine, recording):
    q = np.tile(machine.home, (2, 1))
    q[1, machine.column("q2")] = np.nan
    with pytest.raises(InputError, match=r"link 'link3' .* not finite"):
        link_poses(machine, q, ["link1", "link3"])
    recording.channels["q2"][:] = np.nan  # behind the recording's back
    with pytest.raises(CraneError, match="not finite"):
        build_scene(machine, recording)


def test_recording_of_another_machine_is_refused(machine, recording):
    other = Recording(
        recording.time,
        ("q1", "x1"),
        recording.q[:, :2],
        recording.v[:, :2],
        recording.tau[:, :2],
        {"q1": "rad", "x1": "m"},
    )
    with pytest.raises(RecordingError, match="has no joint 'X1', which drives mini_forwarder"):
        build_scene(machine, other)
    more = dataclasses.replace(
        bare(recording),
        joints=(*recording.joints, "boom"),
        units=recording.units | {"boom": "rad"},
        **{x: np.pad(getattr(recording, x), ((0, 0), (0, 1))) for x in ("q", "v", "tau")},
    )
    with pytest.raises(RecordingError, match="'boom' that mini_forwarder does not have"):
        build_scene(machine, more)
    turning = dataclasses.replace(bare(recording), units=recording.units | {"X1": "rad"})
    with pytest.raises(RecordingError, match="'X1' is recorded in rad, in mini_forwarder it is"):
        build_scene(machine, turning)


def test_every_moving_body_is_drawn_and_joined_at_its_pins(machine):
    """Each loop's pin lies inside of a shape of both bodies that it joins."""
    visuals = read_visuals(machine)
    drawn = {machine.model.frames[machine.frame(visual.link)].parentJoint for visual in visuals}
    assert drawn == set(range(machine.model.njoints))
    poses = link_poses(machine, machine.home[None], sorted({v.link for v in visuals}))
    for pin_, bodies in {
        "link2_D": ("link2", "A1_rod"),
        "link3_G": ("link3", "A2_rod"),
        "link4_J": ("link4", "link5"),
        "link7_K": ("link6", "link7"),
        "link1_B": ("link1", "A1_barrel"),
        "link1_C": ("link1", "link2", "link3"),
        "link2_E": ("link2", "A2_barrel"),
        "link2_F": ("link2", "link4"),
        "link3_H": ("link3", "link5"),
        "link3_elbow": ("link3", "link7"),
    }.items():
        axis = world(machine, machine.home, pin_)
        for body in bodies:
            assert any(
                isinstance(visual.shape, CylinderShape)
                and _on_axis(np.linalg.inv(axis) @ poses[body][0] @ visual.placement)
                for visual in visuals
                if visual.link == body
            ), f"no eye, boss or pin of {body} at {pin_}"


def _on_axis(placement):
    """Whether a cylinder's axis is the pin's, to 0.1 mm."""
    parallel = abs(placement[2, 2]) > 1 - 1e-6
    return parallel and np.hypot(*placement[:2, 3]) < 1e-4


@pytest.mark.parametrize("actuator", ["A1", "A2"])
def test_rods_slide_in_their_barrels(machine, actuator):
    """Over the whole stroke a rod's rear end is in the barrel, and its eye outside."""
    visuals = read_visuals(machine)
    barrel = np.concatenate(
        [v.bounding_corners() for v in visuals if v.link == f"{actuator}_barrel"]
    )
    rod = np.concatenate([v.bounding_corners() for v in visuals if v.link == f"{actuator}_rod"])
    for stroke in (0.0, 0.015, 0.030):
        q = machine.closure.solve([0.0, stroke, stroke])
        shift = np.linalg.inv(world(machine, q, f"{actuator}_barrel")) @ world(
            machine, q, f"{actuator}_rod"
        )
        np.testing.assert_allclose(shift[:3, 3], [0.0825 + stroke, 0, 0], atol=1e-12)
        rear = rod[:, 0].min() + shift[0, 3]
        assert 0 < rear < barrel[:, 0].max() - 0.005
        assert shift[0, 3] > barrel[:, 0].max() + 0.0058


def test_cylinders_keep_their_axis(machine):
    """Meshcat's cylinders lie along y, those of a URDF along z."""
    visuals = read_visuals(machine)
    index = next(
        i
        for i, visual in enumerate(visuals)
        if visual.link == "A1_rod" and isinstance(visual.shape, CylinderShape)
    )
    placed = transforms(build_scene(machine))[f"machine/A1_rod/visual_{index}"]
    np.testing.assert_allclose(abs(placed[:3, 1]), [1, 0, 0], atol=1e-5)


def test_meshes_are_scaled_and_placed(tmp_path):
    import trimesh

    trimesh.creation.box(extents=(1, 2, 3)).export(tmp_path / "block.stl")
    visual = (
        '<visual><origin xyz="0 0 1"/><geometry><mesh filename="block.stl" scale="0.1 0.2 0.3"/>'
        '</geometry><material name="own"><color rgba="1 0.5 0 1"/></material></visual>'
    )
    (tmp_path / "arm.urdf").write_text(ARM.format(foot=visual))
    visuals = read_visuals(crane.load(tmp_path / "arm.urdf"))
    (found,) = (x for x in visuals if x.link == "foot")
    assert isinstance(found.shape, MeshShape)
    assert found.colour == (1, 0.5, 0, 1)
    corners = found.bounding_corners()
    np.testing.assert_allclose(corners.min(axis=0), [-0.05, -0.2, 1 - 0.45], atol=1e-6)
    np.testing.assert_allclose(corners.max(axis=0), [0.05, 0.2, 1 + 0.45], atol=1e-6)


def test_skeleton_reaches_joints_and_frames(tmp_path):
    (tmp_path / "arm.urdf").write_text(ARM.format(foot=""))
    arm = crane.load(tmp_path / "arm.urdf")
    bars = [v for v in skeleton_visuals(arm) if isinstance(v.shape, CylinderShape)]
    ends = {v.link: v.placement @ [0, 0, v.shape.length / 2, 1] for v in bars}
    np.testing.assert_allclose(ends["foot"][:3], [0, 0, 0.5], atol=1e-12)
    np.testing.assert_allclose(ends["arm"][:3], [0.4, 0.1, 0], atol=1e-12)


class References(HTMLParser):
    """Everything by which a page names another resource."""

    def __init__(self):
        super().__init__()
        self.found, self.policy, self.task = [], "", ""

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.found += [values[key] for key in ("src", "href", "action", "data") if key in values]
        if values.get("http-equiv") == "Content-Security-Policy":
            self.policy = values["content"]


def test_page_refers_to_nothing_outside(machine, recording, tmp_path):
    path = report(machine, recording, tmp_path / "page.html")
    references = References()
    references.feed(path.read_text(encoding="utf-8"))
    assert references.found == []
    rules = dict(rule.strip().split(" ", 1) for rule in references.policy.split(";"))
    assert rules["default-src"] == "'none'"
    assert "http" not in references.policy
    assert list(tmp_path.iterdir()) == [path]


def test_names_cannot_break_the_page(machine, recording, tmp_path):
    object.__setattr__(recording, "task", "</script><img src=x>")
    text = report(machine, recording, tmp_path / "page.html").read_text(encoding="utf-8")
    references = References()
    references.feed(text)
    assert references.found == []
    assert "\\u003c/script>\\u003cimg" in text


def test_what_cannot_be_drawn_leaves_the_old_page(machine, recording, tmp_path):
    page = tmp_path / "page.html"
    page.write_text("old")
    recording.channels["q3"][:] = np.inf
    with pytest.raises(CraneError):
        report(machine, recording, page)
    assert page.read_text() == "old"
    with pytest.raises(CraneError):
        report(machine, recording, tmp_path / "none" / "page.html")
    assert list(tmp_path.iterdir()) == [page]


def about(path):
    """What a page says about itself."""
    found = re.search(
        r'<script type="application/json" id="page-data">(.*?)</script>', path.read_text()
    )
    return json.loads(found[1])


@pytest.mark.parametrize("slew", [0.0, 0.7, -2.5])
def test_side_looks_at_the_plane_of_the_crane(machine, tmp_path, slew):
    q_a = np.array([[slew, 0.0221, 0.0108], [slew + 0.4, 0.03, 0.0]])
    zeros, units = np.zeros((2, 3)), {joint: machine.unit(joint) for joint in machine.active}
    recording = Recording([0, 1], machine.active, q_a, zeros, zeros, units)
    views = about(report(machine, recording, tmp_path / "page.html"))["views"]
    plane = world(machine, machine.closure.solve(q_a[0]), "link1")[:3, :3]
    np.testing.assert_allclose(views["front"], plane @ [1, 0, 0], atol=1e-9)
    np.testing.assert_allclose(views["side"], plane @ [0, -1, 0], atol=1e-9)
    np.testing.assert_allclose(views["iso"], plane @ [1, -1.6, 0.75], atol=1e-9)


def test_views_are_the_world_s_where_no_tip_points_anywhere(tmp_path):
    (tmp_path / "arm.urdf").write_text(ARM.format(foot=""))
    arm = crane.load(tmp_path / "arm.urdf")
    for tip in (None, "foot", "arm"):  # none, one that stands still, one on the first joint
        assert build_scene(dataclasses.replace(arm, tip=tip)).heading == 0
    pointing = build_scene(dataclasses.replace(arm, tip="hand")).heading
    assert pointing == pytest.approx(np.arctan2(0.1, 0.4 * np.cos(0.3)))


@pytest.mark.parametrize("name", ["page.png", "page", "page.html.txt"])
def test_a_page_is_named_as_one(machine, tmp_path, name):
    with pytest.raises(OutputError, match=r"end the name in \.html"):
        report(machine, None, tmp_path / name)
    assert list(tmp_path.iterdir()) == []
    report(machine, None, tmp_path / "page.HTM")
