"""Loop closure against closed forms and differences, for each type of loop."""

import re
import warnings

import numpy as np
import oracles
import pinocchio as pin
import pytest
from executed_lines import at_most
from hypothesis import given
from hypothesis import strategies as st

import crane
from crane.common.errors import (
    ClosureError,
    CraneWarning,
    InputError,
    MechanismError,
    OutOfReachError,
    SingularConfigurationError,
    WrongBranchError,
)

STROKE = 0.030  # [m]
CRANK = oracles.SliderCrank()


def strokes(count, seed=0):
    """(count, 3) active coordinates anywhere."""
    random = np.random.default_rng(seed)
    return random.uniform([-3.1, 0.0, 0.0], [3.1, STROKE, STROKE], (count, 3))


def columns(machine, names):
    return [machine.column(name) for name in names]


def poses(machine, q, *links):
    data = machine.model.createData()
    pin.framesForwardKinematics(machine.model, data, q)
    return [data.oMf[machine.frame(link)].copy() for link in links]


def check_gamma_and_drift(machine, q_a, v_a, step, accuracy):
    """Against differences of solve and gamma along the straight line q_A + v_A t."""
    closure = machine.closure
    q = closure.solve(q_a)
    gamma = closure.gamma(q)
    for column, direction in enumerate(np.eye(len(q_a))):
        slope = oracles.derivative(lambda t: closure.solve(q_a + t * direction), step[column])  # noqa: B023
        assert np.abs(gamma[:, column] - slope).max() < accuracy * np.abs(gamma[:, column]).max()
    v = gamma @ v_a
    rate = oracles.derivative(
        lambda t: closure.gamma(closure.solve(q_a + t * v_a)) @ v_a,
        np.min(step[v_a != 0] / np.abs(v_a[v_a != 0])),
    )
    drift = closure.drift(q, v)
    assert np.abs(drift - rate).max() < accuracy * np.abs(drift).max()


# --- the mini forwarder ----------------------------------------------------------------------


def test_passive_joints_and_tip_equal_the_closed_form(mini):
    x1, x2 = (x.ravel() for x in np.meshgrid(*2 * [np.linspace(0.0, STROKE, 31)]))
    turn = np.linspace(-3, 3, len(x1))
    q_a = np.column_stack([turn, x1, x2])
    q = mini.closure.solve(q_a)
    joints, tip = oracles.mini_forwarder(x1, x2)
    for name in oracles.PASSIVE:
        # rounding times dq9/dX1 and the closed form's own loss of digits in acos
        assert np.abs(q[:, mini.column(name)] - joints[name]).max() < 1e-12, name
    expected = np.column_stack([tip[0] * np.cos(turn), tip[0] * np.sin(turn), tip[1]])
    assert np.abs(crane.Kinematics(mini).position(q_a) - expected).max() < 5e-13


def test_gamma_equals_the_closed_form(mini):
    q_a = strokes(1000, seed=1)
    gamma = mini.closure.gamma(mini.closure.solve(q_a))
    exact = oracles.mini_forwarder_gamma(q_a[:, 1], q_a[:, 2])
    assert np.array_equal(gamma[:, mini.closure.active], np.broadcast_to(np.eye(3), (1000, 3, 3)))
    for name in oracles.PASSIVE:
        row = gamma[:, mini.column(name)]
        assert np.all(row[:, 0] == 0)  # slewing moves no pin in the plane
        assert np.abs(row[:, 1:] - exact[name]).max() < 1e-12 * np.abs(exact[name]).max(), name


def test_loops_solve_one_after_the_other(mini, stewart):
    assert [len(rows) for rows, _ in mini.closure.structure.blocks] == [2, 2, 2, 2]
    assert len(mini.closure.structure.redundant_rows) == 12  # 4 spatial pins in a plane
    assert sum(len(rows) for rows, _ in stewart.closure.structure.blocks) == 15


@given(
    st.floats(-3.1, 3.1), st.floats(0.0, STROKE), st.floats(0.0, STROKE), st.floats(-1.0, 1.0),
    st.floats(-1.0, 1.0),
)  # fmt: skip
def test_any_posture(mini, q1, x1, x2, v1, v2):
    q = mini.closure.solve([q1, x1, x2])
    assert mini.closure.residual(q) < 2e-14
    joints, _ = oracles.mini_forwarder(np.array([x1]), np.array([x2]))
    slopes = oracles.mini_forwarder_gamma(np.array([x1]), np.array([x2]))
    gamma = mini.closure.gamma(q)
    for name in oracles.PASSIVE:
        assert abs(q[mini.column(name)] - joints[name][0]) < 1e-12
        assert np.abs(gamma[mini.column(name), 1:] - slopes[name][0]).max() < 1e-10
    velocity = gamma @ [1.0, v1, v2]
    jacobian = mini.closure.equations.evaluate(q)[1]
    assert np.abs(jacobian @ velocity).max() < 1e-14 * max(1.0, np.abs(velocity).max())


def test_gamma_and_drift_against_differences(mini):
    random = np.random.default_rng(4)
    for q_a in strokes(25, seed=4):
        q_a[1:] = np.clip(q_a[1:], 1e-3, STROKE - 1e-3)
        v_a = random.uniform(-1, 1, 3) * [1.0, 0.01, 0.01]
        check_gamma_and_drift(mini, q_a, v_a, np.array([0.1, 1e-4, 1e-4]), 1e-9)


# --- stacks and single samples ---------------------------------------------------------------


def test_guesses_do_not_change_the_answer(mini):
    targets, guesses = strokes(60, seed=6), mini.closure.solve(strokes(60, seed=7))
    for target, guess in zip(targets, guesses, strict=True):
        alone = mini.closure.solve(target)
        assert np.abs(mini.closure.solve(target, initial_guess=guess) - alone).max() < 1e-12
        near = mini.closure.solve(target, initial_guess=alone + 1e-4)  # beside the answer
        assert np.abs(near - alone).max() < 1e-12
    guessed = mini.closure.solve(targets, initial_guess=guesses[0])
    assert np.abs(guessed - mini.closure.solve(targets)).max() < 1e-12


def test_stacks_equal_single_samples(mini):
    closure = mini.closure
    q = closure.solve(strokes(7, seed=8))
    v = np.einsum("ijk,k->ij", closure.gamma(q), [0.3, 0.01, -0.02])
    assert closure.gamma(q).shape == (7, 11, 3) and closure.drift(q, v).shape == (7, 11)
    assert np.array_equal(closure.gamma(q), [closure.gamma(one) for one in q])
    assert np.array_equal(closure.drift(q, v), [closure.drift(*one) for one in zip(q, v)])  # noqa: B905
    assert np.array_equal(closure.residual(q), [closure.residual(one) for one in q])
    assert closure.gamma(q[:1]).shape == (1, 11, 3)
    assert closure.solve([[0.0, 0.01, 0.01]]).shape == (1, 11)
    # one posture for a stack of velocities
    assert np.array_equal(closure.drift(q[0], v), [closure.drift(q[0], one) for one in v])
    path = strokes(1, seed=8) + 0.05 * strokes(20, seed=9)
    stack = closure.solve(path, initial_guess=q[0])
    first = closure.solve(path[0], initial_guess=q[0])
    with at_most(10 * len(path)):
        assert np.array_equal(stack, [first, *map(closure.solve, path[1:])])


def test_home_is_closed_and_cannot_be_overwritten(mini):
    assert np.array_equal(mini.home[mini.closure.active], [0.0, 0.0221, 0.0108])
    assert mini.closure.residual(mini.home) < 1e-15
    with pytest.raises(ValueError):
        mini.home[0] = 1.0
    before = mini.home.copy()
    mini.closure.solve(mini.home[mini.closure.active])[:] = 0.0
    assert np.array_equal(mini.home, before)


# --- a five-bar, whose active coordinates leave holes ----------------------------------------


def reachable(a, b):
    distance = np.hypot(*np.subtract(*oracles.five_bar_tips(a, b)))
    return 1e-3 < distance < 0.5 - 1e-6


def from_closed_form(machine, q):
    """Distance of the passive angles to the closed form, whole turns left out."""
    a, b, c, d = q[columns(machine, "abcd")]
    return np.abs(np.angle(np.exp(1j * (np.array([c, d]) - oracles.five_bar(a, b))))).max()


@pytest.mark.slow
def test_far_samples_stay_on_the_branch_around_holes(five_bar):
    """Half of all crank angles cannot be closed, so straight paths lead through gaps."""
    q_a = np.random.default_rng(14).uniform(-3, 3, (240, 2))
    found, missed = [], 0
    for sample in q_a:
        if not reachable(*sample):
            with pytest.raises(
                (OutOfReachError, SingularConfigurationError), match="'meeting' (cannot|is at)"
            ):
                five_bar.closure.solve(sample)
            continue
        try:
            q = five_bar.closure.solve(sample)
        except OutOfReachError as error:  # the straight way from home is barred
            assert "'meeting' can be closed" in str(error) and "straight" in str(error)
            missed += 1
            continue
        # near stretched rods an angle is the root of the loop's rounding
        assert from_closed_form(five_bar, q) < 1e-7
        found.append(q)
    assert len(found) > 100 and missed < 0.03 * len(found)
    random = np.random.default_rng(15)
    for q, guess in random.choice(found, (150, 2)):
        again = five_bar.closure.solve(q[five_bar.closure.active], initial_guess=guess)
        assert from_closed_form(five_bar, again) < 1e-7
    stack = five_bar.closure.solve(np.array(found)[:, five_bar.closure.active])
    assert max(from_closed_form(five_bar, q) for q in stack) < 1e-7


def test_five_bar_gamma_equals_the_closed_form(five_bar):
    rows, h = columns(five_bar, "cd"), oracles.COMPLEX_STEP
    for a, b in ((0.0, 0.0), (0.4, -0.3), (-0.2, 0.3), (0.1, 0.6)):
        gamma = five_bar.closure.gamma(five_bar.closure.solve([a, b]))[rows]
        slopes = [oracles.five_bar(a + 1j * h, b), oracles.five_bar(a, b + 1j * h)]
        exact = np.imag(slopes).T / h
        assert np.abs(gamma - exact).max() < 1e-13 * np.abs(exact).max()


# --- slider-crank ----------------------------------------------------------------------------


def test_slider_crank_equals_its_closed_form(slider_crank):
    theta = np.linspace(0.1, 3.0, 200)
    q = slider_crank.closure.solve(theta[:, None])
    phi, s = (slider_crank.column(name) for name in ("phi", "s"))
    psi, slide = CRANK.position(theta)
    # loops close to 4e-15 m, times 1/cos(psi), 10 at the ends
    assert np.abs(q[:, phi] + theta - psi).max() < 1e-13
    assert np.abs(q[:, s] - slide).max() < 2e-14
    gamma = slider_crank.closure.gamma(q)[..., 0]
    turn, slide_rate = CRANK.rates(theta)
    assert np.abs(gamma[:, phi] + 1 - turn).max() < 1e-12 * np.abs(turn).max()
    assert np.abs(gamma[:, s] - slide_rate).max() < 1e-12
    drift = slider_crank.closure.drift(q, 1.7 * gamma)
    turn2, slide2 = CRANK.second(theta)
    assert np.abs(drift[:, phi] - 1.7**2 * turn2).max() < 1e-12 * np.abs(turn2).max()
    assert np.abs(drift[:, s] - 1.7**2 * slide2).max() < 1e-12 * np.abs(turn2).max()
    assert np.all(drift[:, slider_crank.column("theta")] == 0)


def test_slider_drives_the_crank_up_to_its_dead_centre(edited):
    """At s = 0.4 crank and rod lie in line: 0.4^2 + 0.3^2 = (0.2 + 0.3)^2."""
    pump = edited("slider_crank.yaml", "active: [theta]", "active: [s]")
    theta = pump.column("theta")
    in_line = np.arcsin(0.6)
    far = pump.closure.solve([0.4 - 1e-6])
    # near the edge, the crank is away by sqrt(2 (s_max - s) ds/d2theta)
    assert 1e-4 < far[theta] - in_line < 1e-2
    assert pump.closure.residual(far) < 1e-13
    with pytest.raises(
        SingularConfigurationError, match=r"loop 'wrist' .* s = 0\.4, where .* stay away"
    ):
        pump.closure.solve([0.4])
    with pytest.raises(SingularConfigurationError, match=r"s = 0\.4 \(sample 2\)"):
        pump.closure.solve([[0.3], [0.35], [0.4], [0.2]])
    edge = np.zeros(3)
    edge[[pump.column("s"), theta]] = 0.4, in_line
    assert pump.closure.residual(edge) < 1e-16
    for call in (pump.closure.gamma, lambda q: pump.closure.drift(q, np.ones(3))):
        with pytest.raises(SingularConfigurationError, match="'wrist'"):
            call(edge)


def test_edge_of_a_loop_that_solves_joint_by_joint(slider_crank):
    """At theta = 0 the rod stands upright: its height alone gave phi, and gives it no more."""
    with pytest.raises(SingularConfigurationError, match="theta = 0,"):
        slider_crank.closure.solve([0.0])
    edge = np.zeros(3)
    edge[[slider_crank.column("s"), slider_crank.column("phi")]] = 0.2, np.pi / 2
    assert slider_crank.closure.residual(edge) < 1e-16
    with pytest.raises(SingularConfigurationError, match="'wrist'"):
        slider_crank.closure.gamma(edge)
    near = slider_crank.closure.solve([1e-6])  # rounding, divided by cos(psi) = 1e-3
    assert near[slider_crank.column("phi")] == pytest.approx(
        CRANK.position(1e-6)[0] - 1e-6, abs=1e-11
    )


def test_out_of_reach_names_loop_gap_and_coordinates(edited):
    pump = edited("slider_crank.yaml", "active: [theta]", "active: [s]")
    with pytest.raises(OutOfReachError) as error:
        pump.closure.solve([[0.3], [0.41]])
    text = str(error.value)
    assert "'wrist'" in text and "s = 0.41 (sample 1)" in text and "closes is at s = 0.4" in text
    # the shortest gap points from the stretched rod's eye to the pin; its larger component is told
    reach = np.hypot(0.41, 0.3)
    gap = float(re.search(r"stays (\S+) m open", text)[1])
    assert gap == pytest.approx((reach - 0.5) * 0.41 / reach, rel=1e-3)
    assert "\n" not in text
    # after an error the closure works as before
    assert pump.closure.residual(pump.closure.solve([0.3])) < 1e-14


def test_strokes_beyond_the_mini_forwarders_geometry(mini):
    longest = np.hypot(0.032, 0.070) + np.hypot(0.042, 0.030) - 0.0825  # B, C, D in line
    q = mini.closure.solve([0.0, longest - 1e-6, 0.01])  # limits are the user's business
    assert mini.closure.residual(q) < 1e-13
    with pytest.raises(OutOfReachError, match=r"'A1_eye'.* X1 = 0\.05, .*X1 = 0\.04608"):
        mini.closure.solve([0.0, 0.05, 0.01])
    with pytest.raises(ClosureError):  # rounding decides which of the two it is
        mini.closure.solve([0.0, longest, 0.01])
    with pytest.raises(OutOfReachError, match=r"sample 3\)"):
        mini.closure.solve([*strokes(3), [0.0, 0.05, 0.01]])


def test_guess_on_the_wrong_branch(slider_crank, edited):
    theta = 1.0
    psi = np.pi - CRANK.position(theta)[0]  # the rod points backwards
    guess = np.zeros(3)
    names = [slider_crank.column(name) for name in ("s", "theta", "phi")]
    guess[names] = 0.2 * np.cos(theta) + 0.3 * np.cos(psi), theta, psi - theta
    assert slider_crank.closure.residual(guess) < 1e-15
    for target in (theta, 1.001, 2.0):
        with pytest.raises(WrongBranchError, match="'wrist' is assembled the other way"):
            slider_crank.closure.solve([target], initial_guess=guess)
    backwards = edited("slider_crank.yaml", "phi: -0.5, s: 0.37", f"phi: {psi - theta}, s: -0.1")
    assert backwards.closure.solve([theta]) == pytest.approx(guess, abs=1e-14)
    with pytest.raises(WrongBranchError):
        backwards.closure.solve([theta], initial_guess=slider_crank.home)


def test_bad_arguments(mini):
    closure = mini.closure
    for call, text in (
        (lambda: closure.solve([0.0, np.nan, 0.01]), "q_a is nan at X1, give finite"),
        (lambda: closure.solve([3 * [0.01], [0, 0, np.inf]]), "q_a is inf at X2 of sample 1"),
        (lambda: closure.solve([0.0, 0.01]), r"q_a has the shape \(2,\).*\(q1, X1, X2\)"),
        (lambda: closure.solve(0.0), r"the shape \(\)"),
        (lambda: closure.solve(np.zeros((2, 2, 3))), r"the shape \(2, 2, 3\)"),
        (lambda: closure.solve(np.zeros((0, 3))), "empty"),
        (lambda: closure.solve("far"), "not made of real numbers"),
        (lambda: closure.solve(np.zeros(3), initial_guess=np.zeros(3)), "guess has the shape"),
        (
            lambda: closure.solve(np.zeros(3), initial_guess=np.zeros((2, 11))),
            "guess has the shape",
        ),
        (
            lambda: closure.solve(np.zeros(3), initial_guess=np.full(11, np.nan)),
            "guess is nan at q1",
        ),
        (lambda: closure.gamma(np.zeros(3)), "q has the shape"),
        (lambda: closure.gamma(np.zeros((0, 11))), "empty"),
        (lambda: closure.drift(mini.home, np.full(11, np.nan)), "v is nan at q1"),
        (lambda: closure.drift(np.zeros((2, 11)), np.zeros((3, 11))), "2, 3. samples"),
    ):
        with pytest.raises(InputError, match=text):
            call()


# --- spatial loops ---------------------------------------------------------------------------


def pose_of(q, machine):
    (pose,) = poses(machine, q, "platform")
    return pose


def test_stewart_platform_has_six_degrees_of_freedom(stewart):
    assert stewart.closure.degrees_of_freedom == 6
    assert (
        len(stewart.closure.passive) == 15 and len(stewart.closure.structure.redundant_rows) == 0
    )
    assert np.abs(stewart.home).max() < 1e-12


def test_stewart_strokes_follow_from_the_pose(stewart):
    """Inverse kinematics of a Stewart platform is closed: lengths between points."""
    random = np.random.default_rng(9)
    for _ in range(60):
        rotation = pin.rpy.rpyToMatrix(*random.uniform(-0.25, 0.25, 3))
        position = oracles.PLATFORM_POINTS[0] + random.uniform(-0.08, 0.08, 3)
        q = stewart.closure.solve(oracles.stewart_strokes(rotation, position))
        pose = pose_of(q, stewart)
        assert np.abs(pose.rotation - rotation).max() < 1e-13
        assert np.abs(pose.translation - position).max() < 1e-13
        assert stewart.closure.residual(q) < 1e-14


def test_stewart_gamma_equals_the_inverse_of_its_closed_form(stewart):
    q_a = np.random.default_rng(10).uniform(-0.08, 0.08, (20, 6))
    for q in stewart.closure.solve(q_a):
        pose = pose_of(q, stewart)
        data = stewart.model.createData()
        jacobian = pin.computeFrameJacobian(
            stewart.model, data, q, stewart.frame("platform"), pin.LOCAL_WORLD_ALIGNED
        )
        twist = jacobian @ stewart.closure.gamma(q)
        rates = oracles.stewart_rates(pose.rotation, pose.translation)
        assert np.abs(rates @ twist - np.eye(6)).max() < 1e-13


def test_stewart_gamma_and_drift_against_differences(stewart):
    random = np.random.default_rng(11)
    for _ in range(5):
        q_a, v_a = random.uniform(-0.07, 0.07, 6), random.uniform(-0.2, 0.2, 6)
        check_gamma_and_drift(stewart, q_a, v_a, np.full(6, 2e-3), 1e-9)


def test_stewart_stacks_keep_the_branch(stewart):
    q_a = np.random.default_rng(12).uniform(-0.08, 0.08, (40, 6))
    stack = stewart.closure.solve(q_a)
    alone = np.array([stewart.closure.solve(sample) for sample in q_a])
    assert np.abs(stack - alone).max() < 1e-12


@pytest.mark.parametrize("kind", oracles.LOCKED)
def test_loop_types_lock_what_they_say(tmp_path, kind):
    axis = np.array([0.48, -0.6, 0.64])
    arm = crane.load(oracles.looped_arm(tmp_path, kind, axis.tolist()))
    free = 7 - oracles.LOCKED[kind]
    assert arm.closure.degrees_of_freedom == free
    assert np.abs(arm.home).max() < 1e-12
    random = np.random.default_rng(13)
    for _ in range(6):
        q_a = random.uniform(-0.03, 0.03, free)
        one, two = poses(arm, arm.closure.solve(q_a), "anchor", "grip")
        relative = one.actInv(two)
        away, turn = relative.translation, pin.log3(relative.rotation)
        along, about = away @ axis, turn @ axis
        aside, tilt = away - along * axis, turn - about * axis
        held, moving = {
            "fixed": ([along, aside, about, tilt], []),
            "revolute": ([along, aside, tilt], [about]),
            "prismatic": ([aside, about, tilt], [along]),
            "cylindrical": ([aside, tilt], [along, about]),
            "spherical": ([along, aside], [about, tilt]),
            "planar": ([along, tilt], [aside, about]),
        }[kind]
        assert max(np.abs(value).max() for value in held) < 1e-14
        assert all(np.abs(value).max() > 1e-5 for value in moving)
        v_a = random.uniform(-1, 1, free)
        check_gamma_and_drift(arm, q_a, v_a, np.full(free, 5e-4), 1e-9)


PLANE = """<robot name="plane">
  <link name="ground"/>
  {joints}
  {links}
  <loop name="cut" type="{kind}">
    <predecessor link="{one}"/><successor link="{two}"><origin xyz="{at} 0 0"/></successor>
    <axis xyz="1 0 0"/>
  </loop>
</robot>"""
JOINT = """<joint name="{0}" type="continuous" independent="{4}"><origin xyz="{3}"/>
  <parent link="{1}"/><child link="{2}"/><axis xyz="0 0 1"/></joint>"""
LINK = """<link name="{}"><inertial><mass value="1"/>
  <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>"""


def plane_machine(tmp_path, kind, one, two, at, joints):
    path = tmp_path / "plane.urdf"
    links = "".join(LINK.format(joint[2]) for joint in joints)
    text = "".join(
        JOINT.format(*joint, str(number == 0).lower()) for number, joint in enumerate(joints)
    )
    path.write_text(PLANE.format(joints=text, links=links, kind=kind, one=one, two=two, at=at))
    return crane.load(path)


def test_cylinder_cut_at_its_sliding_joint(tmp_path):
    """A crank pulls a rod out of a barrel hinged at (-0.3, 0): the stroke is no coordinate."""
    joints = [
        ("crank", "ground", "arm", "0 0 0"),
        ("eye", "arm", "rod", "0.1 0 0"),
        ("foot", "ground", "barrel", "-0.3 0 0"),
    ]
    machine = plane_machine(tmp_path, "prismatic", "barrel", "rod", 0, joints)
    theta = np.linspace(-1.4, 1.4, 57)
    q = machine.closure.solve(theta[:, None])
    pin_x, pin_y = 0.1 * np.cos(theta), 0.1 * np.sin(theta)
    foot = np.arctan2(pin_y, 0.3 + pin_x)
    assert np.abs(q[:, machine.column("foot")] - foot).max() < 2e-14
    assert np.abs(q[:, machine.column("eye")] - (foot - theta)).max() < 2e-14
    gamma = machine.closure.gamma(q)[:, machine.column("foot"), 0]
    exact = (0.01 + 0.03 * np.cos(theta)) / (0.01 + 0.09 + 0.06 * np.cos(theta))
    assert np.abs(gamma - exact).max() < 1e-13
    check_gamma_and_drift(machine, np.array([0.7]), np.array([2.0]), np.array([1e-2]), 1e-10)


def test_four_bar_cut_in_the_middle_of_its_coupler(tmp_path):
    joints = [
        ("crank", "ground", "short", "0 0 0"),
        ("left", "short", "half_left", "0.1 0 0"),
        ("rocker", "ground", "long", "0.2 0.1 0"),
        ("right", "long", "half_right", "-0.15 0 0"),
    ]
    machine = plane_machine(tmp_path, "fixed", "half_left", "half_right", -0.2, joints)
    assert machine.closure.degrees_of_freedom == 1
    theta = np.linspace(-3.0, 3.0, 61) + machine.home[machine.column("crank")]
    for q in machine.closure.solve(theta[:, None]):
        crank = q[machine.column("crank")]
        start = 0.1 * np.array([np.cos(crank), np.sin(crank)])
        turn = q[machine.column("rocker")]
        end = np.array([0.2, 0.1]) - 0.15 * np.array([np.cos(turn), np.sin(turn)])
        # frames of both halves coincide 0.2 m before the right pin, 0 m after the left one
        assert np.hypot(*(end - start)) == pytest.approx(0.2, abs=1e-14)
        assert q[machine.column("left")] + crank == pytest.approx(
            np.arctan2(*(end - start)[::-1]), abs=1e-13
        )
    check_gamma_and_drift(machine, theta[10:11], np.array([2.0]), np.array([1e-2]), 1e-9)


# --- machines that cannot be -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        (("revolute", "fixed"), "'wrist' .* open"),
        (("theta: 1.0, phi: -0.5, s: 0.37", "s: 0.4", "[theta]", "[s]"), "edge of the branch"),
        (
            ("theta: 1.0, phi: -0.5, s: 0.37", "s: 0.45", "[theta]", "[s]"),
            r"'wrist' .*\(s = 0\.45\): it stays",
        ),
        (("theta: 1.0, phi: -0.5, s: 0.37", "theta: 1.0, phi: 2.0"), None),
        (("theta: 1.0, phi: -0.5, s: 0.37", "theta: 1.0, phi: 2.6"), "phi is 0.913 rad off"),
        (("axis: [0, 1, 0]", "axis: [1, 0, 0]"), r"'wrist': .* turn it to axis: \[0, 1, 0\]"),
        (("revolute", "planar"), "'wrist'"),
    ],
)
def test_machines_that_cannot_be_driven(edited, changes, text):
    if text is None:
        assert edited("slider_crank.yaml", *changes).home[0] < 0  # the other branch, asked for
        return
    with pytest.raises(MechanismError, match=text):
        edited("slider_crank.yaml", *changes)


def test_active_joints_that_cannot_drive_the_others(mini, tmp_path):
    text = mini.path.read_text().replace("urdf: ", f"urdf: {mini.path.parent}/")
    for old, new in (("active: [q1, X1, X2]", "active: [q1, X1, q9]"), ("control:", "#"),
                     ("  q1: {kp", "#"), ("  X1: {kp", "#"), ("  X2: {kp", "#")):  # fmt: skip
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "stuck.yaml"
    path.write_text(text)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        with pytest.raises(MechanismError, match="q1, X1, q9 cannot drive .*X2.*: choose others"):
            crane.load(path)
