"""Kinematics of the tip: forward, derivatives and inverse."""

import re

import numpy as np
import oracles
import pinocchio as pin
import pytest
from hydraulic_rig import STROKE as STROKES
from hydraulic_rig import rig

import crane
from crane.common.errors import InputError, LimitError, UnreachableTipError

STROKE = 0.030  # [m]


@pytest.fixture(scope="module")
def tip(mini):
    return crane.Kinematics(mini)


def somewhere(machine, count, seed=0, share=1.0):
    random = np.random.default_rng(seed)
    middle, half = (machine.lower + machine.upper) / 2, (machine.upper - machine.lower) / 2
    return middle + share * random.uniform(-1, 1, (count, len(middle))) * half


@pytest.mark.parametrize(
    ("name", "frame", "step"),
    [("mini", None, (0.05, 1e-4, 1e-4)), ("mini", "link6_K", (0.05, 1e-4, 1e-4)),
     ("stewart", "platform", 6 * (2e-3,)), ("slider_crank", None, (5e-3,))],
)  # fmt: skip
def test_jacobian_and_bias_against_differences(name, frame, step, request):
    machine = request.getfixturevalue(name)
    kinematics = crane.Kinematics(machine, frame)
    random = np.random.default_rng(1)
    share = 0.5 if name == "stewart" else 0.9
    for q_a in somewhere(machine, 10, seed=1, share=share):
        jacobian = kinematics.jacobian(q_a)
        slopes = np.column_stack(
            [
                oracles.derivative(lambda t: kinematics.position(q_a + t * axis), h)  # noqa: B023
                for axis, h in zip(np.eye(len(q_a)), step, strict=True)
            ]
        )
        assert np.abs(jacobian - slopes).max() < 1e-9 * np.abs(jacobian).max()
        v_a = random.uniform(-1, 1, len(q_a)) * step  # one step per second
        rate = oracles.derivative(lambda t: kinematics.jacobian(q_a + t * v_a) @ v_a, 1.0)  # noqa: B023
        bias = kinematics.bias(q_a, v_a)
        assert np.abs(bias - rate).max() < 1e-8 * np.abs(bias).max()
        assert kinematics.bias(q_a, 3 * v_a) == pytest.approx(9 * bias, rel=1e-9, abs=1e-20)


def test_a_machine_of_a_single_joint(tmp_path):
    """A load on a vertical guide: its tip follows the stroke."""
    machine = rig(tmp_path)
    tip = crane.Kinematics(machine, "load_x")
    assert tip.jacobian([0.2]) == pytest.approx(np.array([[0.0], [0.0], [1.0]]))
    assert tip.position([0.3]) == pytest.approx([0, 0, 0.3])
    space = crane.workspace(machine, 100, "load_x")
    assert np.ptp(space.tip_positions, axis=0) == pytest.approx([0, 0, STROKES], abs=1e-12)


def test_stacks_equal_single_samples(mini, tip):
    q_a = somewhere(mini, 6, seed=2)
    v_a = np.tile([0.3, 0.01, -0.02], (6, 1))
    for method, arguments, shape in (
        (tip.position, (q_a,), (6, 3)), (tip.jacobian, (q_a,), (6, 3, 3)),
        (tip.bias, (q_a, v_a), (6, 3)),
    ):  # fmt: skip
        stack = method(*arguments)
        assert stack.shape == shape
        alone = np.array([method(*sample) for sample in zip(*arguments, strict=True)])
        assert np.abs(stack - alone).max() < 1e-12
    position = tip.position(q_a)
    assert tip.inverse(position).shape == (6, 3) and tip.inverse(position[0]).shape == (3,)


def test_inverse_finds_the_strokes_again(mini, tip):
    """The crane's tip has one posture per position within the strokes, corners included."""
    random = np.random.default_rng(3)
    corners = somewhere(mini, 40, seed=4)
    corners[:, 1:] = random.choice([0.0, STROKE], (40, 2))
    for q_a in np.vstack([somewhere(mini, 150, seed=3), corners]):
        position = tip.position(q_a)
        found = tip.inverse(position)
        assert np.abs(tip.position(found) - position).max() < 1e-11
        assert np.all((found >= mini.lower) & (found <= mini.upper))
        # positions within 1e-11 m, through a Jacobian whose smallest singular value is 0.04
        assert np.abs(found - q_a).max() < 1e-9


def test_inverse_tracks_a_path_from_a_guess(mini, tip):
    time = np.linspace(0, 1, 60)[:, None]
    q_a = np.array([0.2, 0.002, 0.003]) + time * [1.0, 0.026, 0.025]
    found = tip.inverse(tip.position(q_a), initial_guess=q_a[0])
    assert np.abs(found - q_a).max() < 1e-9


def test_inverse_with_more_drives_than_directions(stewart):
    platform = crane.Kinematics(stewart, "platform")
    goal = platform.position(somewhere(stewart, 1, seed=5, share=0.5)[0])
    found = platform.inverse(goal)
    assert np.abs(platform.position(found) - goal).max() < 1e-11
    assert np.all((found >= stewart.lower) & (found <= stewart.upper))


def test_inverse_with_fewer_drives_than_directions(slider_crank):
    rod = crane.Kinematics(slider_crank)
    on_its_curve = rod.position([1.3])
    assert rod.inverse(on_its_curve) == pytest.approx([1.3], abs=1e-9)
    with pytest.raises(UnreachableTipError, match="'rod_middle' cannot reach"):
        rod.inverse(on_its_curve + [0, 1e-3, 0])


def test_inverse_of_an_open_arm():
    arm = crane.load("xarm7")
    hand = crane.Kinematics(arm)
    for q_a in somewhere(arm, 10, seed=6, share=0.7):
        goal = hand.position(q_a)
        found = hand.inverse(goal)
        assert np.abs(hand.position(found) - goal).max() < 1e-11
        assert np.all((found >= arm.lower) & (found <= arm.upper))
    model = pin.buildModelFromUrdf(str(arm.path))
    data = model.createData()
    pin.framesForwardKinematics(model, data, q_a)
    assert np.abs(data.oMf[model.getFrameId("link_eef")].translation - goal).max() < 1e-14


@pytest.mark.parametrize("point", [(2.0, 0.0, 0.0), (0.1, 0.0, -0.5), (-0.2, 0.25, 0.4)])
def test_unreachable_points_tell_how_near_the_tip_gets(mini, tip, point):
    with pytest.raises(UnreachableTipError) as error:
        tip.inverse(point)
    text = str(error.value)
    at = ", ".join(f"{x:.4g}" for x in point)
    assert text.startswith(f"'link7_tip' cannot reach ({at}) m: it stays ")
    assert text.endswith("choose a point within reach") and "\n" not in text
    # the nearest posture of all, by a grid of the closed form
    x1, x2 = (x.ravel() for x in np.meshgrid(*2 * [np.linspace(0, STROKE, 301)]))
    _, (reach, height) = oracles.mini_forwarder(x1, x2)
    distance = np.hypot(reach - np.hypot(point[0], point[1]), height - point[2]).min()
    told = float(re.search(r"stays (\S+) m away", text)[1])
    assert told == pytest.approx(distance, rel=5e-3)
    nearest = [float(x) for x in re.findall(r"= ([-+.e\d]+)", text)]
    reached = np.linalg.norm(tip.position(nearest) - point)
    assert reached == pytest.approx(told, rel=5e-3)


def test_limits_bound_the_inverse(mini, tip):
    """A point that only a stroke beyond its limit reaches."""
    beyond = tip.position([0.4, 0.032, 0.012])
    with pytest.raises(UnreachableTipError, match=r"X1 = 0\.03[,;]"):
        tip.inverse(beyond)
    with pytest.raises(UnreachableTipError, match=r"\(sample 1\)"):
        tip.inverse([tip.position([0.4, 0.029, 0.012]), beyond])
    with pytest.raises(LimitError, match=r"guess: X1 = 0\.032"):
        tip.inverse(beyond, initial_guess=[0.4, 0.032, 0.012])


def test_bad_arguments(mini, slider_crank, stewart, tip):
    for call, text in (
        (lambda: tip.inverse([0.3, 0.0]), r"position has the shape \(2,\).*\(x, y, z\)"),
        (lambda: tip.inverse([0.3, np.nan, 0.0]), "position is nan at y"),
        (lambda: tip.position([0.3, 0.0]), "q_a has the shape"),
        (lambda: tip.bias([0, 0.01, 0.01], [0, np.inf, 0]), "v_a is inf at X1"),
        (lambda: tip.inverse([0.3, 0.0, 0.0], initial_guess=[0.0, 0.01]), "guess has the shape"),
        (lambda: crane.Kinematics(stewart), "machine 'stewart' has no tip, name a frame"),
        (lambda: crane.Kinematics(mini, "link7_tp"), "did you mean 'link7_tip'"),
        (lambda: tip.inverse(np.zeros((0, 3))), "empty"),
    ):
        with pytest.raises(InputError, match=text):
            call()
