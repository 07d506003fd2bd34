"""Machines drawn by their pins: the same machine as by URDFs, inertias, errors in its terms."""

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import yaml
from command_line import typed
from warned import quiet

import crane
from crane.common.errors import DescriptionError
from crane.formats.drawing.body_inertia import (
    plate_inertia,
    polygon_moments,
    spread_inertia,
    tube_inertia,
)
from crane.formats.steel_cylinder import SteelCylinder

BACKHOE = Path(__file__).parent / "data" / "backhoe.yaml"
LOADER = """
name: loader
drawing:
  base: frame
  points:
    A: [0.0, 2.0]
    B: [0.4, 1.1]
    C: [1.2, 1.5]
    D: [2.4, 0.6]
    E: [1.3, 1.9]
    F: [1.25, 2.4]
    G: [1.5, 1.0]
    H: [2.3, 1.0]
    T: [0.1, 2.35]
    edge: [3.4, 0.5]
  bodies:
    frame: {points: [A, B, T], mass: 8000, centre: [-1.0, 1.0], inertia: [3e+3, 9e+3, 8e+3]}
    boom: {points: [A, C, D, E], mass: 900, width: 0.8}
    bellcrank: {points: [F, E, G], mass: 150}
    link: {points: [G, H], tubes: [{points: [G, H], height: 0.12, width: 0.1, wall: 0.02}]}
    bucket: {points: [D, H, edge], mass: 900, width: 2.5}
  cylinders:
    X_lift: {points: [B, C], bore: 0.12, rod: 0.07, shortest: 0.8, longest: 1.0, count: 2, spacing: 0.8}
    X_tilt: {points: [T, F], bore: 0.14, rod: 0.08, shortest: 1.1, longest: 1.2}
tip: edge
"""  # noqa: E501


@pytest.fixture
def loaded(tmp_path):
    """Load the loader with parts of its text replaced: loaded(old, new, ...)."""

    def load(*changes):
        text = LOADER
        for old, new in zip(changes[::2], changes[1::2], strict=True):
            assert old in text
            text = text.replace(old, new)
        (tmp_path / "loader.yaml").write_text(text)
        return crane.load(tmp_path / "loader.yaml")

    return load


def home_of(machine):
    """Active coordinates (n,) of home."""
    return np.array([machine.home[machine.column(joint)] for joint in machine.active])


def drawn(machine):
    """A machine in one plane and a slew axis as a drawing in its home posture, by Pinocchio."""
    model, data = machine.model, machine.model.createData()
    home = np.array(machine.home)
    pin.forwardKinematics(model, data, home)
    pin.updateFramePlacements(model, data)
    points, pins, slides = {}, {}, {}
    on = {name: [] for name in ("base", *list(model.names)[1:])}
    body_of = {j: name for j, name in enumerate(on)}

    def place(name, placement, *joints):
        points[name] = placement.translation.tolist()
        for joint in joints:
            on[body_of[joint]].append(name)

    for j in range(1, model.njoints):
        name, parent, spec = model.names[j], model.parents[j], machine.tree.joints[model.names[j]]
        if spec.kind == "prismatic":  # from the pin of the barrel to that of the rod
            eye = f"{name}_rod_point"
            place(eye, data.oMi[j], j)
            length = np.linalg.norm(data.oMi[j].translation - data.oMi[parent].translation)
            coordinate = home[machine.column(name)]
            limits = spec.limits
            slides[name] = {
                "bodies": [body_of[parent], body_of[j]],
                "points": [f"{body_of[parent]}_pin", eye], "driven": True,
                "shortest": float(length - coordinate),
                "longest": float(length - coordinate + limits.upper),
            }  # fmt: skip
            continue
        place(f"{name}_pin", data.oMi[j], parent, j)
        axis = data.oMi[j].rotation @ np.array(spec.axis)
        if abs(axis[2]) > 0.9:
            pins[f"{name}_pin"] = {"axis": "z", "driven": True}
    for loop in machine.closure.equations.loops:
        ends = [machine.frame(x) for x in (loop.predecessor, loop.successor)]
        place(loop.name, data.oMf[ends[0]], *(model.frames[x].parentJoint for x in ends))
    place("edge", data.oMf[machine.frame(machine.tip)],
          model.frames[machine.frame(machine.tip)].parentJoint)  # fmt: skip
    bodies = {}
    for j, name in body_of.items():
        inertia = data.oMi[j].act(model.inertias[j])
        xx, xy, yy, xz, yz, zz = inertia.inertia[np.tril_indices(3)].tolist()
        bodies[name] = {"points": on[name], "mass": max(float(inertia.mass), 1.0),
                        "centre": inertia.lever.tolist(),
                        "inertia": [xx, yy, zz, xy, yz, xz]}  # fmt: skip
    bodies["base"] |= {"mass": 1.0, "inertia": [1.0, 1.0, 1.0]}
    drawing = {"base": "base", "points": points, "bodies": bodies, "pins": pins, "slides": slides}
    return {"name": "drawn", "tip": "edge", "drawing": drawing}


@pytest.mark.slow
def test_an_excavator_by_its_pins_is_that_of_its_urdfs(tmp_path):
    original = crane.load("excavator").replace(friction={}, end_stops=())
    (tmp_path / "drawn.yaml").write_text(yaml.safe_dump(drawn(original)))
    machine = crane.load(tmp_path / "drawn.yaml")
    names = ("slew_pin", "X_boom", "X_arm", "X_bucket")
    assert set(machine.active) == set(names)
    columns = [machine.active.index(name) for name in names]
    one, other = crane.Dynamics(original), crane.Dynamics(machine)
    rng = np.random.default_rng(0)
    compared = 0
    for _ in range(200):
        span = np.array(
            [
                x.limits.upper - x.limits.lower
                for x in (original.tree.joints[j] for j in original.active[1:])
            ]
        )
        q = np.array([original.home[original.column(j)] for j in original.active])
        q += np.append(rng.uniform(-1, 1), rng.uniform(-0.3, 0.3, 3) * span)
        q[1:] = np.clip(q[1:], 0.05, span - 0.05)
        v, a = rng.uniform(-0.5, 0.5, (2, 4))
        mine = np.empty((3, 4))
        mine[:, columns] = q, v, a
        expected = one.inverse(q, v, a)
        found = other.inverse(*mine)[columns]
        assert np.abs(found - expected).max() < 1e-12 * max(1.0, np.abs(expected).max())
        compared += 1
        tips = [m.closure.solve(x) for m, x in ((original, q), (machine, mine[0]))]
        assert all(np.isfinite(tip).all() for tip in tips)
    assert compared == 200


def test_a_drawing_is_a_machine(loaded, tmp_path):
    machine = loaded()
    assert machine.active == ("X_lift", "X_tilt")
    assert {x.name for x in machine.closure.equations.loops} == {"H", "X_lift_eye", "X_tilt_eye"}
    q = machine.closure.solve(home_of(machine))
    angles = [q[machine.column(x)] for x in ("A", "D", "E", "G")]
    assert np.abs(angles).max() < 1e-12  # home is what is drawn
    lift, tilt = np.hypot(0.8, 0.4) - 0.8, np.hypot(1.15, 0.05) - 1.1
    assert q[[machine.column("X_lift"), machine.column("X_tilt")]] == pytest.approx([lift, tilt])
    steel = SteelCylinder.from_dimensions(0.12, 0.07, 0.2, 0.8)
    rod = machine.tree.links["X_lift_rod"].inertial
    assert rod.mass == pytest.approx(2 * steel.rod_inertia.mass)
    across = 2 * steel.rod_inertia.inertia[0, 0] + rod.mass * 0.4**2  # two, 0.4 m to each side
    assert rod.tensor[0] == pytest.approx(across, rel=1e-12)
    done = typed("check", tmp_path / "loader.yaml")
    assert done.returncode == 0, done.stdout


def test_statics_of_a_drawing_by_virtual_work(loaded):
    """The forces of the cylinders that hold it: dV = sum F dX, by differences of heights."""
    machine = loaded()
    dynamics, home = crane.Dynamics(machine), home_of(machine)
    force = dynamics.gravity(home)
    for i, step in enumerate(1e-5 * np.eye(2)):
        high, low = (dynamics.energy(home + x, 0 * home)[1] for x in (step, -step))
        assert force[i] == pytest.approx((high - low) / 2e-5, rel=1e-7)
    # by hand: moments about A of all that hangs on the boom, less what the tilt cylinder carries
    model, data = machine.model, machine.model.createData()
    pin.centerOfMass(model, data, machine.closure.solve(home))
    assert data.mass[0] == pytest.approx(
        900 + 150 + 900 + machine.tree.links["link"].inertial.mass
        + sum(machine.tree.links[f"{x}_{y}"].inertial.mass
              for x in ("X_lift", "X_tilt") for y in ("barrel", "rod"))
    )  # fmt: skip


def test_a_circuit_takes_bore_and_rod_from_the_drawing(loaded):
    circuit = """
hydraulics:
  supply: {pressure: 2.5e+7, flow: 3.0e-3}
  cylinders: {all: {hose_a: 1.0e-3, hose_b: 1.0e-3}}
  valves:
    X_lift: {type: compensated, flow: 2.0e-3, margin: 1.0e+6}
    X_tilt: {type: compensated, flow: 2.0e-3, margin: 1.0e+6}
tip: edge
"""
    machine = quiet(loaded, "\ntip: edge\n", circuit)
    lift, tilt = (machine.hydraulics.cylinders[x] for x in ("X_lift", "X_tilt"))
    assert (lift.count, tilt.count) == (2, 1)
    assert lift.area_a == pytest.approx(2 * np.pi / 4 * 0.12**2)
    assert tilt.area_b == pytest.approx(np.pi / 4 * (0.14**2 - 0.08**2))


def monte_carlo(inside, low, high, count=400_000):
    """Volume, centre, and second moments by random points."""
    points = np.random.default_rng(1).uniform(low, high, (count, 3))
    points = points[inside(points)]
    volume = np.prod(np.subtract(high, low)) * len(points) / count
    return volume, points.mean(axis=0), np.cov(points.T, bias=True)


def test_a_triangle_and_a_square():
    area, centre, moments = polygon_moments(np.array([[1.0, 1.0], [4.0, 1.0], [1.0, 3.0]]))
    assert area == pytest.approx(3.0) and centre == pytest.approx([2.0, 5 / 3])
    assert moments == pytest.approx(3.0 / 18 * np.array([[9.0, -3.0], [-3.0, 4.0]]))
    clockwise = polygon_moments(np.array([[0.0, 0.0], [0.0, 2.0], [2.0, 2.0], [2.0, 0.0]]))
    assert clockwise[0] == pytest.approx(4.0)
    assert clockwise[2] == pytest.approx(4 / 3 * np.eye(2))


def test_tubes_and_plates_are_those_of_the_solids():
    ends = np.array([[0.0, 0.1, 0.0], [0.6, 0.1, 0.8]])
    axis, up = np.array([0.6, 0.0, 0.8]), np.array([-0.8, 0.0, 0.6])

    def hollow(points):
        along = (points - ends[0]) @ axis
        y, z = np.abs(points[:, 1] - 0.1), np.abs((points - ends[0]) @ up)
        outside = (along > 0) & (along < 1) & (y < 0.15) & (z < 0.2)
        return outside & ~((y < 0.12) & (z < 0.17))

    volume, centre, moments = monte_carlo(hollow, [-0.3, -0.1, -0.2], [0.9, 0.3, 1.0])
    body = tube_inertia(ends, 0.4, 0.3, 0.03, 1000.0)
    assert body.mass == pytest.approx(1000 * volume, rel=0.02)
    assert body.lever == pytest.approx(centre, abs=5e-3)
    wanted = body.mass * (np.trace(moments) * np.eye(3) - moments)
    assert np.abs(body.inertia - wanted).max() < 0.02 * np.abs(wanted).max()
    round_bar = tube_inertia(np.array([[0.0, 0, 0], [2.0, 0, 0]]), 0.1, None, None, 7850.0)
    mass = 7850 * np.pi / 4 * 0.01 * 2
    assert round_bar.mass == pytest.approx(mass)
    across = mass * (3 * 0.05**2 + 4) / 12
    assert np.diag(round_bar.inertia) == pytest.approx([mass * 0.05**2 / 2, across, across])
    square = np.array([[0.0, 0, 0], [2, 0, 0], [2, 0, 1], [0, 0, 1]], dtype=float)
    plate = plate_inertia(square, 0.1, 0.3, 500.0)
    assert plate.mass == pytest.approx(100.0) and plate.lever == pytest.approx([1.0, 0.3, 0.5])
    boxes = 100 / 12 * np.array([1 + 0.01, 4 + 1, 4 + 0.01])
    assert np.diag(plate.inertia) == pytest.approx(boxes)


def test_a_mass_is_spread_over_its_points():
    rod = spread_inertia(6.0, np.array([[0.0, 0, 0], [1.0, 0, 0], [3.0, 0, 0]]), 0.0)
    assert rod.lever == pytest.approx([1.5, 0, 0])
    assert np.diag(rod.inertia) == pytest.approx([0.0, 4.5, 4.5])
    plate = spread_inertia(12.0, np.array([[0.0, 0, 0], [2, 0, 0], [2, 0, 1], [0, 0, 1.0]]), 3.0)
    assert plate.lever == pytest.approx([1.0, 0.0, 0.5])
    assert np.diag(plate.inertia) == pytest.approx([1 + 9, 4 + 1, 4 + 9])
    corners = np.array([[x, y, z] for x in (0, 2.0) for y in (-1, 1.0) for z in (0, 1.0)])
    box = spread_inertia(12.0, corners, 0.0)  # from its eight corners
    assert np.diag(box.inertia) == pytest.approx([4 + 1, 4 + 1, 4 + 4])
    level = spread_inertia(12.0, corners[:, [0, 2, 1]] * [1, 2, 0], 0.0)  # a plate that lies
    assert np.diag(level.inertia) == pytest.approx([4.0, 4.0, 8.0])


def test_a_platform_on_six_legs_by_ball_joints(tmp_path):
    """Its strokes are distances, and their forces carry the platform's weight by virtual work."""
    angles = np.deg2rad([-15, 15, 105, 135, 225, 255]), np.deg2rad([-48, 48, 72, 168, 192, 288])
    points, cylinders = {"top": [0.0, 0.0, 1.0]}, {}
    for i, (low, high) in enumerate(zip(*angles, strict=True)):
        points[f"B{i}"] = [float(np.cos(low)), float(np.sin(low)), 0.0]
        points[f"T{i}"] = [0.6 * float(np.cos(high)), 0.6 * float(np.sin(high)), 1.0]
        length = np.linalg.norm(np.subtract(points[f"T{i}"], points[f"B{i}"]))
        ends, middle = [f"B{i}", f"T{i}"], float(length)
        sizes = {"bore": 0.05, "rod": 0.03, "shortest": middle - 0.3, "longest": middle + 0.3}
        cylinders[f"X{i}"] = {"points": ends, **sizes}
    eyes = [f"T{i}" for i in range(6)]
    bodies = {
        "ground": {"points": [f"B{i}" for i in range(6)]},
        "platform": {"points": [*eyes, "top"], "mass": 50.0},
    }
    pins = {name: {"axis": "ball"} for name in points if name != "top"}
    drawing = {"base": "ground", "points": points, "bodies": bodies, "pins": pins,
               "cylinders": cylinders}  # fmt: skip
    path = tmp_path / "platform.yaml"
    path.write_text(yaml.safe_dump({"name": "platform", "drawing": drawing, "tip": "top"}))
    machine = crane.load(path)
    assert machine.active == tuple(cylinders) and len(machine.closure.equations.loops) == 5
    tip = crane.Kinematics(machine, "top")
    home = home_of(machine)
    assert home == pytest.approx(np.full(6, 0.3))
    assert tip.position(home) == pytest.approx([0.0, 0.0, 1.0])
    # all legs 0.1 m longer: the platform rises until they are, by Pythagoras, and turns if at all
    moved = home + 0.1
    for leg in range(6):
        q = machine.closure.solve(moved)
        data = machine.model.createData()
        pin.forwardKinematics(machine.model, data, machine.coordinates.configuration(q))
        ends = [pin.updateFramePlacement(machine.model, data, machine.frame(name)).translation
                for name in (f"B{leg}", f"T{leg}")]  # fmt: skip
        wanted = cylinders[f"X{leg}"]["shortest"] + 0.4
        assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(wanted, abs=1e-12)
    dynamics = crane.Dynamics(machine)
    force = dynamics.gravity(moved)
    for i, step in enumerate(1e-5 * np.eye(6)):
        high, low = (dynamics.energy(moved + x, 0 * home)[1] for x in (step, -step))
        assert force[i] == pytest.approx((high - low) / 2e-5, rel=1e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (("points: [G, H], tubes", "points: [G, X], tubes"),
         "loader.yaml:20: body 'link' has the unknown point 'X'"),
        (("bucket: {points: [D, H, edge]", "bucket: {points: [edge]"),
         "loader.yaml:21: body 'bucket' shares no point with a body that is joined to 'frame'"),
        (("longest: 1.0,", "longest: 0.85,"),
         "loader.yaml:23: cylinder 'X_lift' is 0.8944 m from B to C in the drawing, and 0.8 to "
         "0.85 m long: move a point, or correct its lengths"),
        (("B: [0.4, 1.1]", "B: [0.1, 1.7]", "longest: 1.0,", "longest: 1.2,"),
         "loader.yaml:23: cylinder 'X_lift' is 0.8 to 1.2 m long, but its ends, which turn about "
         "A, are 0.9838 to 1.616 m apart: correct its lengths, or move a point"),
        (("X_lift: {points: [B, C]", "X_lift: {points: [B, A]"),
         "cylinder 'X_lift' has both pins on 'frame', which is rigid"),
        (("base: frame", "base: chassis"), "loader.yaml:4: 'base' is the unknown body 'chassis'"),
        (("A: [0.0, 2.0]", "A: [0.0]"), "point 'A' has 1 coordinates, give [x, z] or [x, y, z]"),
        (("A: [0.0, 2.0]", "A: [0.0, 2000]"),
         "loader.yaml:6: point 'A' is at 2000 m: looks like mm, write 2000e-3"),
        (("rod: 0.07", "rod: 0.13"), "the rod of 0.13 m does not fit into the bore of 0.12 m"),
        (("inertia: [3e+3, 9e+3, 8e+3]", "inertia: [3e+3, 9e+3]"),
         "the inertia of body 'frame' has 2 numbers, give 1, 3 or 6"),
        (("bore: 0.14, rod", "stroke: 0.14, rod"), "unknown key 'stroke' in cylinder 'X_tilt'"),
        (("mass: 150", "mass: -150"), "'mass' of body 'bellcrank' is -150, give at least 0"),
        (("tip: edge", "tip: egde"), "'egde' is unknown, did you mean"),
        (("H: [2.3, 1.0]", "H: [1.5, 1.0]"), "a tube of body 'link' has no length, name other"),
        (("tip: edge", "  pins: {D: {axis: w}}\ntip: edge"), "'axis' of pin 'D': 'w' is unknown"),
        (("tip: edge", "  pins: {D: {axis: [0, 0]}}\ntip: edge"),
         "the axis of pin 'D' is no direction, give [x, y, z] or a name"),
        (("points: [F, E, G]", "points: {F: [0, 0.5], E: [0, 0], G: [0.2, -0.9]}"),
         "loader.yaml:19: body 'bellcrank' shares points E and F with the drawing, but they are "
         "0.5 m apart in its own coordinates and 0.5025 m there"),
        (("points: [F, E, G]", "points: {F: [0, 0.5], E: [0, 0, 0, 0], G: [0.2, -0.9]}"),
         "point 'E' has 4 coordinates, give [x, z] or [x, y, z]"),
        (("points: [F, E, G]", "points: {P: [0, 0.5], E: [0, 0], Q: [0.2, -0.9]}"),
         "loader.yaml:19: body 'bellcrank' shares 1 points with the drawing and cannot be placed "
         "by its own coordinates, give the drawing two of its points"),
    ],
)  # fmt: skip
def test_errors_are_in_terms_of_the_drawing(loaded, changes, message):
    with pytest.raises(DescriptionError) as error:
        quiet(loaded, *changes)
    assert message in str(error.value)


def checked(folder, *changes):
    """What `crane check` says of the backhoe with changes, without its counts."""
    text = BACKHOE.read_text()
    for old, new in zip(changes[::2], changes[1::2], strict=True):
        assert text.count(old) == 1
        text = text.replace(old, new)
    (folder / "backhoe.yaml").write_text(text)
    return [x.message for x in crane.check(folder / "backhoe.yaml").findings]


def test_all_errors_of_a_drawing_are_told_at_once_and_each_alone(tmp_path):
    found = checked(tmp_path, "longest: 2.44", "longest: 2.6", "longest: 1.24", "longest: 1.3")
    assert [x.split(" is ")[0] for x in found] == ["cylinder 'X_boom'", "cylinder 'X_dipper'"]
    found = checked(tmp_path, "A: [0.3, 0.75]", "A: [0,3, 0,75]", "mass: 320", "mass: -320",
                    "width: 0.25", "width: -0.25")  # fmt: skip
    assert found == [
        "point 'A' has 4 coordinates, give [x, z] or [x, y, z], with decimal points",
        "'width' of body 'dipper' is -0.25, give at least 0",
    ]
    found = checked(tmp_path, "mass: 320", "mass: -320", "mass: 25}", "mass: 25, width: -1}")
    assert [x.split(" is ")[0] for x in found] == [
        "'mass' of body 'boom'",
        "'width' of body 'link'",
    ]


@pytest.mark.slow
def test_a_backhoe_written_by_hand_digs_as_its_data_sheet_says():
    """JCB 3CX of 2007: depth 5.46 m, reach 6.52 m; 5700 kg and 3010 kg at bucket and dipper."""
    machine = crane.load(BACKHOE)
    found = crane.working_range(machine)
    assert found["digging depth"].value == pytest.approx(5.46, rel=0.05)
    assert found["reach at ground level"].value == pytest.approx(6.52, rel=0.05)
    forces = crane.ratings.breakout(machine)
    assert forces.bucket.isolated_force == pytest.approx(5700 * 9.80665, rel=0.05)
    assert forces.arm.isolated_force == pytest.approx(3010 * 9.80665, rel=0.05)


def own_coordinates(names, angle, origin):
    """Points of the loader in a frame that is turned and moved, as YAML."""
    drawn = yaml.safe_load(LOADER)["drawing"]["points"]
    c, s = np.cos(angle), np.sin(angle)
    places = {x: np.array([[c, s], [-s, c]]) @ np.subtract(drawn[x], origin) for x in names}
    return {name: place.tolist() for name, place in places.items()}


def test_bodies_drawn_on_their_own_are_placed_by_shared_points(loaded):
    """A bellcrank upside down in its own drawing, and a link that hangs on it alone."""
    masses = "mass: 150, centre: [1.4, 1.5], inertia: [3, 12, 9, 0, 0, 1]}"
    one = loaded("mass: 150}", masses)
    crank = own_coordinates(("E", "F", "G"), 2.5, (0.3, 0.7))
    c, s = np.cos(2.5), np.sin(2.5)
    centre = (np.array([[c, s], [-s, c]]) @ [1.1, 0.8]).tolist()
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    tensor = turn @ np.array([[3, 0, 1], [0, 12, 0], [1, 0, 9.0]]) @ turn.T
    numbers = tensor[[0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2]].tolist()
    other = loaded(
        "    G: [1.5, 1.0]\n", "",  # of the bellcrank's own drawing alone
        "points: [F, E, G], mass: 150}",
        f"points: {crank}, mass: 150, centre: {centre}, inertia: {numbers}}}",
        "link: {points: [G, H]", f"link: {{points: {own_coordinates(('G', 'H'), -1.0, (5, 5))}",
    )  # fmt: skip
    home = home_of(one)
    assert home_of(other) == pytest.approx(home, abs=1e-12)
    for strokes in (home, home + 0.05, home - 0.03):
        motion = strokes, np.array([0.1, -0.2]), np.array([0.3, 0.4])
        found, wanted = (crane.Dynamics(x).inverse(*motion) for x in (other, one))
        assert found == pytest.approx(wanted, rel=1e-11)


def test_what_two_bodies_share_is_at_one_place(loaded):
    """A link that is 12 mm too long, and a bellcrank seen from behind."""
    link = {"G": [0.0, 0.0], "H": [0.812, 0.0]}
    with pytest.raises(DescriptionError) as error:
        loaded("link: {points: [G, H]", f"link: {{points: {link}")
    assert str(error.value) == (
        "loader.yaml:20: body 'link' shares points G and H with the drawing, but they are 0.812 m "
        "apart in its own coordinates and 0.8 m there: correct one of them"
    )
    crank = own_coordinates(("E", "F", "G"), 1.0, (0.0, 0.0))
    behind = {name: [-x, z] for name, (x, z) in crank.items()}
    with pytest.raises(DescriptionError, match="'bellcrank' is drawn from the other side, mirror"):
        loaded("points: [F, E, G]", f"points: {behind}")


def test_a_pin_has_any_axis(loaded):
    named, drawn = loaded(), "tip: edge"
    turned = loaded(drawn, f"  pins: {{E: {{axis: [0, -2, 0]}}}}\n{drawn}")
    home = home_of(named)
    assert turned.tree.joints["E"].axis == pytest.approx(named.tree.joints["E"].axis)
    forces = [crane.Dynamics(x).gravity(home) for x in (named, turned)]
    assert forces[0] == pytest.approx(forces[1], rel=1e-14)


def test_masses_may_be_estimated(loaded):
    with pytest.warns(crane.CraneWarning, match=r"masses are estimated of 'boom' \(\d+ kg\)"):
        machine = loaded("mass: 900, width: 0.8", "width: 0.8")
    length = np.hypot(2.4, 1.4)
    steel = 1.5 * 7850 * 2 * np.pi / 4 * 0.12**2 * length  # of the two lift cylinders
    assert machine.tree.links["boom"].inertial.mass == pytest.approx(steel)


def test_a_drawing_is_written_out_as_urdfs(loaded, tmp_path):
    machine = loaded()
    path = crane.write_machine(machine, tmp_path / "written")
    assert sorted(x.suffix for x in Path(path).parent.rglob("*.*")) == [".urdf", ".yaml"]
    again = crane.load(path)
    home = home_of(machine)
    weights = [crane.Dynamics(x).gravity(home) for x in (again, machine)]
    assert weights[0] == pytest.approx(weights[1])
