"""Tipping: moments by hand, Pinocchio's free-flyer, and machines on contacts."""

import shutil

import numpy as np
import pinocchio as pin
import pytest
from command_line import typed

import crane
from crane.common.errors import CraneError
from crane.dynamics.tipping_stability import TippingStability
from crane.studies.task_tipping_load import tipping_load

G, BASE, FEET = 9.81, 900.0, ((0.9, 1.1), (1.0, -1.0), (-1.2, -1.1), (-1.1, 1.2))
MODELS = crane.load("patu655").path.parent


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The crane on a carrier with a mass, above four feet."""
    there = tmp_path_factory.mktemp("standing") / "models"
    shutil.copytree(MODELS, there)
    urdf = there / "urdf" / "patu655" / "boom.urdf"
    text = urdf.read_text()
    start = text.index("<link name=", text.index("<robot"))
    root = text[start:].split('"')[1]
    end = text.index(">", start)
    feet = "".join(
        f'<link name="foot{i}"/><joint name="to_foot{i}" type="fixed"><parent link="{root}"/>'
        f'<child link="foot{i}"/><origin xyz="{x} {y} -0.6"/></joint>'
        for i, (x, y) in enumerate(FEET)
    )
    mass = (
        f'<inertial><origin xyz="-0.3 0.05 -0.2"/><mass value="{BASE}"/>'
        '<inertia ixx="300" iyy="400" izz="500" ixy="0" ixz="0" iyz="0"/></inertial>'
    )
    if text[end - 1] == "/":
        text = text[: end - 1] + f">{mass}</link>{feet}" + text[end + 1 :]
    else:
        text = text[: end + 1] + mass + text[end + 1 :]
        text = text.replace("</robot>", f"{feet}</robot>")
    urdf.write_text(text)
    path = there / "patu655.yaml"
    path.write_text(path.read_text() + "\nsupports: [foot0, foot1, foot2, foot3]\n")
    return there


@pytest.fixture(scope="module")
def standing(folder):
    return crane.load(folder / "patu655.yaml")


def test_static_moments_are_those_of_the_centre_of_mass(standing):
    stability = TippingStability(standing)
    q_a = standing.home[standing.closure.active] + [[0.0, 0, 0, 0], [1.3, 0.05, -0.02, 0.4]]
    margins = stability.static_margins(q_a)
    for i, q in enumerate(standing.closure.solve(q_a)):
        # Pinocchio leaves out what is fixed to the world
        model, data = standing.model, standing.model.createData()
        pin.centerOfMass(model, data, q)
        moved = sum(x.mass for x in model.inertias[1:])
        centre = (moved * data.com[0] + BASE * np.array([-0.3, 0.05, -0.2])) / (moved + BASE)
        assert stability.mass == pytest.approx(moved + BASE, rel=1e-12)
        for k, (one, other) in enumerate(stability.line_names):
            a, b = (np.array(FEET[int(name[-1])]) for name in (one, other))
            way = (b - a) / np.linalg.norm(b - a)
            lever = way[0] * (centre - [*a, 0])[1] - way[1] * (centre - [*a, 0])[0]
            true = stability.mass * G * lever
            assert margins.moments[i, k] == pytest.approx(true, rel=1e-9)
    q = standing.closure.solve(q_a)
    carried = stability.support_forces(q, stability.ground_wrench(q))
    assert (carried[0] > 0).all()
    assert carried[0].sum() == pytest.approx(stability.mass * G, rel=1e-9)


def test_the_load_that_tips_by_hand_moments(standing):
    stability = TippingStability(standing)
    q_a = standing.home[standing.closure.active] + [0.4, 0.1, -0.05, 1.0]
    (load,), (line,) = stability.tipping_load(q_a)
    loaded = standing.with_payload(crane.Payload(standing.tip, load))
    (moments,) = TippingStability(loaded).static_margins(q_a).moments
    weight = (stability.mass + load) * G
    lines = [" to ".join(x) for x in stability.line_names]
    assert abs(moments[lines.index(line)]) < 1e-9 * weight
    assert moments.min() > -1e-9 * weight and 0 < load < 1e4
    # a load between the supports does not tip it
    assert stability.tipping_load(q_a, "pillar")[0][0] == np.inf


def test_moving_it_takes_what_a_free_flyer_needs(standing):
    """Pinocchio's rnea with a free-flyer at the root, and a load from outside."""
    motion = crane.ComputedTorque(standing, crane.task_trajectory(standing, "swing"))
    pull = crane.Wrench(standing.tip, (300.0, -200.0, -800.0), (0.0, 50.0, 20.0))
    run = crane.simulate(standing, motion, None, 6.0, 0.05, loads=[pull])
    stability = TippingStability(standing.with_external_forces(pull))
    dynamics, closure = crane.Dynamics(standing), standing.closure
    model = pin.Model()
    root = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root")
    model.appendBodyToJoint(root, standing.model.inertias[0], pin.SE3.Identity())
    for joint in range(1, standing.model.njoints):
        above, place = standing.model.parents[joint] + 1, standing.model.jointPlacements[joint]
        model.addJoint(above, standing.model.joints[joint], place, standing.model.names[joint])
        model.appendBodyToJoint(joint + 1, standing.model.inertias[joint], pin.SE3.Identity())
    whole, tip = model, standing.model.frames[standing.frame(standing.tip)]
    assert pin.computeTotalMass(whole) == pytest.approx(stability.mass, rel=1e-12)
    data = whole.createData()
    applied = dynamics.project_wrenches(run.q, {standing.tip: [300.0, -200, -800, 0, 50, 20]})
    friction = np.stack([run.channels[f"friction_{x}"] for x in standing.active], axis=1)
    checked = 0
    for i in range(5, len(run.time), 7):
        q = closure.solve(run.q[i])
        gamma = closure.gamma(q)
        v = gamma @ run.v[i]
        mass, bias = dynamics.mass_matrix(run.q[i]), dynamics.bias(run.q[i], run.v[i])
        a_a = np.linalg.solve(mass, run.tau[i] + applied[i] - friction[i] - bias)
        a = gamma @ a_a + closure.drift(q, v)
        still = np.zeros(6)
        held = pin.rnea(
            whole, data, np.concatenate([pin.neutral(model)[:7], q]),
            np.concatenate([still, v]), np.concatenate([still, a]),
        )[:6]  # fmt: skip
        pin.forwardKinematics(whole, data, np.concatenate([pin.neutral(model)[:7], q]))
        place = (data.oMi[tip.parentJoint + 1] * tip.placement).translation
        force = held[:3] - [300.0, -200.0, -800.0]
        moment = held[3:] - [0.0, 50.0, 20.0] - np.cross(place, [300.0, -200.0, -800.0])
        carried = sum(run.channels[f"support_foot{k}"][i] for k in range(4))
        assert carried == pytest.approx(force[2], rel=1e-7)
        for one, other in stability.line_names:
            start, end = (np.array([*FEET[int(x[-1])], -0.6]) for x in (one, other))
            way = (end - start) / np.linalg.norm(end - start)
            true = way @ (moment - np.cross(start, force))
            found = run.channels[f"stability_{one}_{other}"][i]
            assert found == pytest.approx(true, rel=1e-7, abs=1e-6 * stability.mass)
            checked += 1
    assert checked > 50
    assert (run.channels["stability"] < run.channels["static_stability"]).any()


def test_wrong_supports_are_told(folder):
    path = folder / "wrong.yaml"
    text = (folder / "patu655.yaml").read_text()
    for given, match in (
        ("[foot0, foot1]", "2 supports make no area, name three or more"),
        ("[foot0, foot1, foott]", "the support 'foott' is unknown, did you mean"),
        ("[foot0, foot1, tip]", "support 'tip' is lifted by 'q2', name links of the base"),
        ("[foot0, foot1, foot1]", "lists 'foot1' twice"),
    ):
        path.write_text(text.replace("[foot0, foot1, foot2, foot3]", given))
        with pytest.raises(CraneError, match=rf"wrong.yaml:\d+: .*{match}"):
            crane.load(path)
    with pytest.raises(CraneError, match="0 supports and no area between them"):
        TippingStability(crane.load("patu655"))


def test_supports_are_written(standing, tmp_path):
    again = crane.load(crane.write_machine(standing, tmp_path / "written"))
    assert again.supports == standing.supports


@pytest.mark.slow
def test_a_payload_tips_it_by_its_inertia_earlier(folder, standing):
    """At rest as hand moments say, and less while it slews."""
    found = tipping_load(standing, "swing")
    loaded = crane.load(folder / "patu655.yaml", {"payload.mass": found.static_mass})
    run = crane.simulate(
        loaded, crane.ComputedTorque(loaded, crane.task_trajectory(loaded, "swing")), step=5e-3
    )
    assert run.channels["static_stability"].min() == pytest.approx(0.0, abs=1e-4)
    assert found.mass < found.static_mass
    assert run.channels["stability"].min() < 0
    worst = int(run.channels["static_stability"].argmin())
    alone, _ = TippingStability(standing).tipping_load(run.q[worst])
    # the payload's centre hangs below the tip, so only nearly
    assert found.static_mass == pytest.approx(alone[0], rel=0.2)


@pytest.mark.slow
def test_what_is_fixed_is_what_stands_on_stiff_contacts(folder):
    """At rest both press the ground alike; supports of equal stiffness share alike."""
    path = folder / "floats.yaml"
    text = (folder / "patu655.yaml").read_text().replace("\nsupports: [", "\n#supports: [")
    home = text.replace("home:\n", "home:\n  base_z: 0.6\n")
    contacts = "".join(f"  - {{frame: foot{i}}}\n" for i in range(4))
    path.write_text(
        f"{home}\nfloating: [x, y, z, rx, ry, rz]\nground: {{stiffness: 2.0e+7}}\n"
        f"contacts:\n{contacts}"
    )
    floats = crane.load(path)
    hold = crane.simulate(floats, None, None, 6.0, 0.01)
    fixed = crane.load(folder / "patu655.yaml")
    stability = TippingStability(fixed)
    q_a = hold.q[-1][[floats.active.index(x) for x in fixed.active]]
    q = fixed.closure.solve(q_a)[None]
    carried = stability.support_forces(q, stability.ground_wrench(q))[0]
    found = [hold.channels[f"support_foot{i}"][-1] for i in range(4)]
    assert found == pytest.approx(carried, rel=0.02)
    shares = TippingStability(floats)
    assert hold.channels["stability"][-1] == pytest.approx(
        stability.static_margins(q_a).smallest_ratio[0], rel=0.02
    )
    assert shares.is_stationary is False and stability.is_stationary


@pytest.mark.slow
def test_the_command_tells_both_loads(folder, tmp_path):
    path = folder / "patu655.yaml"
    done = typed("stability", path, "--at", "X_ext=1.0", "--task", "swing")
    assert done.returncode == 0, done.stderr
    assert (
        done.stdout.count(" N m |") + done.stdout.count("kN m |") == 4
        and "kg at 'tip' tip it about foot" in done.stdout
    )
    assert "in 'swing' a payload of" in done.stdout
    done = typed("stability", "patu655")
    assert done.returncode == 2 and "has 0 supports and no area between them" in done.stderr
    words = "--task", "swing", "--set", "payload.mass=2500", "--out", tmp_path / "out"
    run = typed("simulate", path, *words)
    assert run.returncode == 0 and "it would tip at t =" in run.stdout + run.stderr
    assert "of the weight hold it down" in (tmp_path / "out" / "summary.md").read_text()


@pytest.mark.parametrize("slew", [0.0, 0.6, np.pi / 2])
def test_the_excavator_tips_as_by_hand(slew):
    """The load at the bucket's lip about the tracks' edge, by sums of m g x of all bodies."""
    machine = crane.load("excavator")
    q_a = machine.home[machine.closure.active].copy()
    q_a[machine.active.index("slew")] = slew
    (load,), (line,) = TippingStability(machine).tipping_load(q_a)
    model, data = machine.model, machine.model.createData()
    pin.framesForwardKinematics(model, data, machine.closure.solve(q_a))
    bodies = [(x.mass, data.oMi[i].act(x.lever)) for i, x in enumerate(model.inertias)]
    start, end = (data.oMf[machine.frame(x)].translation[:2] for x in line.split(" to "))
    way = (end - start) / np.linalg.norm(end - start)

    def inside(point):
        return way[0] * (point[1] - start[1]) - way[1] * (point[0] - start[0])

    holding = sum(mass * inside(place) for mass, place in bodies)
    lip = data.oMf[machine.frame(machine.tip)].translation
    assert load == pytest.approx(holding / -inside(lip), rel=1e-9)
    assert 2e3 < load < 2e4
