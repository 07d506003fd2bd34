"""The TX40 and the KR300: masses and counterbalance from tables, recordings predicted."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from oracles import COMPLEX_STEP, GRAVITY, angle
from scipy.signal import butter, sosfiltfilt

import crane
from crane.description.specification import EstimationSettings
from crane.recordings.logs import read_log

RECORDINGS = Path(__file__).parents[1] / ".." / "shared" / "data"
SCRIPTS = Path(__file__).parents[1] / "scripts"
recorded = pytest.mark.skipif(
    not RECORDINGS.is_dir(), reason="the recordings, ../shared/data, are not there"
)
ZERO = np.deg2rad([0.0, -90.0, 90.0, 0.0, 0.0, 0.0])  # of the KR300's recordings


# --- rows of Denavit and Hartenberg, and bodies in their frames ---------------------------------


def about_z(turn):
    c, s, o = np.cos(turn), np.sin(turn), 0.0
    return np.array([[c, -s, o, o], [s, c, o, o], [o, o, 1.0, o], [o, o, o, 1.0]])


def about_x(turn):
    c, s, o = np.cos(turn), np.sin(turn), 0.0
    return np.array([[1.0, o, o, o], [o, c, -s, o], [o, s, c, o], [o, o, o, 1.0]])


def shifted(x, y, z):
    out = np.eye(4)
    out[:3, 3] = x, y, z
    return out


def tensor(xx, yy, zz, xy, yz, xz):
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


QUARTER = np.pi / 2
TX40_ROWS = [  # a, alpha before the joint; d, offset of its angle (modified convention)
    (0.0, 0.0, 0.320, 0.0),
    (0.0, -QUARTER, 0.0, 0.0),
    (0.225, 0.0, 0.035, 0.0),
    (0.0, QUARTER, 0.225, 0.0),
    (0.0, -QUARTER, 0.0, 0.0),
    (0.0, QUARTER, 0.0, np.pi),
]
TX40_BODIES = [  # mass, COM, turn of the axes of inertia about z, inertia about the COM
    (10.5, (0, 0.020, -0.043), 0, tensor(0.055, 0.047, 0.035, 0, 0.003, 0)),
    (3.6, (0.109, -0.002, 0.134), -1, tensor(0.009, 0.038, 0.040, 0, 0, 0.002)),
    (4.07, (0.008, 0.006, 0.041), -1, tensor(0.012, 0.012, 0.004, 0, -0.001, 0.001)),
    (3.62, (-0.004, 0.002, -0.107), 1, tensor(0.013, 0.014, 0.004, 0, 0.001, 0)),
    (1.02, (-0.004, -0.003, -0.001), -1, 0.001 * np.eye(3)),
    (0.2, (0, 0, 0.042), 0, 0.2 * 0.02**2 * np.diag([1 / 3, 1 / 3, 1 / 2])),  # disc, h = r
]
KR300_ROWS = [  # d, a, alpha after the joint, offset of its angle
    (-0.675, 0.350, QUARTER, 0.0),
    (-0.189, 1.150, 0.0, 0.0),
    (0.189, 0.041, -QUARTER, QUARTER),
    (-1.000, 0.0, QUARTER, 0.0),
    (0.0, 0.0, -QUARTER, 0.0),
    (-0.240, 0.0, np.pi, 0.0),
]
KR300_BODIES = [  # mass, COM [mm], inertia about it [1e-6 kg m2] in the frame after the row
    (395.40, (-353, 174, -4), (16733765, 29799119, 32814954, -1703664, 129384, 4404062)),
    (339.12, (-709, -1, 23), (7507819, 88886691, 88673761, 430046, 173157, -4396607)),
    (105.21, (-18, -18, -76), (10783798, 10186135, 1943179, 118474, -606384, -101950)),
    (35.80, (0, 236, 1), (425035, 217993, 428465, -4, -11353, -27)),
    (31.46, (0, -80, -9), (283826, 229562, 258266, -4, -19521, -120)),
    (17.78, (0, 0, -50), (59266.6667, 59266.6667, 88900, 0, 0, 0)),
    (150.0, (0, 0, 100), (1788800, 1788800, 3000000, 0, 0, 0)),
]


def tx40_bodies(q):
    """Mass, COM (3,), rotation (3, 3), inertia about the COM in its axes, for q (6,)."""
    frame, out = np.eye(4), []
    for angle_, row, body in zip(q, TX40_ROWS, TX40_BODIES, strict=True):
        a, alpha, d, offset = row
        mass, com, quarters, inertia = body
        frame = frame @ about_x(alpha) @ shifted(a, 0, d) @ about_z(angle_ + offset)
        turned = (frame @ about_z(quarters * QUARTER))[:3, :3]
        out.append((mass, (frame @ [*com, 1.0])[:3], turned, inertia))
    return out


def pins(q2):
    """Barrel's and rod's pin in the plane of the cylinder about axis 2, x along link 1's x."""
    turn = q2 + np.deg2rad(95.0) + np.pi  # link 2's pin leads by this less half a turn
    return np.array([-0.8, 0.0]), 0.2 * np.array([np.cos(turn), np.sin(turn)])


def kr300_bodies(q):
    """The same, with barrel and rod."""
    frame, out = about_x(np.pi), []
    for i, (angle_, (d, a, alpha, offset)) in enumerate(zip(q, KR300_ROWS, strict=True)):
        frame = frame @ about_z(angle_ + offset) @ shifted(a, 0, d) @ about_x(alpha)
        for mass, com, inertia in KR300_BODIES[i : i + 1 if i < 5 else None]:
            place = (frame @ [*(np.array(com) / 1e3), 1.0])[:3]
            out.append((mass, place, frame[:3, :3], tensor(*inertia) * 1e-6))
        if i == 0:
            one, two = pins(q[1])
            cylinder = frame @ about_z(angle(*(two - one)))
            for mass, start, along, around, across in (
                (6.0, one, 0.25, 0.00615675, 0.128078375),
                (3.0, two, -0.225, 0.0003375, 0.05079375),
            ):
                place = (frame @ [*start, 0.0, 1.0])[:3] + along * cylinder[:3, 0]
                out.append((mass, place, cylinder[:3, :3], np.diag([around, across, across])))
    return out


def expected(bodies, q):
    """Gravity torques (6,) and mass matrix (6, 6) by complex steps of the bodies' places."""
    weight, M = np.zeros(6), np.zeros((6, 6))
    here = bodies(q)
    moved = [bodies(q + 1j * COMPLEX_STEP * e) for e in np.eye(6)]
    for i, (mass, _, rotation, inertia) in enumerate(here):
        speeds = np.array([np.imag(m[i][1]) for m in moved]).T / COMPLEX_STEP
        turns = []
        for m in moved:
            spin = np.imag(m[i][2]) / COMPLEX_STEP @ rotation.T
            turns.append([spin[2, 1], spin[0, 2], spin[1, 0]])
        turns = rotation.T @ np.array(turns).T
        weight += GRAVITY * mass * speeds[2]
        M += mass * speeds.T @ speeds + turns.T @ inertia @ turns
    return weight, M


def postures(machine, count, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(machine.lower, machine.upper, (count, 6))


@pytest.fixture(scope="module")
def tx40():
    return crane.load("tx40")


@pytest.mark.parametrize(("name", "bodies"), [("tx40", tx40_bodies), ("kr300", kr300_bodies)])
def test_gravity_and_inertia_are_those_of_the_tables(name, bodies):
    machine = crane.load(name)
    dynamics = crane.Dynamics(machine)
    for q in postures(machine, 40):
        weight, M = expected(bodies, q)
        assert np.abs(dynamics.gravity(q) - weight).max() < 1e-10 * np.abs(weight).max()
        assert np.abs(dynamics.mass_matrix(q) - M).max() < 1e-10 * np.abs(M).max()


def test_the_load_can_be_another(kr300):
    lighter = crane.load("kr300", {"load.mass": 100.0})
    q = postures(kr300, 1)[0]
    gap = crane.Dynamics(kr300).energy(q, 0 * q)[1] - crane.Dynamics(lighter).energy(q, 0 * q)[1]
    load = kr300_bodies(q)[-1][1]
    assert gap == pytest.approx(50.0 * GRAVITY * load[2], rel=1e-10)


# --- the counterbalance -------------------------------------------------------------------------


def length(q2):
    """From pin to pin [m], as printed."""
    delta = q2 + np.deg2rad(95.0)
    return np.sqrt(0.8**2 + 0.2**2 - 2 * 0.8 * 0.2 * np.cos(delta))


AREA = np.pi * (0.055**2 - 0.030**2) / 4


def pressure(stroke):
    """[Pa], as printed."""
    return 1.01 * 296.8 * 328 * 2 * 0.0795 / (2 * 0.00048 - stroke * AREA)


def at_link_2(machine, q2):
    q_a = np.tile(ZERO, (len(q2), 1))
    q_a[:, 1] = q2
    return q_a


def test_one_loop_six_drives_a_passive_angle_and_stroke(kr300):
    assert [loop.name for loop in kr300.closure.equations.loops] == ["rod_eye"]
    assert kr300.active == ("q1", "q2", "q3", "q4", "q5", "q6")
    assert set(kr300.joints) - set(kr300.active) == {"barrel", "stroke"}
    assert kr300.unit("stroke") == "m" and kr300.unit("barrel") == "rad"


def test_the_stroke_is_that_of_the_printed_length(kr300):
    """Holds over the whole range of link 2, independently of the other joints."""
    q_a = postures(kr300, 300)
    q = kr300.closure.solve(q_a)
    stroke = q[:, kr300.column("stroke")]
    assert np.abs(stroke - (length(q_a[:, 1]) - 0.6)).max() < 1e-12
    one, two = pins(q_a[:, 1])
    assert np.abs(q[:, kr300.column("barrel")] - angle(two[0] - one[0], two[1])).max() < 1e-12


def test_the_gas_pulls_as_printed(kr300):
    """tau_2 = -p A dlength/dq2; the gas exerts no force on other joints."""
    q2 = np.linspace(kr300.lower[1], kr300.upper[1], 50)
    q_a = at_link_2(kr300, q2)
    slope = np.imag(length(q2 + 1j * COMPLEX_STEP)) / COMPLEX_STEP
    torque = crane.Dynamics(kr300).passive(q_a, 0 * q_a)
    wanted = -pressure(length(q2) - 0.6) * AREA * slope
    assert np.abs(torque[:, 1] - wanted).max() < 1e-9 * np.abs(wanted).max()
    assert np.abs(np.delete(torque, 1, axis=1)).max() < 1e-9
    without = crane.Dynamics(kr300.replace(gas_springs=())).passive(q_a, 0 * q_a)
    assert not without.any()


def test_the_gas_carries_the_arm(kr300):
    """The cylinder carries more than a third of the weight moment of a leaning link 2."""
    q_a = at_link_2(kr300, np.deg2rad([-50.0]))
    dynamics = crane.Dynamics(kr300)
    weight, gas = dynamics.gravity(q_a)[0, 1], dynamics.passive(q_a, 0 * q_a)[0, 1]
    assert gas / weight > 1 / 3


def test_pressures_are_the_measured_ones(kr300):
    """Nine pairs of link angle [deg] and gas pressure [bar]; 2 bar is a step of the reading."""
    q2 = np.deg2rad(np.arange(-120.0, -39.0, 10.0))
    measured = [170, 167, 164, 162, 164, 170, 180, 190, 200]
    stroke = kr300.closure.solve(at_link_2(kr300, q2))[:, kr300.column("stroke")]
    (gas,) = kr300.gas_springs
    volume = gas.volume + gas.area * (stroke - gas.rest)
    modelled = gas.pressure * (gas.volume / volume) ** gas.exponent
    assert np.sqrt(np.mean((modelled / 1e5 - measured) ** 2)) < 2.0


# --- recordings ---------------------------------------------------------------------------------


@recorded
@pytest.mark.parametrize("name", ["A", "B"])
def test_the_loop_closes_all_along_the_recordings(kr300, name):
    with np.load(RECORDINGS / "kr300" / f"kr300_{name}.npz") as file:
        q_a = np.deg2rad(file["motor_position_deg"]) + ZERO
    kr300.check_limits(q_a)
    q = kr300.closure.solve(q_a)
    assert max(np.abs(kr300.closure.residual(row)).max() for row in q[::50]) < 1e-12


@recorded
def test_the_zero_of_the_recording_explains_the_holding_torques(kr300):
    """Mean torque over there and back: friction and inertia cancel, weight and gas are left."""
    with np.load(RECORDINGS / "kr300" / "kr300_A.npz") as file:
        recorded_q = np.deg2rad(file["motor_position_deg"])
        tau = file["motor_torque"] * [1798 / 7, 1872 / 7, 757 / 3, 221, 5032 / 21, 206793 / 1340]
    dynamics = crane.Dynamics(kr300)

    def gaps(zero):
        q_a = recorded_q + zero
        return np.abs((dynamics.inverse(q_a, 0 * q_a, 0 * q_a) - tau).mean(axis=0))[[1, 2, 4]]

    assert (gaps(ZERO) < [150, 300, 20]).all()
    assert gaps(0 * ZERO)[0] > 1000


@recorded
def test_the_zero_of_the_tx40_explains_the_weight(tx40):
    """What weight leaves of the torques of joints 2 and 3 is least with the offsets."""
    reduction = np.diag([32.0, 32.0, 45.0, -48.0, 45.0, 32.0])
    reduction[5, 4] = 32.0
    with np.load(RECORDINGS / "tx40" / "tx40_recording.npz") as file:
        q = np.linalg.solve(reduction, file["motor_position"][::50].T).T
        tau = file["motor_torque"][::50] @ reduction
    dynamics = crane.Dynamics(tx40)

    def left(zero):
        return np.linalg.norm(tau - dynamics.gravity(q + zero), axis=0)[[1, 2]]

    assert (left(ZERO) < 0.97 * np.linalg.norm(tau, axis=0)[[1, 2]]).all()
    for turned in ([1, 0], [0, 1], [0, 0], [1, -1], [-1, 1]):
        zero = np.array([0.0, turned[0] * -QUARTER, turned[1] * QUARTER, 0.0, 0.0, 0.0])
        assert left(ZERO).sum() < left(zero).sum()


def relative(measured, modelled, counted):
    """Of each joint over the rows (N, n) that count."""
    gap, size = (np.where(counted, x, 0.0) for x in (measured - modelled, measured))
    return np.linalg.norm(gap, axis=0) / np.linalg.norm(size, axis=0)


def judged(result, time, q, tau, slow, cutoffs, trim=50):
    """Relative errors (n,) and stacked one of forces that a result predicts of a recording.

    Differences and Butterworth filters of this test's own: `cutoffs` [Hz] of the coordinates and
    of the forces, both ways.
    """
    step = time[1] - time[0]
    one, other = (butter(4, cutoff, fs=1 / step, output="sos") for cutoff in cutoffs)
    q = sosfiltfilt(one, q, axis=0)
    v = np.gradient(q, step, axis=0)
    a = np.gradient(v, step, axis=0)
    found = sosfiltfilt(other, result.predict(q, v, a, step), axis=0)
    tau = sosfiltfilt(other, tau, axis=0)
    counted = np.abs(v) > slow
    counted[:trim] = counted[-trim:] = False
    gap = np.linalg.norm((tau - found)[counted]) / np.linalg.norm(tau[counted])
    return relative(tau, found, counted), gap


def logs(name, *files):
    columns = SCRIPTS / "columns" / f"{name}.txt"
    return [
        crane.Recording.from_table(read_log(path, columns), path)
        for path in (RECORDINGS / name / file for file in files)
    ]


@recorded
@pytest.mark.filterwarnings("ignore::crane.CraneWarning")
@pytest.mark.slow
@pytest.mark.parametrize("name", ["kr300", "tx40"])
def test_the_written_machine_predicts_as_the_identification(name, tmp_path, request):
    """Presliding, memory and root of the KR300; two Stribeck velocities, a motor of the TX40."""
    machine = request.getfixturevalue(name)
    file = "kr300_A.npz" if name == "kr300" else "tx40_recording.npz"
    (log,) = logs(name, file)
    if name == "tx40":
        log = log.between(0.0, 3.0)
    found = crane.identify(machine, log)
    assert found.feasible
    written = crane.load(crane.identification.write_identified(found, tmp_path / name))
    step = log.time[1] - log.time[0]
    q = sosfiltfilt(butter(4, 20, fs=1 / step, output="sos"), log.q, axis=0)
    v = np.gradient(q, step, axis=0)
    given = q, v, np.gradient(v, step, axis=0)
    forces = crane.Dynamics(written).inverse(*given, friction=True, step=step)
    np.testing.assert_allclose(forces, found.predict(*given, step), rtol=0, atol=1e-9)


@recorded
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::crane.CraneWarning")
def test_the_tx40_predicts_the_part_it_has_not_seen(tx40):
    """The reference's own residual is 5.26 %, its plain friction predicts to 7.4 %."""
    (log,) = logs("tx40", "tx40_recording.npz")
    first, rest = log.between(0.0, 5.4), log.between(5.4, 9.0)
    plain = tx40.replace(estimation=EstimationSettings())
    rotors = {"q*.rotor_inertia": (), "q*.viscous_offset": None, "q5+q6.rotor_inertia": (),
              "q5+q6.coulomb": (), "q5+q6.viscous": ()}  # fmt: skip
    least = crane.identify(
        plain, log, method="ols", terms=rotors, bandwidth=20.0, min_speed={"q*": 0.05}
    )
    assert len(least.values) == 61
    assert least.training.overall_relative_error <= 0.051

    better = crane.identify(tx40, first, rest)
    slow = [0.05009, 0.05009, 0.07505, 0.07156, 0.05585, 0.12217]
    _, error = judged(better, rest.time, rest.q, rest.tau, slow, (100.0, 20.0), trim=400)
    assert error <= 0.0555
    # what the selection finds is no worse than settings by hand
    hand = {"prior": {"bodies": "3 %"}, "bandwidth": 23.0, "min_speed": {"q*": 0.005}}
    other = crane.identify(tx40, first, rest, feasible=True, **hand)
    assert other.validation.overall_relative_error <= 0.0528
    _, by_hand = judged(other, rest.time, rest.q, rest.tau, slow, (100.0, 20.0), trim=400)
    assert error < by_hand <= 0.0558


@recorded
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::crane.CraneWarning")
def test_the_kr300_predicts_the_other_recording(kr300):
    """Bodies near the table, all of them possible; without the gas joint 2 needs other masses."""
    a, b = logs("kr300", "kr300_A.npz", "kr300_B.npz")
    found = crane.identify(kr300, a, b, feasible=True)
    errors, stacked = judged(found, b.time, b.q, b.tau, np.deg2rad(1.0), (20.0, 5.0))
    assert found.validation.relative_error.mean() <= 0.0575
    assert errors.mean() <= 0.0565 and stacked <= 0.0257
    assert errors[1] <= 0.03
    plain = crane.identify(kr300, a, feasible=False)
    errors, _ = judged(plain, b.time, b.q, b.tau, np.deg2rad(1.0), (20.0, 5.0))
    assert errors.mean() <= 0.0535
    scale = found.parameters[found.model.names.index("stroke.gas_scale")]
    assert abs(scale - 1) < 0.06

    terms = {name: kind for name, kind in kr300.estimation.terms.items() if "stroke" not in name}
    bare = kr300.replace(gas_springs=(), estimation=replace(kr300.estimation, terms=terms))
    without = crane.identify(bare, a, b, prior={"bodies": "0.2 %"}, feasible=True)
    assert without.validation.relative_error[1] >= 5 * found.validation.relative_error[1]
