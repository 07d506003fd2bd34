"""The bundled excavator beside what data sheets of its class print, and its cycle's balance."""

import warnings

import numpy as np
import pytest
from scipy.optimize import minimize

import crane
from crane.studies.tipping import tipping_load

PRESSURE, BUCKET, ARM = 3.5e7, 1.1309734e-2, 1.5393804e-2  # [Pa], areas of the pistons [m2]
RADIUS = 1.47  # of the bucket's tip about its pin [m]


@pytest.fixture(scope="module")
def machine():
    return crane.load("excavator")


def farthest(machine, what):
    """The largest value of a function of the tip's place over all strokes."""
    ends = machine.model.upperPositionLimit[machine.closure.active][1:]
    kinematics, random = crane.Kinematics(machine), np.random.default_rng(0)

    def least(shares):
        return -what(kinematics.position(np.r_[0.0, np.clip(shares, 0, 1) * ends]))

    found = [
        minimize(least, random.uniform(0.2, 0.8, 3), method="Nelder-Mead", options={"xatol": 1e-6})
        for _ in range(6)
    ]
    return -min(one.fun for one in found)


@pytest.mark.parametrize(
    ("printed", "share", "what"),
    [
        (9.86, 0.01, lambda tip: tip[0] - 1e3 * tip[2] ** 2),  # reach at the ground
        (6.72, 0.02, lambda tip: -tip[2]),  # depth
        (9.37, 0.05, lambda tip: tip[2]),  # height
    ],
)
def test_it_reaches_as_far_as_data_sheets_say(machine, printed, share, what):
    assert farthest(machine, what) == pytest.approx(printed, rel=share)


def test_it_weighs_and_digs_as_data_sheets_say(machine):
    """Forces of full pressure in one cylinder at the tip, across its radius; without weights."""
    assert sum(x.mass for x in machine.model.inertias) == pytest.approx(21600, rel=0.02)
    strokes = np.linspace(0.001, 1.103, 400)
    home = machine.home[machine.closure.active]
    across = np.tile(home, (400, 1))
    across[:, 3] = strokes
    turn = machine.closure.gamma(machine.closure.solve(across))[:, machine.column("bucket"), 3]
    force = PRESSURE * BUCKET / (RADIUS * np.abs(turn))
    assert force.max() == pytest.approx(150e3, rel=0.07)
    best = home.copy()
    best[3] = strokes[force.argmax()]  # where the arm's force is defined, too
    tip, pin = (crane.Kinematics(machine, frame).position(best) for frame in (machine.tip, "arm"))
    radius = np.linalg.norm(tip - pin)
    along = np.tile(best, (400, 1))
    along[:, 2] = np.linspace(0.001, 1.503, 400)
    turn = machine.closure.gamma(machine.closure.solve(along))[:, machine.column("arm"), 2]
    assert (PRESSURE * ARM / (radius * np.abs(turn))).max() == pytest.approx(106e3, rel=0.02)


def test_a_cycle_ends_where_it_began_and_keeps_the_balance(machine):
    task = machine.tasks["dig"]
    under = machine.under(*task.loads)
    levers = crane.joystick(machine, "dig")
    run = crane.simulate(under, levers, duration=task.duration, step=1e-2)
    seen = run.channels
    assert np.abs(run.q[-1] - run.q[0]).max() < 0.1
    assert np.ptp(run.q[:, 0]) == pytest.approx(np.pi / 2, abs=0.05)
    assert seen["depth_teeth"].max() > 0.1 and seen["stability"].min() > 0
    outside = [name for name in seen if name.startswith("work_")]
    assert {"work_teeth", "work_earth"} <= set(outside) and seen["work_teeth"][-1] < -1e4
    work = seen["work"] + sum(seen[name] for name in outside)
    stored = seen["kinetic"] + seen["potential"]
    gap = work - (stored - stored[0]) - seen["dissipated"]
    assert np.abs(gap).max() < 1e-6 * np.ptp(stored)


@pytest.mark.slow
def test_levers_tip_it_with_the_load_that_is_said(machine):
    """A little less leaves it on its tracks, a little more does not; quietly."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = tipping_load(machine, "dig")
    least = []
    for share in (0.98, 1.02):
        loaded = crane.load("excavator", {"payload.mass": share * found.mass})
        under = loaded.under(*loaded.tasks["dig"].loads)
        run = crane.simulate(under, crane.joystick(loaded, "dig"), duration=16.0, step=5e-3)
        least.append(run.channels["stability"].min())
    assert least[0] > 0 > least[1] and 0 < found.mass < found.static
