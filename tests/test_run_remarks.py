"""Remarks on a run: chatter, end stops that gain energy, pistons beyond their cylinders."""

import re
import warnings

import numpy as np
import pytest
from broken_machines import DATA

import crane
from crane.common.errors import CraneWarning, SimulationError
from crane.recordings.recording_summary import energy_imbalance


def told(*args, **options):
    """A run and its warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", CraneWarning)
        found = crane.simulate(*args, **options)
    return found, [str(one.message) for one in caught]


def returning(machine):
    return crane.PI(machine, crane.task_trajectory(machine, "return"))


def test_friction_that_steps_do_not_follow_is_told_as_chatter(smooth):
    """At 2 ms its energies balance to 0.5 %, and friction is wrong by half of itself."""
    coarse, lines = told(smooth, returning(smooth), step=2e-3, method="rk4")
    (line,) = lines
    count = re.match(r"friction of 'q1', 'X1', 'X2' chatters in (\d+) of 5001 samples", line)
    assert count and "leave that out, so that it sticks" in line
    fine, lines = told(smooth, returning(smooth), step=5e-4, method="rk4")
    assert not lines
    law = smooth.friction["X1"]
    one, two = (law.coulomb * np.tanh(v / law.smoothing) for v in (coarse.v[:, 1], fine.v[::4, 1]))
    wrong = np.abs(one - two) > 0.1 * law.coulomb
    assert 0.5 * wrong.sum() < int(count[1]) < 2.0 * wrong.sum()
    assert np.abs(one - two).max() > 0.4 * law.coulomb


def test_friction_that_sticks_and_steps_by_their_error_do_not_chatter(mini, smooth):
    assert not told(mini, returning(mini), step=2e-3, method="rk4")[1]
    assert not told(smooth, returning(smooth), step=2e-3, method="DOP853")[1]


def test_a_stop_that_gains_energy_is_an_error(mini):
    """A block of steel against a stop that four steps go through."""
    machine = mini.replace(friction={}, end_stops=(crane.description.EndStop("X1", 1e8),))
    start = np.array([0.0, 0.0295, 0.015]), np.array([0.0, 0.3, 0.0])
    with pytest.raises(SimulationError) as caught:
        crane.simulate(machine, None, start, 0.01, 1e-3, method="rk4")
    text = str(caught.value)
    assert "the end stop of 'X1' gives back" in text and "\n" not in text
    found, _ = told(machine, None, start, 0.01, 1e-3, method="DOP853")
    assert found.q[:, 1].max() > machine.upper[1]


def test_a_piston_beyond_its_cylinder_is_told():
    machine = crane.load("patu655")
    soft = tuple(
        crane.description.EndStop(stop.joint, 1e-2 * stop.stiffness, stop.damping)
        for stop in machine.end_stops
    )
    lift = machine.active.index("X_lift")

    def against(machine):
        levers = crane.control.ValveSignals(machine, [0.0, 1.0], {"X_lift": [0.0, 4.0]})
        return told(machine, levers, duration=16.0, step=2e-3)

    found, lines = against(machine.replace(end_stops=soft))
    (line,) = (line for line in lines if "beyond its stroke" in line)
    depth = float(re.search(r"is ([\d.e-]+) m beyond its stroke at t = ", line)[1])
    q = found.q[:, lift]
    beyond = np.maximum(machine.lower[lift] - q, q - machine.upper[lift])
    assert depth == pytest.approx(beyond.max(), rel=1e-2)
    assert not [line for line in against(machine)[1] if "beyond its stroke" in line]


@pytest.mark.parametrize("push", [1e-17, 1e-10, 1e-7])
def test_a_machine_that_hardly_moves_has_no_imbalance(push):
    """Rounding and tolerances are no long steps: energies of 1e-17 J in a machine of 0.1 kg m."""
    machine = crane.load(DATA / "four_bar.yaml").replace(forces=(), end_stops=())
    found, lines = told(machine, lambda t, q, v: np.array([push]), duration=0.3, method="RK45")
    assert lines == [] and np.abs(found.v).max() < 1e-6
    gap = np.abs(energy_imbalance(found)).max()
    assert gap > 5e-3 * max(np.ptp(found["work"]), np.ptp(found["kinetic"]))


def test_an_imbalance_of_a_small_motion_is_told():
    """Friction that a step of 1 ms does not follow, at 1e-3 rad/s."""
    machine = crane.load(DATA / "four_bar.yaml").replace(forces=(), end_stops=())
    _, lines = told(machine, lambda t, q, v: np.array([1e-5]), duration=0.3, method="rk4")
    (line,) = [x for x in lines if "so the step of 0.001 s is too long" in x]
    assert re.match(r"work, energy and dissipation differ by \d\S*e-06 J of \d\S*e-06 J", line)
