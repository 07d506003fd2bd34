"""MJCF files are read with the meaning that MuJoCo gives them."""

import re
import sys
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest
from broken_machines import DATA
from linkages import WRITERS, assert_same, postures, rewritten
from warned import told, without_a_word

import crane
from crane.common.errors import CraneError, CraneWarning
from crane.formats import check
from crane.formats.mjcf.unsupported_features import colliding_geoms

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
    assert machine.friction["joint3"] == crane.description.Friction(coulomb=0.3, viscous=0.4)
    assert machine.forces == (crane.description.ForceElement("turn", 2.0, np.deg2rad(40.0)),)
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
        ball = pin.exp3(np.array([q[machine.column(f"ball_r{x}")] for x in "xyz"]))
        pin.framesForwardKinematics(machine.model, tree, machine.coordinates.configuration(q))
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
    (
        '<joint name="gear" joint1="wheel" joint2="rocker" polycoef="0.1 -2 0 0 0"/>',
        '<tendon name="gear" tendon1="a" tendon2="b" polycoef="0 1 2"/></equality><tendon><fixed '
        'name="a"><joint joint="wheel" coef="1"/></fixed><fixed name="b"><joint joint="crank" '
        'coef="1"/><joint joint="rocker" coef="1"/></fixed></tendon><equality>',
        "bad.xml:17: the constraint 'gear' has higher powers of a tendon of 2 joints",
    ),
    ("<worldbody>", '<include file="parts.xml"/><worldbody>', "bad.xml:2: there is no file 'par"),
    ("<mujoco>", "<mujoko>", "bad.xml:22: not XML, Opening and ending tag mismatch"),
    ("anchor=\"0.5 0 0.1", "anchor=\"0.5 0 0,1", "bad.xml:15: MuJoCo refuses it (bad format in"),
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


OFF = '<option><flag {}="disable"/></option>'
TENDON = (
    '<tendon><fixed name="rope" stiffness="2" range="0 1" limited="true">'
    '<joint joint="crank" coef="1"/></fixed></tendon>'
)


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        (
            '<connect name="side"',
            '<connect name="side" active="false"',
            "constraints that are switched off (side)",
        ),
        ("<mujoco>", '<mujoco><option density="1"/>', "; forces of the air"),
        (
            "<mujoco>",
            f"<mujoco>{OFF.format('equality')}",
            "constraints off, loops are closed here",
        ),
        ("<mujoco>", f"<mujoco>{OFF.format('actuation')}", "switches its actuators off, what th"),
        (
            "<mujoco>",
            f'<mujoco>{OFF.format("frictionloss")}<default><joint frictionloss="1"/></default>',
            "the file switches off what it calls frictionloss, it acts here",
        ),
        (
            'name="ball" type',
            'name="ball" range="0 90" type',
            "limits of the angle of ball joints",
        ),
        (
            'name="crank" axis',
            'name="crank" actuatorfrcrange="-3 3" axis',
            "limits of the force on joints (actuatorfrcrange) (crank)",
        ),
        (
            'body name="wheel"',
            'body name="wheel" gravcomp="1"',
            "; gravity compensation",
        ),
        (
            "<worldbody>",
            '<worldbody><body name="hand" mocap="true"><site/></body>',
            "what a program moves stands still (mocap) (hand)",
        ),
        (
            "<actuator>",
            TENDON.replace("</fixed>", '<joint joint="wheel" coef="1"/></fixed>') + "<actuator>",
            "stiffness of tendons (rope); limits of tendons (rope)",
        ),
        (
            "<actuator>",
            '<actuator><motor name="thruster" site="top"/>',
            "tendons around geoms and cranks that break (thruster); contacts of 5 geoms",
        ),
        (
            'name="ball" type',
            'name="ball" stiffness="1" type',
            "stiffness of ball and free joints (ball)",
        ),
        *(
            ('<motor name="drive"', f'<{kind} name="drive"', "limits of the actuators (drive)")
            for kind in (
                'motor forcerange="-1 1"',
                'position kp="3"',
                'general dyntype="filter" dynprm="0.1"',
            )
        ),
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


def test_a_motor_alone_and_shapes_that_do_not_touch_are_no_news(tmp_path):
    pytest.importorskip("mujoco")
    text = LOOPED.replace("<worldbody>", '<default><geom contype="0"/></default><worldbody>')
    (tmp_path / "plain.xml").write_text(text)
    without_a_word(crane.load, tmp_path / "plain.xml")
    (tmp_path / "off.xml").write_text(
        LOOPED.replace("<mujoco>", "<mujoco>" + OFF.format("contact"))
    )
    without_a_word(crane.load, tmp_path / "off.xml")


@pytest.mark.parametrize("seed", range(30))
def test_shapes_that_can_touch_are_those_that_mujoco_finds(seed):
    """The pairs of coincident balls that may touch are MuJoCo's contacts."""
    mujoco = pytest.importorskip("mujoco")
    rng = np.random.default_rng(seed)
    root = ElementTree.Element("mujoco")
    bodies = [ElementTree.SubElement(root, "worldbody")]
    names = ["world"]
    if rng.random() < 0.3:
        flag = ElementTree.SubElement(ElementTree.SubElement(root, "option"), "flag")
        flag.set("filterparent", "disable")
    for i in range(rng.integers(2, 7)):
        names.append(f"b{i}")
        bodies.append(
            ElementTree.SubElement(bodies[rng.integers(len(bodies))], "body", name=names[-1])
        )
        if i == 0 or rng.random() < 0.7:
            ElementTree.SubElement(bodies[-1], "joint")
        masks = {"contype": str(rng.integers(0, 4)), "conaffinity": str(rng.integers(0, 4))}
        ElementTree.SubElement(bodies[-1], "geom", size="0.1", name=f"g{i}", **masks)
    ElementTree.SubElement(bodies[0], "geom", size="0.1", conaffinity=str(rng.integers(0, 4)))
    contact = ElementTree.SubElement(root, "contact")
    for _ in range(rng.integers(0, 3)):
        one, two = rng.choice(names, 2, replace=False)
        ElementTree.SubElement(contact, "exclude", body1=one, body2=two)
    if rng.random() < 0.3:
        ElementTree.SubElement(contact, "pair", geom1="g0", geom2="g1")
    model = mujoco.MjModel.from_xml_string(ElementTree.tostring(root, encoding="unicode"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    found = {int(geom) for contact in data.contact for geom in contact.geom}
    off = {"FILTERPARENT"} if root.find("option") is not None else set()
    assert set(colliding_geoms(model, off)) == found


MANY = [  # instead of the first body of a file, and what is told
    (
        '<replicate count="1000000000" offset="1 0 0">{}</replicate>',
        "<replicate> stands for 4e+09 el",
    ),
    (
        '<replicate count="1e300" offset="1 0 0">{}</replicate>',
        "<replicate> stands for 4e+300 eleme",
    ),
    (
        '<replicate count="90" offset="1 0 0"><frame><replicate count="90" offset="0 1 0">{}'
        "</replicate></frame></replicate>",
        "<replicate> stands for 32580 elements by its copies, make at most 10000",
    ),
    ('<composite type="cable" count="99999 1 1"/>{}', "<composite> stands for 99999 elements by"),
    ('<flexcomp name="f" type="grid" count="999 999 999"/>{}', "flexible bodies are no machine's"),
    (
        '{}</worldbody><asset><hfield name="h" nrow="99999" ncol="99999" size="1 1 1 1"/></asset>'
        "<worldbody>",
        'nrow="99999" ncol="99999" of <hfield> is too large, make it at most 10000000',
    ),
    (
        '{}</worldbody><asset><texture name="h" builtin="flat" width="99999" height="9999"/>'
        "</asset><worldbody>",
        "of <texture> is too large, make it at most",
    ),
    ('{}</worldbody><size nkey="99999999"/><worldbody>', 'nkey="99999999" of <size> is too large'),
    ('{}</worldbody><size nuserdata="99999999"/><worldbody>', 'nuserdata="99999999" of <size> is'),
    (
        '{}</worldbody><sensor><user dim="99999999"/></sensor><worldbody>',
        'dim="99999999" of <user>',
    ),
    (
        '{}</worldbody><asset><mesh name="m" builtin="cone" params="99999 1"/></asset><worldbody>',
        'params="99999 1" of <mesh> is too large, make it at most 1000',
    ),
]
ONE = '<body><joint/><geom size="0.1"/></body>'


@pytest.mark.parametrize(("around", "line"), MANY)
def test_what_would_take_days_is_not_begun(around, line, tmp_path, monkeypatch):
    mujoco = pytest.importorskip("mujoco")

    def begun(_):
        raise AssertionError("MuJoCo was asked to make it")

    monkeypatch.setattr(mujoco.MjModel, "from_xml_path", begun)
    text = f"<mujoco><worldbody>\n{around.format(ONE)}</worldbody></mujoco>"
    (tmp_path / "many.xml").write_text(text)
    with pytest.raises(CraneError, match=re.escape(line)) as caught:
        crane.load(tmp_path / "many.xml")
    assert str(caught.value).startswith("many.xml:2: ") and len(str(caught.value)) < 200


def test_copies_of_other_files_are_counted(tmp_path, monkeypatch):
    """A model that attaches another a hundred times, which attaches another a hundred times."""
    pytest.importorskip("mujoco")
    (tmp_path / "m0.xml").write_text(f"<mujoco><worldbody>{ONE * 9}</worldbody></mujoco>")
    for i in range(3):
        attached = '<attach model="m" prefix="{}_"/>'
        several = "".join(attached.format(k) for k in range(100))
        asset = f'<asset><model name="m" file="m{i}.xml"/></asset>'
        text = f"<mujoco>{asset}<worldbody>{several}</worldbody></mujoco>"
        (tmp_path / f"m{i + 1}.xml").write_text(text)
    with pytest.raises(
        CraneError, match=r"m\d\.xml:1: <\w+> stands for \d+ elements by its copies"
    ):
        crane.load(tmp_path / "m3.xml")
    (tmp_path / "parts.xml").write_text(f"<mujocoinclude>{ONE}</mujocoinclude>")
    copied = '<replicate count="{}" offset="1 0 0"><include file="parts.xml"/></replicate>'
    for count in (3, 3000):
        text = f"<mujoco><worldbody>{copied.format(count)}</worldbody></mujoco>"
        (tmp_path / "main.xml").write_text(text)
        if count == 3:
            assert len(crane.load(tmp_path / "main.xml").joints) == 3
        else:
            with pytest.raises(CraneError, match="<replicate> stands for 18000 elements"):
                crane.load(tmp_path / "main.xml")


def test_without_mujoco_the_error_says_how_to_install_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(CraneError, match=r"stewart\.xml: reading MJCF needs MuJoCo, install it"):
        crane.load(DATA / "stewart.xml")


def test_an_xml_may_be_a_urdf(tmp_path):
    (tmp_path / "bar.xml").write_text((DATA / "four_bar_loop.urdf").read_text())
    assert crane.load(tmp_path / "bar.xml").active == ("crank",)


def machine_of(text, folder):
    """A machine of a file, and the lines that loading it says."""
    (folder / "some.xml").write_text(text)
    return told(crane.load, folder / "some.xml")


def test_a_key_far_from_closed_is_refused_and_taken_where_that_is_asked_for(tmp_path):
    pytest.importorskip("mujoco")
    path = tmp_path / "key.xml"
    path.write_text(LOOPED.replace('qpos="0.05 1 0 0 0 0 ', 'qpos="0.05 1 0 0 0 2 '))
    with pytest.raises(CraneError, match="far from the home of the file: rocker is 1.88"):
        crane.load(path)
    anyway = {"nearest_assembly": True}
    report = check(path, arguments=anyway)
    (sought,) = [one.message for one in report.findings if "home was searched for" in one.message]
    assert sought.endswith("keep it with crane convert, then crane check --write-home")
    assert report.next_command.startswith("crane convert ") and not report.errors
    machine = crane.load(path, arguments=anyway)
    again = crane.load(machine.load_name, arguments=machine.arguments)
    assert np.abs(again.home - machine.home).max() == 0


def test_what_is_left_out_is_told_in_three_lines(tmp_path):
    """Whatever the file has: what is lost, what is taken otherwise, what MuJoCo says."""
    pytest.importorskip("mujoco")
    more = (
        '<mujoco><option density="1"/><compiler settotalmass="9"/>'
        '<visual/><sensor><jointpos joint="wheel"/><gyro site="top"/></sensor>'
    )
    text = LOOPED.replace("<mujoco>", more).replace("<motor", '<motor gear="3" ctrlrange="0 1"')
    text = text.replace('name="ball" type', 'name="ball" stiffness="1" type')
    text = text.replace("<actuator>", f"{TENDON}<actuator>").replace("<worldbody>", FLOOR, 1)
    _, lines = machine_of(text, tmp_path)
    assert len(lines) == 3 and lines[0].startswith("some.xml: MuJoCo says")
    assert lines[1].startswith(
        "some.xml: left out of what MuJoCo has: friction of free joints, stif"
    )
    for what in ("limits of tendons (rope)", "contacts of 6 geoms (floor", "the air", "2 sensors"):
        assert what in lines[1]
    assert lines[2] == (
        "some.xml: otherwise than in MuJoCo: drives take forces in N and N m, without gains, "
        "dynamics and limits of the actuators (drive)"
    )


FLOOR = '<worldbody><geom name="floor" type="plane" size="1 1 1"/>'
KEYS = """<mujoco><worldbody>
  <body><joint name="hinge" axis="0 1 0" range="-30 30" limited="true"/><geom size="0.1"/>
    <body><joint name="ball" type="ball"/><geom size="0.1"/></body></body>
</worldbody><keyframe>{}</keyframe></mujoco>"""


@pytest.mark.parametrize(
    ("keys", "hinge"),
    [
        ("", 0.0),
        ('<key qpos="0.2 1 0 0 0"/><key qpos="0.3 1 0 0 0"/>', 0.2),
        ('<key qpos="0.2 1 0 0 0"/><key name="home" qpos="0.3 1 0 0 0"/>', 0.3),
        ('<key name="far" qpos="0.9 1 0 0 0"/>', np.deg2rad(30)),
    ],
)
def test_home_is_the_key_of_that_name_or_the_first(keys, hinge, tmp_path):
    pytest.importorskip("mujoco")
    turned = keys.replace(" 1 0 0 0", " 0.9 0.1 -0.3 0.2")
    machine, lines = machine_of(KEYS.format(turned), tmp_path)
    vector = np.array([machine.home[machine.column(f"ball_r{x}")] for x in "xyz"])
    found = pin.exp3(vector)
    wanted = pin.Quaternion(0.9, 0.1, -0.3, 0.2).normalize().toRotationMatrix()
    np.testing.assert_allclose(found, wanted if keys else np.eye(3), atol=1e-12)
    assert machine.home[machine.column("hinge")] == pytest.approx(hinge, abs=1e-12)
    assert ("home is taken within the limits (hinge 0.9 as 0.523599)" in "".join(lines)) == (
        "far" in keys
    )


BOUND = """<mujoco><worldbody>
  <body name="a"><joint name="a" axis="0 0 1"/><geom size="0.1"/><body name="tool" pos="1 0 0"/>
    <body name="b" pos="0.3 0 0"><joint name="b" axis="0 0 1"/><geom size="0.1"/></body></body>
</worldbody><equality>{}</equality></mujoco>"""


def test_constraints_within_one_body_bind_nothing(tmp_path):
    pytest.importorskip("mujoco")
    weld = '<weld name="same" body1="a" body2="tool"/>'
    machine, lines = machine_of(BOUND.format(weld), tmp_path)
    assert machine.active == ("a", "b") and not machine.closure.equations.loops
    assert "constraints within one body (same)" in lines[0]


@pytest.mark.parametrize(("scale", "kind"), [(0, "spherical"), (0.01, "fixed")])
def test_a_weld_that_holds_no_torque_is_a_point(scale, kind, tmp_path):
    pytest.importorskip("mujoco")
    weld = f'<weld name="spot" body1="b" body2="world" torquescale="{scale}" anchor="0.3 0.2 0"/>'
    machine, _ = machine_of(BOUND.format(weld), tmp_path)
    assert [loop.type for loop in machine.closure.equations.loops] == [kind]


MESHED = """<mujoco><compiler meshdir="shapes"/>
  <asset><mesh name="arm" file="arm.stl"/><mesh file="deep/hull.obj"/>
    <texture name="t" type="2d" file="t.png"/><material name="m" texture="t"/>
    <hfield name="h" file="ground.png" size="1 1 1 1"/></asset>
  <worldbody><geom type="hfield" hfield="h"/><geom type="mesh" mesh="arm"/>
    <body name="arm"><joint name="arm"/><inertial mass="1.5" pos="0.1 0 0" diaginertia="1 1 1"/>
      <geom type="mesh" mesh="arm" material="m"/>
      <body name="tool"><geom type="mesh" mesh="hull" {}/></body></body>
    <body name="other"><joint name="other"/><geom type="mesh" mesh="hull" mass="0"/>{}</body>
  </worldbody></mujoco>"""  # fmt: skip


def test_meshes_that_are_not_there_are_done_without(tmp_path):
    """Lost visuals and partial masses are reported; a body without any mass is refused."""
    pytest.importorskip("mujoco")
    ball = '<geom size="0.1"/>'
    machine, lines = machine_of(MESHED.format('group="2" density="0"', ball), tmp_path)
    assert [round(x.mass, 12) for x in machine.model.inertias[1:]][0] == 1.5
    assert lines[0].startswith(
        "some.xml: left out of what MuJoCo has: meshes and pictures that are not there (arm.stl, "
        "hull.obj, ground.png)"
    )
    assert not any("without the mass" in line for line in lines)
    same, lines = machine_of(MESHED.format("", ball), tmp_path)
    assert same.model.inertias[1] == machine.model.inertias[1]
    assert "bodies without the mass of their meshes, which are not there (tool)" in lines[1]
    with pytest.raises(CraneError) as caught:
        machine_of(MESHED.format("", "").replace('mass="0"', 'mass="2"'), tmp_path)
    assert str(caught.value) == (
        "some.xml:9: body 'other' has its mass from 'shapes/deep/hull.obj', which is not there: "
        "put the file there, or give the body an <inertial>"
    )
