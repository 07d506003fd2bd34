"""Regression model and base parameters: known counts, groups in closed form."""

import dataclasses

import numpy as np
import pinocchio as pin
import pytest

import crane
from crane.common.errors import InputError
from crane.identification.mechanics.base_parameters import (
    base_parameters,
    group_parameters,
    random_samples,
)
from crane.identification.mechanics.identification_model import IdentificationModel
from crane.identification.mechanics.model_terms import (
    ForceDirection,
    GasSpringTerm,
    InertialTerm,
    PreslidingFriction,
    RotorInertiaTerm,
    VelocityFriction,
    friction_term,
)

pytestmark = pytest.mark.filterwarnings("ignore::crane.CraneWarning")
FINGERS = {"panda_finger_joint1": 0.0, "panda_finger_joint2": 0.0}


def inertial(machine):
    return IdentificationModel(machine, [InertialTerm(machine)])


def with_gravity(machine, gravity):
    model = pin.Model(machine.model)
    model.gravity.linear = np.array(gravity)
    return dataclasses.replace(machine, model=model)


# --- how many ------------------------------------------------------------------------------


def tiago_arm():
    arm = crane.load("tiago_no_hand").joints
    lock = {joint: 0.0 for joint in arm if not joint.startswith("arm_")}
    return crane.load("tiago_no_hand", lock=lock)


@pytest.mark.parametrize(
    ("load", "level", "tilted", "weightless"),
    [
        (lambda: crane.load("panda", lock=FINGERS), 43, 45, 39),
        (lambda: crane.load("ur5_robot"), 36, 38, 34),
        (lambda: crane.load("ur10_robot"), 36, 38, 34),
        (lambda: crane.load("xarm7"), 43, 45, 41),
        (tiago_arm, 43, 45, 43),
    ],
    ids=["panda", "ur5", "ur10", "xarm7", "tiago"],
)
def test_arms_have_as_many_base_parameters_as_the_field_knows(load, level, tilted, weightless):
    """The counts without weight of the last two are those that singular values give."""
    arm = load()
    for gravity, count in (
        ([0.0, 0.0, -9.81], level),
        ([3.0, 2.0, -9.0], tilted),
        ([0.0, 0.0, 0.0], weightless),
    ):
        model = inertial(with_gravity(arm, gravity))
        assert base_parameters(model).rank == count
        W = model.regressor(random_samples(model, 300, seed=11)).reshape(-1, len(model.names))
        sizes = np.linalg.svd(W, compute_uv=False)
        assert (sizes > 1e-10 * sizes[0]).sum() == count


def test_measured_arms():
    """36 of each arm; the KR300's cylinder adds nine."""
    assert base_parameters(inertial(crane.load("tx40"))).rank == 36
    model = inertial(crane.load("kr300"))
    assert base_parameters(model).rank == 45
    arm = [i for i, name in enumerate(model.names) if not name.startswith(("barrel", "rod"))]
    W = model.regressor(random_samples(model, 300, seed=1)).reshape(-1, len(model.names))
    assert group_parameters([model.names[i] for i in arm], W[:, arm], np.ones(len(arm))).rank == 36


def test_the_mini_forwarder(mini):
    """55 inertial; with four of friction per drive and eight viscous 75."""
    assert base_parameters(inertial(mini)).rank == 55
    base = base_parameters(IdentificationModel(mini))
    assert base.rank == 75
    assert {"link1.m", "link1.Ixx", "link1.mz"} < set(base.unobservable)
    assert not any(name.startswith("link7.") for name in base.unobservable)


# --- what they are ---------------------------------------------------------------------------

FOREWARD = """<robot name="planar">
  <link name="base"/>
  <link name="FL">{fl}</link>
  <link name="SL">{sl}</link>
  <link name="TL">{tl}</link>
  <link name="Gr">{gr}</link>
  <joint name="q2" type="revolute"><parent link="base"/><child link="FL"/>
    <origin rpy="1.5707963267948966 0 0"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <joint name="q3" type="revolute"><parent link="FL"/><child link="SL"/>
    <origin xyz="3.493 0 0"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <joint name="q4" type="prismatic"><parent link="SL"/><child link="TL"/>
    <axis xyz="1 0 0"/><limit lower="0.2" upper="1.5" effort="1" velocity="1"/></joint>
  <joint name="hang" type="fixed"><parent link="TL"/><child link="Gr"/>
    <origin xyz="{r7} 0 0"/></joint>
</robot>"""
L, R7 = 3.493, 1.2


def forwarder(tmp_path, off_line):
    """Two revolute joints and a telescope; masses and COMs as in theta1 to theta7."""
    numbers = {"FL": (250.0, 1.1, 9.0), "SL": (120.0, 0.7, 4.0), "TL": (60.0, 0.4, 1.5)}

    def body(m, x, y, i):
        return (
            f'<inertial><origin xyz="{x} {y} 0"/><mass value="{m}"/>'
            f'<inertia ixx="{i}" iyy="{i}" izz="{i}" ixy="0" ixz="0" iyz="0"/></inertial>'
        )

    text = FOREWARD.format(
        fl=body(numbers["FL"][0], numbers["FL"][1], off_line, numbers["FL"][2]),
        sl=body(numbers["SL"][0], numbers["SL"][1], 0.0, numbers["SL"][2]),
        tl=body(numbers["TL"][0], numbers["TL"][1], 0.0, numbers["TL"][2]),
        gr=body(80.0, 0.0, 0.0, 2.0),
        r7=R7,
    )
    path = tmp_path / "planar.urdf"
    path.write_text(text)
    return crane.load(path), {**numbers, "Gr": (80.0, 0.0, 2.0)}


def seven(machine):
    """Columns of the parameters of theta1 to theta7, equation (3) of the hydraulic paper.

    theta as linear functions of the ten numbers of each body; TL carries the gripper here.
    """
    names = inertial(machine).names
    at = {name: i for i, name in enumerate(names)}
    rows = np.zeros((7, len(names)))
    rows[0, at["FL.Izz"]] = 1.0  # m r^2 + I of the first link
    rows[1, at["SL.mx"]] = 1.0
    rows[2, at["SL.m"]] = 1.0
    rows[3, at["TL.mx"]] = 1.0  # m_Gr r7 + r_TL m_TL
    rows[4, at["TL.m"]] = 1.0  # m_TL + m_Gr
    rows[5, [at["SL.Izz"], at["TL.Izz"]]] = 1.0
    rows[6, at["FL.mx"]] = 1.0
    return rows


def theta(numbers):
    (fl, r_fl, i_fl), (sl, r_sl, i_sl), (tl, r_tl, i_tl) = (numbers[k] for k in ("FL", "SL", "TL"))
    gr, _, i_gr = numbers["Gr"]
    return np.array(
        [
            fl * r_fl**2 + i_fl,
            r_sl * sl,
            sl,
            gr * R7 + r_tl * tl,
            tl + gr,
            gr * R7**2 + tl * r_tl**2 + i_sl + i_tl + sl * r_sl**2 + i_gr,
            fl * r_fl,
        ]
    )


def test_seven_base_parameters(tmp_path):
    """With the first link's COM off the line to the elbow seven of them, and its my."""
    machine, numbers = forwarder(tmp_path, 0.0)
    model = inertial(machine)
    rows = seven(machine)
    np.testing.assert_allclose(rows @ model.nominal, theta(numbers), rtol=1e-13)
    # the seven reproduce the forces of this machine, whose bodies have no my, exactly
    samples = random_samples(model, 50, seed=1)
    W = model.regressor(samples).reshape(-1, len(model.names))
    planar = W[
        :,
        [
            model.names.index(n)
            for n in ("FL.Izz", "SL.mx", "SL.m", "TL.mx", "TL.m", "SL.Izz", "FL.mx")
        ],
    ]
    assert np.abs(planar @ theta(numbers) - W @ model.nominal).max() < 1e-9 * np.abs(W).max()


@pytest.mark.parametrize(("off_line", "rank"), [(0.3, 7), (0.0, 6)])
def test_their_rank_depends_on_where_the_first_link_has_its_com(tmp_path, off_line, rank):
    """theta1 + L^2 theta3 and theta7 + L theta3 appear together on the line."""
    machine, _ = forwarder(tmp_path, 0.0)
    model = inertial(machine)
    samples = random_samples(model, 200, seed=2)
    W = model.regressor(samples).reshape(-1, len(model.names))
    index = model.names.index
    # the first link's COM as one parameter r at a known angle to the line
    angle = np.arctan2(off_line, 1.1)
    first = W[:, index("FL.mx")] * np.cos(angle) + W[:, index("FL.my")] * np.sin(angle)
    columns = [W[:, index(n)] for n in ("FL.Izz", "SL.mx", "SL.m", "TL.mx", "TL.m", "SL.Izz")]
    matrix = np.column_stack([*columns, first])
    sizes = np.linalg.svd(matrix / np.linalg.norm(matrix, axis=0), compute_uv=False)
    assert (sizes > 1e-9 * sizes[0]).sum() == rank
    if rank == 6:
        base = base_parameters(model)
        both = np.zeros((3, len(model.names)))
        both[0, [index("FL.Izz"), index("SL.m")]] = 1.0, L**2
        both[1, [index("FL.mx"), index("SL.m")]] = 1.0, L
        both[2, index("SL.m")] = 1.0
        # both groups are combinations of the base parameters, their member alone is none
        rest = both - np.linalg.lstsq(base.grouping.T, both.T, rcond=None)[0].T @ base.grouping
        assert np.abs(rest[:2]).max() < 1e-9 and np.abs(rest[2]).max() > 1e-2


def test_base_parameters_carry_everything(mini):
    model = IdentificationModel(mini)
    base = base_parameters(model)
    samples = random_samples(model, 60, seed=5)
    W = model.regressor(samples)
    whole = W @ model.nominal
    alone = W[:, :, base.independent] @ base.values(model.nominal)
    assert np.abs(alone - whole).max() < 1e-10 * np.abs(whole).max()
    assert np.linalg.matrix_rank(base.grouping) == base.rank


# --- terms -----------------------------------------------------------------------------------


def test_the_model_is_the_inverse_dynamics(mini):
    for machine in (
        mini,
        mini.replace(
            forces=(crane.description.ForceElement("q3", stiffness=2.0, rest=1.0, damping=0.1),)
        ),
        mini.replace(gas_springs=(crane.description.GasSpring("q7", 1e-4, 1e5, 1e-4, 0.7),)),
    ):
        model = IdentificationModel(machine)
        samples = random_samples(model, 40, seed=7)
        tau = crane.Dynamics(machine).inverse(samples.q_a, samples.v_a, samples.a_a, friction=True)
        found = model.regressor(samples) @ model.nominal + model.known_forces(samples)
        assert np.abs(found - tau).max() < 1e-11 * np.abs(tau).max()


def test_gas_of_unknown_scale(mini):
    gas = crane.description.GasSpring("q7", 1e-4, 1e5, 1e-4, 0.7, 1.3)
    machine = mini.replace(friction={}, gas_springs=(gas,))
    model = IdentificationModel(machine, [InertialTerm(machine), GasSpringTerm(machine, "q7")])
    samples = random_samples(model, 40, seed=8)
    tau = crane.Dynamics(machine).inverse(samples.q_a, samples.v_a, samples.a_a)
    found = model.regressor(samples) @ model.nominal + model.known_forces(samples)
    assert np.abs(found - tau).max() < 1e-11 * np.abs(tau).max()
    assert model.names[-1] == "q7.gas_scale" and model.nominal[-1] == 1.0


def test_friction_along_a_coupled_motor():
    """A motor that turns with the sum of two joints brakes both of them alike."""
    arm = crane.load("ur5_robot").replace(friction={})
    motor = ForceDirection("motor6", {"wrist_2_joint": 1.0, "wrist_3_joint": 1.0})
    model = IdentificationModel(
        arm,
        [
            friction_term(arm, motor, ("coulomb", "viscous"), smoothing=0.0, stribeck=(0.1,)),
            RotorInertiaTerm(arm, motor),
        ],
    )
    rng = np.random.default_rng(9)
    q, v, a = rng.normal(size=(3, 20, 6))
    W = model.regressor(model.samples(q, v, a))
    speed, hurry = v[:, 4] + v[:, 5], a[:, 4] + a[:, 5]
    shapes = [np.sign(speed), speed, np.sign(speed) * np.exp(-((speed / 0.1) ** 2)), hurry]
    wanted = np.zeros((20, 6, 4))
    wanted[:, 4] = wanted[:, 5] = np.column_stack(shapes)
    np.testing.assert_allclose(W, wanted, atol=1e-15)
    assert model.names == ("motor6.coulomb", "motor6.viscous", "motor6.stiction",
                           "motor6.rotor_inertia")  # fmt: skip


def test_presliding_winds_up_over_a_distance():
    arm = crane.load("ur5_robot").replace(friction={})
    term = PreslidingFriction(arm, "elbow_joint", 0.02)
    way = np.concatenate([np.linspace(0, 0.1, 200), np.linspace(0.1, 0.07, 100)])
    q = np.zeros((300, 6))
    q[:, 2] = way
    at = IdentificationModel(arm, [term]).samples(q, 0 * q, 0 * q)
    z = term.columns(at)[:, 2, 0]
    np.testing.assert_allclose(z[:200], 1 - np.exp(-way[:200] / 0.02), atol=1e-12)
    top = z[199]
    back = -1 + (top + 1) * np.exp(-(0.1 - way[200:]) / 0.02)
    np.testing.assert_allclose(z[200:], back, atol=1e-12)
    twice = dataclasses.replace(at, starts=(0, 150))
    assert term.columns(twice)[150, 2, 0] == 0.0
    assert np.abs(np.delete(term.columns(at), 2, axis=1)).max() == 0


def test_what_is_no_model(mini):
    for make, message in (
        (
            lambda: IdentificationModel(mini, [InertialTerm(mini), InertialTerm(mini)]),
            "two terms have the parameter",
        ),
        (lambda: friction_term(mini, "X9"), "joint 'X9' is unknown"),
        (lambda: friction_term(mini, "X1", ("columb",)), "friction 'columb' is unknown"),
        (lambda: GasSpringTerm(mini, "X1"), "joint 'X1' has no gas spring"),
        (lambda: PreslidingFriction(mini, "X1", 0.0), "the length of presliding of 'X1' is 0"),
        (
            lambda: IdentificationModel(
                mini, [VelocityFriction(mini, ForceDirection("m", {"q4": 1.0}), {"c": np.sign})]
            ).regressor(random_samples(inertial(mini), 3)),
            "'m' combines 'q4', which is not active",
        ),
    ):
        with pytest.raises(InputError) as caught:
            make()
        assert str(caught.value).startswith(message)
