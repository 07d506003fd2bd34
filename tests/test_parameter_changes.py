"""Machines loaded with changed parameters."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from broken_machines import DATA

import crane
import crane.cli
from crane.common.errors import InputError
from crane.description import bundled_machines, parameters
from crane.description.parameter_changes import apply_parameter_changes
from crane.formats import machine_loading, read_machine_spec
from crane.formats.machine_loading import MachineVariants
from crane.hydraulics.components import Spool

pytestmark = pytest.mark.filterwarnings("ignore::crane.CraneWarning")
POSE = np.array([0.3, 0.021, 0.012])


def tip(machine, q_a=POSE):
    return crane.Kinematics(machine).position(q_a)


def test_without_changes_nothing_changes(mini):
    names = parameters(read_machine_spec("mini_forwarder"))
    same = crane.load("mini_forwarder", dict(list(names.items())[:-1]))  # all but the payload
    for name in ("mass_matrix", "gravity"):
        one, two = (getattr(crane.Dynamics(m), name)(POSE) for m in (mini, same))
        assert np.array_equal(one, two)
    assert same.friction == {
        **dict.fromkeys(mini.joints, crane.description.Friction()),
        **mini.friction,
    }
    assert same.control == mini.control


def test_a_payload_is_that_of_the_machine(mini):
    loaded = crane.load("mini_forwarder", {"payload.mass": 0.1})
    wanted = mini.with_payload(crane.Payload(mini.tip, 0.1))
    v_a, a_a = np.array([0.3, 0.01, 0.02]), np.array([1.0, 0.1, 0.1])
    one, two = (crane.Dynamics(m).inverse(POSE, v_a, a_a) for m in (loaded, wanted))
    assert np.abs(one - two).max() < 1e-13 * np.abs(two).max()


def test_a_load_of_the_machine_file_is_scaled_to_the_mass(edited):
    """Two bodies of 1 and 3 kg as one of 2 kg: half of both, by Huygens and Steiner."""
    line = "tip: coupler_pin"
    bare = edited("four_bar.yaml", line, f"{line}\npayload: {{urdf: {DATA}/four_bar/load.urdf}}")
    nothing = crane.load(bare.path, {"payload.mass": 0.0})
    loaded = crane.load(bare.path, {"payload.mass": 2.0})
    assert [c.name for c in loaded.chains] == ["crank", "rocker", "payload"]
    assert [c.name for c in nothing.chains] == ["crank", "rocker"] and loaded.tip == bare.tip
    one, two = np.array([0.01, 0, 0]), np.array([0.0, -0.1 + 0.02, 0])
    com = (0.5 * one + 1.5 * two) / 2
    tensor = np.diag([0.5e-3 + 2e-3, 1e-3 + 1.5e-3, 1e-3 + 2.5e-3])  # the box turned by 90 deg
    for mass, at in ((0.5, one), (1.5, two)):
        d = at - com
        tensor += mass * (d @ d * np.eye(3) - np.outer(d, d))
    wanted = bare.with_payload(crane.Payload("coupler_pin", 2.0, tuple(com), tensor))
    q = np.array([[1.2], [1.3], [1.0]])
    found, other = (crane.Dynamics(m).inverse(q, 1 + q, 2 * q) for m in (loaded, wanted))
    assert np.abs(found - other).max() < 1e-12 * np.abs(other).max()
    same, empty = (crane.Dynamics(m).mass_matrix(q) for m in (bare, nothing))
    assert np.array_equal(same, empty)


def test_a_mass_changes_the_weight_by_its_own(mini):
    """dV/dm = g z of that body's centre of mass."""
    heavy = crane.load("mini_forwarder", {"link4.mass": 0.301})
    gap = crane.Dynamics(heavy).energy(POSE, 0 * POSE)[1]
    gap -= crane.Dynamics(mini).energy(POSE, 0 * POSE)[1]
    data = mini.model.createData()
    pin.forwardKinematics(mini.model, data, mini.closure.solve(POSE))
    body = mini.model.getJointId("q6")
    centre = data.oMi[body].act(mini.model.inertias[body].lever)
    assert gap == pytest.approx(0.1 * 9.81 * centre[2], rel=1e-12)


def test_a_pin_moves_the_linkage(mini):
    """A2's rod eye further out: G stays A2's pin-to-pin length from E, so the boom turns."""
    moved = crane.load("mini_forwarder", {"link3_G.x": 0.097, "link3_G.y": 0.002})
    assert np.linalg.norm(tip(moved) - tip(mini)) > 1e-3
    data = moved.model.createData()
    pin.framesForwardKinematics(moved.model, data, moved.closure.solve(POSE))
    boom, pin_g, base = (data.oMf[moved.frame(name)] for name in ("link3", "link3_G", "A2_barrel"))
    assert np.allclose(boom.actInv(pin_g.translation), [0.097, 0.002, 0.0], atol=1e-15)
    length = np.linalg.norm(pin_g.translation - base.translation)
    assert length == pytest.approx(0.0825 + POSE[2], abs=1e-14)


def test_friction_control_and_limits():
    changed = {
        "friction.X1.coulomb": 20.0,
        "friction.q3.stiction": 0.5,
        "control.X2.kp": 17.0,
        "X1.upper": 0.025,
    }
    machine = crane.load("mini_forwarder", changed)
    assert machine.friction["X1"].coulomb == 20.0 and machine.friction["X1"].viscous == 600.4
    assert machine.friction["q3"].stiction == 0.5 and machine.friction["q3"].viscous == 0.4
    assert machine.control["X2"].kp == 17.0 and machine.control["X2"].ki == 20000
    assert machine.upper[1] == 0.025
    assert dict(machine.parameter_changes) == changed


def test_urdfs_can_be_changed_too():
    nominal = crane.load("ur5_robot")
    heavy = crane.load("ur5_robot", {"forearm_link.mass": 9.0})
    q = np.array([0.1, -1.0, 0.8, 0.3, 0.2, 0.1])
    assert np.abs(crane.Dynamics(heavy).gravity(q) - crane.Dynamics(nominal).gravity(q)).max() > 1


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"link3G.x": 1.0},
            "parameter 'link3G.x' is unknown, did you mean 'link3_G.x'? like it are "
            "'link3.x' and 'link3_H.x'; crane info mini_forwarder --names lists all names",
        ),
        ({"link7.mass": -1.0}, "parameter 'link7.mass' is -1 kg, it must not be negative"),
        (
            {"link7.mass": "heavy"},
            "parameter 'link7.mass' is 'heavy', give a number in kg, as in 5 t",
        ),
        ({"link7.mass": float("nan")}, "parameter 'link7.mass' is nan"),
        ({"friction.X1.coulomb": -1}, "coulomb of friction is -1, it must not be negative"),
        ({"friction.X1.stribeck": 0}, "stribeck of friction is 0"),
    ],
)
def test_what_cannot_be_is_refused(changes, message):
    with pytest.raises(InputError) as caught:
        crane.load("mini_forwarder", changes)
    assert str(caught.value).startswith(message) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "alike", "other"),
    [
        ("mini_forwarder", {"link3.mass": 0.25, "friction.X1.coulomb": 20.0}, {"link3_G.x": 0.1}),
        pytest.param(
            "patu655",
            {"payload.mass": 300.0, "valve.X_lift.c1": 6e-7},
            {"X_lift.upper": 0.4},
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "excavator",
            {"oil.bulk_modulus": 1e9, "bucket.mass": 400.0},
            {"slew.lower": -1.0},
            marks=pytest.mark.slow,
        ),
    ],
)
def test_numbers_that_leave_the_loops_alone_do_not_close_them_again(
    name, alike, other, monkeypatch
):
    """What comes of it is as if all had been loaded with these numbers, to the last bit."""
    variants, closings = MachineVariants(crane.load(name)), []
    closed = machine_loading.build_closure
    monkeypatch.setattr(
        machine_loading, "build_closure", lambda *x: closings.append(x) or closed(*x)
    )
    for changes, count in ((alike, 0), (other, 1), ({**alike, **other}, 0), ({}, 0)):
        closings.clear()
        found = variants.machine(changes)
        assert len(closings) == count
        anew = crane.load(name, changes)
        for machine in (found, anew):
            machine.closure.solve(machine.closure.home[machine.closure.active])
        runs = [crane.simulate(x, duration=0.05) for x in (found, anew)]
        assert np.array_equal(found.home, anew.home)
        assert found.active == anew.active and found.friction == anew.friction
        assert np.array_equal(runs[0].q, runs[1].q) and np.array_equal(runs[0].v, runs[1].v)


def test_a_geometry_that_does_not_close_is_refused():
    with pytest.raises(crane.CraneError, match="link3_G|A2_eye|X2|closed"):
        crane.load("mini_forwarder", {"link3_G.x": 0.4})


# --- locked joints ---------------------------------------------------------------------------


def test_a_locked_joint_stays_where_it_is_put(mini):
    """The tip of the machine with X2 and q1 locked is that of the whole machine there."""
    locked = crane.load("mini_forwarder", lock={"q1": 0.4, "X2": 0.013})
    assert locked.active == ("X1",) and set(locked.joints) == set(mini.joints) - {"q1", "X2"}
    for x1 in (0.002, 0.015, 0.028):
        assert np.abs(tip(locked, [x1]) - tip(mini, [0.4, x1, 0.013])).max() < 1e-12
    whole = crane.Dynamics(mini).inverse([0.4, 0.02, 0.013], [0, 0.01, 0], [0, 0.1, 0])
    alone = crane.Dynamics(locked).inverse([0.02], [0.01], [0.1])
    assert alone[0] == pytest.approx(whole[1], rel=1e-12)


def test_fingers_that_mimic_can_be_locked():
    """Either of the two may be given; if both are given they have to agree."""
    with pytest.raises(crane.CraneError, match="'panda_finger_joint2_mimic' does not allow"):
        crane.load("panda", lock={"panda_finger_joint1": 0.02, "panda_finger_joint2": 0.03})
    alone = crane.load("panda", lock={"panda_finger_joint2": 0.02})
    arm = crane.load("panda", lock={"panda_finger_joint1": 0.02, "panda_finger_joint2": 0.02})
    assert alone.joints == arm.joints
    assert len(arm.joints) == 7
    urdf = arm.path.read_text()
    whole = pin.buildModelFromXML(urdf)
    q = pin.neutral(whole)
    q[-2:] = 0.02
    wanted = pin.buildReducedModel(whole, [8, 9], q)
    rng = np.random.default_rng(1)
    q, v, a = rng.normal(size=(3, 7))
    tau = pin.rnea(wanted, wanted.createData(), q, v, a)
    bare = arm.replace(friction={})
    assert np.abs(crane.Dynamics(bare).inverse(q, v, a) - tau).max() < 1e-10


def test_what_cannot_be_locked():
    for lock, message in (
        ({"q12": 0.0}, "joint 'q12' to lock is unknown, did you mean 'q2'"),
        ({"q1": float("inf")}, "the coordinate to lock 'q1' at is inf"),
        (
            {"X1": 0.3},
            "joint 'X1' cannot be locked at 0.3 m, beyond its limits 0 to 0.03 "
            "(chain_b1.urdf:57), give a coordinate within them",
        ),
        ({"q1": 0, "X1": 0.01, "X2": 0.01}, "with q1, X1, X2 locked nothing drives the machine"),
    ):
        with pytest.raises(InputError) as caught:
            crane.load("mini_forwarder", lock=lock)
        assert str(caught.value).startswith(message)


def documented():
    """Patterns of the names in the documentation, and the fields that they stand for."""
    text = (Path(__file__).parents[1] / "docs" / "machine_file.md").read_text()
    section = text.split("## Names of parameters")[1].split("\n## ")[0]
    names = [name for row in section.splitlines() if row.startswith("| `")
             for name in re.findall("`([^`]+)`", row.split("|")[1])]  # fmt: skip
    return {name: name.replace(".", r"\.").replace("LINK", ".+").replace("JOINT", ".+")
            .replace("NAME", ".+")
            .replace("KEY", "[a-z0-9_]+")
            .replace("QUANTITY", ".+") for name in names}  # fmt: skip


@pytest.mark.parametrize("name", [*bundled_machines(), str(DATA / "four_bar.yaml")])
def test_every_name_is_documented(name):
    patterns = documented()
    for parameter in parameters(read_machine_spec(name)):
        assert any(re.fullmatch(x, parameter) for x in patterns.values()), parameter


def test_every_documented_name_is_one():
    every = (*bundled_machines(), DATA / "four_bar.yaml", DATA / "network.yaml")
    names = [x for name in every for x in parameters(read_machine_spec(name))]
    spec = read_machine_spec("patu655")
    valves = dict(spec.hydraulics.valves)
    valves["X_lift"] = dataclasses.replace(valves["X_lift"], spool_b=Spool("X_lift"))
    two = dataclasses.replace(spec.hydraulics, valves=valves)
    names += parameters(dataclasses.replace(spec, hydraulics=two))
    for name, pattern in documented().items():
        assert any(re.fullmatch(pattern, x) for x in names), name


def test_names_can_be_listed_and_changed(capsys):
    crane.cli.program()(args=["info", "mini_forwarder", "--parameters"], standalone_mode=False)
    listed = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert {
        name: float(f"{x:.6g}")
        for name, x in parameters(read_machine_spec("mini_forwarder")).items()
    } == {name: float(value) for name, value in listed}


def test_numbers_of_springs_stops_and_ropes(tmp_path):
    """By name, the second of a name too, and between frames; what cannot be is said."""
    machine = crane.load("kr300", changes={"gas_spring.stroke.pressure": 1.2e7,
                                           "gas_spring.stroke.exponent": 1.3})  # fmt: skip
    (gas,) = machine.gas_springs
    assert (gas.pressure, gas.exponent, gas.area) == (
        1.2e7, 1.3, crane.load("kr300").gas_springs[0].area
    )  # fmt: skip
    assert (
        crane.load("patu655", changes={"end_stop.slew.damping": 7.0}).end_stops[0].damping == 7.0
    )
    spec = read_machine_spec("mini_forwarder")
    ropes = (
        crane.description.Rope(("link1", "link7"), 0.5, 1e4),
        crane.description.Rope(("link1", "link7"), 0.6, 2e4),
    )
    springs = (crane.description.ForceElement("q1", stiffness=3.0),)
    spec = dataclasses.replace(spec, ropes=ropes, forces=springs)
    names = parameters(spec)
    assert names["rope.link1-link7.length"] == 0.5 and names["rope.link1-link7#2.length"] == 0.6
    new = apply_parameter_changes(spec, {"rope.link1-link7#2.length": 0.7, "spring.q1.rest": 0.1})
    assert [rope.length for rope in new.ropes] == [0.5, 0.7] and new.forces[0].rest == 0.1
    with pytest.raises(InputError, match="stiffness of .* is -1"):
        apply_parameter_changes(spec, {"spring.q1.stiffness": -1.0})
