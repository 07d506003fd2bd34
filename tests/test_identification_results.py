"""Output of identification: machine files, report, parameters, payloads."""

import csv
import dataclasses
import re
from functools import partial
from pathlib import Path

import forwarder_motions
import numpy as np
import pytest
from broken_machines import DATA
from command_line import typed
from forwarder_motions import NOISE
from lxml import etree
from scipy.interpolate import CubicSpline
from warned import without_a_word

import crane
from crane.common.errors import CraneWarning, InputError, OutputError, RecordingError
from crane.identification.mechanics.identification_model import default_terms
from crane.identification.mechanics.identify import identify
from crane.identification.mechanics.identify_payload import identify_payload
from crane.identification.mechanics.model_terms import (
    InertialTerm,
    body_names,
)
from crane.identification.mechanics.write_identified import divide_locked_bodies
from crane.identification.signals.signal_processing import Motion
from crane.recordings.measured_recordings import read_run

HERE = Path(__file__).parents[1]
RAW = HERE / ".." / "shared" / "data" / "patu655" / "lifting_first_half.csv"
COLUMNS = HERE / "scripts" / "columns" / "patu655.txt"
pytestmark = [pytest.mark.filterwarnings("ignore::crane.CraneWarning"), pytest.mark.slow]
motion = partial(forwarder_motions.motion, duration=20.0, noise=1.0)


def as_recording(machine, given):
    units = {joint: machine.unit(joint) for joint in machine.active}
    return crane.Recording(
        given.time, machine.active, given.q, given.v, given.tau, units, machine="mini_forwarder"
    )


@pytest.fixture(scope="module")
def found(mini):
    return identify(mini, motion(mini), motion(mini, seed=3), feasible=True)


# --- machine files ---------------------------------------------------------------------------


def same_forces(result, machine, q, v, a):
    """Mass matrix, bias and friction against the regressor and what it predicts."""
    dynamics = crane.Dynamics(machine)
    inertial = InertialTerm(result.described_machine)
    bodies = result.parameters[: 10 * len(result.model.bodies)]

    def forces(q, v, a):
        at = result.model.samples(q, v, a)
        return inertial.columns(at) @ bodies + result.model.known_forces(at)

    bias = forces(q, v, 0 * a)
    M = np.stack([forces(q, v, np.eye(3)[i] + 0 * a) - bias for i in range(3)], axis=2)
    wanted = result.predict(q, v, a)
    lost = dynamics.inverse(q, v, a, friction=True) - dynamics.inverse(q, v, a)
    for one, other in (
        (dynamics.mass_matrix(q), M),
        (dynamics.bias(q, v), bias),
        (lost, wanted - forces(q, v, a)),
        (dynamics.inverse(q, v, a, friction=True), wanted),
    ):
        assert np.abs(one - other).max() < 1e-10 * np.abs(other).max()


def random_states(machine, count=40):
    rng = np.random.default_rng(4)
    q = rng.uniform(machine.lower + 1e-3, machine.upper - 1e-3, size=(count, 3))
    v, a = rng.normal(size=(2, count, 3)) * [1.0, 0.02, 0.02]
    return q, v, a


def test_the_written_machine_is_the_identified_one(mini, found, tmp_path):
    file = crane.identification.write_identified(found, tmp_path / "out")
    assert file == tmp_path / "out" / "mini_forwarder.yaml"
    assert len(list(file.parent.iterdir())) == 6
    written = crane.load(file)
    same_forces(found, written, *random_states(mini))
    assert "identified by wls, feasible" in written.source
    noted = re.findall(r"^ +(\w+): (\S+)  # identified ±(\S+), 95 %", file.read_text(), re.M)
    told = dict(zip(found.names, found.values.tolist(), strict=True))
    assert len(noted) > 3 and {float(value) for _, value, _ in noted} <= set(told.values())
    assert written.tasks == mini.tasks and written.end_stops == mini.end_stops
    assert written.friction["X2"].is_driving  # as described, of which nothing is told either
    without_a_word(crane.load, file)
    assert abs(written.model.inertias[1].mass - mini.model.inertias[1].mass) > 1e-6


def test_only_inertials_change_in_the_urdfs(mini, found, tmp_path):
    written = crane.load(crane.identification.write_identified(found, tmp_path))

    def places(machine):
        return {
            x.name: (x.kind, x.parent, x.child, x.xyz, x.rpy, x.axis, str(x.limits.lower))
            for x in machine.tree.joints.values()
        }

    def shapes(machine):
        robots = [etree.parse(str(chain.urdf)).getroot() for chain in machine.chains]
        return {
            link.get("name"): [dict(x.attrib) for x in link.iterfind("visual//*")]
            for robot in robots
            for link in robot.iter("link")
        }

    assert places(written) == places(mini) and written.tree.links.keys() == mini.tree.links.keys()
    np.testing.assert_array_equal(written.home, mini.home)
    assert shapes(written) == shapes(mini) and any(shapes(mini).values())
    for chain in written.chains:
        comment = chain.urdf.read_text().splitlines()[1]
        assert "source: identified by wls, feasible; else " in comment


LOADED = """<robot name="arm">
  <link name="base"><inertial><mass value="5"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="beam"/>
  <link name="tool"><inertial><origin xyz="0.1 0 0.02" rpy="0.3 0 0"/><mass value="2"/>
    <inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><box size="1 1 1"/></geometry></visual></link>
  <link name="rocker"><inertial><origin xyz="0.1 0 0"/><mass value="1"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="rod"><inertial><origin xyz="0.2 0 0"/><mass value="1"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="crank" type="revolute" independent="true"><parent link="base"/>
    <child link="beam"/><axis xyz="0 1 0"/><dynamics damping="0.4" friction="0.2"/>
    <limit lower="-0.6" upper="0.6" effort="9" velocity="9"/></joint>
  <joint name="weld" type="fixed"><parent link="beam"/><child link="tool"/>
    <origin xyz="0.05 0 0" rpy="0 0.2 0"/></joint>
  <joint name="swing" type="revolute"><parent link="base"/><child link="rocker"/>
    <origin xyz="0.5 0 0"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="9" velocity="9"/></joint>
  <joint name="knee" type="revolute"><parent link="beam"/><child link="rod"/>
    <origin xyz="0 0 0.3"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="9" velocity="9"/></joint>
  <loop name="pin" type="revolute">
    <predecessor link="rod"><origin xyz="0.5 0 0"/></predecessor>
    <successor link="rocker"><origin xyz="0 0 0.3"/></successor><axis xyz="0 1 0"/></loop>
</robot>"""


def test_one_urdf_with_a_loop_becomes_a_machine_file(tmp_path):
    """What is welded to a body is in it, the loop's frames are links, friction is written."""
    path = tmp_path / "arm.urdf"
    path.write_text(LOADED)
    arm = crane.load(path)
    time = np.arange(0, 20, 0.01)[:, None]
    q, v, a = 0.5 * np.sin(time), 0.5 * np.cos(time), -0.5 * np.sin(time)
    tau = crane.Dynamics(arm).inverse(q, v, a, friction=True)
    noise = np.random.default_rng(0).normal(size=tau.shape)
    given = Motion(time[:, 0], q, v, a, 1.1 * tau + 0.1 * noise)
    result = identify(arm, given, prior=0.3, feasible=True)
    written = crane.load(crane.identification.write_identified(result, tmp_path / "out"))
    at = result.model.samples(q, v, a)
    wanted = result.model.regressor(at) @ result.parameters
    again = crane.Dynamics(written).inverse(q, v, a, friction=True)
    assert np.abs(again - wanted).max() < 1e-10 * np.abs(wanted).max()
    robot = etree.parse(str(written.chains[0].urdf)).getroot()
    having = {link.get("name") for link in robot.iter("link") if link.find("inertial") is not None}
    assert having == {"base", "beam", "rocker", "rod"}
    assert robot.find("link[@name='tool']/visual") is not None


def test_the_load_that_a_machine_names_comes_along(edited, tmp_path):
    line = "tip: coupler_pin"
    load = DATA / "four_bar" / "load.urdf"
    machine = edited("four_bar.yaml", line, f"{line}\npayload: {{urdf: {load}}}")
    time = np.arange(0, 20, 0.01)[:, None]
    q, v, a = 1.2 + 0.3 * np.sin(time), 0.3 * np.cos(time), -0.3 * np.sin(time)
    tau = crane.Dynamics(machine).inverse(q, v, a, friction=True)
    given = Motion(time[:, 0], q, v, a, tau + 0.1 * np.random.default_rng(0).normal(size=q.shape))
    result = identify(machine, given, prior=0.3, feasible=True)
    with pytest.raises(OutputError) as caught:
        crane.identification.write_identified(result, machine.path.parent / "sub" / "..")
    assert f"is what '{machine.name}' was read from" in str(caught.value)
    file = crane.identification.write_identified(result, tmp_path / "out")
    assert (file.parent / "load.urdf").read_bytes() == load.read_bytes()
    written, loaded = (crane.load(file, {"payload.mass": mass}) for mass in (0.0, 3.0))
    total = [sum(inertia.mass for inertia in m.model.inertias[1:]) for m in (written, loaded)]
    assert total[1] - total[0] == pytest.approx(3.0, rel=1e-12)


class Spring:
    """A term of a user."""

    names, nominal, nonnegative = ("q1.spring",), np.zeros(1), (False,)

    def columns(self, samples):
        columns = np.zeros((*samples.v_a.shape, 1))
        columns[:, 0, 0] = np.sin(samples.q_a[:, 0])
        return columns


def test_what_cannot_be_written(mini, found, tmp_path):
    plain = identify(mini, motion(mini))
    parameters = found.parameters.copy()
    parameters[found.model.names.index("X1.viscous")] = -1.0
    spring = [*default_terms(mini), Spring()]
    bodies = found.parameters.copy()
    bodies[4] = -1.0
    for result, message in (
        (plain, "forces determine base parameters only: give prior or feasible=True"),
        (
            dataclasses.replace(found, parameters=parameters),
            "'X1': viscous of friction is -1, it must not be negative, give feasible=True",
        ),
        (dataclasses.replace(found, parameters=bodies), "the identified machine is not valid: "),
        (identify(mini, motion(mini), feasible=True, terms=spring), "the model has 'q1.spring'"),
    ):  # fmt: skip
        with pytest.raises(InputError) as caught:
            crane.identification.write_identified(result, tmp_path / "out")
        assert str(caught.value).startswith(message), str(caught.value)
        assert list(tmp_path.iterdir()) == []


def test_a_body_that_cannot_be_asks_for_feasible_ones(mini, found, tmp_path):
    """A line number is not given for a file that was not written."""
    bodies = found.parameters.copy()
    bodies[4:10] = [-1.0, 0.0, 1.0, 0.0, 0.0, 1.0]
    parted = dataclasses.replace(found, parameters=bodies, feasible=False)
    with pytest.raises(InputError) as caught:
        crane.identification.write_identified(parted, tmp_path / "out")
    link = found.model.bodies[0]
    assert re.fullmatch(
        f"the identified machine is not valid: link '{link}' has the negative principal moment of "
        r"inertia -\S+ kg m2, give feasible=True",
        str(caught.value),
    )
    with pytest.warns(CraneWarning, match="no machine files are written: .*") as told:
        parted.write(tmp_path / "folder")
    assert str(told[0].message) == (
        f"no machine files are written: {caught.value} (on the command line --feasible)"
    )


def test_the_parameters_as_a_table(found, tmp_path):
    found.to_csv(tmp_path / "p.csv")
    with (tmp_path / "p.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["parameter"] for row in rows] == list(found.names)
    np.testing.assert_array_equal([float(row["value"]) for row in rows], found.values)
    assert [row["mark"] for row in rows] == list(found.marks)
    np.testing.assert_array_equal(
        [float(row["lower"]) for row in rows], found.confidence_interval()[:, 0]
    )


# --- report ----------------------------------------------------------------------------------


def test_a_report_is_one_file_that_says_everything(mini, found, tmp_path):
    path = crane.view.identification_report(
        found, tmp_path / "report.html", "train <1>.csv", "judge.csv"
    )
    text = path.read_text(encoding="utf-8")
    assert len(text) < 3e6
    bare = re.sub(r'src="data:image/png;base64,[^"]*"', "", text)
    assert not re.search(r"https?:|src=|href=|url\(|<script|@import", bare)
    assert "train &lt;1&gt;.csv" in bare and "judge.csv" in bare
    tree = etree.HTML(text)
    assert len(tree.findall(".//img")) == 3 * 3 + 1
    tables = tree.findall(".//table")
    counts = [len(table.findall(".//tr")) - 1 for table in tables]
    assert counts[:3] == [3, found.base.rank, len(found.model.bodies)]
    shown = {code.text for code in tables[1].iter("code")}
    assert shown == set(found.names)
    assert f"{100 * found.training.relative_error[1]:.3g} %" in bare
    assert "essential" in bare and "zero in interval" in bare
    section = tree.xpath("//h2[.='Unobservable parameters']/following-sibling::p")[0]
    unobservable = " ".join(section.itertext())
    assert all(name in unobservable for name in found.base.unobservable)
    with pytest.raises(OutputError):
        crane.view.identification_report(found, tmp_path / "report.pdf")


# --- payload ---------------------------------------------------------------------------------

LOAD = crane.Payload("link7_tip", 0.2, (0.01, -0.03, 0.005), np.diag([1e-4, 2e-4, 1.5e-4]))
TRUTH = np.array([0.2, 0.01, -0.03, 0.005])


def test_a_load_comes_back_from_exact_forces(mini):
    estimate = identify_payload(mini, motion(mini.with_payload(LOAD), noise=0.0))
    np.testing.assert_allclose([estimate.mass, *estimate.com], TRUTH, rtol=1e-8)
    # in another frame of the same body
    frame = mini.model.frames[mini.frame("link7")].placement
    tip = mini.model.frames[mini.frame("link7_tip")].placement
    other = identify_payload(mini, motion(mini.with_payload(LOAD), noise=0.0), "link7")
    np.testing.assert_allclose(other.com, frame.actInv(tip.act(TRUTH[1:])), rtol=1e-7, atol=1e-9)


def test_the_intervals_of_a_load_cover_it(mini):
    loaded = mini.with_payload(LOAD)
    covered = []
    for seed in range(12):
        low, high = identify_payload(mini, motion(loaded, seed)).confidence_interval().T
        covered.append((low <= TRUTH) & (high >= TRUTH))
    assert np.mean(covered) > 0.88  # of 48
    estimate = identify_payload(mini, motion(loaded, 1))
    assert abs(estimate.mass - 0.2) < 2e-3 and estimate.std[0] < 1e-3
    assert re.search(r"^mass +0\.\d+ .* to 0\.\d+ kg$", estimate.to_text(), re.M)
    bare = identify_payload(mini, motion(mini, 2))
    assert "the mass may be zero" in bare.to_text()


@pytest.mark.parametrize("way", [0.02, None])
def test_a_load_that_lifts_is_refused(mini, way):
    """Forces less by as much as a load adds: of all that moves, and of a lift."""
    bare, loaded = (
        motion(machine, 1) if way is None else one_way(machine, way)
        for machine in (mini, mini.with_payload(LOAD))
    )
    given = dataclasses.replace(bare, tau=2 * bare.tau - loaded.tau)
    with pytest.raises(RecordingError) as caught:
        identify_payload(mini, given)
    text = str(caught.value)
    assert re.match(r"the mass comes out as -0\.2\d* to -0\.[12]\d* kg, and no load weighs", text)
    assert "look at signs and units of forces" in text and "trust it (trust)" in text
    with pytest.warns(CraneWarning, match="no load weighs less than nothing"):
        assert identify_payload(mini, given, trust=True).mass < 0


def test_what_a_motion_does_not_tell_of_a_load(mini):
    """Without slewing, nothing at right angles to the crane's plane."""
    estimate = identify_payload(mini, motion(mini.with_payload(LOAD), still=[0]))
    np.testing.assert_allclose(estimate.com[:2], TRUTH[1:3], atol=3e-3)
    assert np.isnan(estimate.com[2]) and np.isnan(estimate.std[3])
    assert estimate.directions.shape == (2, 3) and np.abs(estimate.directions[:, 2]).max() < 1e-9
    assert re.search(r"^com z +- +not determined by this motion$", estimate.to_text(), re.M)


def test_no_load_can_be_told(mini):
    given = motion(mini, duration=4.0)
    slewing = motion(mini, duration=4.0, still=[1, 2])
    for call, kind, message in (
        (lambda: identify_payload(mini, given, "base"), InputError, "frame 'base' does not move"),
        (lambda: identify_payload(mini, given, "tip"), InputError, "frame 'tip' is unknown"),
        (
            lambda: identify_payload(mini, dataclasses.replace(given, tau=1e3 * given.tau)),
            RecordingError,
            "'q1_force' is 986",
        ),
        (
            lambda: identify_payload(mini, slewing),
            RecordingError,
            "this motion does not determine",
        ),
    ):
        with pytest.raises(kind) as caught:
            call()
        assert str(caught.value).startswith(message), str(caught.value)


def one_way(machine, way):
    """Both cylinders run out by so much once, from rest to rest, and the forces of it."""
    time = np.arange(0, 20, 4e-3)
    s = time / time[-1]
    rise = 10 * s**3 - 15 * s**4 + 6 * s**5
    path = CubicSpline(time, np.outer(rise, [0.0, way, way]) + [0.0, 0.005, 0.005])
    q, v, a = (path(time, k) for k in range(3))
    tau = crane.Dynamics(machine).inverse(q, v, a, friction=True)
    rng = np.random.default_rng(0)
    return Motion(time, q, v, a, tau + NOISE * rng.normal(size=tau.shape))


def rougher(machine, factor):
    """The same machine with more friction in its drives."""
    laws = {
        joint: dataclasses.replace(law, coulomb=factor * law.coulomb)
        if joint in machine.active
        else law
        for joint, law in machine.friction.items()
    }
    return machine.replace(friction=laws)


def test_friction_that_is_not_as_described_is_no_load(mini):
    """Twice the Coulomb friction, motion both ways: the load is the load."""
    rough = rougher(mini, 2.0)
    estimate = identify_payload(mini, motion(rough.with_payload(LOAD), 1))
    low, high = estimate.confidence_interval()[0]
    assert low < 0.2 < high and high - low < 0.02
    for i, joint in enumerate(mini.active):
        wanted = mini.friction[joint].coulomb
        assert estimate.friction_corrections[joint] == pytest.approx(
            wanted, rel=0.1, abs=0.2 * NOISE[i]
        )


def test_motion_one_way_does_not_tell_friction_from_weight(mini):
    """By a short way, along which the load's lever hardly changes: refused, and why."""
    given = one_way(rougher(mini, 3.0).with_payload(LOAD), 0.002)
    with pytest.raises(RecordingError) as caught:
        identify_payload(mini, given)
    text = str(caught.value)
    assert text.startswith("this recording does not determine the mass (") and "\n" not in text
    assert "'X1', 'X2' moved one way only, where friction looks like weight" in text
    assert "the forces at rest hold -0.0" in text
    # a long way tells a load by its levers, whatever the friction
    for factor in (1.0, 3.0):
        right = identify_payload(mini, one_way(rougher(mini, factor).with_payload(LOAD), 0.02))
        low, high = right.confidence_interval()[0]
        assert low < 0.2 < high and high - low < 0.05
    assert right.friction_corrections == {}


def test_one_speed_each_way_tells_friction_and_a_load_as_a_point(mini):
    """X1 up and down at one speed, at friction three times the described; nothing else moves."""
    point = crane.Payload("link7_tip", 0.2)
    rough = rougher(mini, 3.0).with_payload(point)
    step, speed, turn = 4e-3, 2e-3, 50
    ramp = np.sin(np.linspace(0, np.pi / 2, turn)) ** 2
    up = np.concatenate([ramp, np.ones(1000), ramp[::-1]])
    v = np.zeros((2 * len(up), 3))
    v[:, 1] = speed * np.concatenate([up, -up])
    q = np.array([0.0, 0.008, 0.01]) + step * np.cumsum(v, axis=0)
    a = np.gradient(v, step, axis=0)
    tau = crane.Dynamics(rough).inverse(q, v, a, friction=True)
    tau += NOISE * np.random.default_rng(0).normal(size=tau.shape)
    estimate = identify_payload(mini, Motion(step * np.arange(len(v)), q, v, a, tau))
    low, high = estimate.confidence_interval()[0]
    assert np.isnan(estimate.com).all() and low < 0.2 < high and high - low < 0.05
    wanted = 2 * mini.friction["X1"].coulomb
    assert estimate.friction_corrections["X1"] == pytest.approx(wanted, rel=0.1)
    assert "load on link7_tip, modelled as a point mass at this frame" in estimate.to_text()


@pytest.mark.skipif(not RAW.is_file(), reason="the recording, ../shared/data, is not there")
def test_a_lift_that_was_recorded_is_weighed():
    """211.4 kg are said to hang there; it goes one way, nothing tells the centre."""
    machine = crane.load("patu655", lock={"slew": 0.0, "X_ext": 0.0})
    estimate = identify_payload(machine, read_run(RAW, machine, COLUMNS))
    low, high = estimate.confidence_interval()[0]
    mass, band = estimate.static_mass
    assert low < 211.4 < high and low < mass < high and high - low < 250
    assert np.isnan(estimate.com).all() and estimate.friction_corrections == {}
    # in the first seconds weights that are not as described count for more than the load
    with pytest.raises(RecordingError, match="no load weighs less than nothing"):
        identify_payload(machine, read_run(RAW, machine, COLUMNS, (0.0, 2.0)))


def one_cylinder(machine, payload, seed=0):
    """The boom alone, up and down in 15 s: its forces tell two moments of a load, not three."""
    step = 0.01
    time = step * np.arange(3000)
    middle, half = 0.5 * (machine.upper + machine.lower), 0.5 * (machine.upper - machine.lower)
    angle = 2 * np.pi * time / 15
    q = np.stack([middle[0] + 0.7 * half[0] * np.sin(angle), np.full_like(time, middle[1])], 1)
    v, a = np.zeros((2, *q.shape))
    v[:, 0] = 0.7 * half[0] * np.cos(angle) * 2 * np.pi / 15
    a[:, 0] = -0.7 * half[0] * np.sin(angle) * (2 * np.pi / 15) ** 2
    tau = crane.Dynamics(machine.with_payload(payload)).inverse(q, v, a, friction=True)
    noise = np.random.default_rng(seed).normal(size=tau.shape)
    return Motion(time, q, v, a, tau + 2e-3 * np.sqrt(np.mean(tau**2, axis=0)) * noise)


def test_the_centre_of_a_point_load_can_be_given(tmp_path):
    """0.2 m beyond the frame: without it the mass is 5 % off, and what it hangs on is told."""
    machine = crane.load("patu655", lock={"slew": 0.0, "X_ext": 0.0})
    covered = []
    for seed in range(6):
        for com in ((0.2, 0.0, 0.0), (0.0, 0.2, 0.0), (-0.1, 0.1, 0.0)):
            given = one_cylinder(machine, crane.Payload("tip", 80.0, com), seed)
            right = identify_payload(machine, given, com=com)
            np.testing.assert_array_equal(right.com, com)
            low, high = right.confidence_interval()[0]
            assert abs(right.mass - 80.0) < 0.1 and high - low < 0.4
            covered.append(low < 80.0 < high)
    assert np.mean(covered) > 0.8  # of 18
    beyond = one_cylinder(machine, crane.Payload("tip", 80.0, (0.2, 0.0, 0.0)))
    wrong = identify_payload(machine, beyond)
    assert np.isnan(wrong.com).all() and 83.0 < wrong.mass < 84.5
    # by its derivative the mass comes back, to second order
    assert wrong.mass + 0.2 * wrong.mass_gradient[0] == pytest.approx(80.0, abs=0.4)
    assert abs(wrong.mass_gradient[2]) < 1e-6 * abs(wrong.mass_gradient[0])
    text = r"per 0\.1 m of its centre along x, y, z the mass changes by -2, \S+, \S+ kg: give the"
    assert re.search(text, wrong.to_text()) and "(--centre X,Y,Z)" in wrong.to_text()
    told = identify_payload(machine, beyond, com=(0.2, 0.0, 0.0)).to_text()
    assert re.search(r"^com x +0\.2 +given$", told, re.M) and "--centre" not in told
    units = {joint: "m" for joint in machine.active}
    rows = (beyond.time, machine.active, beyond.q, beyond.v, beyond.tau, units)
    crane.Recording(*rows).to_csv(tmp_path / "lift.csv")
    words = ("payload", "patu655", tmp_path / "lift.csv", "--lock", "slew=0", "--lock", "X_ext=0")
    done = typed(*words, "--centre", "0.2,0,0")
    assert done.returncode == 0
    mass = float(re.search(r"^mass +(\S+)", done.stdout, re.M)[1])
    assert mass == pytest.approx(80.0, abs=0.1)
    for bad in ("0.2", "0.2,a,0", "0.2,0,0,1"):
        done = typed(*words, "--centre", bad)
        assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr


def test_a_given_centre_narrows_what_a_motion_tells(mini):
    """Of all joints: as well determined as before, and better."""
    given = motion(mini.with_payload(LOAD), 1)
    free, held = (identify_payload(mini, given, com=com) for com in (None, TRUTH[1:]))
    assert abs(held.mass - 0.2) < 4 * held.std[0] and held.std[0] < free.std[0]
    np.testing.assert_array_equal(held.std[1:], 0.0)


def test_a_machine_that_is_not_as_described_widens_the_interval(mini):
    """The load is found although two links are 50 % heavier than described."""
    changes = {f"{name}.mass": 1.5 * mass for name, mass in (("link2", 0.1833), ("link5", 0.028))}
    heavy = crane.load("mini_forwarder", changes)
    right, wrong = (
        identify_payload(mini, motion(machine.with_payload(LOAD), 1)).confidence_interval()[0]
        for machine in (mini, heavy)
    )
    assert np.ptp(wrong) > 4 * np.ptp(right)


def test_forces_at_rest_are_compared(mini):
    """A drive whose sensor is off by a tenth of its weight, told at rest and not by the motion."""
    given = motion(mini.with_payload(LOAD), 1)
    rests = 250
    hold = {
        key: np.vstack([getattr(given, key), np.tile(getattr(given, key)[-1], (rests, 1))])
        for key in ("q", "v", "a", "tau")
    }
    hold["v"][-rests:] = hold["a"][-rests:] = 0.0
    q, zero = hold["q"][-rests:], np.zeros((rests, 3))
    tau = crane.Dynamics(mini.with_payload(LOAD)).inverse(q, zero, zero)
    hold["tau"][-rests:] = tau
    time = 4e-3 * np.arange(len(hold["q"]))
    estimate = identify_payload(mini, Motion(time, **hold))
    mass, band = estimate.static_mass
    assert abs(mass - 0.2) < band and estimate.warning == ""
    assert re.search(r"^mass by the forces at rest: 0\.\d+ \+- ", estimate.to_text(), re.M)
    hold["tau"][-rests:] = tau * [1, 3, 3]
    doubted = identify_payload(mini, Motion(time, **hold))
    assert "the forces at rest say" in doubted.warning and doubted.warning in doubted.to_text()


# --- locked machines -------------------------------------------------------------------------


def test_a_machine_with_changes_is_written_with_them(mini, tmp_path):
    changed = crane.load("mini_forwarder", {"link7.mass": 0.3, "end_stop.X1.stiffness": 3e6})
    result = identify(changed, motion(changed), prior=0.3, feasible=True)
    written = crane.load(crane.identification.write_identified(result, tmp_path / "out"))
    assert written.end_stops == changed.end_stops != mini.end_stops
    same_forces(result, written, *random_states(changed))


def test_a_locked_machine_is_written_with_all_its_joints(mini, tmp_path):
    """What the lock makes one body is divided; locked again, the forces are the same."""
    locked = crane.load("mini_forwarder", lock={"X2": 0.012})
    time = np.arange(0, 20, 4e-3)[:, None]
    place, turn = np.array([0.3, 0.015]), np.array([1.0, 0.012])
    q, v, a = place + turn * np.sin(time), turn * np.cos(time), -turn * np.sin(time)
    tau = 1.1 * crane.Dynamics(locked).inverse(q, v, a, friction=True)
    noise = np.random.default_rng(0).normal(size=tau.shape) * NOISE[:2]
    given = Motion(time[:, 0], q, v, a, tau + noise)
    result = identify(locked, given, feasible=True)
    file = crane.identification.write_identified(result, tmp_path / "out")
    written = crane.load(file)
    assert written.joints == mini.joints and written.active == mini.active
    assert written.friction["X2"] == mini.friction["X2"]
    assert all(inertia.mass > 0 for inertia in written.model.inertias[1:])
    again = crane.load(file, lock=result.described_machine.locked_joints)
    found = crane.Dynamics(again).inverse(q, v, a, friction=True)
    wanted = result.model.regressor(result.model.samples(q, v, a)) @ result.parameters
    assert np.abs(found - wanted).max() < 1e-9 * np.abs(wanted).max()


def test_a_machine_identified_as_described_is_divided_as_described():
    arm = crane.load("ur5_robot")
    locked = crane.load("ur5_robot", lock={"elbow_joint": 0.7, "shoulder_pan_joint": -0.4})
    parts = divide_locked_bodies(locked, crane.Dynamics(locked).parameters, arm)
    wanted = crane.Dynamics(arm).parameters.reshape(-1, 10)
    assert parts.keys() == set(body_names(arm))
    for name, parameters in zip(body_names(arm), wanted, strict=True):
        np.testing.assert_allclose(parts[name], parameters, rtol=1e-9, atol=1e-9)


# --- command line ----------------------------------------------------------------------------


@pytest.fixture
def run(tmp_path):
    """The command line in this process: exit status, stdout, stderr without warnings."""

    def call(*arguments):
        done = typed(*arguments, cwd=tmp_path)
        lines = [x for x in done.stderr.splitlines() if not x.startswith("warning: ")]
        return done.returncode, done.stdout, lines

    return call


@pytest.fixture(scope="module")
def simulated(mini, tmp_path_factory):
    """A machine that moves with a load, or without."""
    folder = tmp_path_factory.mktemp("simulated")
    given = motion(mini)
    path = crane.motion.Trajectory(CubicSpline(given.time[::10], given.q[::10]))
    for name, machine in (("empty", mini), ("loaded", mini.with_payload(LOAD))):
        control = crane.ComputedTorque(machine, path)
        run = crane.simulate(machine, control, path(0.0)[:2])
        noise = NOISE * np.random.default_rng(0).normal(size=run.tau.shape)
        dataclasses.replace(run, tau=run.tau + noise).to_csv(folder / f"{name}.csv")
    return folder


def test_from_a_simulated_file_to_a_folder(run, simulated, tmp_path):
    file = simulated / "empty.csv"
    command = ("identify", "mini_forwarder", file, "--validation", file, "--feasible")
    status, out, errors = run(*command, "--out", "result")
    assert (status, errors) == (0, [])
    assert "mini_forwarder: " in out and "validation, samples near standstill excluded" in out
    assert out.endswith("\nwritten to result; see result/report.html\n")
    written = {path.name for path in (tmp_path / "result").iterdir()}
    assert written == {"report.html", "parameters.csv", "machine"}
    assert crane.load(tmp_path / "result" / "machine" / "mini_forwarder.yaml").name
    status, out, errors = run(*command, "--out", "result")
    assert status == 2 and out == "" and "is not empty" in errors[0]
    (tmp_path / "result" / "mine").write_text("kept")
    assert run(*command[:-1], "--out", "result", "--force")[0] == 0  # of no machine
    written = {path.name for path in (tmp_path / "result").iterdir()}
    assert written == {"report.html", "parameters.csv", "mine"}


def test_a_load_from_a_simulated_file(run, simulated):
    status, out, errors = run("payload", "mini_forwarder", simulated / "loaded.csv")
    assert (status, errors) == (0, [])
    mass = float(re.search(r"^mass +(\S+)", out, re.M)[1])
    assert abs(mass - 0.2) < 0.01 * 0.2


def without(column, text):
    """A file with a column cut out."""
    lines = text.splitlines()
    at = next(i for i, line in enumerate(lines) if not line.startswith("#"))
    index = [cell.split(" [")[0] for cell in lines[at].split(",")].index(column)
    kept = (
        line if i < at else ",".join(c for k, c in enumerate(line.split(",")) if k != index)
        for i, line in enumerate(lines)
    )
    return "".join(f"{line}\n" for line in kept)


def test_wrong_recordings_and_arguments_are_one_line(run, mini, tmp_path):
    good = as_recording(mini, motion(mini, duration=8.0))
    good.to_csv(tmp_path / "good.csv")
    text = (tmp_path / "good.csv").read_text()

    def other(**changes):
        return dataclasses.replace(good, **changes)

    def few():
        return other(**{k: getattr(good, k)[:20] for k in ("time", "q", "v", "tau")})

    trembling = 1e-6 * np.random.default_rng(0).normal(size=good.q.shape)
    still = other(q=good.q[0] + trembling, v=0 * good.v)
    broken = text.replace(",".join(text.splitlines()[40].split(",")[:2]), "nan,0", 1)
    cases = [
        (without("X1_force", text), "column 'X1_force' is missing"),
        (broken, "column 'time': 'nan' is not a finite number"),
        (still, "no joint moves, record a motion"),
        (few(), "20 samples are too few, record at least 50"),
    ]
    for case, message in cases:
        if isinstance(case, str):
            (tmp_path / "bad.csv").write_text(case)
        else:
            case.to_csv(tmp_path / "bad.csv")
        status, out, errors = run("identify", "mini_forwarder", "bad.csv", "--out", "out")
        assert (status, out, len(errors)) == (2, "", 1), errors
        assert errors[0].startswith("error: ") and message in errors[0]
        assert not (tmp_path / "out").exists()
    for arguments, message in (
        (["--prior", "-1"], "--prior is '-1', write NAME=STD, as in bodies=10%"),
        (["--bandwidth", "1e-6"], "the bandwidth is 1e-06 Hz"),
        (["--validation", "none.csv"], "none.csv: no such file"),
    ):
        status, out, errors = run(
            "identify", "mini_forwarder", "good.csv", "--out", "out", *arguments
        )
        assert (status, out, len(errors)) == (2, "", 1), errors
        assert message in errors[0]
        assert not (tmp_path / "out").exists()
