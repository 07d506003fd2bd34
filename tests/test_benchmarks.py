"""Benchmark mechanisms against published or independently computed references."""

import warnings

import benchmark_mechanisms
import numpy as np
import pytest
from urdf_text import sliding_block
from warned import quiet

import crane


def of(machine, found, joint):
    """A joint's coordinate over time."""
    return (
        found.q[:, machine.active.index(joint)]
        if joint in machine.active
        else found.channels[joint]
    )


@pytest.mark.parametrize(
    ("method", "step", "error"),
    [
        ("DOP853", 1e-3, 3e-9),
        ("Radau", 1e-3, 3e-9),
        ("rosenbrock", 1e-3, 2e-6),
        ("rk4", 1e-5, 3e-9),
    ],
)
def test_andrews_squeezing_mechanism(tmp_path, method, step, error):
    """Against the digits of the Test Set for IVP Solvers, 15.8 rad in 30 ms."""
    machine = benchmark_mechanisms.squeezer(tmp_path)
    found = crane.simulate(machine, duration=0.03, step=step, method=method)
    gamma = machine.closure.gamma(
        np.array([of(machine, found, joint)[-1] for joint in machine.joints])
    )
    for joint, (angle, speed) in benchmark_mechanisms.SQUEEZED.items():
        assert of(machine, found, joint)[-1] == pytest.approx(angle, abs=error)
        rate = gamma[machine.column(joint)] @ found.v[-1]
        assert rate == pytest.approx(speed, abs=1e3 * error)
    stored = found.channels["kinetic"] + found.channels["potential"]
    assert np.ptp(stored) < 1e-7 * np.ptp(found.channels["kinetic"]) * (1e2 if error > 1e-8 else 1)


@pytest.mark.parametrize(
    "active",
    ["j1", "j2", *(pytest.param(f"j{i}", marks=pytest.mark.slow) for i in (3, 4))],
)
def test_bricard_s_mechanism_moves_alike_by_any_joint(tmp_path, active):
    """Overconstrained, through dead centres of some joints, for 10 s."""
    motions = []
    for joint in ("j0", active):
        machine = benchmark_mechanisms.bricard(tmp_path, joint)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", crane.CraneWarning)  # of dead centres
            found = crane.simulate(machine, duration=10.0, step=1e-2)
        motions.append(np.column_stack([of(machine, found, x) for x in machine.joints]))
        stored = found.channels["kinetic"] + found.channels["potential"]
        assert np.ptp(stored) < 5e-9 * np.ptp(found.channels["kinetic"])
    assert np.ptp(motions[0], axis=0).max() > 3
    assert np.abs(motions[0] - motions[1]).max() < 4e-9


def test_a_stiff_governor_by_all_methods(tmp_path):
    """Flyballs against 8e5 N/m and 4e4 N s/m: errors are what the tolerance says."""
    machine = quiet(benchmark_mechanisms.governor, tmp_path)
    start = machine.home[machine.closure.active], np.array([2 * np.pi, 0.0])

    def run(**how):
        return crane.simulate(machine, None, start, 2.0, 1e-2, **how)

    exact = run(method="DOP853", tolerance=1e-13)
    parts = (exact.channels[name] for name in ("kinetic", "potential", "dissipated"))
    stored = sum(parts)
    assert np.ptp(stored) < 1e-8 * np.ptp(exact.channels["dissipated"])
    assert np.ptp(exact.q[:, 1]) > 1e-4
    for method, tolerance, error in (
        ("DOP853", 1e-8, 1e-9), ("Radau", 1e-8, 1e-9), ("Radau", 1e-11, 1e-12),
        ("rosenbrock", 1e-8, 1e-7),
    ):  # fmt: skip
        found = run(method=method, tolerance=tolerance)
        assert 0 < np.abs(found.q - exact.q).max() < error
    # a hundred times as stiff, explicit steps would be a hundred times as short
    (spring,) = machine.forces
    hard = machine.replace(
        forces=(crane.description.ForceElement("collar", 8e7, spring.rest, 100 * spring.damping),)
    )
    one, two = (
        crane.simulate(hard, None, start, 2.0, 1e-2, method="Radau", tolerance=x)
        for x in (1e-8, 1e-11)
    )
    assert np.abs(one.q - two.q).max() < 1e-9


def test_tolerances_that_cannot_be(mini):
    for method, tolerance, text in (
        ("rk4", 1e-6, "method 'rk4' has no tolerance"),
        ("Radau", 1e-20, "the tolerance is 1e-20, give 1e-13 to 0.01"),
        (None, -1.0, "the tolerance"),
    ):
        with pytest.raises(crane.CraneError) as caught:
            crane.simulate(mini, duration=0.01, method=method, tolerance=tolerance)
        assert text in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("how", "error"),
    [({}, 5e-10), ({"tolerance": 1e-13}, 2e-10), ({"method": "Radau"}, 1e-8)],
)
def test_a_block_between_stops_bounces_as_its_closed_form(tmp_path, how, error):
    """Straight lines and half sines, for a minute: a stop begins and ends where it does."""
    stiffness, mass = 1e6, 2.0
    machine = crane.load(sliding_block(tmp_path, mass, end=1))
    machine = machine.replace(end_stops=(crane.description.EndStop("x", stiffness),))
    found = crane.simulate(machine, None, (np.zeros(1), np.ones(1)), 60.0, 0.1, **how)
    omega = np.sqrt(stiffness / mass)
    contact = np.pi / omega
    t = np.mod(found.time - 1.0, 2 * (contact + 2.0))  # since the first contact
    side = np.where(t < contact + 2.0, 1.0, -1.0)
    t = np.mod(t, contact + 2.0)
    pressed = 1.0 + np.sin(omega * t) / omega
    wanted = side * np.where(t < contact, pressed, 1.0 - (t - contact))
    assert np.abs(found.q[:, 0] - wanted).max() < error
    assert np.ptp(found.channels["kinetic"] + found.channels["potential"]) < error
