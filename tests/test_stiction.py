"""Stiction: rest, break-away, stops and stick-slip against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
import singular_linkages
from scipy.integrate import solve_ivp
from scipy.linalg import qr
from scipy.optimize import lsq_linear
from urdf_text import sliding_block
from warned import without_a_word

import crane
from crane.description import machine_templates
from crane.dynamics import Dynamics
from crane.simulation.integration.stick_slip_modes import (
    RANK_TOLERANCE,
    _bounded_least_squares,
    _independent_columns,
)

METHODS = ("rk4", "DOP853", "Radau", "rosenbrock", "LSODA")
G = 9.81


def block(folder, slope=0.0, mass=2.0, spring=0.0, **friction):
    """A block that slides along x down a slope."""
    path = sliding_block(folder, mass, (np.cos(slope), 0, -np.sin(slope)))
    machine = crane.load(path)
    return machine.replace(
        friction={"x": crane.description.Friction(**friction)},
        forces=(crane.description.ForceElement("x", stiffness=spring),) if spring else (),
    )


def run(*args, **options):
    return without_a_word(crane.simulate, *args, **options)


def gap(recording):
    c = recording.channels
    stored = c["kinetic"] + c["potential"]
    return np.abs(c["work"] - (stored - stored[0]) - c["dissipated"]).max()


@pytest.mark.parametrize("method", METHODS)
def test_a_block_on_a_slope_stays_or_slides(tmp_path, method):
    """It stays to the last bit for an hour below F_C + F_S, and slides as the closed form says."""
    weight = 2.0 * G * np.sin(0.3)
    still = block(tmp_path, 0.3, coulomb=0.8 * weight, stiction=0.201 * weight)
    step = 1.0 if method != "LSODA" else 60.0
    found = run(still, None, [0.7], 3600.0, step, method=method)
    assert (found.q == 0.7).all() and (found.v == 0).all()
    assert found.channels["rest_x"] == pytest.approx(np.full(len(found.time), weight), rel=1e-13)
    loose = block(tmp_path, 0.3, coulomb=0.8 * weight, stiction=0.199 * weight, stribeck=1e9)
    found = run(loose, None, [0.0], 2.0, 1e-2, method=method)
    # with a Stribeck velocity that is never reached stiction stays
    fallen = 0.5 * (weight - 0.999 * weight) / 2.0 * found.time**2
    assert found.q[:, 0] == pytest.approx(fallen, abs=1e-9)
    assert (found.channels["rest_x"] == 0).all()


@pytest.mark.parametrize("method", METHODS)
def test_a_spring_brings_a_block_to_rest(tmp_path, method):
    """Amplitudes fall by 2 F / k per half swing, until the spring is weaker than friction."""
    k, m, force = 200.0, 2.0, 7.0
    machine = block(tmp_path, 0.0, m, k, coulomb=force)
    found = run(machine, None, [1.0], 5.0, 1e-3, method=method)
    omega, dead = np.sqrt(k / m), force / k
    half = np.pi / omega
    swing = np.minimum(np.floor(found.time / half), np.floor((1.0 / dead + 1) / 2))
    sign = (-1.0) ** swing
    centre = dead * sign
    start = sign * (1.0 - 2 * dead * swing)
    phase = omega * (found.time - swing * half)
    wanted = centre + (start - centre) * np.cos(phase)
    resting = np.abs(start) <= dead
    wanted[resting] = start[resting]
    tolerance = {"rk4": 1e-8, "DOP853": 2e-9, "LSODA": 1e-6, "Radau": 1e-7, "rosenbrock": 1e-6}[
        method
    ]
    assert np.abs(found.q[:, 0] - wanted).max() < tolerance
    assert resting.sum() > 100
    assert np.ptp(found.q[found.time > 14.1 * half + 1e-3]) == 0
    assert found.channels["rest_x"][-1] == pytest.approx(-k * found.q[-1, 0], rel=1e-12)
    assert gap(found) < 30 * tolerance


def stick_slip(k, m, speed, law, breakaway, until):
    """Phases of a block that a spring pulls at a constant speed: times and states."""

    def stops(t, y):
        return y[1]

    stops.terminal, stops.direction = True, -1.0
    t, x, phases = 0.0, 0.0, []
    while t < until:
        slips = (breakaway + k * x) / (k * speed)
        phases.append(("rest", t, slips, x))
        first, jerk = 1e-5, k * speed / m  # the series' next terms are below 1e-25
        path = solve_ivp(
            lambda t, y: [y[1], (k * (speed * t - y[0]) - law(y[1])) / m],
            (slips + first, slips + 10), [x + jerk * first**3 / 6, jerk * first**2 / 2], "DOP853",
            events=stops,
            rtol=1e-13, atol=1e-15, dense_output=True,
        )  # fmt: skip
        t, x = path.t_events[0][-1], path.y_events[0][-1][0]
        phases.append(("slip", slips, t, path.sol))
    return phases


STRIBECK = {"coulomb": 4.0, "stiction": 2.0, "stribeck": 0.2}
ALL_TERMS = {  # presliding and memory as at steady speeds
    "coulomb": 1.0, "presliding": 3.0, "stiction": 1.5, "stribeck": 0.2, "stiction_2": -0.5,
    "stribeck_2": 0.1, "memory": 1.0, "memory_speed": 0.3, "root": 0.3, "viscous": 0.2,
}  # fmt: skip


def all_terms(v):
    excess = 1.5 * np.exp(-((v / 0.2) ** 2)) - 0.5 * np.exp(-((v / 0.1) ** 2))
    return 4.0 + excess + np.exp(-v / 0.3) + 0.3 * np.sqrt(max(v, 0.0)) + 0.2 * v


@pytest.mark.parametrize(
    ("method", "tolerance", "law", "force", "breakaway"),
    [
        ("rk4", 2e-8, STRIBECK, lambda v: 4.0 + 2.0 * np.exp(-((v / 0.2) ** 2)), 6.0),
        ("DOP853", 1e-9, STRIBECK, lambda v: 4.0 + 2.0 * np.exp(-((v / 0.2) ** 2)), 6.0),
        ("DOP853", 2e-7, ALL_TERMS, all_terms, 6.0),
    ],
)
def test_a_stick_slip_oscillator(tmp_path, method, tolerance, law, force, breakaway):
    """A block that a spring pulls at constant speed, against phases integrated one by one."""
    k, m, speed = 50.0, 2.0, 0.1
    machine = block(tmp_path, 0.0, m, **law)
    path = crane.motion.polynomial([[0.0, speed]], 10.0)
    pull = crane.PI(machine, path, {"x": crane.description.PIGains(k, 0.0)}, np.zeros(1))
    found = run(machine, pull, step=1e-3, method=method)
    wanted, rests = np.zeros(len(found.time)), np.zeros(len(found.time), dtype=bool)
    phases = stick_slip(k, m, speed, force, breakaway, until=10.0)
    assert len(phases) >= 10
    for kind, begun, ended, what in phases:
        here = (found.time >= begun) & (found.time < ended)
        if here.any():
            wanted[here] = what if kind == "rest" else what(found.time[here])[0]
        rests |= here & (kind == "rest")
    assert np.abs(found.q[:, 0] - wanted).max() < tolerance
    assert ((found.v[:, 0] == 0) == rests).mean() > 0.999
    force = k * (speed * found.time - found.q[:, 0])
    assert found.channels["rest_x"][rests] == pytest.approx(force[rests], abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_many_joints_that_stick_give_way_together(tmp_path, method):
    """A four-bar breaks away at the force of virtual work, sum F_k |Gamma_k|: three, one way.

    On its way joints turn while others move on.
    """
    machine = singular_linkages.four_bar(tmp_path, "a")
    limits = {"a": 3.0, "b": 1.0, "c": 2.0}
    machine = machine.replace(
        friction={joint: crane.description.Friction(coulomb=x) for joint, x in limits.items()}
    )
    q_a = machine.home[machine.closure.active]
    gamma = machine.closure.gamma(machine.home)[:, 0]
    weight = Dynamics(machine).gravity(q_a)[0]
    most = sum(x * abs(gamma[machine.column(joint)]) for joint, x in limits.items())
    for sign in (1.0, -1.0):
        breaks = (weight + sign * most) / (sign * 40.0)

        def ramp(t, q, v, sign=sign):
            return np.array([sign * 40.0 * t])

        with pytest.warns(crane.CraneWarning, match="in more ways than one: the motion is det"):
            found = crane.simulate(machine, ramp, None, 0.58, 1e-3, method=method)
        # it is let go from weight's side first, if friction does not hold that alone
        assert abs(weight) < most
        still = found.time < breaks
        assert (found.v[still] == 0).all()
        assert still.sum() > 100
        assert (sign * found.v[found.time > breaks + 2e-3] > 0).all()
        forces = sum(
            found.channels[f"rest_{joint}"] * gamma[machine.column(joint)] for joint in limits
        )
        held = sign * 40.0 * found.time[still] - weight
        assert forces[still] == pytest.approx(held, abs=1e-9)
        for joint, limit in limits.items():
            assert np.abs(found.channels[f"rest_{joint}"]).max() <= limit * (1 + 1e-8)


def test_a_loaded_crane_stands_still_for_an_hour(mini):
    """The mini forwarder without drive comes down onto its stop and rests: nothing creeps."""
    found = run(mini, None, None, 3600.0, 1.0, method="DOP853")
    late = found.time > 3.0
    assert (found.q[late] == found.q[-1]).all() and (found.v[late] == 0).all()
    assert found.q[-1, 1] > mini.upper[1]
    # within the stroke, its offsets taken off, as large as its friction can carry
    loaded = mini.replace(
        friction={
            **mini.friction,
            **{
                joint: crane.description.Friction(coulomb=60.0, viscous=500.0)
                for joint in ("X1", "X2")
            },
        }
    ).with_payload(crane.Payload(mass=0.3, frame="link7_tip"))
    start = [0.3, 0.015, 0.02]
    found = run(loaded, None, start, 3600.0, 1.0, method="DOP853")
    assert (found.q == start).all() and (found.v == 0).all()
    weight = Dynamics(loaded).gravity(np.array(start))
    assert 50.0 < abs(weight[1]) < 60.0
    for i, joint in enumerate(loaded.active):
        assert found.channels[f"rest_{joint}"] == pytest.approx(-weight[i], abs=1e-9)


@pytest.mark.slow
def test_methods_and_backends_agree(mini):
    """The lift with friction that sticks: machine code, Python and Pinocchio."""

    def lift(**how):
        drive = crane.PI(mini, crane.task_trajectory(mini, "lift"))
        return run(mini, drive, step=1e-3, **how)

    exact, fixed = lift(method="DOP853"), lift(method="rk4")
    assert np.abs(exact.q - fixed.q).max() < 2e-7
    assert gap(exact) < 1e-9 * np.ptp(exact.channels["work"])
    python = lift(backend="pinocchio", duration=0.5)
    rests = [f"rest_{joint}" for joint in ("q1", "X1", "X2")]
    for name in ("kinetic", "dissipated", *rests):
        some = fixed.channels[name][:501]
        assert python.channels[name] == pytest.approx(some, abs=1e-9 * np.abs(some).max())
    assert 0 < (fixed.v[:501] == 0).mean() < 1


def test_a_boom_on_closed_valves_stays_for_an_hour():
    """Without leakage, with 211 kg at its tip: nothing moves, and pressures only by rounding."""
    tight = {
        f"cylinder.{joint}.leakage_{side}": 0.0
        for joint in ("slew", "X_lift", "X_tilt", "X_ext")
        for side in "ab"
    }
    machine = crane.load("patu655", {"payload.mass": 211.4, **tight})
    found = run(machine, None, None, 3600.0, 2.0)
    assert (found.q == found.q[0]).all() and (found.v == 0).all()
    for name, values in found.channels.items():
        if name.startswith("pressure"):
            assert np.ptp(values) < 2e-9, name  # Pa: a spring in series rounds its force


# --- shares of resting joints -------------------------------------------------------------------


@pytest.mark.parametrize("over", [1e-10, 0.3, 3.0])
def test_shares_are_the_least_within_their_limits(over):
    """Most searches end at once: nothing is beyond, or an event has brought one joint there."""
    draw = np.random.default_rng(0)
    full = 0
    for _ in range(300):
        k = int(draw.integers(1, 5))
        reach = draw.normal(size=(int(draw.integers(k, 6)), k)) * 10 ** draw.uniform(-3, 3, k)
        shares = draw.uniform(-1.0, 1.0, k)
        shares[: draw.integers(k + 1)] *= 1.0 + over
        shares[0] = np.sign(shares[0]) * (1.0 + over)
        size = np.linalg.norm(reach, axis=0).max()
        net = reach @ shares + draw.normal(size=len(reach)) * 1e-2 * size
        found = _bounded_least_squares(reach, net)
        wanted = lsq_linear(reach, net, (-1.0, 1.0), method="bvls", tol=1e-15).x
        assert np.abs(found).max() <= 1.0 + 1e-15  # as scipy has it
        off = np.linalg.norm(reach * (found - wanted), axis=0).max()
        assert off <= 1e-12 * size
        full += int((np.abs(found) >= 1.0).sum())
    assert full > 200


@pytest.mark.parametrize("near", [0.0, 1e-12, 3e-9, 1e-6, 1.0])
def test_independent_columns_are_those_of_a_pivoted_qr(near):
    draw = np.random.default_rng(1)
    for _ in range(200):
        n, k = int(draw.integers(1, 6)), int(draw.integers(0, 6))
        columns = draw.normal(size=(n, k)) * 10 ** draw.uniform(-6, 6, k)
        if k > 1 and draw.random() < 0.7:  # one that nearly follows from the others
            size = np.linalg.norm(columns[:, -1])
            columns[:, -1] *= near
            columns[:, -1] += size * columns[:, 0] / np.linalg.norm(columns[:, 0])
        if k and draw.random() < 0.2:
            columns[:, draw.integers(k)] = 0.0
        kept, rank = _independent_columns(columns)
        if not k:
            assert (len(kept), rank) == (0, 0)
            continue
        upper, order = qr(columns, mode="r", pivoting=True)
        sizes = np.abs(np.diag(upper))
        own = np.linalg.norm(columns, axis=0)[order[: len(sizes)]]
        independent = sizes > RANK_TOLERANCE * own
        assert rank == independent.sum()
        assert set(kept) == set(order[:rank])


@pytest.mark.slow
def test_a_held_cylinder_breaks_away_while_another_moves():
    """Without stiction it gives way at zero acceleration, from a velocity of exactly zero.

    The coordinates of the integration are not the strokes.
    """
    machine = crane.load(machine_templates()["loader_zbar"]["10t"])
    friction = {x: replace(law, stiction=0.0) for x, law in machine.friction.items()}
    machine = machine.replace(friction=friction)
    found = crane.simulate(machine, crane.joystick(machine, "load"), step=1e-2)
    tilt, held = found.v[:, 1], found.channels["rest_X_tilt"] != 0.0
    assert held.sum() > 100 and (np.diff(held.astype(int)) == -1).sum() > 3
    assert np.abs(tilt[held]).max() < 1e-7  # what integration errors leave
