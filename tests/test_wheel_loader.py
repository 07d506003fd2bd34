"""Breakout forces of a wheel loader whose tilt cylinder stands on the frame, against statics."""

import math

import numpy as np
import pytest
import wheel_loader
from scipy.optimize import brentq

import crane
from crane.ratings.strokes import Strokes, find_toggle


def turned(arm, angle):
    (x, z), c, s = arm, math.cos(angle), math.sin(angle)
    return np.array([c * x - s * z, s * x + c * z])


def cross(arm, force):
    return arm[0] * force[1] - arm[1] * force[0]


def quarter(arm):
    """The velocity of an arm's end that turns at 1 rad/s, from x to z."""
    return np.array([-arm[1], arm[0]])


def unit(way):
    return np.asarray(way) / np.linalg.norm(way)


class Linkage:
    """A loader's pins as circles that cross put them, and its levers, by hand.

    The boom is turned until the lift cylinder fits, the bellcrank until the tilt cylinder does,
    the bucket until the link does.
    """

    def __init__(self, lift, tilt, link=wheel_loader.LINK):
        known = wheel_loader
        self.pivot, self.tilt, self.lift = map(np.array, (known.PIVOT, known.TILT, known.LIFT))
        long = math.dist(known.LIFT, known.LIFT_EYE) + lift - known.LIFTED
        eye, pin, crank = (
            np.subtract(x, known.PIVOT) for x in (known.LIFT_EYE, known.PIN, known.CRANK)
        )
        boom = self._fitted(self.pivot, eye, self.lift, long, 0.0)
        self.lift_eye, self.pin, self.crank = (
            self.pivot + turned(x, boom) for x in (eye, pin, crank)
        )
        upper, lower = (np.subtract(x, known.CRANK) for x in (known.EYE, link))
        long = math.dist(known.TILT, known.EYE) + tilt - known.TILTED
        turn = self._fitted(self.crank, upper, self.tilt, long, boom)
        self.tilt_eye, self.link = (
            self.crank + turned(upper, turn),
            self.crank + turned(lower, turn),
        )
        arm, lip = (np.subtract(x, known.PIN) for x in (known.BUCKET, known.LIP))
        turn = self._fitted(self.pin, arm, self.link, math.dist(link, known.BUCKET), boom)
        self.eye, self.lip = self.pin + turned(arm, turn), self.pin + turned(lip, turn)

    @staticmethod
    def _fitted(centre, arm, other, long, near):
        """The angle nearest to one at which an arm's end is so far from a point."""

        def gap(angle):
            return math.dist(centre + turned(arm, angle), other) - long

        angles = near + np.linspace(-1.5, 1.5, 601)
        gaps = np.array([gap(x) for x in angles])
        found = np.flatnonzero(gaps[:-1] * gaps[1:] <= 0)
        k = found[np.argmin(np.abs(angles[found] - near))]
        return brentq(gap, angles[k], angles[k + 1], xtol=1e-14)

    def lip_as_boom_turns(self):
        """Velocity of the lip and angular velocity of the bucket, with the tilt cylinder held."""
        rod = self.tilt_eye - self.tilt  # the bellcrank's eye goes round the cylinder's base
        on_boom = quarter(self.crank - self.pivot)
        crank = -(on_boom @ rod) / (quarter(self.tilt_eye - self.crank) @ rod)
        way = self.eye - self.link
        pulled = (on_boom + crank * quarter(self.link - self.crank)) @ way
        on_pin = quarter(self.pin - self.pivot)
        bucket = (pulled - on_pin @ way) / (quarter(self.eye - self.pin) @ way)
        return on_pin + bucket * quarter(self.lip - self.pin), bucket

    def centre(self):
        """The bucket's instantaneous centre as the boom turns."""
        velocity, rate = self.lip_as_boom_turns()
        return self.lip + quarter(velocity) / rate

    def forces(self, force):
        """Of lift and tilt cylinders that hold a force (2,) on the lip, as pushes [N].

        Moments of the bucket about its pin, of the bellcrank about its, and of all that the boom
        carries about its pivot.
        """
        link = unit(self.eye - self.link)  # pushes the bucket's eye
        pushed = -cross(self.lip - self.pin, force) / cross(self.eye - self.pin, link)
        rod = unit(self.tilt_eye - self.tilt)
        tilt = (
            pushed * cross(self.link - self.crank, link) / cross(self.tilt_eye - self.crank, rod)
        )
        boom = cross(self.lip - self.pivot, force) + tilt * cross(self.tilt_eye - self.pivot, rod)
        push = unit(self.lift_eye - self.lift)
        return -boom / cross(self.lift_eye - self.pivot, push), tilt

    def most(self, way, working):
        """The largest force that the tool pushes along a way, by cylinder [N]."""
        out = {}
        areas = {"X_lift": wheel_loader.LIFT_AREAS, "X_tilt": wheel_loader.TILT_AREAS}
        for joint, each in zip(areas, self.forces(-np.asarray(way)), strict=True):
            pressure = wheel_loader.PRESSURE if joint in working else wheel_loader.RELIEF
            a, b = areas[joint] if each > 0 else areas[joint][::-1]
            if abs(each) > 1e-9:
                out[joint] = (pressure * a - wheel_loader.TANK * b) / abs(each)
        return out

    def path(self, joint):
        """The way in which the lip pushes as a cylinder does."""
        if joint == "X_tilt":
            return -unit(quarter(self.lip - self.pin)) * np.sign(
                self.forces(quarter(self.lip - self.pin))[1]
            )
        way = unit(self.lip_as_boom_turns()[0])
        return -way * np.sign(self.forces(way)[0])


@pytest.fixture(scope="module")
def loader(tmp_path_factory):
    return crane.load(wheel_loader.write(tmp_path_factory.mktemp("loader")))


@pytest.fixture(scope="module")
def with_toggle(tmp_path_factory):
    return crane.load(wheel_loader.write(tmp_path_factory.mktemp("toggle"), wheel_loader.TOGGLE))


def test_break_out_is_what_moments_about_the_pins_give(loader):
    found = crane.ratings.breakout(loader, bucket="X_tilt")
    assert (found.bucket.joint, found.arm.joint) == ("X_tilt", "X_lift")
    home = Linkage(wheel_loader.LIFTED, wheel_loader.TILTED)
    for one in (found.bucket, found.arm):
        by_hand = home.most(home.path(one.joint), [one.joint])
        assert one.home == pytest.approx(by_hand[one.joint], rel=1e-9)
        lever = Linkage(*one.lever)
        by_hand = lever.most(lever.path(one.joint), [one.joint])
        assert one.isolated_force == pytest.approx(by_hand[one.joint], rel=1e-9)
        at = Linkage(*one.q_a)
        by_hand = at.most(at.path(one.joint), [one.joint])
        assert one.force == pytest.approx(min(by_hand.values()), rel=1e-9)
        for cause, force in one.forces_by_factor.items():
            assert force == pytest.approx(by_hand[cause.element], rel=1e-9)


def test_the_radius_is_about_the_centre_that_the_lip_turns_about(loader):
    """The bucket about its pin; with the boom about no pin, as its tilt cylinder turns it, too."""
    found = crane.ratings.breakout(loader, bucket="X_tilt")
    reach = math.dist(wheel_loader.PIN, wheel_loader.LIP)
    assert found.bucket.radius == pytest.approx(reach, rel=1e-12)
    assert found.bucket.turn.offset < 1e-9
    hand = Linkage(*found.arm.q_a)
    centre = hand.centre()
    assert found.arm.turn.centre[[0, 2]] == pytest.approx(centre, abs=1e-9)
    assert found.arm.radius == pytest.approx(math.dist(centre, hand.lip), rel=1e-9)
    assert found.arm.turn.offset == pytest.approx(math.dist(centre, wheel_loader.PIVOT), rel=1e-9)
    assert found.arm.turn.offset > 1.0  # the pin is not what it turns about
    text = found.to_markdown()
    assert f"| bucket | X_tilt | bucket | {reach:.4f} |" in text
    words = f"instantaneous centre, x {centre[0]:.3f}, z {centre[1]:.3f} m"
    assert f"| arm | X_lift | {words}, {found.arm.turn.offset:.3f} m off boom |" in text


@pytest.mark.slow
def test_a_toggle_is_said_and_ended_by_what_holds(with_toggle):
    """Bellcrank and link in line: the cylinder moves and the bucket does not."""
    found = crane.ratings.breakout(with_toggle, bucket="X_tilt")
    assert found.bucket.isolated_force == np.inf
    at = Linkage(*found.bucket.lever, wheel_loader.TOGGLE)
    line = unit(at.eye - at.link)
    assert abs(cross(unit(at.link - at.crank), line)) < 1e-6
    assert found.bucket.stroke == pytest.approx(found.bucket.lever[1])
    at = Linkage(*found.bucket.q_a, wheel_loader.TOGGLE)  # the lift cylinder gives way before
    by_hand = at.most(at.path("X_tilt"), ["X_tilt"])
    assert found.bucket.force == pytest.approx(min(by_hand.values()), rel=1e-9)
    assert (found.bucket.limiting_factor.element, found.bucket.limiting_factor.reason) == (
        "X_lift",
        "holding pressure",
    )
    home = Linkage(wheel_loader.LIFTED, wheel_loader.TILTED, wheel_loader.TOGGLE)
    by_hand = home.most(home.path("X_tilt"), ["X_tilt"])
    assert found.bucket.home == pytest.approx(by_hand["X_tilt"], rel=1e-9)
    assert found.arm.q_a[1] == wheel_loader.TILTED  # the bucket at home
    text = found.to_markdown()
    assert "| unbounded | " in text and "goes through a toggle, where the lip stands still" in text


def test_a_toggle_is_beside_it_alone(with_toggle):
    """The extreme is found within 1 % of the stroke, away from zero and infinite levers."""
    strokes = Strokes(with_toggle)
    closure = with_toggle.closure
    lift = wheel_loader.LIFTED

    def in_line(tilt):
        at = Linkage(lift, tilt, wheel_loader.TOGGLE)
        return cross(at.link - at.crank, at.eye - at.link)

    exact = brentq(in_line, 0.02, 0.12, xtol=1e-12)
    for away in (-0.9, -0.3, 0.0, 0.3, 0.9):
        q = closure.solve(np.array([lift, exact + 0.01 * away * strokes.span[1]]))
        found = find_toggle(strokes, 1, q)
        assert found[closure.active][1] == pytest.approx(exact, abs=1e-7)
    for tilt in (exact + 0.012 * strokes.span[1], 0.2, 0.4, 0.6):
        q = closure.solve(np.array([lift, tilt]))
        assert find_toggle(strokes, 1, q) is None and find_toggle(strokes, 0, q) is None


def test_vertical_break_out_of_loaders(loader):
    """SAE J732, ISO 14397-2: upwards at the edge of the level bucket, by either cylinder."""
    at = Linkage(wheel_loader.LIFTED, wheel_loader.TILTED)
    for working in (["X_tilt"], ["X_lift"]):
        by_hand = min(at.most([0.0, 1.0], working).values())
        field = crane.ratings.tool_force(
            loader, "up", working=working, weights=False,
            radii=[wheel_loader.LIP[0]], heights=[wheel_loader.LIP[1]],
        )  # fmt: skip
        assert field.forces[0, 0, 0] == pytest.approx(by_hand, rel=1e-9)


def test_a_machine_with_one_stroke_left_digs():
    """`--lock` of all but the bucket: its force alone, nothing about charts."""
    whole = crane.ratings.breakout(crane.load("excavator"))
    locked = crane.load("excavator", lock={"X_boom": 0.8, "X_arm": 0.5})
    found = crane.ratings.breakout(locked, bucket="X_bucket")
    assert found.bucket.force == pytest.approx(found.bucket.isolated_force, rel=1e-9)
    assert found.bucket.isolated_force == pytest.approx(whole.bucket.isolated_force, rel=1e-9)
    assert found.arm is None
