"""Machines as transmissions of ros2_control, compiled against its interface."""

import shutil
import subprocess
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from command_line import typed

import crane
from crane.common.errors import InputError
from crane.export import write_ros2_control

DATA = Path(__file__).parent / "data" / "ros2_control"
HEADERS = (
    "hardware_interface/hardware_info.hpp",
    "hardware_interface/types/hardware_interface_type_values.hpp",
    "pluginlib/class_list_macros.hpp", "transmission_interface/exception.hpp",
    "transmission_interface/transmission.hpp", "transmission_interface/transmission_loader.hpp",
)  # fmt: skip
CASADI = find_spec("casadi")  # whose wheel has Eigen, as ROS has
EIGEN = [
    folder / "eigen3"
    for folder in (
        Path("/usr/include"),
        *(Path(x) / "include" for x in (CASADI and CASADI.submodule_search_locations) or ()),
    )
    if (folder / "eigen3").is_dir()
]
needs_compiler = pytest.mark.skipif(
    not (shutil.which("g++") and EIGEN), reason="no C++ compiler with Eigen is here"
)


class Plugin:
    """The transmission of a machine in a process of its own."""

    def __init__(self, machine, folder):
        write_ros2_control(machine, folder, name="m")
        for header in HEADERS:
            (folder / header).parent.mkdir(parents=True, exist_ok=True)
            (folder / header).write_text('#include "interface.hpp"\n')
        strict = ["-Wall", "-Wextra", "-Werror", "-pedantic", "-O1"]
        subprocess.run(["gcc", "-std=c99", *strict, "-c", "m.c"], cwd=folder, check=True)
        folders = [f"-I{DATA}", "-I.", "-isystem", str(EIGEN[0])]
        command = ["g++", "-std=c++17", *strict, *folders, "m_transmission.cpp", "m.o"]
        subprocess.run([*command, str(DATA / "run.cpp"), "-o", "run"], cwd=folder, check=True)
        self.machine, self.folder = machine, folder

    def run(self, joints, calls):
        """Statuses, values of actuators (3, n) and of joints (3, k) after calls.

        A call is 1 (actuator_to_joint) or 0, with values of actuators and of joints before it.
        """
        rows = [[method, *np.ravel(a), *np.ravel(j)] for method, a, j in calls]
        command = [str(self.folder / "run"), *self.machine.active, "--", *joints]
        given = np.array(rows, dtype=float).tobytes()
        done = subprocess.run(command, input=given, capture_output=True, timeout=60, check=False)
        self.messages = done.stderr.decode()
        if done.returncode:
            return None
        n, found = len(self.machine.active), np.frombuffer(done.stdout).reshape(len(rows), -1)
        return (
            found[:, 0],
            found[:, 1 : 1 + 3 * n].reshape(-1, 3, n),
            found[:, 1 + 3 * n :].reshape(-1, 3, len(joints)),
        )


def random_states(machine, count, seed=1):
    """Active positions near home, velocities, and forces of actuators and joints."""
    random, n = np.random.default_rng(seed), len(machine.active)
    units = machine.closure.units[machine.closure.active]
    q_a = machine.home[machine.closure.active] + 0.05 * units * random.uniform(-1, 1, (count, n))
    return q_a, *random.normal(size=(2, count, n)), random.normal(size=(count, machine.model.nv))


def fixed_ratio_forces(ratios, tau):
    """joint_to_actuator of FourBarLinkageTransmission of ros2_control for efforts.

    With ratios n_1, n_2 of the actuators and m_1, m_2 of the joints, as corrected by
    ros-controls/ros2_control#1837, and as published until then.
    """
    (n_1, n_2), (m_1, m_2) = ratios
    corrected = (tau[0] - tau[1] / m_2) / (m_1 * n_1), tau[1] / (m_2 * n_2)
    published = tau[0] / (m_1 * n_1), (tau[0] + tau[1] / m_2) / n_2
    return np.array(corrected), np.array(published)


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("name", ["patu655", "mini_forwarder"])
def test_positions_velocities_and_efforts_are_those_of_the_library(tmp_path, name):
    machine = crane.load(name)
    plugin, expected = Plugin(machine, tmp_path), crane.motion.Transmission(machine)
    q_a, v_a, f_a, tau = random_states(machine, 50)
    n, nq = len(machine.active), machine.model.nv
    ahead = [(1, (q, v, f), np.zeros((3, nq))) for q, v, f in zip(q_a, v_a, f_a, strict=True)]
    statuses, _, joints = plugin.run(machine.joints, ahead)
    assert (statuses == 1).all()
    for (_, actuators, _), found in zip(ahead, joints, strict=True):
        state = expected.update(machine.active, *actuators)
        assert np.abs(found[0] - state.position).max() < 1e-13
        assert np.abs(found[1] - state.velocity).max() < 1e-12 * np.abs(state.velocity).max()
        assert np.abs(found[2] - state.effort).max() < 1e-13
    # with other forces at the joints back to the actuators
    back = [
        (0, np.zeros((3, n)), (*found[:2], forces))
        for found, forces in zip(joints, tau, strict=True)
    ]
    statuses, actuators, _ = plugin.run(machine.joints, back)
    assert (statuses == 1).all()
    assert np.abs(actuators[:, 0] - q_a).max() < 1e-13
    assert np.abs(actuators[:, 1] - v_a).max() < 1e-12
    powers = (actuators[:, 2] * v_a).sum(axis=1), (tau * joints[:, 1]).sum(axis=1)
    assert np.abs(powers[0] - powers[1]).max() < 1e-13 * np.abs(tau * joints[:, 1]).max()


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "booms"),
    [("patu655", ("slew", "q2", "q3", "X_ext")), ("mini_forwarder", ("q1", "q2", "q3"))],
)
def test_booms_in_place_of_cylinders_keep_the_power(tmp_path, name, booms):
    machine = crane.load(name)
    plugin, columns = Plugin(machine, tmp_path), [machine.column(x) for x in booms]
    q_a, v_a, f_a, _ = random_states(machine, 200)
    q, none = machine.closure.solve(q_a), np.zeros((3, len(booms)))
    tau = np.random.default_rng(3).normal(size=v_a.shape)
    given = [
        (0, none, (x[columns], machine.closure.gamma(x)[columns] @ v, t))
        for x, v, t in zip(q, v_a, tau, strict=True)
    ]
    statuses, actuators, joints = plugin.run(booms, given)
    assert (statuses == 1).all()
    assert np.abs(actuators[:, 0] - q_a).max() < 1e-13  # the inverse of the closed loops
    assert np.abs(actuators[:, 1] - v_a).max() < 1e-12
    powers = (actuators[:, 2] * v_a).sum(axis=1), (tau * joints[:, 1]).sum(axis=1)
    assert np.abs(powers[0] - powers[1]).max() < 1e-13 * np.abs(tau * joints[:, 1]).max()
    given = [(1, (x, v, f), none) for x, v, f in zip(q_a, v_a, f_a, strict=True)]
    statuses, _, joints = plugin.run(booms, given)
    assert (statuses == 1).all()
    powers = (f_a * v_a).sum(axis=1), (joints[:, 2] * joints[:, 1]).sum(axis=1)
    assert np.abs(powers[0] - powers[1]).max() < 1e-12 * np.abs(f_a * v_a).max()


def test_fixed_ratios_lose_power_on_four_bars():
    machine = crane.load("mini_forwarder")  # its jib depends on one cylinder, its boom on both
    rows, columns = [machine.column(x) for x in ("q3", "q2")], [2, 1]
    gamma = machine.closure.gamma(machine.home)[np.ix_(rows, columns)]
    second = -gamma[0, 0] / gamma[1, 0]
    ratios = (1 / gamma[0, 0], 1 / (gamma[1, 1] * second)), (1.0, second)  # exact at home
    q_a, v_a, _, _ = random_states(machine, 200)
    tau = np.random.default_rng(3).normal(size=(len(q_a), 2))
    shares = []
    for q, t in zip([machine.home, *machine.closure.solve(q_a)], [tau[0], *tau], strict=True):
        exact = t @ machine.closure.gamma(q)[np.ix_(rows, columns)]
        found = fixed_ratio_forces(ratios, t)
        shares.append([np.abs(x - exact).max() / np.abs(exact).max() for x in found])
    assert shares[0][0] < 1e-14 < 0.1 < shares[0][1]
    assert np.median(shares[1:], axis=0).min() > 0.02


@needs_compiler
@pytest.mark.slow
def test_what_cannot_be_is_an_exception_and_nothing_moves(tmp_path):
    machine = crane.load("patu655")
    plugin = Plugin(machine, tmp_path)
    home = machine.home[machine.closure.active]
    none, joints = np.zeros(4), np.full((3, 2), 7.0)
    calls = [(1, (home, none, none), joints), (1, (home - 2.0, none, none), joints)]
    calls.append((1, (home * np.nan, none, none), joints))
    plugin.run(("slew", "q2"), calls[:1])
    assert "give positions of all actuators, and these or as many joints" in plugin.messages
    joints = np.full((3, 4), 7.0)
    calls = [(method, actuators, joints) for method, actuators, _ in calls]
    statuses, _, found = plugin.run(("slew", "q2", "q3", "X_ext"), calls)
    assert statuses.tolist() == [1, 0, 1]
    assert "the loops do not close on the branch of home" in plugin.messages
    assert (found[1:] == 7.0).all()
    plugin.run(("slew", "q2", "q3", "nose"), calls)
    assert "'nose' is not in the machine by name or role" in plugin.messages


def test_the_command_line_writes_a_package(tmp_path):
    assert typed("export", "kr300", "--to", "ros2_control", "--out", tmp_path).returncode == 0
    assert "find_package(transmission_interface" in (tmp_path / "CMakeLists.txt").read_text()
    assert 'name="kr300/Transmission"' in (tmp_path / "kr300_plugins.xml").read_text()
    assert "<name>kr300</name>" in (tmp_path / "package.xml").read_text()


def test_a_base_that_floats_is_refused(tmp_path):
    with pytest.raises(InputError, match="has a floating base"):
        write_ros2_control(crane.load("excavator", floating=True), tmp_path / "out")
