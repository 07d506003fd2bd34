"""Markers on a page's machine: force arrows on a common scale, springs, sliding bodies."""

import warnings
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import crane
from crane.common.errors import CraneWarning
from crane.formats.visuals.urdf_shapes import BoxShape, CylinderShape
from crane.view.page.force_markers import full_arrow_forces, spring_markers
from crane.view.page.scene import build_scene, link_poses, read_visuals, sliding_body_visuals

DATA = Path(__file__).parent / "data"
SPRINGS = """forces:
  - {between: [guide, slider], stiffness: 300, rest: 0.2, damping: 5}
  - {between: [base, rod_eye], damping: 5}
  - {between: [base, rod_middle], force: -2}
  - {joint: s, stiffness: 20}
gas_springs: {strut: {between: [base, slider], area: 1.0e-4, pressure: 1.0e+4, volume: 1.0e-3}}
ropes:
  - {between: [base, rod_middle], length: 0.6, stiffness: 1.0e+4}
"""


@pytest.fixture(scope="module")
def sprung(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sprung")
    text = (DATA / "slider_crank.yaml").read_text().replace("urdf: ", f"urdf: {DATA}/")
    (folder / "sprung.yaml").write_text(text + SPRINGS)
    return crane.load(folder / "sprung.yaml")


def test_springs_are_drawn_from_frame_to_frame(sprung):
    q = sprung.closure.solve(np.array([[1.0], [1.4], [0.7]]))
    found = {tuple(spring["parts"]): spring for spring in spring_markers(sprung, q)}
    assert len(spring_markers(sprung, q)) == 5  # that of the joint has no place
    assert set(found) == {("coil", "strut"), ("strut",), ("line",)}
    for parts, links in ((("coil", "strut"), ("guide", "slider")), (("line",), None)):
        one, links = found[parts], links or ("base", "rod_middle")
        poses = link_poses(sprung, np.vstack([sprung.home[None], q]), links)
        start, end = (poses[link][:, :3, 3] for link in links)
        lengths = np.linalg.norm(end - start, axis=1)
        assert one["length"] == pytest.approx(lengths[0], abs=1e-12)
        assert one["least"] == pytest.approx(lengths[1:].min(), abs=1e-12)
        data = sprung.model.createData()
        pin.forwardKinematics(sprung.model, data, q[1])
        for place, expected in zip(one["ends"], (start[2], end[2]), strict=True):
            pose = np.reshape(place["placement"], (4, 4)).T
            shown = data.oMi[place["joint"] + 1].homogeneous @ pose
            np.testing.assert_allclose(shown[:3, 3], expected, atol=1e-12)


def test_ends_of_springs_are_in_the_picture(sprung, tmp_path):
    folder = tmp_path / "far"
    folder.mkdir()
    for part in ("crank", "slider"):
        text = (DATA / "slider_crank" / f"{part}.urdf").read_text()
        text = text.replace(
            '<link name="guide"/>',
            '<link name="guide"/><link name="far"/><joint name="j" type="fixed"><origin '
            'xyz="-2 0 1"/><parent link="base"/><child link="far"/></joint>',
        )
        drawn = '<visual><geometry><sphere radius="0.01"/></geometry></visual><inertial>'
        (folder / f"{part}.urdf").write_text(text.replace("<inertial>", drawn))
    text = (DATA / "slider_crank.yaml").read_text().replace("slider_crank/", f"{folder}/")
    text += "forces: [{between: [far, slider], stiffness: 3}]\n"
    (tmp_path / "far.yaml").write_text(text)
    scene = build_scene(crane.load(tmp_path / "far.yaml"))
    assert scene.lower[0] == pytest.approx(-2) and scene.upper[2] == pytest.approx(1)


def test_a_body_that_slides_and_is_not_drawn_is_a_block_along_its_axis(sprung):
    assert [visual.link for visual in sliding_body_visuals(sprung, ())] == ["slider"]
    (block,) = (visual for visual in read_visuals(sprung) if isinstance(visual.shape, BoxShape))
    np.testing.assert_allclose(block.placement[:3, 3], 0)
    assert block.shape.size[0] > block.shape.size[1] == block.shape.size[2]  # along x, as s
    assert sliding_body_visuals(sprung, [sprung.model.getJointId("s")]) == []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        for name in ("mini_forwarder", "patu655", "excavator"):  # all have shapes of their own
            machine = crane.load(name)
            links = {visual.link for visual in read_visuals(machine)}
            drawn = {machine.model.frames[machine.frame(link)].parentJoint for link in links}
            assert sliding_body_visuals(machine, drawn) == []


def test_a_cylinder_that_is_not_drawn_has_a_rod_that_stays_in_its_barrel(tmp_path):
    body = '<inertial><mass value="3"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    links = "".join(f'<link name="{x}">{body}</inertial></link>' for x in ("barrel", "rod"))
    (tmp_path / "cylinder.urdf").write_text(
        f"""<robot name="cylinder"><link name="base"/>{links}
        <joint name="pin" type="continuous"><parent link="base"/><child link="barrel"/>
        <axis xyz="0 1 0"/></joint>
        <joint name="stroke" type="prismatic"><parent link="barrel"/><child link="rod"/>
        <origin xyz="0.8 0 0.1"/><axis xyz="-1 0 0"/>
        <limit lower="0.1" upper="0.7" effort="1" velocity="1"/></joint></robot>"""
    )
    machine = crane.load(tmp_path / "cylinder.urdf")
    (rod,) = sliding_body_visuals(machine, ())
    assert rod.link == "rod" and isinstance(rod.shape, CylinderShape)
    ends = [(rod.placement @ [0, 0, z * rod.shape.length, 1])[:3] for z in (0.5, -0.5)]
    np.testing.assert_allclose(ends, [[0, 0, 0], [0.6, 0, 0]], atol=1e-15)  # against the axis
    text = (tmp_path / "cylinder.urdf").read_text().replace('lower="0.1" upper="0.7"', "{}")
    (tmp_path / "endless.urdf").write_text(text.format('lower="-1000" upper="1000"'))
    (block,) = sliding_body_visuals(crane.load(tmp_path / "endless.urdf"), ())
    assert isinstance(block.shape, BoxShape)  # such limits are placeholders


def test_arrows_are_in_proportion_to_what_joints_can():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        machine = crane.load("mini_forwarder")
    limits = {"q1": 1.765, "X1": 80.0, "X2": 80.0}
    peaks = {"q1": 0.011, "X1": 40.0, "X2": 10.0}
    full = full_arrow_forces(machine, peaks)
    shares = {joint: peak / full[joint] for joint, peak in peaks.items()}
    expected = {joint: peaks[joint] / limits[joint] / 0.5 for joint in peaks}
    assert shares == pytest.approx(expected)
    assert full_arrow_forces(machine, dict.fromkeys(peaks, 0.0)) == pytest.approx(limits)


def test_without_limits_torques_are_forces_on_the_longest_body(tmp_path):
    text = (DATA / "slider_crank.yaml").read_text().replace("slider_crank/", f"{tmp_path}/")
    (tmp_path / "free.yaml").write_text(text)
    for part in ("crank", "slider"):
        urdf = (DATA / "slider_crank" / f"{part}.urdf").read_text()
        (tmp_path / f"{part}.urdf").write_text(urdf.replace('effort="50"', 'effort="0"'))
    machine = crane.load(tmp_path / "free.yaml", active=["theta"])
    assert full_arrow_forces(machine, {"theta": 6.0}) == pytest.approx({"theta": 6.0})
    sliding = crane.load(tmp_path / "free.yaml", active=["s"])
    peaks = {"theta": 6.0, "s": 10.0}  # 6 N m on a rod of 0.3 m are 20 N
    for one in (machine, sliding):
        full = full_arrow_forces(one, peaks)
        assert full == pytest.approx({"theta": 6.0, "s": 20.0})
