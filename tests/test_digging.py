"""Breakout and tool forces against free-body diagrams, brute force and the lifting capacity."""

import numpy as np
import pytest
from free_bodies import about, balance, moment, places

import crane
from crane.formats.machine_loading import MachineVariants

G, NONE = np.array([0.0, 0.0, -9.81]), np.zeros(3)
PUMP, TANK = 3.5e7, 3.0e5  # of the excavator [Pa]
LIP = "bucket_lip"


def limit(machine, working, joint, slope):
    """What a cylinder exerts at most against what asks for more with this sign."""
    cylinder = machine.hydraulics.cylinders[joint]
    pressure = PUMP if joint in working else cylinder.relief
    a, b = cylinder.area_a, cylinder.area_b
    return pressure * a - TANK * b if slope > 0 else TANK * a - pressure * b


def by_hand(machine, working, q, way, gravity):
    """The force along a way of every cause, from two balances of all links [N]."""
    some = balance(machine, q, gravity, 0.0, LIP, -1e5 * way)[0]
    none = balance(machine, q, gravity, 0.0, LIP)[0] if gravity.any() else dict.fromkeys(some, 0.0)
    found = {}
    for joint in machine.hydraulics.joints:
        slope = (some[joint] - none[joint]) / 1e5
        if abs(slope) > 1e-6:
            found[joint] = (limit(machine, working, joint, slope) - none[joint]) / slope
    return found


def tangent(machine, q, link="bucket"):
    """Of the lip's circle about a pin, the way in which the bucket curls."""
    at = places(machine, q)
    arm = at[LIP][:3, 3] - at[link][:3, 3]
    return np.cross([0.0, 1.0, 0.0], arm) / np.linalg.norm(arm)


def lever_of_bucket(at):
    """Torque about the bucket's pin per force of its cylinder, by moments about three pins."""
    axis = np.array([0.0, 1.0, 0.0])
    rocker, eye, pin = (at[x][:3, 3] for x in ("rocker", "bucket_eye", "bucket"))
    base, link = at["bucket_barrel"][:3, 3], at["link_eye"][:3, 3]
    push, along = eye - base, link - eye  # cylinder, connecting link
    push, along = push / np.linalg.norm(push), along / np.linalg.norm(along)
    on_rocker = axis @ np.cross(eye - rocker, push)
    in_link = on_rocker / (axis @ np.cross(eye - rocker, along))  # the link's force per push
    return axis @ np.cross(link - pin, along) * in_link


def test_what_the_drives_give_alone_is_pressure_times_levers(excavator):
    """Moments about the pins of rocker, link and bucket; about those of the arm."""
    found = crane.ratings.breakout(excavator)
    assert (found.bucket.joint, found.bucket.pivot) == ("X_bucket", "bucket")
    assert (found.arm.joint, found.arm.pivot) == ("X_arm", "arm")
    assert found.bucket.radius == pytest.approx(1.47, rel=1e-12)
    home = excavator.home[excavator.closure.active]

    def force(joint, stroke, curl):
        q_a = home.copy()
        q_a[3], q_a[excavator.active.index(joint)] = curl, stroke
        at = places(excavator, excavator.closure.solve(q_a))
        push = limit(excavator, [joint], joint, 1.0)
        if joint == "X_bucket":
            return push * abs(lever_of_bucket(at)) / 1.47
        pin, base, eye = (at[x][:3, 3] for x in ("arm", "arm_barrel", "arm_eye"))
        lever = np.linalg.norm(np.cross(base - pin, eye - pin)) / np.linalg.norm(eye - base)
        return push * lever / np.linalg.norm(at[LIP][:3, 3] - pin)

    for one, curls in ((found.bucket, None), (found.arm, found.bucket.stroke)):
        i = excavator.active.index(one.joint)
        at_best = force(one.joint, one.stroke, curls or one.stroke)
        assert one.isolated_force == pytest.approx(at_best, rel=1e-9)
        low, high = excavator.lower[i] + 1e-3, excavator.upper[i] - 1e-3
        brute = [force(one.joint, x, curls or x) for x in np.linspace(low, high, 200)]
        assert max(brute) <= one.isolated_force * (1 + 1e-12)
        assert max(brute) == pytest.approx(one.isolated_force, rel=1e-4)
        step = 1e-3 * (high - low)  # a maximum: flat to both sides
        beside = [force(one.joint, one.stroke + x, curls or one.stroke + x) for x in (-step, step)]
        assert beside[0] - beside[1] == pytest.approx(0, abs=1e-3 * (2 * at_best - sum(beside)))
    assert found.bucket.isolated_force == pytest.approx(140.5e3, rel=0.005)  # as data sheets print
    assert found.arm.isolated_force == pytest.approx(106.7e3, rel=0.01)


@pytest.mark.parametrize("weights", [False, True])
def test_what_holds_ends_what_digs(excavator, weights):
    """Every limit agrees with free bodies there; no configuration of a grid gives more force."""
    found = crane.ratings.breakout(excavator, weights=weights)
    for one in (found.bucket, found.arm):
        q = excavator.closure.solve(one.q_a)
        way, gravity = tangent(excavator, q, one.pivot), G if weights else NONE
        hand = by_hand(excavator, [one.joint], q, way, gravity)
        for cause, force in one.forces_by_factor.items():
            if cause.reason == "tips":
                first, second = (
                    places(excavator, q)[x][:3, 3] for x in cause.element.split(" to ")
                )
                held = moment(excavator, q, G, 0.0, LIP, first, second)
                line = (second - first) / np.linalg.norm(second - first)
                lip = places(excavator, q)[LIP][:3, 3]
                turned = line @ np.cross(lip - first, -way)
                hand[cause.element] = -held / turned if turned > 0 else np.inf
            if cause.element in hand:
                assert force == pytest.approx(hand[cause.element], rel=1e-9)
        assert one.force == pytest.approx(min(hand.values()), rel=1e-9)
        # at the edge of two causes, one of which is what a closed valve holds
        ends = [
            cause.reason
            for cause, force in one.forces_by_factor.items()
            if force <= one.force * (1 + 1e-9)
        ]
        assert one.limiting_factor.reason in ends and "holding pressure" in ends
        axes = [np.linspace(excavator.lower[k], excavator.upper[k], 9) for k in (1, 2, 3)]
        if one.joint == "X_arm":
            axes[2] = [found.bucket.stroke]
        field = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        for q_a in field[np.random.default_rng(0).choice(len(field), 25, replace=False)]:
            q = excavator.closure.solve(np.r_[0.0, q_a])
            tried = by_hand(excavator, [one.joint], q, tangent(excavator, q, one.pivot), gravity)
            assert min(tried.values()) <= one.force * (1 + 1e-9)


def test_arm_and_bucket_are_named_or_found(excavator):
    found = crane.ratings.breakout(excavator, bucket="X_arm", arm="X_boom")
    assert (found.bucket.joint, found.arm.joint) == ("X_arm", "X_boom")
    assert crane.ratings.breakout(excavator, bucket="X_boom").arm is None
    text = crane.ratings.breakout(excavator).to_markdown()
    assert "| bucket | X_bucket | bucket | 1.4700 | 140.06 |" in text


@pytest.mark.slow
def test_a_tool_that_pushes_upwards_lifts(excavator):
    """As many newtons as the capacity has kilograms times g, by the same causes."""
    chart = crane.capacity(excavator, step=1.0)
    field = crane.ratings.tool_force(excavator, "up", step=1.0)
    assert np.array_equal(np.isfinite(field.forces), np.isfinite(chart.loads))
    assert np.nanmax(np.abs(field.forces / (9.81 * chart.loads) - 1)) < 1e-13
    assert np.array_equal(field.limiting_factor_index, chart.limiting_factor_index)
    other = crane.ratings.tool_force(excavator, (0.0, 0.0, 2.0), step=1.0)
    assert np.array_equal(other.forces, field.forces, equal_nan=True)


@pytest.mark.parametrize("direction", ["tangent", "-tangent", "normal", "in", (1.0, 0.0, -1.0)])
def test_every_place_is_what_statics_by_hand_give(excavator, direction):
    field = crane.ratings.tool_force(excavator, direction, step=3.0, slews=[0.0, 1.2])
    ways = field.section_directions()
    reached = np.argwhere(np.isfinite(field.forces) & (field.forces > 0))
    for s, b, a in reached[np.random.default_rng(0).choice(len(reached), 8, replace=False)]:
        q = excavator.closure.solve(field.q_a[s, b, a])
        at = places(excavator, q)
        turn = about((0, 0, 1), field.slews[s])[:3, :3]
        arm = at[LIP][:3, 3] - at["bucket"][:3, 3]
        way = {
            "tangent": np.cross(turn @ [0.0, 1.0, 0.0], arm) / 1.47,
            "-tangent": -np.cross(turn @ [0.0, 1.0, 0.0], arm) / 1.47,
            "normal": arm / 1.47,
            "in": turn @ [-1.0, 0.0, 0.0],
        }.get(direction, turn @ [0.5**0.5, 0.0, -(0.5**0.5)])
        assert ways[s, b, a] == pytest.approx((turn.T @ way)[[0, 2]], abs=1e-9)
        hand = by_hand(excavator, field.working_joints, q, way, G)
        for cause in field.limiting_factors:
            if cause.reason == "tips":
                first, second = (at[x][:3, 3] for x in cause.element.split(" to "))
                line = (second - first) / np.linalg.norm(second - first)
                turned = line @ np.cross(at[LIP][:3, 3] - first, -way)
                held = moment(excavator, q, G, 0.0, LIP, first, second)
                hand[cause.element] = -held / turned if turned > 0 else np.inf
        assert field.forces[s, b, a] == pytest.approx(min(hand.values()), rel=1e-8)


def test_directions_beside_the_plane_through_the_slewing_axis(excavator):
    """A lip 0.5 m beside the plane: outwards at a radius r is asin(0.5 m / r) off the plane."""
    beside = MachineVariants(excavator).machine({"bucket_lip.z": 0.5})
    field = crane.ratings.tool_force(
        beside, (1.0, 0.0, -1.0), radii=[4.0, 8.0], heights=[-4.0, 0.5], slews=[0.0, 1.2]
    )
    horizontal = np.sqrt(0.5 - 0.5 * (0.5 / field.radii) ** 2)
    expected = np.stack([horizontal, np.full(2, -np.sqrt(0.5))], axis=1)
    assert np.isfinite(field.forces).all()
    assert np.abs(field.section_directions() - expected).max() < 1e-9


def test_a_quarter_turn_is_rated_where_the_machine_can_tip(excavator):
    given = {"direction": "up", "radii": [6.0], "heights": [0.0]}
    assert np.ptp(crane.ratings.tool_force(excavator, **given).slews) == pytest.approx(np.pi / 2)
    assert len(crane.ratings.tool_force(excavator, **given, weights=False).slews) == 1


@pytest.mark.parametrize(
    ("given", "gap"),
    [
        ({"direction": "tangent", "joint": "X_arm", "frame": "bucket"}, 1e-7),
        ({"direction": "normal", "joint": "X_arm", "frame": "bucket"}, 1e-7),
        ({"direction": "out", "frame": "bucket"}, 1e-7),
        pytest.param(
            {"direction": "tangent"}, 1e-4, marks=pytest.mark.slow
        ),  # three strokes: a best posture is sought to 1e-8
    ],
)
def test_slopes_of_tool_forces_are_those_of_fields_beside(excavator, given, gap):
    """A direction that turns with the tool, too; slewed."""
    field = crane.ratings.tool_force(excavator, **given, step=1.5, slews=[0.4])
    works = "X_boom" if given["direction"] == "normal" else "X_arm"
    names = ["boom_lift.y", "arm.mass", f"cylinder.{works}.area_a"]
    slopes, beside = field.derivatives(names), MachineVariants(excavator)
    at = {"slews": [0.4], "radii": field.radii, "heights": field.heights}
    for k, name in enumerate(names):
        value = beside.values[name]
        step = 1e-4 * (value or 0.1)
        more, less = (
            crane.ratings.tool_force(beside.machine({name: value + x * step}), **given, **at)
            for x in (1, -1)
        )
        with np.errstate(invalid="ignore"):
            difference = (more.forces - less.forces) / (2 * step)
        same = (
            (more.limiting_factor_index == field.limiting_factor_index)
            & (less.limiting_factor_index == field.limiting_factor_index)
            & (field.forces > 0)
        )
        same &= np.isfinite(difference)
        found = np.abs(difference - slopes[..., k])[same] / np.abs(difference[same]).max()
        assert same.sum() > 8 and np.median(found) < gap


@pytest.mark.parametrize(
    ("name", "given", "said"),
    [
        ("patu655", {}, "'patu655' has no bucket: 'tip' is turned by "),
        ("kr300", {}, "turned by no cylinder, and boom"),
        ("excavator", {"bucket": "slew"}, "'slew' does not turn 'bucket_lip', known: X_arm"),
        ("excavator", {"arm": "X_bucket", "bucket": "X_bucket"}, "as both bucket and arm"),
        ("excavator", {"frame": "nothing"}, "frame 'nothing' is unknown"),
        ("patu655_grapple", {}, "is free, hold it"),
    ],
)
def test_what_digs_not_is_said_in_one_line(name, given, said):
    with pytest.raises(crane.CraneError, match=said) as error:
        crane.ratings.breakout(crane.load(name), **given)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"direction": "sideways"}, "direction 'sideways' is unknown"),
        ({"direction": (0, 0, 0)}, "the direction is zero"),
        ({"direction": (1, 2)}, "the direction has the shape"),
        ({"direction": "up", "joint": "X_arm"}, "'X_arm' is named, but only tangent"),
        ({"joint": "boom"}, "'boom' does not turn"),
        ({"working": ["boom"]}, "'boom' drives nothing"),
        ({"radii": [30.0]}, "reaches none of these positions"),
    ],
)
def test_forces_that_cannot_be_are_said_in_one_line(excavator, given, said):
    with pytest.raises(crane.CraneError, match=said) as error:
        crane.ratings.tool_force(excavator, **given)
    assert "\n" not in str(error.value)
