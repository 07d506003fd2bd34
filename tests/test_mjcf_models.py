"""MJCF models of other authors: accelerations and holding forces equal MuJoCo's."""

import warnings
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from warned import quiet

import crane
from crane.common.errors import CraneError, CraneWarning

pytest.importorskip("mujoco")
from mujoco_oracle import Oracle  # noqa: E402

FILES = Path(__file__).parent / "data" / "mjcf"
REACH = {  # [rad], [m] about home that active coordinates are drawn from
    "ankle": 0.15, "delta": 0.2, "differential": 0.3, "excavator": 0.05, "flyer": 0.6,
    "gantry": 0.2, "gripper": 0.05, "hexapod": 0.03, "leg": 0.05, "struts": 0.2, "walker": 0.2,
    "welded": 0.15, "wrist": 0.15,
}  # fmt: skip
TOLERANCE = 1e-9


@cache
def loaded(name):
    return quiet(crane.load, FILES / f"{name}.xml")


def states(machine, reach, count=6):
    random = np.random.default_rng(0)
    home = machine.home[machine.closure.active]
    for _ in range(count):
        step, v_a, tau = random.uniform(-1, 1, (3, len(home)))
        yield np.clip(home + reach * step, machine.lower, machine.upper), v_a, tau


@pytest.mark.parametrize("name", REACH)
def test_accelerations_are_those_of_mujoco(name):
    """Under random forces of the active joints, closed exactly, at random postures and rates."""
    machine = loaded(name)
    oracle, dynamics = Oracle(FILES / f"{name}.xml", machine), crane.Dynamics(machine)
    for q_a, v_a, tau in states(machine, REACH[name]):
        q = machine.closure.solve(q_a)
        gamma = machine.closure.gamma(q)
        v = gamma @ v_a
        oracle.place(q, v)
        assert oracle.gap < TOLERANCE
        along = np.zeros(machine.model.nv)
        along[machine.closure.active] = tau * np.diag(dynamics.mass_matrix(q_a))
        a_a = dynamics.forward(q_a, v_a, along[machine.closure.active], friction=True)
        found = oracle.motion(q, v, gamma @ a_a + machine.closure.drift(q, v))
        wanted = oracle.accelerations(oracle.forces(q, along))
        np.testing.assert_allclose(found, wanted, rtol=0, atol=TOLERANCE * np.abs(wanted).max())


@pytest.mark.parametrize("name", REACH)
def test_holding_forces_are_those_of_mujoco(name):
    """At rest the active forces carry weights, springs and tendons, with what the loops carry."""
    machine = loaded(name)
    oracle, dynamics = Oracle(FILES / f"{name}.xml", machine), crane.Dynamics(machine)
    for q_a, _, _ in states(machine, REACH[name]):
        q, rest = machine.closure.solve(q_a), np.zeros(len(q_a))
        oracle.place(q, np.zeros(machine.model.nv))
        along = np.zeros(machine.model.nv)
        along[machine.closure.active] = dynamics.bias(q_a, rest)
        left = oracle.unbalanced(oracle.forces(q, along))
        scale = np.abs(oracle.data.qfrc_bias).max()
        np.testing.assert_allclose(left, 0.0, rtol=0, atol=TOLERANCE * max(scale, 1e-3))


def acting(oracle, q, drive):
    """Forces (nv,) of MuJoCo's actuator of a drive, per force."""
    model, data, (first, *_) = oracle.model, oracle.data, drive.factors
    for i in range(model.nu):
        target = model.actuator_trnid[i, 0]
        by_tendon = model.actuator_trntype[i] == 3
        if (model.tendon(target).name if by_tendon else oracle.names[target]) == drive.name:
            row = np.zeros(model.nv)
            start, count = data.moment_rowadr[i], data.moment_rownnz[i]
            row[data.moment_colind[start : start + count]] = data.actuator_moment[start:][:count]
            return row
    along = np.zeros(oracle.machine.model.nv)  # a slide of a free joint
    along[oracle.machine.column(first)] = 1.0
    return oracle.forces(q, along)


@pytest.mark.parametrize("name", ["differential", "excavator", "gantry", "gripper", "leg"])
def test_drives_act_as_mujoco_s_actuators(name):
    """Joints and tendons alike: accelerations under the drives' forces."""
    machine = loaded(name)
    oracle, dynamics = Oracle(FILES / f"{name}.xml", machine), crane.Dynamics(machine)
    random = np.random.default_rng(1)
    for q_a, v_a, _ in states(machine, REACH[name], 3):
        q = machine.closure.solve(q_a)
        gamma = machine.closure.gamma(q)
        v = gamma @ v_a
        oracle.place(q, v)
        u = random.uniform(-1, 1, len(machine.drives)) * dynamics.mass_matrix(q_a).max()
        force = sum(
            x * acting(oracle, q, drive) for x, drive in zip(u, machine.drives, strict=True)
        )
        wanted = oracle.accelerations(force)
        a_a = dynamics.forward(q_a, v_a, dynamics.active_forces(q_a, u), friction=True)
        found = oracle.motion(q, v, gamma @ a_a + machine.closure.drift(q, v))
        np.testing.assert_allclose(found, wanted, rtol=0, atol=TOLERANCE * np.abs(wanted).max())


def test_what_the_files_drive():
    """Tendons with their factors; doubled actuators once; of free joints their parts."""
    drives = {name: {x.name: dict(x.factors) for x in loaded(name).drives} for name in REACH}
    assert drives["gripper"] == {"split": {"right_driver": 0.5, "left_driver": 0.5}}
    assert drives["differential"] == {
        "one": {"one": 1.0}, "rope": {"four": -6.0}, "two": {"two": 1.0}, "wheel": {"wheel": 1.0},
    }  # fmt: skip
    parts = [f"hull_{x}" for x in ("x", "y", "z", "rx", "ry", "rz")]
    assert list(drives["flyer"]) == [*parts, "pan", "tilt"]
    assert set(loaded("gripper").free) == {"left_follower", "right_follower"}
    assert loaded("leg").free == ("shin", "tarsus", "rod_rx")
    assert not any(loaded(name).free for name in set(REACH) - {"gripper", "leg", "walker"})


def test_machine_files_hold_drives_along_several_joints(tmp_path):
    machine = loaded("gripper")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        again = crane.load(crane.write_machine(machine, tmp_path / "gripper"))
    assert {x.name: dict(x.factors) for x in again.drives} == {
        "split": {"right_driver": 0.5, "left_driver": 0.5}
    }
    file = tmp_path / "gripper" / "gripper.yaml"
    text = file.read_text()
    for old, new, line in (
        ("left_driver: 0.5}", "left_diver: 0.5}", "joint 'left_diver' is unknown, did you mean"),
        ("left_driver: 0.5}", "left_driver: 0}", "the factor of 'left_driver' is 0, leave it out"),
        ("{right_driver: 0.5, left_driver: 0.5}", "{}", "drive 'split' moves no joint, name some"),
    ):
        assert old in text
        file.write_text(text.replace(old, new))
        with pytest.raises(CraneError, match=line):
            crane.load(file)


def test_rotors_springs_and_dampers_are_those_of_the_files():
    """Of joints, tendons (c^2 times theirs) and actuators (gear^2 times theirs)."""
    differential, gantry, flyer = (loaded(x) for x in ("differential", "gantry", "flyer"))
    rotors = dict(zip(differential.joints, differential.model.armature, strict=True))
    assert rotors["one"] == 0.3
    assert rotors["four"] == pytest.approx(9 * 0.5 + 9 * 2**2 * 0.1, rel=1e-14)
    assert differential.friction["four"].viscous == pytest.approx(9 * 2 + 9 * 4 * 0.3, rel=1e-14)
    (spring,) = (x for x in differential.forces if x.joint == "four")
    assert (spring.stiffness, spring.rest) == pytest.approx((9 * 40, -0.1), rel=1e-14)
    sway = gantry.model.armature[gantry.column("sway")]
    assert sway == pytest.approx(2**2 * 0.03, rel=1e-14)
    slides = [flyer.column(f"hull_{x}") for x in "xyz"]
    assert list(flyer.model.armature[slides]) == [0.7] * 3
    assert flyer.model.armature[flyer.column("hull_rx")] == 0.7


@pytest.mark.parametrize("name", sorted(REACH))
def test_written_again_the_machine_is_the_same(name, tmp_path):
    machine = loaded(name)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        crane.formats.write_mjcf(machine, tmp_path / "again.xml")
        again = crane.load(tmp_path / "again.xml")
    assert again.joints == machine.joints and set(again.active) == set(machine.active)
    assert {x.name: dict(x.factors) for x in again.drives} == {
        x.name: dict(x.factors) for x in machine.drives
    }
    assert again.free == machine.free
    order = [machine.active.index(joint) for joint in again.active]
    one, two = crane.Dynamics(machine), crane.Dynamics(again)
    for q_a, v_a, tau in states(machine, REACH[name], 3):
        wanted = one.inverse(q_a, v_a, tau)[order]
        found = two.inverse(q_a[order], v_a[order], tau[order])
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-11 * np.abs(wanted).max())
