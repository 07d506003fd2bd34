"""Springs, gas springs and ropes between two frames: closed forms, energies, both backends."""

import warnings
from itertools import pairwise

import families
import numpy as np
import oracles
import pinocchio as pin
import pytest
from broken_machines import MACHINE, assert_refused, case, copy_machine, swap
from command_line import typed
from test_compiled import off
from urdf_text import body, joint
from warned import quiet

import crane
from crane.closure.kinematics_formulas import FormulaConstants, PositionKinematics
from crane.closure.loop_formulas import LoopFormulas
from crane.common.errors import CraneWarning, InputError
from crane.description import ForceElement, Rope
from crane.dynamics.compiled_dynamics import QUANTITIES, STICK_SLIP_QUANTITIES
from crane.dynamics.dynamics_formulas import DynamicsFormulas
from crane.identification.mechanics.base_parameters import random_samples
from crane.identification.mechanics.identification_model import IdentificationModel
from crane.identification.mechanics.model_terms import (
    GasSpringTerm,
    InertialTerm,
)

BOOM, STRUT = ("base", "link7"), ("link3_H", "A1_rod")  # of the mini forwarder


def bare(machine):
    return machine.replace(friction={}, forces=(), gas_springs=(), ropes=(), end_stops=())


def places(machine, q, links):
    """Origins of links in the world, from Pinocchio."""
    model, data = machine.model, machine.model.createData()
    pin.framesForwardKinematics(model, data, machine.coordinates.configuration(q))
    return [data.oMf[machine.frame(link)].translation.copy() for link in links]


def length(machine, q_a, pair):
    one, two = places(machine, machine.closure.solve(q_a), pair)
    return float(np.linalg.norm(two - one))


def clad(machine, seed):
    """A machine with elements of all kinds between links of random pairs of bodies."""
    random = np.random.default_rng(seed)
    model = machine.model
    links = [f.name for f in model.frames if f.type == pin.FrameType.BODY]
    body = {link: model.frames[machine.frame(link)].parentJoint for link in links}
    at_home = dict(zip(links, places(machine, machine.home, links), strict=True))
    pairs = []
    while len(pairs) < 4:
        one, two = (str(x) for x in random.choice(links, 2, replace=False))
        if body[one] != body[two] and np.linalg.norm(at_home[two] - at_home[one]) > 0.05:
            pairs.append((one, two))
    far = [float(np.linalg.norm(at_home[two] - at_home[one])) for one, two in pairs]
    return machine.replace(
        forces=(
            ForceElement("", 30.0, 0.8 * far[0], 4.0, 2.0, between=pairs[0]),
            ForceElement("", 20.0, between=pairs[0]),
            ForceElement(damping=3.0, between=pairs[1]),
            ForceElement(machine.joints[0], stiffness=2.0, damping=0.1),
        ),
        gas_springs=(
            crane.description.GasSpring("one", 1e-3, 2e4, 1e-3, far[0], 1.4, between=pairs[0]),
            crane.description.GasSpring("two", 1e-3, 1e4, 2e-3, far[2], between=pairs[2]),
        ),
        ropes=(
            Rope(pairs[3], 0.9 * far[3], 500.0, 2.0),
            Rope(pairs[3], 1.02 * far[3], 300.0),
        ),
    )


# --- both backends ---------------------------------------------------------------------------


class Floats(FormulaConstants):
    """Numbers of a machine, not traced: formulas of floats are floats."""

    def __init__(self, values):
        self._values = values

    def __getitem__(self, index):
        return float(self._values[index])


def formula(dynamics, quantity, q, v_a, x):
    """A quantity by its formulas, without compiling them."""
    fast = dynamics.machine.closure.compiled_closure
    posture = PositionKinematics(fast.geometry, Floats(fast.geometry.constants), q.tolist())
    loops = LoopFormulas(
        fast._equations, fast._structure, fast._active_columns, fast._passive_columns, posture
    )
    sweep = DynamicsFormulas(
        posture, loops, Floats(dynamics.formula_constants), q.tolist(), v_a.tolist(),
        dynamics.formula_structure,
        quantity in STICK_SLIP_QUANTITIES,
    )  # fmt: skip
    return np.array(QUANTITIES[quantity](sweep, x.tolist()), dtype=float)


def same_on_both_backends(machine, samples):
    one, two = (crane.Dynamics(machine, backend=x) for x in ("compiled", "pinocchio"))
    q_a, v_a, x = samples
    q = machine.closure.solve(q_a)
    for quantity in ("passive", "inverse with friction", "bias", "energy", "rates", "observation"):
        wanted = two.evaluate_closed(quantity, q, v_a, x)
        found = np.array(
            [formula(one, quantity, *sample) for sample in zip(q, v_a, x, strict=True)]
        )
        assert off(found, wanted) < (1e-9 if quantity == "rates" else 1e-11)
    assert np.abs(two.evaluate_closed("passive", q, v_a, x)).max() > 0.1
    return one


def samples_of(machine, reach, count=4, seed=0):
    random, n = np.random.default_rng(seed), len(machine.active)
    home = machine.home[machine.closure.active]
    q_a = np.clip(home + random.uniform(-reach, reach, (count, n)), machine.lower, machine.upper)
    return q_a, random.normal(size=(count, n)), 5 * random.normal(size=(count, n))


@pytest.mark.parametrize("kind", ["spherical", "revolute", "cylindrical"])
def test_random_mechanisms(kind, tmp_path):
    made = 0
    for seed in range(40):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CraneWarning)
            try:
                machine = crane.load(oracles.random_mechanism(tmp_path, seed, kind))
            except crane.CraneError:
                continue
        condition = float(machine.closure.condition_number(machine.home))
        if condition < 30 and len(machine.joints) < 8:
            same_on_both_backends(clad(machine, seed), samples_of(machine, 0.005))
            made += 1
        if made == 2:
            return
    raise AssertionError("too few mechanisms")


def test_machine_code(mini):
    machine = clad(bare(mini), 1)
    samples = states(machine)
    one = same_on_both_backends(machine, samples)
    two = crane.Dynamics(machine, backend="pinocchio")
    q = mini.closure.solve(samples[0])
    for quantity in ("passive", "rates", "observation"):
        assert one.backend_of(quantity) == "compiled"
        found, wanted = (d.evaluate_closed(quantity, q, *samples[1:]) for d in (one, two))
        assert off(found, wanted) < 1e-11


def states(machine, count=5):
    """All over the strokes of the mini forwarder."""
    random = np.random.default_rng(7)
    low, high = np.array([[-3.0, 0.001, 0.001], [3.0, 0.029, 0.029]])
    v_a = random.uniform(-1, 1, (count, 3)) * [1.0, 0.05, 0.05]
    return random.uniform(low, high, (count, 3)), v_a, random.uniform(-1, 1, (count, 3))


@pytest.mark.parametrize(("family", "joints"), [("ring", 12), ("tree", 25)])
def test_large_machines(family, joints, tmp_path):
    """By recursion over clusters, across which the elements act."""
    machine = clad(crane.load(families.write(family, joints, tmp_path)), 5)
    dynamics = same_on_both_backends(machine, samples_of(machine, 0.05))
    assert dynamics.formula_structure.recursion_plan and len(machine.active) > 7


# --- work and energy -------------------------------------------------------------------------


def test_forces_are_the_slope_of_what_is_stored(mini):
    """With laws and lengths written out here; on both backends; added to gravity's."""
    gas = crane.description.GasSpring("strut", 2e-4, 3e5, 2e-5, 0.15, 1.3, between=STRUT)
    machine = bare(mini).replace(
        forces=(ForceElement("", 300.0, 0.2, 0.0, -4.0, between=BOOM),),
        gas_springs=(gas,),
        ropes=(Rope(BOOM, 0.2, 900.0, 3.0),),
    )

    def stored(q_a):
        boom, strut = (length(machine, q_a, pair) for pair in (BOOM, STRUT))
        volume = 2e-5 + 2e-4 * (strut - 0.15)
        work = 3e5 * 2e-5**1.3 * (volume**-0.3 - 2e-5**-0.3) / -0.3
        taut = max(0.0, boom - 0.2)
        return 150 * (boom - 0.2) ** 2 + 4 * boom - work + 450 * taut**2

    random = np.random.default_rng(2)
    for backend in ("compiled", "pinocchio"):
        dynamics, plain = (crane.Dynamics(x, backend=backend) for x in (machine, bare(mini)))
        for q_a in random.uniform([-1, 1e-3, 1e-3], [1, 0.029, 0.029], (5, 3)):
            rest = np.zeros(3)
            slope = [
                oracles.derivative(lambda t: stored(q_a + t * axis), 1e-4)  # noqa: B023
                for axis in np.eye(3)
            ]
            force = dynamics.passive(q_a, rest)
            np.testing.assert_allclose(force, -np.array(slope), atol=1e-8 * np.abs(force).max())
            assert np.abs(force).max() > 10
            added = dynamics.energy(q_a, rest)[1] - plain.energy(q_a, rest)[1]
            assert added == pytest.approx(stored(q_a), abs=1e-11)
            np.testing.assert_allclose(
                plain.inverse(q_a, rest, rest) - dynamics.inverse(q_a, rest, rest),
                force,
                atol=1e-10 * np.abs(force).max(),
            )


def test_dampers_and_ropes_take_out_what_the_length_s_rate_says(mini):
    rope = Rope(STRUT, 0.05, 400.0, 1.5)
    damper = ForceElement(damping=7.0, between=BOOM)
    machine = bare(mini).replace(forces=(damper,), ropes=(rope,))
    dynamics, home = crane.Dynamics(machine), np.array([0.2, 0.01, 0.02])
    random = np.random.default_rng(4)
    for v_a in random.uniform(-1, 1, (6, 3)) * [2.0, 0.1, 0.1]:
        boom, strut = (
            oracles.derivative(lambda t: length(machine, home + t * v_a, p), 1e-3)  # noqa: B023
            for p in (BOOM, STRUT)
        )
        depth = length(machine, home, STRUT) - 0.05
        assert depth > 0.01
        lost = 7.0 * boom**2 + 400.0 * depth * (max(0.0, 1 + 1.5 * strut) - 1) * strut
        q = machine.closure.solve(home)
        rates = dynamics.evaluate_closed("rates", q, v_a, np.zeros(3))
        assert rates[-2] == pytest.approx(lost, rel=1e-8) and lost > 0


def test_the_balance_of_energies(mini):
    """A second with dampers, a gas spring and a rope that gets taut and slack."""
    machine = bare(mini)
    middle = np.array([0.0, 0.015, 0.015])
    weight, far = crane.Dynamics(machine).gravity(middle), length(machine, middle, BOOM)
    held = zip(machine.active, (0.3, 2e3, 4e3), middle, weight, strict=True)
    machine = machine.replace(
        forces=(
            *(ForceElement(x, k, float(at + w / k)) for x, k, at, w in held),
            ForceElement("", 30.0, far, 8.0, between=BOOM),
        ),
        gas_springs=(crane.description.GasSpring("strut", 2e-5, 3e5, 2e-5, 0.1, between=STRUT),),
        ropes=(Rope(BOOM, far + 3e-4, 200.0, 0.5),),
    )
    start = np.array([0.3, 0.018, 0.013]), np.array([0.5, 0.0, 0.02])
    run = crane.simulate(machine, initial=start, duration=1.0, step=5e-4)
    channels = run.channels
    energy = channels["kinetic"] + channels["potential"]
    gap = channels["work"] - (energy - energy[0]) - channels["dissipated"]
    assert np.abs(gap).max() < 1e-6 * np.ptp(channels["dissipated"])
    boom = [length(machine, q_a, BOOM) - far - 3e-4 for q_a in run.q[::20]]
    assert sum(one * two < 0 for one, two in pairwise(boom)) >= 2
    batch = crane.simulation.simulate_batch(machine, initial=[start[0]], duration=0.05)
    alone = crane.simulate(machine, initial=start[0], duration=0.05)
    np.testing.assert_array_equal(batch.q[0], alone.q)


# --- closed forms ----------------------------------------------------------------------------

LIFT = """<robot name="lift"><link name="ground"/>
<link name="eye"/><joint name="up" type="fixed"><origin xyz="0 0 1.5"/>
<parent link="ground"/><child link="eye"/></joint>
<joint name="z" type="prismatic"><parent link="ground"/><child link="ball"/><axis xyz="0 0 1"/>
<limit lower="-9" upper="9" effort="0" velocity="9"/></joint>
<link name="ball"><inertial><mass value="2"/>
<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link></robot>
"""


def lift(folder, **elements):
    (folder / "lift.urdf").write_text(LIFT)
    return crane.load(folder / "lift.urdf").replace(**elements)


def test_a_mass_on_a_spring_oscillates(tmp_path):
    """m z'' = k (l - rest) - m g with l = 1.5 - z: about z_0 by cos(sqrt(k / m) t)."""
    spring = ForceElement("", 50.0, 0.4, between=("eye", "ball"))
    machine = lift(tmp_path, forces=(spring,))
    run = crane.simulate(machine, initial=[0.2], duration=2.0)
    middle = 1.1 - 2 * oracles.GRAVITY / 50
    wanted = middle + (0.2 - middle) * np.cos(5.0 * run.time)
    np.testing.assert_allclose(run.q[:, 0], wanted, atol=1e-9)


def test_a_ball_on_a_rope_falls_freely_until_it_is_taut(tmp_path):
    """From the rope's other end, then about m g / k under its length, then flying up again."""
    rope = Rope(("eye", "ball"), 0.8, 400.0)
    machine = lift(tmp_path, ropes=(rope,))
    g, rate = oracles.GRAVITY, np.sqrt(400.0 / 2)
    run = crane.simulate(machine, initial=[1.5], duration=1.0, step=2e-4)
    taut, speed = np.sqrt(2 * 0.8 / g), np.sqrt(2 * 0.8 * g)
    falling = run.time <= taut
    np.testing.assert_allclose(run.q[falling, 0], 1.5 - g * run.time[falling] ** 2 / 2, atol=1e-12)
    # below: d = m g / k (1 - cos wt) + speed / w sin wt
    sag, swing = 2 * g / 400, speed / rate
    half = (np.pi + 2 * np.arctan2(sag, swing)) / rate
    after = run.time - taut
    hanging = (after > 0) & (after <= half)
    depth = sag * (1 - np.cos(rate * after)) + swing * np.sin(rate * after)
    np.testing.assert_allclose(run.q[hanging, 0], 0.7 - depth[hanging], atol=1e-6)
    rising = after > half
    up = speed * (after - half) - g * (after - half) ** 2 / 2
    np.testing.assert_allclose(run.q[rising, 0], 0.7 + up[rising], atol=2e-5)
    assert hanging.sum() > 100 and rising.sum() > 100


def test_ropes_pull_and_never_push(tmp_path):
    rope = Rope(("eye", "ball"), 0.8, 400.0, 5.0)
    dynamics = crane.Dynamics(lift(tmp_path, ropes=(rope,)))
    for z, v, force in (
        (0.8, -9.0, 0.0), (0.7, -9.0, 0.0), (0.6, 0.0, 40.0), (0.6, -0.1, 60.0), (0.6, 0.1, 20.0),
        (0.6, 0.3, 0.0), (2.2, 0.0, 0.0), (2.4, 0.0, -40.0),
    ):  # fmt: skip
        assert dynamics.passive([z], [v]) == pytest.approx(force, abs=1e-10)


def test_a_spring_of_no_length_balances_a_pendulum(slider_crank):
    """k c r sin(angle): with rest 0 the force is k (p_2 - p_1), linear in the ends' places."""
    machine = bare(slider_crank)
    one, two = places(machine, machine.home, ("guide", "rod_eye"))
    spring = ForceElement(stiffness=70.0, between=("guide", "rod_eye"))
    dynamics = crane.Dynamics(machine.replace(forces=(spring,)))
    crank = oracles.SliderCrank()

    def stored(theta):  # the eye of the rod is on the slider
        _, s = crank.position(theta)
        return 35.0 * ((s - one[0]) ** 2 + (two[2] - one[2]) ** 2)

    for theta in (0.4, 1.0, 1.6):
        slope = stored(theta + 1e-30j).imag / 1e-30
        assert dynamics.passive([theta], [0.0])[0] == pytest.approx(-slope, rel=1e-10)


def test_frames_that_meet_have_no_direction_and_no_force(tmp_path):
    """Along a motion nothing acts there; at home it is refused unless its law says nothing."""
    ends = ("eye", "ball")
    gas = crane.description.GasSpring("gas", 1e-3, 1e5, 1e-3, between=ends)
    machine = lift(
        tmp_path,
        forces=(ForceElement("", 30.0, 0.2, 5.0, 1.0, between=ends),),
        gas_springs=(gas,),
        ropes=(Rope(ends, 0.3, 100.0, 1.0),),
    )
    for backend in ("compiled", "pinocchio"):
        dynamics = crane.Dynamics(machine, backend=backend)
        assert dynamics.passive([1.5], [0.7]) == [0.0]
        assert np.isfinite(dynamics.energy([1.5], [0.7])).all()
        push = dynamics.passive([[1.5 - 1e-9], [1.5 + 1e-9]], [[0.0], [0.0]])[:, 0]
        assert push == pytest.approx([-107.0, 107.0], rel=1e-6)  # one limit on each side
    meeting = crane.load(tmp_path / "lift.urdf", changes={"eye.z": 0.0})
    calm = ForceElement(stiffness=30.0, between=ends)
    assert meeting.replace(forces=(calm,), ropes=machine.ropes).forces == (calm,)
    line = "between 'eye' and 'ball' has no direction, its frames meet at home"
    with pytest.raises(InputError, match=f"the force element {line}"):
        meeting.replace(forces=machine.forces)
    with pytest.raises(InputError, match=f"the gas spring {line}"):
        meeting.replace(gas_springs=(gas,))


def test_a_floating_body_on_springs(tmp_path):
    """Three springs hold a body that stays a free-flyer; its energy is kept while it turns."""
    anchors = "".join(
        f'<link name="a{i}"/><joint name="ja{i}" type="fixed"><origin xyz="{x} {y} 1"/>'
        f'<parent link="world"/><child link="a{i}"/></joint><link name="e{i}"/>'
        f'<joint name="je{i}" type="fixed"><origin xyz="{0.3 * x} {0.3 * y} 0.1"/>'
        f'<parent link="box"/><child link="e{i}"/></joint>'
        for i, (x, y) in enumerate(((1, 0), (-0.5, 0.8), (-0.5, -0.8)))
    )
    (tmp_path / "box.urdf").write_text(
        '<robot name="box"><link name="world"/><link name="box"><inertial><mass value="3"/>'
        '<inertia ixx="0.1" ixy="0.01" ixz="0" iyy="0.2" iyz="0" izz="0.15"/></inertial></link>'
        '<joint name="base" type="floating"><parent link="world"/><child link="box"/></joint>'
        f"{anchors}</robot>"
    )
    springs = tuple(ForceElement("", 90.0, 0.9, between=(f"a{i}", f"e{i}")) for i in "012")
    machine = crane.load(tmp_path / "box.urdf").replace(forces=springs)
    assert machine.coordinates.floating_base_columns
    same_on_both_backends(machine, samples_of(machine, 0.3))
    start = np.array([0.1, 0.0, -0.1, 0.2, 0.1, 0.3])
    run = crane.simulate(
        machine, initial=(start, np.array([0, 0.2, 0, 0.5, 1.0, 2.0])), duration=1
    )
    energy = run.channels["kinetic"] + run.channels["potential"]
    assert np.ptp(energy) < 1e-8 * np.ptp(run.channels["kinetic"])
    assert np.ptp(run.channels["kinetic"]) > 1


# --- files, locks, identification, the command line ------------------------------------------

FORCES = "forces:\n  - {joint: rocker, stiffness: 2, rest: 1.5, damping: 0.1}\n"
GIVEN = FORCES + (
    "  - {between: [ground, coupler_arm], stiffness: 40, rest: 0.2, damping: 3, force: -1}\n"
    "gas_springs:\n  lift: {between: [pin_B, crank_arm], area: 1e-4, pressure: 1e5, volume: 1e-4}"
    "\n"
    "ropes:\n  - {between: [coupler_pin, pin_B], length: 0.3, stiffness: 1e4, damping: 0.2}\n"
)


def given(folder):
    path = copy_machine(MACHINE, folder)
    text = path.read_text()
    assert FORCES in text
    path.write_text(text.replace(FORCES, GIVEN))
    return path


def test_machine_files_hold_them(tmp_path):
    machine = crane.load(given(tmp_path))
    spring = ForceElement("", 40.0, 0.2, 3.0, -1.0, between=("ground", "coupler_arm"))
    assert machine.forces[1] == spring
    assert machine.gas_springs == (
        crane.description.GasSpring("lift", 1e-4, 1e5, 1e-4, between=("pin_B", "crank_arm")),
    )
    assert machine.ropes == (Rope(("coupler_pin", "pin_B"), 0.3, 1e4, 0.2),)
    again = crane.load(crane.write_machine(machine, tmp_path / "again"))
    assert again.force_elements == machine.force_elements


def test_locks_take_what_they_put_on_one_body(tmp_path):
    path = tmp_path / "arm.yaml"
    slide = joint("x", "ball", "tool", kind="prismatic", axis=(1, 0, 0), limits=(-1, 1))
    more = f"{slide}{body('tool', 1)}</robot>"
    (tmp_path / "lift.urdf").write_text(LIFT.replace("</robot>", more))
    path.write_text(
        "name: arm\nchains: [{name: arm, urdf: lift.urdf}]\nactive: [z, x]\nropes:\n"
        "  - {between: [eye, ball], length: 1, stiffness: 9}\n"
        "  - {between: [ball, tool], length: 1, stiffness: 9}\n"
    )
    assert [rope.between[0] for rope in crane.load(path).ropes] == ["eye", "ball"]
    assert [rope.between[0] for rope in crane.load(path, lock={"x": 0.1}).ropes] == ["eye"]


REFUSED = [
    case(
        f"four_bar.yaml:24: {line}",
        swap("{joint: rocker, stiffness: 2, rest: 1.5, damping: 0.1}", f"{{{item}}}"),
    )
    for item, line in (
        ("between: [ground, coupler_arn], stiffness: 2",
            "the frame 'coupler_arn' is unknown, did you mean 'coupler_arm'?",
        ),
        ("between: [ground, pin_B], stiffness: 2",
            "'ground' and 'pin_B' are both on the body 'ground', choose frames of two bodies",
        ),
        ("between: [ground], stiffness: 2",
            "the force element between 'ground' is between two frames, name two",
        ),
        ("between: [ground, crank_arm], stiffness: -2",
            "'stiffness' of the force element between 'ground' and 'crank_arm' is -2, give at "
            "least 0",
        ),
        ("joint: rocker, between: [ground, coupler_arm], stiffness: 2",
            "an element is on a joint or between frames, keep one of the two",
        ),
        ("between: [ground, coupler_arm]",
            "the force element between 'ground' and 'coupler_arm' does nothing, give stiffness, "
            "damping or force",
        ),
    )
] + [
    case(
        f"four_bar.yaml:27: {line}",
        swap("end_stops:", f"ropes:\n  - {{{item}}}\nend_stops:"),
    )
    for item, line in (
        ("length: 2, stiffness: 3", "a rope has no 'between', add it"),
        ("between: [pin_B, coupler_pin], length: 0, stiffness: 3",
            "'length' of the rope between 'pin_B' and 'coupler_pin' is 0, give one",
        ),
    )
]  # fmt: skip


@pytest.mark.parametrize("broken", REFUSED)
def test_is_refused(broken, tmp_path):
    assert_refused(broken, tmp_path)


@pytest.mark.parametrize(
    ("call", "line"),
    [
        (lambda m: m.replace(ropes=(Rope(("base", "moon"), 1, 1),)), "frame 'moon' is unk"),
        (lambda m: m.replace(ropes=(Rope(("link1", "link1_B"), 1, 1),)), "within one body"),
        (lambda _: Rope(("base", "base"), 1, 1), "needs two frames, give two"),
        (lambda _: Rope(("base", "link1"), 0, 1), "length of rope between 'base' and"),
        (lambda _: ForceElement(stiffness=1.0), "acts on nothing, give it a joint or two"),
        (
            lambda _: ForceElement("q1", stiffness=1.0, between=BOOM),
            "is on 'q1', too, keep one of the two",
        ),
        (
            lambda _: crane.description.GasSpring("x", 1e-4, -1.0, 1e-4, between=BOOM),
            "pressure of gas spring between 'base' and 'link7' is -1, it must not be negative",
        ),
    ],
)  # fmt: skip
def test_wrong_elements_are_told_in_a_line(mini, call, line):
    with pytest.raises(InputError, match=line):
        call(mini)


def test_meeting_frames_of_a_file_are_told_with_the_section(tmp_path):
    path = given(tmp_path)
    path.write_text(path.read_text().replace("[ground, coupler_arm]", "[rocker_pin, coupler_pin]"))
    ran = typed("check", path)
    assert ran.returncode == 2 and "has no direction, its frames meet at home" in ran.stdout
    with pytest.raises(crane.CraneError, match=r"four_bar.yaml:\d+: the force element between"):
        crane.load(path)


def test_columns_of_identification(mini):
    """A strut's scale; stiffness, preload and damping of a distance are known forces."""
    spring = ForceElement("", 30.0, 0.0, 4.0, -2.0, between=BOOM)
    gas = crane.description.GasSpring("strut", 2e-4, 3e5, 2e-5, 0.15, 1.3, between=STRUT)
    rope = Rope(BOOM, 0.05, 90.0, 1.0)
    machine = bare(mini).replace(forces=(spring,), gas_springs=(gas,), ropes=(rope,))
    samples = random_samples(IdentificationModel(machine), 30, seed=8)
    tau = crane.Dynamics(machine).inverse(samples.q_a, samples.v_a, samples.a_a)
    plain = machine.replace(forces=())
    scaled = IdentificationModel(plain, [InertialTerm(plain), GasSpringTerm(plain, "strut")])
    for model, others in ((IdentificationModel(machine), machine), (scaled, plain)):
        expected = crane.Dynamics(others).inverse(samples.q_a, samples.v_a, samples.a_a)
        found = model.regressor(samples) @ model.nominal + model.known_forces(samples)
        assert np.abs(found - expected).max() < 1e-11 * np.abs(tau).max()
    assert scaled.names[-1] == "strut.gas_scale"


def test_what_mjcf_has_no_place_for_is_told(tmp_path, mini):
    pytest.importorskip("mujoco")
    machine = bare(mini).replace(
        forces=(
            ForceElement("", 30.0, 0.2, 0.0, 3.0, between=BOOM),
            ForceElement("", 30.0, 0.1, 0.0, -6.0, between=STRUT),
            ForceElement(force=2.0, between=STRUT),
        ),
        ropes=(Rope(STRUT, 0.1, 90.0, 1.0),),
    )
    with pytest.warns(CraneWarning) as told:
        crane.formats.write_mjcf(machine, tmp_path / "mini.xml")
    (line,) = [str(x.message) for x in told if "has no place for" in str(x.message)]
    names = "between 'link3_H' and 'A1_rod'"
    assert line.count(f"the constant force of the force element {names}") == 2
    assert f"the damping of the rope {names}" in line
    again = quiet(crane.load, tmp_path / "mini.xml")
    first, second = (x for x in again.forces if x.between)
    assert first.between == BOOM and first.rest == pytest.approx(0.3)  # 30 (l - 0.3)
    assert (second.stiffness, second.rest) == (30.0, 0.0)
    assert again.ropes == (Rope(STRUT, 0.1, 90.0),)
    with pytest.warns(CraneWarning, match=r"springs and forces, ropes"):
        crane.formats.write_urdf_plus(machine, tmp_path / "mini.urdf")
