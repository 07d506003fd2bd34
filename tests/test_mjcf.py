"""MJCF files: what they say is what MuJoCo computes with."""

import re
import sys

import numpy as np
import pinocchio as pin
import pytest
from broken import DATA
from linkages import WRITERS, assert_same, postures, rewritten

import crane
from crane.errors import CraneError, CraneWarning

TREE = """<mujoco model="tree">
  <compiler angle="degree" eulerseq="zyx"/>
  <default><default class="odd"><joint pos="0.1 -0.02 0.03" damping="0.4"/></default></default>
  <worldbody>
    <body name="one" pos="0.1 0.2 0.3" euler="10 20 30">
      <joint name="slide" type="slide" axis="1 2 0" ref="0.1" range="-1 1"/>
      <joint name="turn" class="odd" axis="0 1 1" ref="25" stiffness="2" springref="40"/>
      <geom type="box" size="0.1 0.05 0.2" pos="0.05 0 0.1" quat="1 0.2 0 0" density="700"/>
      <body name="two" pos="0 0.1 0.4" axisangle="1 0 0 50">
        <joint class="odd" axis="1 0 0" range="-90 90" frictionloss="0.3"/>
        <inertial pos="0.02 0.1 0" mass="1.5" fullinertia="0.02 0.03 0.04 0.001 -0.002 0.003"/>
        <body pos="0.3 0 0"><joint name="third" axis="0 0 1" pos="0 0.1 0"/>
          <joint name="fourth" axis="1 1 0" pos="0.05 0 -0.1"/>
          <geom type="capsule" size="0.02" fromto="0 0 0 0.2 0 0.1"/>
          <site name="hand" pos="1 2 3"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def test_a_tree_moves_as_in_mujoco(tmp_path):
    """M and bias of the same coordinates; anchors, references, several joints in a body."""
    mujoco = pytest.importorskip("mujoco")
    (tmp_path / "tree.xml").write_text(TREE)
    machine = crane.load(tmp_path / "tree.xml")
    assert machine.active == machine.joints == ("slide", "turn", "joint3", "third", "fourth")
    assert machine.friction["joint3"] == crane.Friction(coulomb=0.3, viscous=0.4)
    assert machine.forces == (crane.ForceElement("turn", 2.0, np.deg2rad(40.0)),)
    np.testing.assert_allclose(machine.home, [0.1, np.deg2rad(25), 0, 0, 0])
    model = mujoco.MjModel.from_xml_string(TREE)
    data = mujoco.MjData(model)
    dynamics = crane.Dynamics(machine.replace(forces=()))
    tree = machine.model.createData()
    for q, v, _ in postures(machine, 0.8, 10):
        data.qpos[:], data.qvel[:] = q, v
        mujoco.mj_forward(model, data)
        mass = np.zeros((5, 5))
        mujoco.mj_fullM(model, data, mass)
        np.testing.assert_allclose(dynamics.mass_matrix(q), mass, atol=1e-12)
        np.testing.assert_allclose(dynamics.bias(q, v), data.qfrc_bias, atol=1e-11)
        pin.framesForwardKinematics(machine.model, tree, q)
        np.testing.assert_allclose(
            tree.oMf[machine.frame("hand")].translation, data.site("hand").xpos, atol=1e-12
        )


@pytest.mark.parametrize("kind", WRITERS)
def test_series_of_turned_joints_are_written(kind, tmp_path):
    """At zero, away from the reference, the joints of one body have frames of their own."""
    pytest.importorskip("mujoco")
    (tmp_path / "tree.xml").write_text(TREE)
    machine = crane.load(tmp_path / "tree.xml")
    (tmp_path / kind).mkdir()
    assert_same(machine, rewritten(machine, kind, tmp_path / kind), 0.5, kind != "urdf+")


LOOPED = """<mujoco>
  <worldbody>
    <body name="crank" pos="0 0 0"><joint name="crank" axis="0 1 0"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0 0 0.2"/><site name="top" pos="0 0 0.2"/>
      <body name="rod" pos="0 0 0.2"><joint name="ball" type="ball"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0.5 0 0.1"/></body></body>
    <body name="rocker" pos="0.5 0 0"><joint name="rocker" axis="0 1 0"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0 0 0.3"/></body>
    <body name="wheel" pos="0.9 0 0"><joint name="wheel" axis="0 1 0" ref="0.5"/>
      <geom type="cylinder" size="0.1 0.02" quat="1 1 0 0"/></body>
    <body name="plate" pos="0.5 0 0.3"><freejoint name="float"/>
      <geom type="box" size="0.05 0.05 0.01"/></body>
  </worldbody>
  <equality>
    <connect name="pin" body1="rod" body2="rocker" anchor="0.5 0 0.1"/>
    <connect name="side" body1="rod" body2="rocker" anchor="0.5 0.1 0.1"/>
    <joint name="gear" joint1="wheel" joint2="rocker" polycoef="0.1 -2 0 0 0"/>
    <weld name="bond" body1="rocker" body2="plate" relpose="0.01 0.02 0.3 1 0.1 0 0"/>
  </equality>
  <actuator><motor name="drive" joint="crank"/></actuator>
  <keyframe><key name="home" qpos="0.05 1 0 0 0 0 0.6 0.5 0 0.3 1 0 0 0"/></keyframe>
</mujoco>
"""


def test_equality_constraints(tmp_path):
    """Two connects make a hinge; a ball in it; a gear; a plate that floats and is welded on."""
    mujoco = pytest.importorskip("mujoco")
    (tmp_path / "looped.xml").write_text(LOOPED)
    machine = crane.load(tmp_path / "looped.xml")
    loops = {loop.name: loop.type for loop in machine.closure.equations.loops}
    assert set(loops.values()) == {"revolute", "fixed"} and "bond" in loops
    assert machine.active == ("crank",)
    assert machine.home[machine.column("crank")] == 0.05
    model = mujoco.MjModel.from_xml_string(LOOPED)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    data, tree = mujoco.MjData(model), machine.model.createData()
    for q_a in np.linspace(-0.3, 0.3, 7):
        q = machine.closure.solve([q_a])
        wheel, rocker = (q[machine.column(joint)] for joint in ("wheel", "rocker"))
        rest = np.deg2rad(0.5)
        assert wheel - rest == pytest.approx(0.1 - 2 * rocker, abs=1e-12)
        angles = [q[machine.column(f"ball_r{x}")] for x in "xyz"]
        ball = pin.rpy.rpyToMatrix(0, 0, 0)
        for axis, angle in zip(np.eye(3), angles, strict=True):
            ball = ball @ pin.AngleAxis(angle, axis).toRotationMatrix()
        pin.framesForwardKinematics(machine.model, tree, q)
        plate = tree.oMf[machine.frame("plate")]
        x, y, z, w = pin.Quaternion(ball).coeffs()
        data.qpos[:5] = q_a, w, x, y, z
        data.qpos[5:7] = rocker, wheel
        x, y, z, w = pin.Quaternion(plate.rotation).coeffs()
        data.qpos[7:] = *plate.translation, w, x, y, z
        mujoco.mj_forward(model, data)
        assert data.nefc == 3 + 3 + 1 + 6
        assert np.abs(data.efc_pos).max() < 1e-9
    for kind in WRITERS:
        folder = tmp_path / kind
        folder.mkdir()
        assert_same(machine, rewritten(machine, kind, folder), 0.2)


BAD_MJCF = [
    ("<connect ", "<connekt ", r"bad.xml:15: MuJoCo refuses it (Schema violation: unrecognized "),
    ('polycoef="0.1 -2 0 0 0"', 'polycoef="0.1 -2 0.5 0 0"', "bad.xml:17: the constraint 'gear'"),
    ('joint="crank"/></act', 'joint="ball"/></act', "the actuator 'drive' drives a joint with 3"),
    ("<worldbody>", '<include file="parts.xml"/><worldbody>', "bad.xml:2: there is no file 'par"),
    ("<mujoco>", "<mujoko>", "bad.xml:22: not XML, Opening and ending tag mismatch"),
    ("anchor=\"0.5 0 0.1", "anchor=\"0.5 0 0,1", "bad.xml:15: MuJoCo refuses it (bad format in"),
    ('<motor name="drive" joint="crank"/>', "", "bad.xml: 1 degree of freedom and no active"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "line"), BAD_MJCF)
def test_bad_mjcf_is_refused(old, new, line, tmp_path):
    pytest.importorskip("mujoco")
    assert old in LOOPED
    (tmp_path / "bad.xml").write_text(LOOPED.replace(old, new, 1))
    with pytest.raises(CraneError) as caught:
        crane.load(tmp_path / "bad.xml")
    assert line in str(caught.value)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("<mujoco>", '<mujoco><option gravity="0 0 -1.62"/>', "gravity is 0 0 -1.62 m/s2"),
        ('name="wheel" axis', 'name="wheel" armature="0.1" axis', "armature of wheel is left out"),
        ('<connect name="side"', '<connect name="side" active="false"', "'side' is switched off"),
        ('name="ball" type', 'name="ball" damping="1" type', "of the ball joint 'ball' are left"),
    ],
)
def test_what_is_left_out_of_mjcf_is_told(old, new, line, tmp_path):
    pytest.importorskip("mujoco")
    assert LOOPED.count(old) == 1
    text = LOOPED.replace(old, new)
    if "active" in new:
        text = text.replace('type="ball"', 'axis="0 1 0"').replace("0.05 1 0 0 0 0", "0.05 0 0")
    (tmp_path / "odd.xml").write_text(text)
    with pytest.warns(CraneWarning, match=re.escape(line)):
        crane.load(tmp_path / "odd.xml")


def test_without_mujoco_the_error_says_how_to_install_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(CraneError, match=r"stewart\.xml: reading MJCF needs MuJoCo, install it"):
        crane.load(DATA / "stewart.xml")


def test_an_xml_may_be_a_urdf(tmp_path):
    (tmp_path / "bar.xml").write_text((DATA / "four_bar_loop.urdf").read_text())
    assert crane.load(tmp_path / "bar.xml").active == ("crank",)
