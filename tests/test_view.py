"""Pages: what they show is where forward kinematics puts it, and nothing leaves them."""

import dataclasses
import json
import shutil
import warnings
from html.parser import HTMLParser

import numpy as np
import pinocchio as pin
import pytest

import crane
from crane.errors import CraneError, CraneWarning, InputError, OutputError, RecordingError
from crane.recording import Recording
from crane.view import build_scene, write_page
from crane.view.scene import decimate, link_poses
from crane.view.visuals import Cylinder, Mesh, read_visuals, skeleton

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
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        return crane.load("mini_forwarder")


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


def tracks(scene):
    """Times, positions and quaternions by link, as the page plays them."""
    (command,) = (c for c in scene.commands if c["type"] == "set_animation")
    found = {}
    for item in command["animations"]:
        position, quaternion = item["clip"]["tracks"]
        assert (position["name"], quaternion["name"]) == (".position", ".quaternion")
        times = [key["time"] / item["clip"]["fps"] for key in position["keys"]]
        assert times == [key["time"] / item["clip"]["fps"] for key in quaternion["keys"]]
        found[item["path"].removeprefix("/meshcat/machine/")] = (
            np.array(times),
            np.array([key["value"] for key in position["keys"]]),
            np.array([key["value"] for key in quaternion["keys"]]),
        )
    return found


def transforms(scene):
    """The transforms that are set before anything moves, by path."""
    return {
        c["path"].removeprefix("/meshcat/"): np.reshape(c["matrix"], (4, 4)).T
        for c in scene.commands
        if c["type"] == "set_transform"
    }


def test_recorded_poses_are_forward_kinematics(machine, recording):
    scene = build_scene(machine, recording)
    found = tracks(scene)
    assert set(found) >= {"link1", "link2", "link3", "link4", "link5", "link6", "link7"}
    assert set(found) >= {"A1_barrel", "A1_rod", "A2_barrel", "A2_rod"}
    q = machine.closure.solve(recording.q)
    for link, (times, positions, quaternions) in found.items():
        for time, position, quaternion in zip(times, positions, quaternions, strict=True):
            sample = int(np.argmin(abs(recording.time - scene.start - time)))
            assert recording.time[sample] - scene.start == pytest.approx(time, abs=1e-12)
            pose = world(machine, q[sample], link)
            np.testing.assert_allclose(position, pose[:3, 3], atol=1e-12)
            rotation = pin.Quaternion(quaternion).toRotationMatrix()
            np.testing.assert_allclose(rotation, pose[:3, :3], atol=1e-12)
    assert (scene.start, scene.duration) == (3.0, pytest.approx(2.0))


def test_loops_are_closed_where_channels_are_missing(machine, recording):
    full, closed = (tracks(build_scene(machine, r)) for r in (recording, bare(recording)))
    for link, values in full.items():
        for one, other in zip(values, closed[link], strict=True):
            np.testing.assert_allclose(one, other, atol=1e-10)


def test_home_posture_stands_still(machine):
    scene = build_scene(machine)
    assert all(c["type"] != "set_animation" for c in scene.commands)
    assert scene.duration == 0
    for link in ("link7", "A2_rod"):
        expected = world(machine, machine.home, link)
        np.testing.assert_allclose(transforms(scene)[f"machine/{link}"], expected, atol=1e-12)


def test_lines_go_where_the_tip_goes_and_should_go(machine, recording):
    scene = build_scene(machine, recording)
    assert scene.traces == ("reference", "tip")
    lines = {}
    for command in scene.commands:
        if command["type"] == "set_object" and "/trace/" in command["path"]:
            (geometry,) = command["object"]["geometries"]
            points = geometry["data"]["attributes"]["position"]["array"].data
            name = command["path"].split("/trace/")[1].split("/")[0]
            lines[name] = np.frombuffer(points, dtype=np.float32).reshape(-1, 3)
    q = machine.closure.solve(recording.q[decimate(recording.time, 30)])
    for point, posture in zip(lines["tip"], q, strict=True):
        expected = world(machine, posture, "link7_tip")[:3, 3]
        np.testing.assert_allclose(point, expected, atol=1e-7)
    np.testing.assert_allclose(lines["reference"] - lines["tip"], 0.01, atol=1e-7)
    assert build_scene(machine, bare(recording)).traces == ("tip",)


@pytest.mark.parametrize(("step", "frames"), [(1e-3, 301), (5e-2, 201), (1.0, 11)])
def test_frames_are_the_nearest_samples(step, frames):
    time = 7.0 + step * np.arange(round(10 / step) + 1)
    rows = decimate(time, 30)
    assert len(rows) == frames
    assert rows[0] == 0
    assert rows[-1] == len(time) - 1
    if step < 1 / 30:
        film = 7.0 + np.arange(len(rows)) / 30
        np.testing.assert_allclose(time[rows], film, atol=step / 2 * (1 + 1e-9))


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
                isinstance(visual.shape, Cylinder)
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
    barrel = np.concatenate([v.corners() for v in visuals if v.link == f"{actuator}_barrel"])
    rod = np.concatenate([v.corners() for v in visuals if v.link == f"{actuator}_rod"])
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
        if visual.link == "A1_rod" and isinstance(visual.shape, Cylinder)
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
    (found,) = read_visuals(crane.load(tmp_path / "arm.urdf"))
    assert isinstance(found.shape, Mesh)
    assert found.colour == (1, 0.5, 0, 1)
    corners = found.corners()
    np.testing.assert_allclose(corners.min(axis=0), [-0.05, -0.2, 1 - 0.45], atol=1e-6)
    np.testing.assert_allclose(corners.max(axis=0), [0.05, 0.2, 1 + 0.45], atol=1e-6)


def test_missing_meshes_leave_a_skeleton_and_a_warning(tmp_path):
    visual = '<visual><geometry><mesh filename="package://gone/foot.stl"/></geometry></visual>'
    (tmp_path / "arm.urdf").write_text(ARM.format(foot=visual))
    arm = crane.load(tmp_path / "arm.urdf")
    with pytest.warns(CraneWarning, match=r"1 mesh files? .*gone/foot\.stl"):
        found = read_visuals(arm)
    assert {visual.link for visual in found} == {"foot", "arm"}


def test_skeleton_reaches_joints_and_frames(tmp_path):
    (tmp_path / "arm.urdf").write_text(ARM.format(foot=""))
    arm = crane.load(tmp_path / "arm.urdf")
    bars = [v for v in skeleton(arm) if isinstance(v.shape, Cylinder)]
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
    path = write_page(machine, tmp_path / "page.html", recording)
    references = References()
    references.feed(path.read_text(encoding="utf-8"))
    assert references.found == []
    rules = dict(rule.strip().split(" ", 1) for rule in references.policy.split(";"))
    assert rules["default-src"] == "'none'"
    assert "http" not in references.policy
    assert list(tmp_path.iterdir()) == [path]


def test_names_cannot_break_the_page(machine, recording, tmp_path):
    object.__setattr__(recording, "task", "</script><img src=x>")
    text = write_page(machine, tmp_path / "page.html", recording).read_text(encoding="utf-8")
    references = References()
    references.feed(text)
    assert references.found == []
    assert "\\u003c/script>\\u003cimg" in text


def test_what_cannot_be_drawn_leaves_the_old_page(machine, recording, tmp_path):
    page = tmp_path / "page.html"
    page.write_text("old")
    recording.channels["q3"][:] = np.inf
    with pytest.raises(CraneError):
        write_page(machine, page, recording)
    assert page.read_text() == "old"
    with pytest.raises(OutputError, match="there is no folder"):
        write_page(machine, tmp_path / "none" / "page.html")
    assert list(tmp_path.iterdir()) == [page]


def about(path):
    """What a page says about itself."""
    (line,) = (x for x in path.read_text().splitlines() if x.startswith("const page = "))
    return json.loads(line.removeprefix("const page = ").removesuffix(";"))


@pytest.mark.parametrize("slew", [0.0, 0.7, -2.5])
def test_side_looks_at_the_plane_of_the_crane(machine, tmp_path, slew):
    q_a = np.array([[slew, 0.0221, 0.0108], [slew + 0.4, 0.03, 0.0]])
    zeros, units = np.zeros((2, 3)), {joint: machine.unit(joint) for joint in machine.active}
    recording = Recording([0, 1], machine.active, q_a, zeros, zeros, units)
    views = about(write_page(machine, tmp_path / "page.html", recording))["views"]
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
        write_page(machine, tmp_path / name)
    assert list(tmp_path.iterdir()) == []
    write_page(machine, tmp_path / "page.HTM")


MATRICES = """(links) => {
    viewer.scene.updateMatrixWorld(true);
    // the viewer's scene is turned, so that its y axis is our z
    const back = viewer.scene.matrixWorld.clone().invert();
    return links.map((link) => back.clone().multiply(
        viewer.scene_tree.find(["meshcat", "machine", link]).object.matrixWorld).toArray());
}"""

MESHES = """() => {
    let count = 0;
    const root = viewer.scene_tree.find(["meshcat"]).object;
    root.traverse((item) => { count += item.isMesh ? 1 : 0; });
    return count;
}"""


@pytest.mark.slow
def test_page_in_a_browser(machine, recording, tmp_path):
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("no chromium in the path")
    sync_api = pytest.importorskip("playwright.sync_api")
    path = write_page(machine, tmp_path / "page.html", recording)
    visuals = read_visuals(machine)
    links = sorted({visual.link for visual in visuals})
    q = machine.closure.solve(recording.q)
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=chromium,
            args=["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"],
        )
        page = browser.new_page(viewport={"width": 600, "height": 400})
        problems, requests = [], []
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on(
            "console",
            lambda line: problems.append(line.text) if line.type in ("error", "warning") else None,
        )
        page.on("request", lambda request: requests.append(request.url))
        page.goto(path.as_uri())
        assert page.evaluate(MESHES) == len(visuals)
        assert page.evaluate("viewer.animator.duration") == pytest.approx(2.0)
        page.wait_for_function("viewer.animator.time > 0.05")  # it plays by itself
        page.click("#play")
        rows = decimate(recording.time, 30)
        for row in rows[[0, 20, -1, 40, 3]]:
            time = recording.time[row] - recording.time[0]
            page.evaluate("(time) => seek(time)", time)
            page.wait_for_function(
                "(text) => document.getElementById('clock').textContent.startsWith(text)",
                arg=f"{recording.time[row]:.2f} s",
            )
            for link, matrix in zip(links, page.evaluate(MATRICES, links), strict=True):
                shown = np.reshape(matrix, (4, 4)).T
                np.testing.assert_allclose(shown, world(machine, q[row], link), atol=1e-6)
        assert page.inner_text("#machine") == "mini_forwarder"
        assert page.inner_text("#task") == "round the corners"
        for view in ("side", "front", "iso"):
            page.click(f"#views button:text('{view}')")
        browser.close()
    assert requests == [path.as_uri()]
    assert problems == []
