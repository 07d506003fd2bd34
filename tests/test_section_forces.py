"""Section forces of drawn bodies against beam theory by hand, at rest and in motion."""

import numpy as np
import pytest
import yaml

import crane
from crane.common.errors import InputError
from crane.description import machine_templates

G, DENSITY = 9.81, 7850.0
HEIGHT, WIDTH, WALL = 0.3, 0.2, 0.012  # of the boom's tube
LENGTH, PIN, BACK = 4.0, 1.5, 0.5  # of the boom from its foot; where the cylinder acts; behind it
PAYLOAD = 800.0
AREA = HEIGHT * WIDTH - (HEIGHT - 2 * WALL) * (WIDTH - 2 * WALL)
SECOND = (WIDTH * HEIGHT**3 - (WIDTH - 2 * WALL) * (HEIGHT - 2 * WALL) ** 3) / 12
LINE = DENSITY * AREA  # [kg/m]


def write(folder, boom=None):
    """A boom on a frame with a lift cylinder; straight along x as drawn."""
    tube = {"points": ["foot", "tip"], "height": HEIGHT, "width": WIDTH, "wall": WALL}
    drawing = {
        "base": "frame",
        "points": {"foot": [0, 2], "low": [0.4, 0.3], "eye": [PIN, 2], "tip": [LENGTH, 2]},
        "bodies": {
            "frame": {"points": ["foot", "low"]},
            "boom": boom or {"points": ["foot", "eye", "tip"], "tubes": [tube]},
        },
        "cylinders": {
            "lift": {"points": ["low", "eye"], "bore": 0.1, "rod": 0.06, "shortest": 1.5,
                     "longest": 2.6},
        },
    }  # fmt: skip
    path = folder / "boom.yaml"
    path.write_text(yaml.safe_dump({"name": "boom", "drawing": drawing, "tip": "tip"}))
    return path


@pytest.fixture(scope="module")
def boom(tmp_path_factory):
    path = write(tmp_path_factory.mktemp("boom"))
    return crane.load(path, changes={"payload.mass": PAYLOAD})


def motion(machine, stroke, speed, acceleration):
    """Configuration, velocities and accelerations of all joints; the angle and its derivatives."""
    q = machine.closure.solve([stroke])
    v = machine.closure.gamma(q) @ [speed]
    a = machine.closure.gamma(q) @ [acceleration] + machine.closure.drift(q, v)
    i = machine.column("foot")
    return (q, v, a), (q[i], v[i], a[i])


def beam(sections, angle, omega, alpha, eye_force):
    """N, Q, M of the boom by hand, from its free end on.

    A piece dr at r accelerates by alpha r across and -omega^2 r along the boom, and resists
    turning by the rotary inertia of its section.
    """
    s = sections.positions
    rest = LENGTH - s
    across, along = G * np.cos(angle), G * np.sin(angle)
    axial = -LINE * (along * rest - omega**2 * (LENGTH**2 - s**2) / 2)
    axial -= PAYLOAD * (along - omega**2 * LENGTH)
    shear = LINE * (across * rest + alpha * (LENGTH**2 - s**2) / 2)
    shear += PAYLOAD * (across + alpha * LENGTH)
    moment = LINE * (across * rest**2 / 2 + alpha * (LENGTH**3 / 3 - s * LENGTH**2 / 2 + s**3 / 6))
    moment += DENSITY * SECOND * rest * alpha + PAYLOAD * (across + alpha * LENGTH) * rest
    before = s < PIN
    axial += np.where(before, eye_force[0], 0.0)
    shear -= np.where(before, eye_force[1], 0.0)
    moment -= np.where(before, eye_force[1] * (PIN - s), 0.0)
    return np.column_stack([axial, shear, -moment])


@pytest.mark.parametrize("state", [(0.6, 0.0, 0.0), (0.35, 0.4, -0.8), (0.9, -0.3, 1.5)])
def test_a_straight_boom_bends_as_a_beam(boom, state):
    sections = crane.dynamics.SectionForces(boom, "boom")
    (q, v, a), (angle, omega, alpha) = motion(boom, *state)
    found = sections.evaluate(q[None], v[None], a[None])[0]
    # the force of the cylinder on the eye, in the axes of the boom
    reactions = crane.dynamics.Reactions(boom)
    eye = reactions.joint_wrenches(q, v, a)[list(reactions.names).index("lift_eye"), :3]
    cos, sin = np.cos(angle), np.sin(angle)
    force = np.array([eye[0] * cos + eye[2] * sin, -eye[0] * sin + eye[2] * cos])
    wanted = beam(sections, angle, omega, alpha, force)
    inside = (sections.positions > 0) & (sections.positions < LENGTH)
    inside &= np.abs(sections.positions - PIN) > 1e-12
    scale = np.abs(wanted).max(axis=0)
    assert np.abs(found - wanted)[inside].max(axis=0) == pytest.approx(0, abs=1e-9 * scale.max())
    # the moment vanishes at the pin of its foot, and beyond the tip all does
    assert abs(found[inside][0, 2]) < 1e-6 * scale[2]
    assert np.abs(found[sections.positions > LENGTH]).max() < 1e-9 * scale.max()


def test_stress_is_that_of_the_section(boom):
    sections = crane.dynamics.SectionForces(boom, "boom")
    inside = (sections.positions > 0) & (sections.positions < LENGTH)
    area, centroid, moment, low, high = sections.sections[inside].T
    assert area == pytest.approx(AREA, rel=1e-12) and moment == pytest.approx(SECOND, rel=1e-12)
    assert np.abs(centroid).max() < 1e-12 and (high - low) == pytest.approx(HEIGHT, rel=1e-12)
    forces = np.array([2e4, 5e3, 3e4]) * np.ones((len(sections.positions), 1))
    modulus = SECOND / (HEIGHT / 2)
    stress = sections.stresses(forces)[inside]
    assert stress[:, 0] == pytest.approx(2e4 / AREA + 3e4 / modulus, rel=1e-12)
    assert stress[:, 1] == pytest.approx(2e4 / AREA - 3e4 / modulus, rel=1e-12)


def test_a_tapered_plate_carries_its_own_weight(tmp_path):
    """Two webs of a height that falls from 0.6 to 0.2 m, scaled to a mass, and a round bar."""
    first, last, thickness, mass = 0.6, 0.2, 0.01, 900.0
    boom = {
        "points": ["foot", "eye", "tip", "a", "b", "c", "d"],
        "plates": [{"outline": ["a", "b", "c", "d"], "thickness": thickness, "y": [-0.1, 0.1]}],
        "mass": mass,
    }
    path = write(tmp_path, boom)
    data = yaml.safe_load(path.read_text())
    data["drawing"]["points"] |= {
        "a": [0, 2 - first / 2], "b": [LENGTH, 2 - last / 2], "c": [LENGTH, 2 + last / 2],
        "d": [0, 2 + first / 2],
    }  # fmt: skip
    path.write_text(yaml.safe_dump(data))
    machine = crane.load(path)
    sections = crane.dynamics.SectionForces(machine, "boom")
    (q, v, a), (angle, *_) = motion(machine, 0.6, 0.0, 0.0)
    found = sections.evaluate(q[None], v[None], a[None])[0]
    s = sections.positions
    beyond = (s > PIN + 1e-6) & (s < LENGTH - 1e-6)
    height = first + (last - first) * s / LENGTH
    weight = mass * G / ((first + last) / 2 * LENGTH) * (height + last) / 2 * (LENGTH - s)
    assert found[beyond, 1] == pytest.approx((weight * np.cos(angle))[beyond], rel=1e-9)
    assert found[beyond, 0] == pytest.approx((-weight * np.sin(angle))[beyond], rel=1e-9)
    area, _, second, low, high = sections.sections[beyond].T
    assert area == pytest.approx(2 * thickness * height[beyond], rel=1e-9)
    assert second == pytest.approx(2 * thickness * height[beyond] ** 3 / 12, rel=1e-9)
    assert high - low == pytest.approx(height[beyond], rel=1e-9)
    tube = {"points": ["foot", "tip"], "height": 0.2, "wall": 0.01}
    boom = {"points": ["foot", "eye", "tip"], "tubes": [tube]}
    sections = crane.dynamics.SectionForces(crane.load(write(tmp_path, boom)), "boom")
    area, centroid, second, low, high = sections.sections[50]
    assert area == pytest.approx(np.pi / 4 * (0.2**2 - 0.18**2), rel=1e-9)
    assert second == pytest.approx(np.pi / 64 * (0.2**4 - 0.18**4), rel=1e-9)
    assert (centroid, high) == pytest.approx((0.0, 0.1), abs=1e-12)


def test_the_chart_of_a_run_has_its_extremes_and_loads(boom, tmp_path):
    pull = crane.Wrench("tip", [0, 0, -5e3])
    machine = boom.with_external_forces(pull)
    control = crane.ComputedTorque(machine, crane.point_to_point([0.3], [0.9], 1.0))
    run = crane.simulate(machine, control, step=0.005)
    chart = crane.dynamics.section_chart(machine, run, "boom")
    pin = np.flatnonzero((chart.positions > PIN) & (chart.positions < LENGTH))[0]
    rest = LENGTH - PIN
    still = crane.dynamics.SectionForces(machine, "boom")
    assert repr(still).startswith("SectionForces(")
    (q, v, a), (angle, *_) = motion(machine, 0.3, 0.0, 0.0)
    load = {"tip": np.array([[0, 0, -5e3, 0, 0, 0]])}
    at_rest = still.evaluate(q[None], v[None], a[None], load)[0]
    weight = (LINE * rest + PAYLOAD) * G + 5e3
    assert at_rest[pin, 1] == pytest.approx(weight * np.cos(angle), rel=1e-7)
    low, high = chart.envelopes["shear_force"][:, pin]
    assert low < at_rest[pin, 1] < high  # it speeds up and brakes
    force = crane.dynamics.Reactions(machine).drive_forces(q, wrenches={"tip": load["tip"][0]})
    run = crane.simulate(machine, lambda *_: force, [0.3], 0.02)
    held = crane.dynamics.section_chart(machine, run, "boom")
    assert held.envelopes["shear_force"][:, pin] == pytest.approx(at_rest[pin, 1], rel=1e-7)
    assert held.envelopes["bending_moment"][:, pin] == pytest.approx(at_rest[pin, 2], rel=1e-7)
    text = chart.write(tmp_path / "sections")
    assert "| bending moment | -" in text and " MPa |" in text
    names = {x.name for x in (tmp_path / "sections").iterdir()}
    assert names == {"sections.md", "sections.csv", "sections.png"}


def test_rods_of_a_delta_robot_have_sections_in_the_plane_alone():
    """The tubes begin exactly at a pin; two pairs of rods are beside the plane of the drawing."""
    machine = crane.load(machine_templates()["delta"]["1kg"])
    rods = crane.dynamics.SectionForces(machine, "rods_1")
    home = machine.coordinates.configuration(machine.home)[None]
    assert rods.positions[1] == 0
    assert np.isfinite(rods.evaluate(home, 0 * home, 0 * home)).all()
    with pytest.raises(InputError, match="'rods_2' has pins beside the plane of the drawing"):
        crane.dynamics.SectionForces(machine, "rods_2")


@pytest.mark.parametrize(
    ("name", "message"),
    [("frame", "body 'frame' has no plates and no tubes"), ("bom", "'bom' is not in the drawing")],
)
def test_what_has_no_sections_says_so(boom, name, message):
    with pytest.raises(InputError, match=message):
        crane.dynamics.SectionForces(boom, name)
    with pytest.raises(InputError, match="has no drawing"):
        crane.dynamics.SectionForces(crane.load("mini_forwarder"), "link7")
