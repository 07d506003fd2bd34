"""Machines written in other formats and read again; couplings of URDF+."""

import dataclasses
import itertools
import re
import warnings

import numpy as np
import pytest
from broken_machines import DATA
from command_line import typed
from linkages import MACHINES, WRITERS, assert_same, loaded, postures, rewritten

import crane
from crane.common.errors import CraneError, CraneWarning
from crane.description import parameters
from crane.formats import read_machine_spec, write_machine, write_mjcf, write_urdf_plus


@pytest.fixture(params=MACHINES)
def case(request):
    return request.param, loaded(request.param)


@pytest.mark.parametrize("kind", WRITERS)
def test_round_trip(case, kind, tmp_path):
    name, machine = case
    again = rewritten(machine, kind, tmp_path)
    assert_same(machine, again, MACHINES[name][2])
    assert dict(again.friction) == dict(machine.friction)
    assert again.tip == machine.tip


def test_mujoco_computes_the_written_machine_alike(case, tmp_path):
    """Its constraints are closed where ours are, and its tree has the same mass and bias."""
    mujoco = pytest.importorskip("mujoco")
    name, machine = case
    write_mjcf(machine, tmp_path / "written.xml")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "written.xml"))
    data, dynamics = mujoco.MjData(model), crane.Dynamics(machine, backend="pinocchio")
    names = [model.joint(i).name for i in range(model.njnt)]
    joints = [machine.model.joints[machine.model.getJointId(name)] for name in names]
    columns = [joint.idx_v + k for joint in joints for k in range(joint.nv)]
    assert model.nv == len(columns) == machine.model.nv
    # quaternions of balls have the scalar last in Pinocchio, first in MuJoCo
    order = [joint.idx_q + (k - 1) % joint.nq for joint in joints for k in range(joint.nq)]
    for q_a, v_a, _ in postures(machine, MACHINES[name][2], 3):
        q = machine.closure.solve(q_a)
        gamma = machine.closure.gamma(q)
        v = gamma @ v_a
        data.qpos[:] = machine.coordinates.configuration(q)[order]
        data.qvel[:] = v[columns]
        mujoco.mj_forward(model, data)
        equal = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        assert np.abs(data.efc_pos[equal]).max() < 1e-9
        assert np.abs(data.efc_vel[equal]).max() < 1e-9 * np.abs(v).max()
        mass = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, mass)
        ours = dynamics.mass_matrix(q_a)
        theirs = gamma[columns].T @ mass @ gamma[columns]
        np.testing.assert_allclose(theirs, ours, rtol=0, atol=1e-11 * np.abs(ours).max())
        drift = machine.closure.drift(q, v)[columns]
        bias, ours = mass @ drift + data.qfrc_bias, dynamics.bias(q_a, v_a)
        np.testing.assert_allclose(
            gamma[columns].T @ bias, ours, rtol=0, atol=1e-9 * np.abs(ours).max()
        )


@pytest.mark.filterwarnings("ignore::crane.common.errors.CraneWarning")
@pytest.mark.parametrize("kind", WRITERS)
@pytest.mark.parametrize("name", ["mini_forwarder", "patu655", "kr300", "four_bar"])
def test_round_trip_of_machine_files(name, kind, tmp_path):
    machine = crane.load(DATA / "four_bar.yaml" if name == "four_bar" else name)
    again = rewritten(machine, kind, tmp_path)
    assert_same(machine, again, 0.005 if name == "mini_forwarder" else 0.05, kind == "machine")
    assert again.tip == machine.tip
    if kind == "machine":
        for part in ("friction", "forces", "gas_springs", "end_stops", "tasks", "control"):
            assert getattr(again, part) == getattr(machine, part)
        assert [(c.name, c.parent, c.joints) for c in again.chains] == [
            (c.name, c.parent, c.joints) for c in machine.chains
        ]
        assert again.hydraulics == machine.hydraulics or np.allclose(
            [v.c1 for v in again.hydraulics.valves.values()],
            [v.c1 for v in machine.hydraulics.valves.values()],
            rtol=1e-15,
        )


def numbers(tree):
    """Links and joints without their places in files."""
    plain = {f"joint {name}": dataclasses.replace(x, source_location="", limits=None)
             for name, x in tree.joints.items()}  # fmt: skip
    limits = {f"limits {name}": dataclasses.replace(x.limits, source_location="")
              for name, x in tree.joints.items()}  # fmt: skip
    links = {name: dataclasses.replace(x, source_location="") for name, x in tree.links.items()}
    return plain | limits | links


@pytest.mark.filterwarnings("ignore::crane.common.errors.CraneWarning")
@pytest.mark.parametrize("kind", ["urdf+", "machine"])
@pytest.mark.parametrize("name", ["mini_forwarder", "patu655", "four_bar_loop.urdf"])
def test_every_number_of_links_and_joints_is_kept(name, kind, tmp_path):
    machine = crane.load(DATA / name if name.endswith("urdf") else name)
    again = rewritten(machine, kind, tmp_path)
    found = numbers(again.tree)  # with frames where URDF+ reads the ends of loops of chains
    assert {name: found[name] for name in numbers(machine.tree)} == numbers(machine.tree)


SLIDES = """<robot name="slides">
  <link name="base"/>
  {bodies}
  <joint name="free" type="prismatic"><parent link="base"/><child link="a"/>
    <limit lower="-1e9" upper="1e9" effort="1e9" velocity="2"/></joint>
  <joint name="half" type="revolute"><parent link="a"/><child link="b"/>
    <limit lower="-0.5" upper="1e12" effort="3" velocity="1e9"/></joint>
  <joint name="round" type="continuous"><parent link="b"/><child link="c"/></joint>
</robot>
"""


def test_limits_that_are_none_are_infinite_and_survive_every_format(tmp_path):
    body = (
        '<link name="{}"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" '
        'ixz="0" iyz="0"/></inertial></link>'
    )
    text = SLIDES.format(bodies="".join(map(body.format, "abc")))
    (tmp_path / "slides.urdf").write_text(text)
    machine = crane.load(tmp_path / "slides.urdf")
    inf, none = np.inf, (-np.inf, np.inf, np.inf, np.inf)
    wanted = {
        "free": (-inf, inf, inf, 2.0), "half": (-0.5, inf, 3.0, inf), "round": none
    }  # fmt: skip
    again = [machine]
    for kind in WRITERS:
        (tmp_path / kind).mkdir()
        again.append(rewritten(machine, kind, tmp_path / kind))
    for (joint, expected), other in itertools.product(wanted.items(), again):
        limits, column = other.tree.joints[joint].limits, other.column(joint)
        ends = other.model.lowerPositionLimit[column], other.model.upperPositionLimit[column]
        assert (limits.lower, limits.upper) == ends == expected[:2]
        if other.path.suffix != ".xml":  # MJCF has no place for these
            assert (limits.effort, limits.velocity) == expected[2:]
    with pytest.raises(CraneError, match=r"limits -0\.5 to inf rad \(slides\.urdf:7\), choose"):
        machine.check_limits([0.0, -1.0, 0.0])
    assert "free.lower" not in parameters(read_machine_spec(machine.path))
    narrow = crane.load(machine.path, {"half.lower": -1e9})
    assert narrow.lower[1] == -inf


def test_the_other_assembly_branch_is_kept(tmp_path):
    """The assembly mode of the four-bar's home configuration is kept by every format."""
    text = (DATA / "four_bar.yaml").read_text().replace("urdf: ", f"urdf: {DATA}/")
    text = text.replace("coupler: -1.0", "coupler: -2.3").replace("rocker: 1.5", "rocker: -2.2")
    (tmp_path / "other.yaml").write_text(text)
    other, usual = crane.load(tmp_path / "other.yaml"), crane.load(DATA / "four_bar.yaml")
    assert abs(other.home - usual.home).max() > 0.5
    for kind in WRITERS:
        folder = tmp_path / kind
        folder.mkdir()
        again = rewritten(other, kind, folder)
        np.testing.assert_allclose(sorted(again.home), sorted(other.home), atol=1e-12)


def test_changes_locks_and_payloads_are_written(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        machine = crane.load(
            "mini_forwarder", {"payload.mass": 0.3, "link3_G.x": 0.11}, {"q1": 0.2}
        )
        machine = machine.with_payload(crane.Payload("link7_tip", 0.1))
    for kind in WRITERS:
        folder = tmp_path / kind
        folder.mkdir()
        assert_same(machine, rewritten(machine, kind, folder), 0.005, kind == "machine")


def test_writing_tells_what_is_left_out(tmp_path):
    machine = crane.load(DATA / "four_bar.yaml")
    for writer, lost in (
        (
            write_urdf_plus,
            "the friction law of crank, end stops, tasks, gains, springs and forces",
        ),
        (write_mjcf, "the friction law of crank, end stops, tasks, gains"),
    ):
        with pytest.warns(CraneWarning, match=rf"has no place for {lost}, left out"):
            writer(machine, tmp_path / "written.xml")


def test_loops_that_mjcf_has_not(tmp_path):
    text = (DATA / "four_bar_loop.urdf").read_text()
    text = text.replace(
        '<loop name="pin" type="continuous">', '<loop name="pin" type="cylindrical">'
    )
    (tmp_path / "bar.urdf").write_text(text)
    machine = crane.load(tmp_path / "bar.urdf")
    with pytest.raises(CraneError, match="loop 'pin' is cylindrical, for which MJCF has no con"):
        write_mjcf(machine, tmp_path / "bar.xml")
    assert not (tmp_path / "bar.xml").exists()
    write_urdf_plus(machine, tmp_path / "again.urdf")
    assert_same(machine, crane.load(tmp_path / "again.urdf"), 0.2)


def test_a_belt_over_two_joints_turns_the_sum():
    machine = loaded("planar_leg")
    gamma = machine.closure.gamma(machine.home)
    rows = [machine.column(joint) for joint in ("hip", "rotor", "driver")]
    np.testing.assert_allclose(gamma[rows], [[1, 0], [0, 1], [-1, -1.5]], atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ('type="rolling"', 'type="roling"', "unknown type 'roling', did you mean 'rolling'?"),
        ('<ratio value="-1.5"/>', '<ratio value="fast"/>', "is not a number, write digits"),
        ('<ratio value="-1.5"/>', "<ratio/>", 'has no value, add value="..."'),
        (
            'link="rotor_disc"/>\n    <succ',
            'link="disc"/>\n    <succ',
            "unknown predecessor 'disc'",
        ),
        ('<successor link="driver_arm"/>', "", 'has no successor, add <successor link="..."/>'),
        ('link="rotor_disc"/>\n    <succ', 'link="driver_arm"/>\n    <succ', "binds no joint"),
    ],
)
def test_bad_couplings_are_refused(old, new, line, tmp_path):
    text = (DATA / "planar_leg.urdf").read_text()
    assert text.count(old) == 1
    (tmp_path / "leg.urdf").write_text(text.replace(old, new))
    with pytest.raises(CraneError) as caught:
        crane.load(tmp_path / "leg.urdf")
    assert line in str(caught.value)
    assert re.match(r"leg\.urdf:\d+: ", str(caught.value))


def test_unmarked_joints_are_independent_beside_marked_ones(tmp_path):
    """As the authors of URDF+ read it, whose files also have "True" and "False"."""
    text = (DATA / "planar_leg.urdf").read_text()
    text = text.replace(
        'name="hip" type="continuous" independent="true"', 'name="hip" type="continuous"'
    )
    (tmp_path / "leg.urdf").write_text(text.replace('independent="true"', 'independent="True"'))
    assert crane.load(tmp_path / "leg.urdf").active == ("hip", "rotor")


def test_the_documented_conversion(tmp_path):
    """The files of docs/formats.md are one machine, and what `crane convert` writes."""
    text = (DATA.parents[1] / "docs" / "formats.md").read_text()
    part = text[text.index("## One machine") : text.index("## URDF+")]
    urdf, xml, machine, robot = re.findall(r"```\w+\n(.*?)```", part, flags=re.DOTALL)
    (tmp_path / "four_bar.urdf").write_text(urdf)
    first = crane.load(tmp_path / "four_bar.urdf")
    written = write_machine(first, tmp_path / "four_bar")
    assert written.read_text() == machine
    write_mjcf(first, tmp_path / "four_bar.xml")
    assert xml.strip() in (tmp_path / "four_bar.xml").read_text()
    (tmp_path / "robot.urdf").write_text((written.parent / "1_four_bar.urdf").read_text())
    (tmp_path / "robot.yaml").write_text(robot)
    same = [crane.load(written), crane.load(tmp_path)]
    for q_a in ([0.4], [1.2], [2.1]):
        expected = crane.Dynamics(first).inverse(q_a, [0.5], [1.0])
        for other in same:
            found = crane.Dynamics(other).inverse(q_a, [0.5], [1.0])
            np.testing.assert_allclose(found, expected, rtol=1e-11)


ROTOR = """<robot name="rotor">
  <link name="base"/>
  <link name="arm"><inertial><origin xyz="0.2 0 0"/><mass value="1"/>
    <inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="disc"><inertial><mass value="0.1"/>
    <inertia ixx="1e-4" iyy="2e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="q" type="continuous"><parent link="base"/><child link="arm"/>
    <axis xyz="0 1 0"/></joint>
  <joint name="r" type="continuous" independent="False"><parent link="base"/><child link="disc"/>
    <axis xyz="0 1 0"/></joint>
  <coupling name="gear"><predecessor link="arm"/><successor link="disc"/>
    <ratio value="6"/></coupling>
</robot>
"""


def test_elements_of_the_time_before_urdf_plus_are_not_overlooked(tmp_path):
    (tmp_path / "rotor.urdf").write_text(ROTOR.replace("coupling", "joint_constraint"))
    with pytest.raises(
        CraneError, match=r"rotor\.urdf:11: <joint_constraint> is not read, URDF\+ h"
    ):
        crane.load(tmp_path / "rotor.urdf")


def test_frames_of_a_chain_that_hangs_from_another(tmp_path):
    text = (DATA / "four_bar.yaml").read_text()
    for name in ("ground", "rocker", "load"):
        urdf = (DATA / "four_bar" / f"{name}.urdf").read_text()
        eye = (
            '<link name="eye"/><joint name="eye_fixed" type="fixed"><origin xyz="0 0.1 0.2" '
            'rpy="0.1 0.2 0.3"/><parent link="rocker_base"/><child link="eye"/></joint></robot>'
        )
        (tmp_path / f"{name}.urdf").write_text(
            urdf.replace("</robot>", eye) if name == "rocker" else urdf
        )
    (tmp_path / "four_bar.yaml").write_text(text.replace("four_bar/", ""))
    machine = crane.load(tmp_path / "four_bar.yaml")
    assert_same(machine, crane.load(write_machine(machine, tmp_path / "again")), 0.05)


# --- the command -----------------------------------------------------------------------------


def convert(*arguments):
    return typed("convert", *arguments)


def test_convert(tmp_path):
    machine = crane.load(DATA / "five_bar.urdf")
    for out, options, written in (
        ("a.urdf", (), "a.urdf"),
        ("b.xml", (), "b.xml"),
        ("c", (), "c/five_bar.yaml"),
        ("d.txt", ("--to", "mjcf"), "d.txt"),
        ("e.v2", ("--to", "machine"), "e.v2/five_bar.yaml"),
    ):
        result = convert(DATA / "five_bar.urdf", tmp_path / out, *options)
        assert (result.returncode, result.stderr) == (0, "")
        assert result.stdout == f"written to {tmp_path / written}\n"
    assert_same(machine, crane.load(tmp_path / "a.urdf"), 0.2)
    assert_same(machine, crane.load(tmp_path / "c" / "five_bar.yaml"), 0.2)
    assert (tmp_path / "b.xml").read_text() == (tmp_path / "d.txt").read_text()


@pytest.mark.parametrize(
    ("out", "options", "line"),
    [
        ("there.urdf", (), "there.urdf: exists already, choose another name or add --force"),
        ("x.yaml", (), "x.yaml: a machine file comes with its URDFs, give the name of a folder"),
        ("x.fmu", (), "x.fmu: .fmu is not written, give a .urdf or .xml file, or a folder; "),
        ("x", ("--to", "sdf"), "error: --to is 'sdf', known: machine, mjcf, urdf, urdf+"),
    ],
)
def test_bad_conversions(out, options, line, tmp_path):
    (tmp_path / "there.urdf").write_text("mine")
    result = convert(DATA / "five_bar.urdf", tmp_path / out, *options)
    assert result.returncode == 2
    assert line in result.stderr and len(result.stderr.splitlines()) == 1
    assert (tmp_path / "there.urdf").read_text() == "mine"


def test_a_machine_is_not_written_over_its_own_files(tmp_path):
    written = write_machine(crane.load(DATA / "five_bar.urdf"), tmp_path)
    with pytest.raises(CraneError, match="is what 'five_bar' was read from, choose another fold"):
        write_machine(crane.load(written), tmp_path)
