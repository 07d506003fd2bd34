"""Physically impossible inertias: when they are corrected, reported or refused."""

import warnings
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import warned
from command_line import typed
from lxml import etree
from scipy.linalg import null_space
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

import crane
from crane.common.errors import DescriptionError
from crane.description.kinematic_tree import inertia_problem, nearest_inertia
from crane.formats import check

GRBDA = Path(__file__).parents[2] / "shared" / "data" / "third_party" / "grbda"
FILES = sorted(GRBDA.glob("*.urdf"))


def told(path, **options):
    """The machine of a file, and its warnings of inertias."""
    machine, texts = warned.told(crane.load, path, **options)
    return machine, [
        text for text in texts if "home was searched for" not in text and "loop" not in text
    ]


# --- the nearest possible inertia --------------------------------------------------------------


def second_moments(tensor):
    return np.trace(tensor) / 2 * np.eye(3) - tensor


@pytest.mark.parametrize(
    ("moments", "nearest"),
    [
        ((1.0, 1.0, 1.0), (1.0, 1.0, 1.0)),
        ((0.0, 0.0, 2.0), (1.0, 1.0, 2.0)),  # planar: a disc
        ((0.01, 0.01, 0.1), (0.05, 0.05, 0.1)),
        ((-0.02, 1.0, 1.0), (0.0, 1.01, 1.01)),  # second moments 1.01, -0.01, -0.01: the first
    ],
)
def test_nearest_inertias_by_hand(moments, nearest):
    turn = Rotation.random(random_state=1).as_matrix()
    found = nearest_inertia(turn @ np.diag(moments) @ turn.T)
    assert np.allclose(turn.T @ found @ turn, np.diag(nearest), rtol=0, atol=1e-14)
    assert inertia_problem(1.0, found) is None


def test_nearest_inertias_are_the_nearest():
    """No body with a second moment L L^T, L drawn or sought, is nearer in Frobenius' norm."""
    rng = np.random.default_rng(4)
    for _ in range(10):
        drawn = rng.normal(size=(3, 3))
        tensor = drawn + drawn.T + np.eye(3)
        found = second_moments(nearest_inertia(tensor))
        least = np.linalg.norm(found - second_moments(tensor))

        def distance(x, tensor=tensor):
            root = x.reshape(3, 3)
            return np.sum((root @ root.T - second_moments(tensor)) ** 2)

        best = min(minimize(distance, rng.normal(size=9), tol=1e-14).fun for _ in range(5))
        assert least**2 == pytest.approx(best, rel=1e-6, abs=1e-9)


# --- the benchmark of generalized_rbda ---------------------------------------------------------


def independent_accelerations(path, machine, q, v, tau):
    """Accelerations by Pinocchio's own reading of the file, and the null space of its loops.

    a = a_p + N (N^T M N)^-1 N^T (tau - h - M a_p) with J a_p = -Jdot v, J N = 0, in the
    machine's order of columns. All that is taken of the machine is which column is whose.
    """
    robot = etree.parse(path).getroot()
    model = pin.buildModelFromXML(single_freedoms(robot))
    order = np.array([machine.column(name) for name in model.names[1:]])
    # three revolute joints there are a rotation vector here
    coordinates, h = machine.coordinates, 1e-4
    angles, rates = coordinates.cardan_angles(q)
    ahead, before = (
        coordinates.cardan_angles(q + coordinates.coordinate_derivatives(q, x * v))[1]
        for x in (h, -h)
    )
    theirs, tau = angles[order], np.linalg.solve(rates.T, tau)
    loops = [loop_frames(model, loop) for loop in robot.iterfind("loop")]
    gears = np.array([gear(robot, model, one) for one in robot.iterfind("coupling")])
    data = model.createData()

    def jacobian(at):
        pin.computeJointJacobians(model, data, at)
        pin.updateFramePlacements(model, data)
        rows = [row for loop in loops for row in loop_rows(model, data, *loop)]
        return np.vstack([*rows, *gears])

    speed, step = (rates @ v)[order], 1e-4
    rows = jacobian(theirs)
    far = [jacobian(pin.integrate(model, theirs, k * step * speed)) for k in (-2, -1, 1, 2)]
    bias = (8 * (far[2] - far[1]) - (far[3] - far[0])) @ speed / (12 * step)
    free = null_space(rows, rcond=1e-9)
    mass = pin.crba(model, data, theirs)
    mass = np.triu(mass) + np.triu(mass, 1).T
    particular = -np.linalg.pinv(rows, rcond=1e-9) @ bias
    rest = tau[order] - pin.nonLinearEffects(model, data, theirs, speed) - mass @ particular
    found = particular + free @ np.linalg.solve(free.T @ mass @ free, free.T @ rest)
    out = np.zeros_like(found)
    out[order] = found
    return np.linalg.solve(rates, out - (ahead - before) @ v / (2 * h))


def single_freedoms(robot):
    """URDF whose floating joints are series of six, of one coordinate each."""
    alone = etree.fromstring(etree.tostring(robot))
    for joint in alone.findall("joint"):
        if joint.get("type") == "continuous":  # of which Pinocchio makes cosine and sine
            joint.set("type", "revolute")
            etree.SubElement(joint, "limit", lower="-9", upper="9", effort="9", velocity="9")
        if joint.get("type") != "floating":
            continue
        alone.remove(joint)
        name, link = joint.get("name"), joint.find("parent").get("link")
        for i in range(6):
            below = joint.find("child").get("link") if i == 5 else f"{name}_{i}"
            if i < 5:
                etree.SubElement(alone, "link", name=below)
            one = etree.SubElement(alone, "joint", type="revolute" if i > 2 else "prismatic")
            one.set("name", f"{name}_{('x', 'y', 'z', 'rx', 'ry', 'rz')[i]}")
            etree.SubElement(one, "parent", link=link)
            etree.SubElement(one, "child", link=below)
            etree.SubElement(one, "axis", xyz=("1 0 0", "0 1 0", "0 0 1")[i % 3])
            etree.SubElement(one, "limit", lower="-9", upper="9", effort="9", velocity="9")
            link = below
    return etree.tostring(alone).decode()


def loop_frames(model, loop):
    """Two frames of Pinocchio, and two directions across the axis, (3, 2)."""
    frames = []
    for end in ("predecessor", "successor"):
        tag = loop.find(end)
        xyz = [float(x) for x in tag.find("origin").get("xyz").split()]
        link = model.frames[model.getFrameId(tag.get("link"), pin.FrameType.BODY)]
        name = f"{loop.get('name')}_{end}"
        place = link.placement * pin.SE3(np.eye(3), np.array(xyz))
        frames.append(
            model.addFrame(pin.Frame(name, link.parentJoint, place, pin.FrameType.OP_FRAME))
        )
    axis = np.array([[float(x) for x in loop.find("axis").get("xyz").split()]])
    return (*frames, null_space(axis) if loop.get("type") != "spherical" else np.zeros((3, 0)))


def loop_rows(model, data, one, two, across):
    world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    first, second = (pin.getFrameJacobian(model, data, frame, world) for frame in (one, two))
    yield first[:3] - second[:3]
    axis = data.oMf[two].rotation @ np.cross(*across.T) if across.size else None
    for direction in across.T:
        arm = np.cross(data.oMf[one].rotation @ direction, axis)
        yield arm @ (first[3:] - second[3:])


def gear(robot, model, coupling):
    """The row ratio sum_P v - sum_S v of joints below the nearest common ancestor."""
    above = {x.find("child").get("link"): x for x in robot.iterfind("joint")}
    ways = []
    for end in ("predecessor", "successor"):
        link, way = coupling.find(end).get("link"), []
        while link in above:
            way.append(above[link].get("name"))
            link = above[link].find("parent").get("link")
        ways.append(way)
    row = np.zeros(model.nv)
    for factor, way, other in ((1.0, *ways), (-1.0, *ways[::-1])):
        ratio = float(coupling.find("ratio").get("value")) if factor > 0 else 1.0
        for name in set(way) - set(other):
            row[model.joints[model.getJointId(name)].idx_v] += factor * ratio
    return row


@pytest.mark.skipif(not FILES, reason="the files of generalized_rbda are not there")
@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
@pytest.mark.filterwarnings("ignore::crane.common.errors.CraneWarning")
def test_the_benchmark_loads_and_moves_by_its_own_numbers(path):
    machine = crane.load(path)
    dynamics = crane.Dynamics(machine, backend="pinocchio")
    rng = np.random.default_rng(1)
    active = machine.closure.active
    for _ in range(3):
        q_a = machine.home[active] + rng.uniform(-1e-3, 1e-3, len(active))
        v_a, tau_a = rng.normal(size=(2, len(active))) * [[0.1], [1.0]]
        q = machine.closure.solve(q_a)
        gamma = machine.closure.gamma(q)
        found = dynamics.forward(q_a, v_a, tau_a)
        tau = np.zeros(machine.model.nv)
        tau[active] = tau_a
        expected = independent_accelerations(path, machine, q, gamma @ v_a, tau)[active]
        assert np.abs(found - expected).max() < 1e-6 * np.abs(expected).max()


# --- what is taken, and told -------------------------------------------------------------------

ROBOT = (
    '<robot name="two">\n<link name="base"/>\n<link name="arm"><inertial>{arm}</inertial></link>\n'
    '<joint name="turn" type="continuous"><parent link="base"/><child link="arm"/>'
    '<axis xyz="{axis}"/></joint>\n</robot>\n'
)


def inertial(mass=2.0, com="0 0 0", **parts):
    keys = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    tensor = " ".join(f'{key}="{parts.get(key, 0)}"' for key in keys)
    return f'<origin xyz="{com}"/><mass value="{mass}"/><inertia {tensor}/>'


def robot(folder, arm, axis="0 0 1"):
    path = folder / "two.urdf"
    path.write_text(ROBOT.format(arm=arm, axis=axis))
    return path


def test_a_planar_body_is_taken_as_the_file_has_it(tmp_path):
    path = robot(tmp_path, inertial(izz=0.5, com="0.3 0 0"))
    machine, lines = told(path)
    assert lines == [
        "two.urdf:3: link 'arm' has an inertia of no possible body: principal moments 0 + 0 < 0.5 "
        'kg m2; computed with as it stands, the nearest possible is ixx="0.25" ixy="0" ixz="0" '
        'iyy="0.25" iyz="0" izz="0.5"'
    ]
    mass = crane.Dynamics(machine, backend="pinocchio").mass_matrix([0.4])
    assert mass[0, 0] == pytest.approx(0.5 + 2 * 0.09, rel=1e-12)


def test_the_nearest_is_taken_where_a_motion_would_move_no_mass(tmp_path):
    path = robot(tmp_path, inertial(izz=0.5), axis="1 0 0")
    machine, lines = told(path)
    assert lines == [
        "two.urdf:3: link 'arm' has an inertia of no possible body: principal moments 0 + 0 < 0.5 "
        'kg m2; computed with the nearest possible, ixx="0.25" ixy="0" ixz="0" iyy="0.25" '
        'iyz="0" izz="0.5": write it'
    ]
    mass = crane.Dynamics(machine, backend="pinocchio").mass_matrix([0.4])
    assert mass[0, 0] == pytest.approx(0.25, rel=1e-12)
    assert machine.tree.links["arm"].inertial.tensor == pytest.approx((0.25, 0, 0, 0.25, 0, 0.5))


def test_the_nearest_is_taken_of_a_moment_rounded_below_zero(tmp_path):
    path = robot(tmp_path, inertial(ixx=-0.01, iyy=1.0, izz=1.0), axis="0 1 0")
    machine, lines = told(path)
    assert len(lines) == 1
    assert "moment of inertia -0.01 kg m2; computed with the nearest possible, ixx" in lines[0]
    mass = crane.Dynamics(machine, backend="pinocchio").mass_matrix([0.0])
    assert mass[0, 0] == pytest.approx(1.005, rel=1e-9)


def test_a_mass_without_inertia_is_a_point(tmp_path):
    machine, lines = told(robot(tmp_path, inertial(com="0.3 0 0")))
    assert lines == ["two.urdf:3: link 'arm' has a mass but no inertia; taken as a point mass"]
    mass = crane.Dynamics(machine, backend="pinocchio").mass_matrix([0.0])
    assert mass[0, 0] == pytest.approx(2 * 0.09, rel=1e-12)


@pytest.mark.parametrize(
    ("arm", "axis", "message"),
    [
        (inertial(ixx=-0.2, iyy=1, izz=1), "0 0 1", "negative principal moment of inertia -0.2 "),
        (inertial(mass=-1, izz=1), "0 0 1", "has the mass -1 kg, give a positive one"),
        (inertial(), "0 0 1", "joint 'turn' moves link 'arm', which has no inertia against it"),
        (inertial(ixx=0, iyy=1, izz=1), "1 0 0", "link 'arm', which has no inertia against it"),
    ],
    ids=["negative", "mass", "point about itself", "rod about itself"],
)
def test_what_no_form_excuses_stays_refused(arm, axis, message, tmp_path):
    path = robot(tmp_path, arm, axis)
    with warnings.catch_warnings(), pytest.raises(DescriptionError, match=message):
        warnings.simplefilter("ignore")
        crane.load(path)
    assert any(message in str(finding) for finding in check(path).findings if finding.is_error)


def test_check_and_strict_refuse_the_form(tmp_path):
    path = robot(tmp_path, inertial(izz=0.5, com="0.3 0 0"))
    line = (
        "two.urdf:3: link 'arm' has an inertia of no possible body: principal moments 0 + 0 < 0.5 "
        'kg m2, the nearest possible is ixx="0.25" ixy="0" ixz="0" iyy="0.25" iyz="0" izz="0.5", '
        "correct it"
    )
    with pytest.raises(DescriptionError) as caught:
        crane.load(path, strict=True)
    assert str(caught.value) == line
    report = check(path)
    assert [str(one) for one in report.findings] == [line.replace(": link", ": error: link", 1)]
    assert report.status == 2
    done = typed("info", path, "--strict")
    assert (done.returncode, done.stderr) == (2, f"error: {line}\n")
    assert typed("info", path).returncode == 0


def test_the_written_tensor_is_possible(tmp_path):
    """The values that the warning proposes load without a warning."""
    drawn = inertial(ixx=0.3, ixy=0.01, iyy=0.2, iyz=-0.02, izz=0.9, com="0.3 0 0")
    _, (line,) = told(robot(tmp_path, drawn))
    nearest = line.partition("the nearest possible is ")[2]
    whole = f'<origin xyz="0.3 0 0"/><mass value="2"/><inertia {nearest}/>'
    assert told(robot(tmp_path, whole))[1] == []


def test_changed_numbers_find_no_excuse(tmp_path):
    """An inertia that is given as a change is refused, not corrected."""
    path = robot(tmp_path, inertial(ixx=1, iyy=1, izz=1))
    with pytest.raises(DescriptionError, match="no possible body"):
        crane.load(path, changes={"arm.inertia.zz": 3.0})


@pytest.mark.parametrize("kind", ["fixed", "floating"])
def test_an_axis_that_a_type_does_not_use_is_not_read(kind, tmp_path):
    body = inertial(ixx=1, iyy=1, izz=1)
    path = robot(tmp_path, body)
    joint = (
        f'<link name="more"><inertial>{body}</inertial></link><joint name="on" type="{kind}">'
        '<parent link="base"/><child link="more"/><axis xyz="{}"/></joint></robot>'
    )
    for axis in ("0 0 0", "none"):
        path.write_text(path.read_text().replace("</robot>", joint.format(axis)))
        assert crane.load(path).tree.joints
        robot(tmp_path, body)


def test_loops_without_an_axis(tmp_path):
    text = (Path(__file__).parent / "data" / "four_bar_loop.urdf").read_text()
    start = text.index("<loop")
    loop = text[start:].replace('type="continuous"', 'type="spherical"', 1)
    loop = loop.replace('<axis xyz="0 0 2"/>', '<axis xyz="0 0 0"/>', 1)
    path = tmp_path / "ball.urdf"
    path.write_text(text[:start] + loop)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert crane.load(path).closure.equations.loops[0].type == "spherical"
