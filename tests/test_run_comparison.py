"""Two runs compared in one figure, with their difference."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import typed

from crane import simulate
from crane.recordings.recording import Recording
from crane.recordings.recording_summary import joint_differences

DATA = Path(__file__).parent / "data"


def moved(time, bump, start=0.0):
    """q1 rises by 0.1 rad/s, X1 rests; a bump [rad, m] at 0.6 s after the start."""
    time = np.asarray(time)
    q = np.column_stack([0.1 * time, 0.0 * time]) + np.outer(np.isclose(time, 0.6), bump)
    nothing = np.zeros_like(q)
    units = {"q1": "rad", "X1": "m"}
    return Recording(start + time, ("q1", "X1"), q, nothing, nothing, units)


@pytest.mark.parametrize("start", [0.0, 7.0])
@pytest.mark.parametrize("bumps", [((0.0, 0.0), (0.02, -0.003)), ((0.02, -0.003), (0.0, 0.0))])
def test_the_largest_difference_is_found_in_either_run(start, bumps):
    first = moved(np.arange(11) / 10, bumps[0])
    times = [0.0, 0.59, 0.6, 0.61, 2.0] if any(bumps[1]) else [0.0, 2.0]
    second = moved(times, bumps[1], start)
    q1, x1 = joint_differences(first, second)
    assert (q1.joint, q1.unit, x1.joint, x1.unit) == ("q1", "rad", "X1", "m")
    assert (q1.largest, q1.time) == pytest.approx((0.02, 0.6), abs=1e-12)
    assert (x1.largest, x1.time) == pytest.approx((0.003, 0.6), abs=1e-12)
    assert x1.formatted == ("3 mm", "0.6 s")
    same = joint_differences(first, first)
    assert [one.largest for one in same] == [0.0, 0.0]


def test_view_tells_it(slider_crank, tmp_path):
    run = simulate(slider_crank, duration=0.05)
    run.to_csv(tmp_path / "one.csv")
    q = run.q.copy()
    q[20] += np.deg2rad(1.5)
    replace(run, q=q, channels={}, channel_units={}).to_csv(tmp_path / "other.csv")
    command = ("view", tmp_path / "one.csv", "--over", tmp_path / "other.csv", "--no-open")
    result = typed(*command, "--machine", DATA / "slider_crank.yaml", "--out", tmp_path / "a.html")
    assert "theta differs by at most 1.5 deg at 0.02 s\n" in result.stdout, result.stderr
    assert '"differences":[["theta","1.5 deg","0.02 s"]]' in (tmp_path / "a.html").read_text()
