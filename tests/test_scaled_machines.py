"""A machine scaled to other sizes closes, moves and is checked as the original.

Lengths times s, masses times s^3 or another factor, times by the root of s: every number of the
mechanics follows from those of the machine as it is by one factor (`scaled_machines.py`).
"""

import re
from functools import cache

import numpy as np
import pytest
import test_random_linkages
from broken_machines import DATA, MODELS
from scaled_machines import Scale
from warned import quiet

import crane
from crane.common.errors import CraneError

SIZES = [(1e-3, None), (1e-2, None), (1e2, None), (1e4, None), (1.0, 1e-9), (1.0, 1e9)]
FEW = [(1e-3, None), (1e4, None), (1.0, 1e-9)]
QUICK = ["slider_crank.yaml", "four_bar.yaml", "five_bar.urdf"]
SLOW = ["six_bar.urdf", "sarrus.urdf", "four_bar_loop.urdf", "stewart.urdf", "mini_forwarder.yaml",
        "patu655.yaml", "kr300.yaml", "random"]  # fmt: skip
LARGE = {"stewart.urdf"}  # whose formulas take long to compile
FAR = re.compile("is a long way|denser than any metal")  # what is told of sizes


def path_of(name, folder):
    if name == "random":
        return test_random_linkages.linkage(
            folder, (0, 1, 2, 0, 4), (False, True, False, False, False), [(3, 5)], 7
        )
    return MODELS / name if (MODELS / name).exists() else DATA / name


def written(name, scale, folder):
    (folder / "as_it_is").mkdir(parents=True, exist_ok=True)
    return scale.write(path_of(name, folder / "as_it_is"), folder / f"{scale.s:g}_{scale.m:g}")


@cache
def moved(name, scale, folder, backend):
    """What a machine of some size answers, brought back to that as it is."""
    path = written(name, scale, folder)
    report = quiet(crane.check, path)
    found = {
        (finding.is_error, re.sub(r"[-+]?\d[\d.e+-]*", "#", finding.message))
        for finding in report.findings
        if not FAR.search(finding.message)
    }
    machine = quiet(crane.load, path)
    closure, n, random = machine.closure, len(machine.active), np.random.default_rng(0)
    coordinate, rate, acceleration, force = (
        scale.of(machine, what) for what in ("coordinate", "rate", "acceleration", "force")
    )
    home = machine.home[closure.active] / coordinate
    q_a = np.clip(
        home + random.uniform(-0.05, 0.05, (12, n)),
        machine.lower / coordinate,
        machine.upper / coordinate,
    )
    q_a, v_a, a_a = q_a * coordinate, *random.normal(size=(2, 12, n))
    every = scale.of(machine, "coordinate", machine.joints)
    q = closure.solve(q_a)
    gaps = [
        np.abs(closure.equations.evaluate_scaled(one)[0][closure.structure.independent_rows]).max()
        for one in q
    ]
    dynamics = crane.Dynamics(machine, backend=backend)
    tau = dynamics.inverse(q_a, v_a * rate, a_a * acceleration)
    recording = quiet(
        crane.simulate,
        machine,
        initial=(q_a[0], 0.3 * v_a[0] * rate),
        duration=0.1 * scale.time,
        step=1e-3 * scale.time,
        backend=backend,
    )
    energy = scale.by((2, 1, -2))
    answers = {
        "q": q / every,
        "gamma": closure.gamma(q) * coordinate / every[:, None],
        "mass": dynamics.mass_matrix(q_a) * coordinate * coordinate[:, None] / scale.by((2, 1, 0)),
        "inverse": tau / force,
        "forward": dynamics.forward(q_a, v_a * rate, 0.5 * tau) / acceleration,
        "condition": closure.condition_number(q),
        "motion": recording.q / coordinate,
        "kinetic": recording.channels["kinetic"] / energy,
    }
    return found, max(gaps), answers


def assert_similar(name, size, folder, backend):
    expected, _, as_it_is = moved(name, ONE, folder, backend)
    found, gap, answers = moved(name, Scale(*size), folder, backend)
    assert found == expected
    assert gap < 1e-14
    for what, values in answers.items():
        wanted = as_it_is[what]
        off = np.abs(values - wanted).max() / np.abs(wanted).max()
        assert off < (1e-6 if what in ("motion", "kinetic") else 1e-9), what


ONE = Scale(1.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("scales")


@pytest.mark.parametrize("size", FEW)
@pytest.mark.parametrize("name", QUICK)
def test_machines_of_any_size_are_the_same_machine(name, size, folder):
    assert_similar(name, size, folder, "compiled")


@pytest.mark.slow
@pytest.mark.parametrize(
    "size", [x if x == FEW[1] else pytest.param(x, marks=pytest.mark.long) for x in SIZES]
)
@pytest.mark.parametrize(
    "name", [*(pytest.param(x, marks=pytest.mark.long) for x in QUICK), *SLOW]
)
def test_all_machines_at_all_sizes(name, size, folder):
    for backend in ("pinocchio", "compiled")[: 1 if name in LARGE else 2]:
        assert_similar(name, size, folder, backend)


@pytest.mark.slow
@pytest.mark.parametrize("s", [1e-3, pytest.param(1e4, marks=pytest.mark.long)])
@pytest.mark.parametrize("name", ["five_bar.urdf", "mini_forwarder.yaml"])
def test_workspaces_of_any_size(name, s, folder):
    frame = {"frame": "rod_a"} if name == "five_bar.urdf" else {}
    one, other = (
        crane.workspace(quiet(crane.load, written(name, scale, folder)), **frame)
        for scale in (ONE, Scale(s))
    )
    assert other.closed_share == pytest.approx(one.closed_share, rel=1e-9)
    assert other.area == pytest.approx(one.area * s**2, rel=1e-9)
    for found, wanted in zip(other.extremes, one.extremes, strict=True):
        assert found.value == pytest.approx(wanted.value * s, rel=1e-6)
    assert len(other.curves) == len(one.curves)


@pytest.mark.parametrize("s", [1e-3, 1e4])
def test_tips_are_reached_at_any_size(s, folder):
    machine = quiet(crane.load, written("slider_crank.yaml", Scale(s), folder))
    kinematics = crane.Kinematics(machine)
    q_a = np.linspace(0.5, 2.5, 100)[:, None]
    found = kinematics.inverse(kinematics.position(q_a), q_a[0])
    assert np.abs(found - q_a).max() < 1e-9
    with pytest.raises(CraneError, match="cannot reach"):
        kinematics.inverse(np.array([2.0, 0.0, 0.0]) * s)


@pytest.mark.parametrize("s", [1e-3, 1e4])
def test_a_loop_that_stays_open_is_told_at_any_size(s, folder):
    """The error gives the gap in metres."""
    told = {}
    for scale in (ONE, Scale(s)):
        path = written("four_bar.yaml", scale, folder / "open")
        rod = path.parent / "four_bar" / "rocker.urdf"
        length = f'xyz="{0.3 * scale.s!r}'
        assert length in rod.read_text()
        rod.write_text(rod.read_text().replace(length, f'xyz="{9 * scale.s!r}'))
        with pytest.raises(CraneError, match="cannot be closed") as caught:
            quiet(crane.load, path)
        told[scale.s] = float(re.search(r"stays (\S+) m open", str(caught.value))[1])
    assert told[s] == pytest.approx(told[1.0] * s, rel=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("s", [1e-3, 1e4])
def test_base_parameters_are_those_of_the_machine(s, folder):
    """Groups of masses, first moments and inertias, whose factors have powers of a length."""
    from crane.identification.mechanics.base_parameters import base_parameters
    from crane.identification.mechanics.identification_model import IdentificationModel

    one, other = (
        base_parameters(
            IdentificationModel(quiet(crane.load, written("mini_forwarder.yaml", scale, folder)))
        )
        for scale in (ONE, Scale(s))
    )
    assert one.names == other.names and one.unobservable == other.unobservable
    assert (one.independent == other.independent).all()


def test_masses_beyond_what_counts_are_told_in_a_line(folder):
    """Two discs on one axis: I1 + I2 is I2 in floating point, and M_A is singular."""
    body = '<inertial><mass value="{0}"/><inertia ixx="{0}" ixy="0" ixz="0" iyy="{0}" iyz="0"'
    body += ' izz="{0}"/></inertial>'
    path = folder / "discs.urdf"
    path.write_text(
        '<robot name="discs"><link name="base"/>'
        f'<link name="light">{body.format(0.01)}</link>'
        f'<link name="heavy">{body.format(1e30)}</link>'
        '<joint name="one" type="continuous"><parent link="base"/><child link="light"/>'
        '<axis xyz="0 0 1"/></joint>'
        '<joint name="two" type="continuous"><parent link="light"/><child link="heavy"/>'
        '<axis xyz="0 0 1"/></joint></robot>'
    )
    dynamics = crane.Dynamics(quiet(crane.load, path), backend="pinocchio")
    with pytest.raises(CraneError, match="the mass matrix is singular at one = 0, two = 0"):
        dynamics.forward([0.0, 0.0], [0.0, 0.0], [1.0, 1.0])


@pytest.mark.parametrize(("mass", "told"), [(1e-12, ""), (1.0, ""), (1e9, "")])
def test_inertias_are_judged_by_their_mass(mass, told):
    from crane.description.kinematic_tree import inertia_problem

    size = 1e-6  # [m]
    assert str(inertia_problem(mass, mass * size**2 * np.eye(3)) or "") == told
    assert "no inertia" in str(inertia_problem(mass, np.zeros((3, 3))))
    long = mass * size**2 * np.diag([1.0, 1.0, 3.0])
    assert "no possible body" in str(inertia_problem(mass, long))
