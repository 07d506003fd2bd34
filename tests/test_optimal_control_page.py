"""The program of docs/optimal_control.md: motions are optimal and feasible for the machine."""

import re
import warnings
from pathlib import Path

import numpy as np
import pytest

import crane
from crane.common.errors import CraneWarning

pytest.importorskip("casadi", reason="CasADi is not installed")
pytestmark = pytest.mark.slow
PAGE = Path(__file__).parents[1] / "docs" / "optimal_control.md"


@pytest.fixture(scope="module")
def page():
    """What is defined after the page's blocks."""
    blocks = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(), re.DOTALL | re.MULTILINE)
    assert len(blocks) == 4
    names: dict = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        exec(compile("\n".join(blocks), str(PAGE), "exec"), names)
    return names


def test_the_fastest_motion_takes_as_long_as_its_slowest_cylinder(page):
    """Way / v + v / a of a trapezoid at the valve's flow and the largest acceleration."""
    path, machine = page["fastest"], page["machine"]
    way = path.position(path.duration) - path.position(0.0)
    area = np.where(way > 0, page["A"], page["B"])
    speed = page["spare"] * page["c1"] * np.sqrt(page["drop"]) / area
    way, a = np.abs(way), page["quickest"]
    times = np.where(way > speed**2 / a, way / speed + speed / a, 2 * np.sqrt(way / a))
    assert times[0] < path.duration < 1.05 * times.max()  # the lift, which no load pulls
    assert (path.bounds()[0] > machine.lower).all() and (path.bounds()[1] < machine.upper).all()


def test_the_cheapest_motion_needs_less_and_no_extension(page):
    assert page["least_energy"] < 0.85 * page["its_energy"]
    assert np.ptp(page["cheapest"].position(np.linspace(0, 9, 50))[:, 2]) < 2e-3
    assert np.ptp(page["fastest"].position(np.linspace(0, 9, 50))[:, 2]) > 0.04


@pytest.mark.parametrize("which", [0, 1], ids=["fastest", "cheapest"])
def test_the_simulated_machine_does_as_planned(page, which):
    """Its pump works as the plan says, though that knows steady circuits alone."""
    run, path = page["runs"][which], page[("fastest", "cheapest")[which]]
    planned = page[("its_energy", "least_energy")[which]]
    assert run.channels["pump_work"][-1] == pytest.approx(planned, rel=0.02)
    supply = page["described"].hydraulics.supply
    asked = (supply.pressure - run.channels["pressure_supply"]) / supply.droop
    assert asked.max() < 0.9
    for joint in page["circuit"].joints:
        assert max(run.channels[f"pressure_{joint}_{x}"].max() for x in "ab") < supply.pressure
    error = np.abs(run.q - path.position(run.time))
    assert error.max() < 0.045 and error[-1].max() < 2e-3
    tip = [run.channels[f"tip_{axis}"][-1] for axis in "xz"]
    assert np.abs(tip - page["goal"]).max() < 0.015


def test_the_planned_end_is_the_goal(page):
    place = crane.Kinematics(page["machine"])
    for path in (page["fastest"], page["cheapest"]):
        end = place.position(path.position(path.duration))
        assert end[[0, 2]] == pytest.approx(page["goal"], abs=1e-6)


def test_the_rootfinder_of_the_page_closes_the_loops(page):
    machine, active, passive = page["machine"], page["active"], page["passive"]
    wanted = machine.closure.solve(machine.home[active] + 0.01)
    found = page["closed"](machine.home[passive], wanted[active])
    assert np.array(found).ravel() == pytest.approx(wanted[passive], abs=1e-9)
