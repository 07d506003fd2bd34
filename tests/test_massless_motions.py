"""Motions that move no inertia: idle ones are left out, singular mass matrices are errors."""

import numpy as np
import oracles
import pinocchio as pin
import pytest
import urdf_text
from urdf_text import body, frame, joint, loop
from warned import told

import crane
from crane.common.errors import (
    CraneWarning,
    DescriptionError,
    InputError,
    SimulationError,
    SingularMassMatrixError,
)

pytestmark = pytest.mark.filterwarnings("ignore::crane.common.errors.CraneWarning")
STROKES = [f"s{i}" for i in range(6)]
BALL, SLIDE = "spherical", "prismatic"


def ball_loop(name, one, place, other, reach):
    ends = [" ".join(repr(float(x)) for x in at) for at in (place, reach)]
    return (
        f'<loop name="{name}" type="spherical"><predecessor link="{one}"><origin xyz="{ends[0]}"/>'
        f'</predecessor><successor link="{other}"><origin xyz="{ends[1]}"/></successor></loop>'
    )


def load(folder, lines, home=None, **options):
    states = "".join(f'<joint name="{x}" value="{value!r}"/>' for x, value in (home or {}).items())
    state = f'<group_state name="home">{states}</group_state>'
    return crane.load(urdf_text.write(folder, "machine", "base", *lines, state), **options)


def stewart(folder, axial, along="x"):
    """A platform on six legs of ball, stroke, ball; rods along an axis of their links."""
    e = np.eye(3)["xyz".index(along)]
    moments = np.where(e > 0, axial, [0.02] * 3)
    angles = np.radians([[-10, 10, 110, 130, 230, 250], [-50, 50, 70, 170, 190, 290]])
    feet, heads = (
        np.column_stack([radius * np.cos(turn), radius * np.sin(turn), np.full(6, height)])
        for turn, radius, height in zip(angles, (0.6, 0.4), (0.0, 0.8), strict=True)
    )
    lines = []
    for i, (foot, head) in enumerate(zip(feet, heads, strict=True)):
        length = np.linalg.norm(head - foot)
        turn = pin.Quaternion.FromTwoVectors(e, head - foot).matrix()
        lines += [
            body(f"barrel{i}", 2.0, 0.25 * e, moments),
            body(f"rod{i}", 1.0, -0.2 * e, moments / 2),
            joint(f"foot{i}", "base", f"barrel{i}", foot, BALL, turn=pin.rpy.matrixToRpy(turn)),
            joint(f"s{i}", f"barrel{i}", f"rod{i}", length * e, SLIDE, e, (-1, 1)),
        ]
        if not i:
            back = pin.rpy.matrixToRpy(turn.T)
            lines.append(body("platform", 30.0, heads.mean(0) - head, (1.0, 1.2, 2.0)))
            lines.append(joint("head0", "rod0", "platform", kind=BALL, turn=back))
        else:
            lines.append(ball_loop(f"head{i}", "platform", head - heads[0], f"rod{i}", (0, 0, 0)))
    return load(folder, lines, active=STROKES)


def tie_rod(folder, axial, along="x", turned=0.7, more="", base="base", **options):
    """An arm that falls with a rod on a ball at its end."""
    e = np.eye(3)["xyz".index(along)]
    lines = [
        body("arm", 4.0, (0.5, 0, 0), (0.01, 0.3, 0.3)),
        body("rod", 1.0, 0.3 * e, np.where(e > 0, axial, 0.03)),
        joint("h", base, "arm", axis=(0, -1, 0)),
        joint("b", "arm", "rod", (1, 0, 0), BALL),
        more,
    ]
    return load(folder, lines, {"b_rx": 0.2, "b_ry": turned, "b_rz": -0.4}, **options)


def rssr(folder, axial):
    """Crank about z, rod between two balls, rocker about x."""
    lines = [
        body("crank", 1.0, (0.1, 0, 0), (1e-3, 4e-3, 4e-3)),
        body("rod", 0.5, (0.4, 0, 0), (axial, 0.03, 0.03)),
        body("rocker", 1.0, (0, 0, 0.25), (0.02, 0.02, 1e-3)),
        joint("a", "base", "crank"),
        joint("b", "crank", "rod", (0.2, 0, 0), BALL),
        joint("c", "base", "rocker", (0.7, 0.3, -0.5), axis=(1, 0, 0)),
        ball_loop("end", "rocker", (0, 0, 0.5), "rod", (0.58, 0, 0)),
    ]
    return load(folder, lines, {"b_rz": 0.5}, active=["a"])


def hoist(folder):
    """A point mass on a massless rope, drawn as a ball and a stroke below a trolley."""
    lines = [
        body("trolley", 5.0, (0, 0, 0), (0.1, 0.1, 0.1)),
        '<link name="rope"/>',
        body("load", 100.0, moments=(0, 0, 0)),
        joint("x", "base", "trolley", (0, 0, 0), SLIDE, (1, 0, 0), (-9, 9)),
        joint("ball", "trolley", "rope", kind=BALL),
        joint("hoist", "rope", "load", (0, 0, -2), SLIDE, (0, 0, -1), (-9, 9)),
    ]
    return load(folder, lines, active=["x", "hoist"])


def point_arm(folder):
    """A point mass on an arm that turns and lifts: without inertia about the vertical upright."""
    lines = [
        '<link name="column"/>',
        body("arm", 2.0, (1, 0, 0), (0, 0, 0)),
        joint("az", "base", "column"),
        joint("el", "column", "arm", axis=(0, -1, 0)),
    ]
    return load(folder, lines)


def slider_crank(folder):
    """Only the slider has a mass: the crank moves none at its dead centres."""
    lines = [
        '<link name="crank"/><link name="rod"/>',
        body("slider", 2.0, (0, 0, 0), (0.01, 0.01, 0.01)),
        joint("a", "base", "crank", axis=(0, -1, 0)),
        joint("b", "crank", "rod", (0.3, 0, 0), axis=(0, -1, 0)),
        joint("s", "base", "slider", (0, 0, 0), SLIDE, (1, 0, 0), (-9, 9)),
        frame("end", "rod", (0.5, 0, 0)),
        loop("pin", "end", "slider", (0, 1, 0)),
    ]
    return load(folder, lines, {"a": 0.5, "b": -0.79, "s": 0.74}, active=["a"])


def start(machine):
    return machine.home[machine.closure.active]


@pytest.mark.parametrize("along", ["x", "z"])
def test_thin_legs_of_a_stewart_platform(tmp_path, along):
    """Accelerations are those of thick legs that do not spin; how these spin changes nothing."""
    thin, thick = stewart(tmp_path, 0.0, along), stewart(tmp_path, 5e-3, along)
    spins = [f"foot{i}_r{along}" for i in range(6)]
    assert thin.free == tuple(spins) and [thin.active[i] for i in thin.held] == spins
    assert not thick.held and thin.active == thick.active
    dynamics, random = crane.Dynamics(thin, backend="pinocchio"), np.random.default_rng(3)
    for _ in range(3):
        q_a = np.concatenate([random.uniform(-0.1, 0.1, 6), random.uniform(-0.5, 0.5, 6)])
        tau = np.concatenate([random.normal(200.0, 50.0, 6), np.zeros(6)])
        q = thin.closure.solve(q_a)
        gamma, rates = thin.closure.gamma(q), random.normal(size=6)
        # angular velocities of the barrels about their rods, by active velocity
        data = thick.model.createData()
        pin.computeJointJacobians(thick.model, data, thick.coordinates.configuration(q))
        rows = [
            pin.getJointJacobian(thick.model, data, thick.model.getJointId(f"foot{i}"), pin.LOCAL)[
                3 + "xyz".index(along)
            ]
            for i in range(6)
        ]
        spin = np.array(rows) @ gamma
        v_a = np.concatenate([rates, -np.linalg.solve(spin[:, 6:], spin[:, :6] @ rates)])
        forces = np.zeros(len(q))
        forces[thick.closure.active] = tau
        wanted = oracles.constraint_dynamics(thick, q, gamma @ v_a, forces)[thick.closure.active]
        found = dynamics.forward(q_a, v_a, tau)
        np.testing.assert_allclose(found[:6], wanted[:6], rtol=0, atol=1e-6)
        assert (found[6:] == 0).all()
        v_a[6:] += random.normal(0.0, 3.0, 6)
        np.testing.assert_allclose(dynamics.forward(q_a, v_a, tau)[:6], found[:6], atol=1e-9)


def test_thin_legs_simulate(tmp_path):
    """A platform that falls moves as one on thick legs that are at rest at first."""
    runs = []
    for axial in (0.0, 5e-3):
        machine = stewart(tmp_path, axial)
        runs.append(crane.simulate(machine, initial=(start(machine), np.zeros(12)), duration=0.2))
        c = runs[-1].channels
        assert np.ptp(c["work"] - c["kinetic"] - c["potential"]) < 1e-8 * np.ptp(c["kinetic"])
    assert np.ptp(runs[0].q[:, 0]) > 0.1 and not runs[0].v[:, 6:].any()
    np.testing.assert_allclose(runs[0].q[:, :6], runs[1].q[:, :6], rtol=0, atol=1e-9)


@pytest.mark.parametrize("make", [lambda f, i: tie_rod(f, i, active=["h"]), rssr])
def test_rods_between_balls_move_as_rods_that_do_not_spin(tmp_path, make):
    runs = []
    for axial in (0.0, 2e-3):
        machine = make(tmp_path, axial)
        assert len(machine.held) == (axial == 0)
        n = len(machine.active)
        runs.append(
            crane.simulate(machine, initial=(start(machine), np.zeros(n)), duration=0.8, step=1e-3)
        )
        c = runs[-1].channels
        assert np.ptp(c["work"] - c["kinetic"] - c["potential"]) < 1e-8 * np.ptp(c["kinetic"])
    first = [run.q[:, 0] for run in runs]
    assert np.ptp(first[0]) > 0.1
    np.testing.assert_allclose(*first, rtol=0, atol=1e-8)


def wrist(folder, rubbed=""):
    """An arm of two joints with a tool that has no inertia about its roll."""
    tool = body("tool", 1.0, (0.3, 0, 0), (0.0, 0.03, 0.03))
    roll = joint("roll", "fore", "tool", (1, 0, 0), axis=(1, 0, 0))
    lines = [
        body("arm", 4.0, (0.5, 0, 0), (0.01, 0.3, 0.3)),
        body("fore", 3.0, (0.5, 0.1, 0), (0.01, 0.2, 0.2)),
        tool,
        joint("h", "base", "arm", axis=(0, -1, 0)),
        joint("k", "arm", "fore", (1, 0, 0), axis=(0, 0, 1)),
        roll.replace("</joint>", f"{rubbed}</joint>"),
    ]
    return load(folder, lines)


def test_backends_and_derivatives_agree_on_what_is_left(tmp_path):
    machine = wrist(tmp_path)
    assert [machine.active[i] for i in machine.held] == ["roll"] and machine.free == ("roll",)
    found, checked = (crane.Dynamics(machine, backend=name) for name in ("compiled", "pinocchio"))
    random, tau = np.random.default_rng(0), np.array([3.0, -2.0, 0.0])
    q_a, v_a = random.normal(size=(2, 3))
    wanted = checked.forward(q_a, v_a, tau)
    assert wanted[2] == 0 and np.abs(wanted[:2]).min() > 0.1
    np.testing.assert_allclose(found.forward(q_a, v_a, tau), wanted, rtol=1e-11)
    needed = found.inverse(q_a, v_a, wanted)
    np.testing.assert_allclose(needed, tau, rtol=0, atol=1e-12)  # met in the idle motion, too
    by_q = found.derivatives("forward", q_a, v_a, tau, by=["q_a"])["q_a"]
    for k in range(3):
        step = 1e-6 * np.eye(3)[k]
        ends = [checked.forward(q_a + side * step, v_a, tau) for side in (1, -1)]
        np.testing.assert_allclose(by_q[:, k], (ends[0] - ends[1]) / 2e-6, rtol=0, atol=1e-6)
    forces, a_roll = found.hybrid(q_a, v_a, wanted[:2])
    np.testing.assert_allclose(forces, tau[:2], rtol=0, atol=1e-12)
    assert a_roll == 0


def test_a_hoist_of_a_point_mass(tmp_path):
    """A pendulum on a rope: the same as its closed form, with a spin that is idle."""
    machine = hoist(tmp_path)
    assert [machine.active[i] for i in machine.held] == ["ball_rz"]
    trolley, mass, length, swing = 5.0, 100.0, 2.0, 0.3
    model = crane.linearize(machine, start(machine))
    assert np.isfinite(model.A).all() and len(model.A) == 10
    q_a = np.array([0.0, 0.0, 0.0, swing, 0.0])
    found = crane.Dynamics(machine).forward(q_a, np.zeros(5), [0.0, -mass * 9.81, 0.0, 0.0, 0.0])
    # trolley and mass under the pull F of the rope, in a plane
    pull = mass * 9.81
    a_x = -pull * np.sin(swing) / trolley
    assert found[0] == pytest.approx(a_x, rel=1e-12)
    along, across = np.array([-np.sin(swing), -np.cos(swing)]), [-np.cos(swing), np.sin(swing)]
    relative = np.array([0.0, -9.81]) - pull / mass * along - np.array([a_x, 0.0])
    assert found[1] == pytest.approx(relative @ along, rel=1e-12)
    assert found[3] == pytest.approx(relative @ across / length, rel=1e-12)


def test_what_is_idle_is_said_once(tmp_path):
    _, lines = told(tie_rod, tmp_path, 0.0, active=["h"])
    lines = [line for line in lines if "idle" in line]
    assert lines == [
        "machine.urdf:3: link 'rod' has no inertia against joint 'b_rz': this motion is idle and "
        "is left out of the equations, give it an inertia if its speed counts"
    ]


def test_a_home_where_axes_line_up_is_told(tmp_path):
    lines = [
        '<link name="one"/><link name="two"/>',
        body("load", 5.0, (0.5, 0, 0), (0.03, 0.03, 0.03)),
        joint("x", "base", "one", axis=(1, 0, 0)),
        joint("y", "one", "two", axis=(0, 1, 0)),
        joint("z", "two", "load"),
    ]
    with pytest.warns(CraneWarning, match="singular at home, 'x' and 'z' move link 'one' without"):
        load(tmp_path, lines, {"y": np.pi / 2})


def test_a_force_on_an_idle_motion_is_refused(tmp_path):
    machine = tie_rod(tmp_path, 0.0, "z")
    tau = np.zeros(4)
    tau[machine.held[0]] = 0.5
    with pytest.raises(InputError, match=r"a force of 0\.5 acts on the idle motion of 'b_rz'"):
        crane.Dynamics(machine).forward(start(machine), np.zeros(4), tau)
    several = np.array([0 * tau, tau, 0 * tau])  # a stack of three postures
    places = np.tile(start(machine), (3, 1))
    with pytest.raises(InputError, match=r"a force of 0\.5 acts on the idle motion of 'b_rz'"):
        crane.Dynamics(machine).forward(places, 0 * places, several)
    a_a = crane.Dynamics(machine).forward(places, 0 * places, 0 * several)
    assert a_a.shape == (3, 4) and np.ptp(a_a, axis=0).max() < 1e-12 * np.abs(a_a).max()


def test_driven_and_rubbed_motions_need_an_inertia(tmp_path):
    with pytest.raises(DescriptionError, match="'b_rz' is driven, give it an <inertial>"):
        tie_rod(tmp_path, 0.0, "z", active=["h", "b_rx", "b_ry", "b_rz"])
    with pytest.raises(DescriptionError, match="friction of 'roll' acts on it, give it"):
        wrist(tmp_path, '<dynamics damping="0.1"/>')


def test_links_without_mass_at_the_end_are_refused(tmp_path):
    chain = [
        body("arm", 4.0, (0.5, 0, 0), (0.01, 0.3, 0.3)),
        '<link name="one"/><link name="two"/>',
        joint("h", "base", "arm", axis=(0, -1, 0)),
        joint("j", "arm", "one", (1, 0, 0), axis=(0, -1, 0)),
        joint("k", "one", "two", (0.3, 0, 0), axis=(0, -1, 0)),
    ]
    with pytest.raises(DescriptionError, match="joint 'j' moves link 'one', which has no mass"):
        load(tmp_path, chain)


@pytest.mark.parametrize(
    ("make", "q_a", "text"),
    [
        (point_arm, [0.3, np.pi / 2], "at az = 0.3, el = 1.5708, 'az' moves link 'column'"),
        (slider_crank, [0.0], "at a = 0, 'a' and 'b' move link 'crank'"),
    ],
)
def test_a_mass_matrix_that_is_singular_in_one_configuration(tmp_path, make, q_a, text):
    """Single calls, stacks, derivatives, linear models and runs, by both backends: one line."""
    machine = make(tmp_path)
    home, zero = start(machine), np.zeros(len(q_a))
    compiled, pinocchio = (crane.Dynamics(machine, backend=x) for x in ("compiled", "pinocchio"))
    compiled.forward(home, zero, zero)  # the first call compiles, the next one is the fast one
    calls = [
        lambda: compiled.forward(np.array(q_a), zero, zero),
        lambda: compiled.forward([home, q_a], zero, zero),
        lambda: pinocchio.forward(q_a, zero, zero),
        lambda: compiled.derivatives("forward", q_a, zero, zero),
        lambda: crane.linearize(machine, q_a),
    ]
    for call in calls:
        with pytest.raises(SingularMassMatrixError) as caught:
            call()
        line = str(caught.value).replace(" (sample 1)", "")
        assert text in line and "\n" not in line
    for backend in ("compiled", "pinocchio"):
        with pytest.raises(SimulationError) as caught:
            crane.simulate(machine, initial=(q_a, zero), duration=0.1, backend=backend)
        assert str(caught.value).startswith("at t = 0 s: the mass matrix is singular")
        assert text in str(caught.value)
    near = np.array(q_a) + 1e-3
    np.testing.assert_allclose(
        compiled.forward(near, zero, zero), pinocchio.forward(near, zero, zero), rtol=1e-8
    )


def test_a_graph_has_no_number_there(tmp_path):
    pytest.importorskip("casadi")
    machine = point_arm(tmp_path)
    forward = crane.simulation.casadi_function(machine, "forward")
    zero = np.zeros(2)
    found = [np.ravel(forward([0.3, at], zero, [1.0, 1.0])) for at in (0.5, np.pi / 2)]
    wanted = crane.Dynamics(machine).forward([0.3, 0.5], zero, [1.0, 1.0])
    np.testing.assert_allclose(found[0], wanted, rtol=1e-12)
    assert np.isnan(found[1]).any()


def test_free_joints_that_move_no_inertia_have_no_hybrid_dynamics(tmp_path):
    path = tmp_path / "machine.urdf"
    point_arm(tmp_path)
    machine = crane.load(path, active=["el"], free=["az"])
    with pytest.raises(SingularMassMatrixError, match="'az' moves link 'column'"):
        crane.Dynamics(machine).hybrid([np.pi / 2, 0.3], [0.0, 0.0], [1.0])


def test_the_threshold_is_a_radius_of_gyration(tmp_path):
    """A wire of 0.1 mm on 1 m is a body; one of 1 um has no inertia about itself."""
    wires = {}
    for radius in (1e-4, 1e-6):
        machine = tie_rod(tmp_path, 0.5 * radius**2, active=["h"])
        wires[radius] = machine
        assert len(machine.held) == (radius < 1e-5)
    thin = wires[1e-4]
    found, checked = (crane.Dynamics(thin, backend=x) for x in ("compiled", "pinocchio"))
    one = found.forward(start(thin), np.zeros(4), np.zeros(4))
    np.testing.assert_allclose(
        one, checked.forward(start(thin), np.zeros(4), np.zeros(4)), rtol=1e-4
    )
    assert found.forward(start(thin), np.zeros(4), np.zeros(4)) == pytest.approx(one, abs=0)
    idle = crane.Dynamics(wires[1e-6]).forward(start(thin), np.zeros(4), np.zeros(4))
    assert one[0] == pytest.approx(idle[0], rel=1e-8)


@pytest.mark.parametrize("along", ["x", "y", "z"])
def test_a_rod_that_spins_idly_sways_about_its_equilibrium(tmp_path, along):
    """On an arm that hangs too: modes are those of a thick rod by Pinocchio, less its spin."""
    free = ["h", "b_rx", "b_ry", "b_rz"]
    pillar = body("pillar", 9.0, moments=(1, 1, 1)) + joint("az", "base", "pillar")
    lines = {"active": ["az"], "free": free, "more": pillar}
    thin, thick = (
        tie_rod(tmp_path, axial, along, base="pillar", **lines) for axial in (0.0, 5e-3)
    )
    assert len(thin.held) == 1 and not thick.held
    sway, begin = crane.motion.Sway(thin), start(thin)
    begin[thin.active.index("h")] = -1.2
    hanging = sway.hanging_equilibrium(begin)
    assert len(sway.free_indices) == 3 and hanging[thin.active.index("h")] == pytest.approx(
        -np.pi / 2
    )
    q = thick.coordinates.configuration(thick.closure.solve(hanging))
    data, rows = thick.model.createData(), [thick.column(joint) for joint in free]
    upper = pin.crba(thick.model, data, q)
    mass = (np.triu(upper) + np.triu(upper, 1).T)[np.ix_(rows, rows)]
    stiffness = pin.computeGeneralizedGravityDerivatives(thick.model, data, q)[np.ix_(rows, rows)]
    squares = np.sort(np.linalg.eigvals(np.linalg.solve(mass, stiffness)).real)
    assert abs(squares[0]) < 1e-6
    omega, damping = sway.modes(hanging)
    np.testing.assert_allclose(omega, np.sqrt(squares[1:]), rtol=1e-6)
    assert not damping.any()
    arm = tie_rod(tmp_path, 0.0, along)
    assert arm.free and len(arm.held) == len(arm.free)
    with pytest.raises(InputError, match="it has no free joints that move an inertia"):
        crane.motion.Sway(arm)
