"""Parallel robots exported by others: they close, hold and fall unchanged."""

from pathlib import Path

import numpy as np
import pytest
from command_line import typed
from warned import quiet

import crane
from crane.control import make_controller
from crane.motion.trajectory import point_to_point

ROBOTS = Path(__file__).parents[2] / "shared/data/third_party/parallel_robots"
FREEDOMS = {
    "5bar_linkage_iso6d": 2, "robot_delta": 5, "digit_like_2legs": 12, "wl16_like": 12,
}  # fmt: skip
# how long each falls: motors of the two large ones come to dead centres at 0.23 and 0.14 s
FALLS = {
    "5bar_linkage_iso6d": 1.0, "robot_delta": 1.0, "digit_like_2legs": 0.3, "wl16_like": 1.0,
}  # fmt: skip
LARGE = {
    "digit_like_2legs": pytest.mark.slow, "wl16_like": (pytest.mark.slow, pytest.mark.long),
}  # fmt: skip
EVERY = [pytest.param(x, marks=LARGE.get(x, ())) for x in FREEDOMS]

pytestmark = pytest.mark.skipif(
    not ROBOTS.exists(), reason="the robots, ../shared/data, are not there"
)


def robot(name):
    return quiet(crane.load, ROBOTS / name / "robot.yaml")


@pytest.mark.parametrize("name", FREEDOMS)
def test_they_close(name):
    machine = robot(name)
    closure = machine.closure
    assert len(machine.active) == FREEDOMS[name]
    assert closure.residual(machine.home) <= 1e-12
    assert closure.structure.redundancy.largest_gap <= 1e-12
    coordinates = closure.equations.coordinates
    assert (machine.home >= coordinates.lower - 1e-9).all()
    assert (machine.home <= coordinates.upper + 1e-9).all()


@pytest.mark.parametrize("name", EVERY)
def test_a_check_fits_on_a_screen(name):
    told = typed("check", ROBOTS / name / "robot.yaml")
    lines = told.stdout.splitlines()
    assert told.returncode == 1 and len(lines) <= 24
    assert any("home was searched for" in line for line in lines)
    assert lines[-1] == f"next: crane check {ROBOTS / name / 'robot.yaml'} --write-home"


@pytest.mark.parametrize("name", EVERY)
def test_computed_torque_holds_home(name):
    machine = robot(name)
    home = machine.home[machine.closure.active]
    driven = [i for i, joint in enumerate(machine.active) if joint not in machine.free]
    hold = make_controller("computed-torque", machine, point_to_point(home, home, 1.0))
    run = crane.simulate(machine, hold)
    assert run.time[-1] == pytest.approx(1.0)
    assert np.abs(run.q - run.q[0])[:, driven].max() < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("name", EVERY)
def test_they_fall_without_gain_or_loss(name):
    machine = robot(name)
    run = quiet(crane.simulate, machine, duration=FALLS[name], method="DOP853")
    kinetic, potential, work, lost = (
        run.channels[key] for key in ("kinetic", "potential", "work", "dissipated")
    )
    balance = kinetic + potential - work + lost
    assert kinetic.max() > 1e-5 and np.abs(work).max() == 0 and np.abs(lost).max() == 0
    assert np.ptp(balance) < 1e-8 * kinetic.max()
