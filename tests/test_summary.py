"""Summaries of recordings, and two runs compared."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import typed

from crane import load, simulate
from crane.recordings.recording import Recording
from crane.recordings.recording_summary import (
    energy_imbalance,
    joint_differences,
    point_channel,
    rms,
    summarize,
)

DATA = Path(__file__).parent / "data"


def make(time, **channels):
    """q1 swings as sin t against a torque 2 cos t, X1 rests under a force of 50 N."""
    time = np.asarray(time)
    rest = np.zeros_like(time)
    return Recording(
        time=time,
        joints=("q1", "X1"),
        q=np.column_stack([np.sin(time), rest + 0.02]),
        v=np.column_stack([np.cos(time), rest]),
        tau=np.column_stack([2 * np.cos(time), rest - 50.0]),
        units={"q1": "rad", "X1": "m"},
        channels=channels,
    )


def test_extremes_of_a_swing():
    time = np.linspace(0, 2 * np.pi, 4001)
    turn, slide = summarize(make(time)).joints
    assert (turn.lowest, turn.highest) == pytest.approx((-1, 1), abs=1e-6)
    assert turn.peak_speed == pytest.approx(1)
    assert turn.peak_force == pytest.approx(2)
    assert turn.rms_force == pytest.approx(np.sqrt(2), rel=1e-6)
    assert (slide.lowest, slide.highest, slide.peak_speed) == (0.02, 0.02, 0)
    assert (slide.peak_force, slide.rms_force) == pytest.approx((50, 50))
    assert turn.peak_error is None and turn.rms_error is None


def test_rms_weighs_by_time_not_by_sample():
    time = np.r_[np.linspace(0, 1, 1001), 2.0, 3.0]
    values = np.where(time <= 1, 1.0, 3.0)
    assert rms(time, values) == pytest.approx(np.sqrt((1 + (1 + 9) / 2 + 9) / 3))
    assert rms(np.array([4.0]), np.array([-3.0])) == 3


def test_tracking_errors():
    time = np.linspace(0, 2 * np.pi, 4001)
    tip = np.column_stack([np.cos(time), np.sin(time), time])
    shift = np.array([0.003, 0.0, 0.004])
    channels = {"reference_q1": np.sin(time) - 0.1 * np.sin(3 * time)}
    channels |= {f"tip_{axis}": tip[:, i] for i, axis in enumerate("xyz")}
    channels |= {f"reference_tip_{axis}": tip[:, i] - shift[i] for i, axis in enumerate("xyz")}
    summary = summarize(make(time, **channels))
    turn, slide = summary.joints
    assert turn.peak_error == pytest.approx(0.1, rel=1e-5)
    assert turn.rms_error == pytest.approx(0.1 / np.sqrt(2), rel=1e-6)
    assert slide.peak_error is None
    assert (summary.tip_peak_error, summary.tip_rms_error) == pytest.approx((0.005, 0.005))
    assert summary.duration == pytest.approx(2 * np.pi)


def test_points_need_all_three_axes():
    recording = make([0.0, 1.0], tip_x=[1.0, 2.0], tip_y=[3.0, 4.0])
    assert point_channel(recording, "tip") is None
    assert summarize(recording).tip_rms_error is None
    recording = make([0.0, 1.0], tip_x=[1.0, 2.0], tip_y=[3.0, 4.0], tip_z=[5.0, 6.0])
    np.testing.assert_array_equal(point_channel(recording, "tip"), [[1, 3, 5], [2, 4, 6]])


def test_markdown():
    zero = {f"tip_{axis}": [0.0, 0.0] for axis in "xyz"}
    away = {f"reference_tip_{axis}": [0.0, 0.0] for axis in "yz"} | {
        "reference_tip_x": [0.002] * 2
    }
    recording = make([0.0, np.pi / 2], reference_X1=[0.0195, 0.02], **zero, **away)
    assert summarize(recording).to_markdown().splitlines() == [
        "| joint | position range | peak speed | peak force | RMS force | peak tracking error "
        "| RMS tracking error |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: |",
        "| q1 | 0.00 to 57.30 deg | 57.30 deg/s | 2 N m | 1.414 N m |  |  |",
        "| X1 | 20.00 to 20.00 mm | 0.00 mm/s | 50 N | 50 N | 0.500 mm | 0.354 mm |",
        "| tip |  |  |  |  | 2.000 mm | 2.000 mm |",
    ]


def energies(time):
    """A free fall by 3 m with friction, pushed by a drive and by a load, and an oil besides."""
    time = np.asarray(time)
    return {
        "kinetic": 8 * time, "potential": 20 - 7 * time, "dissipated": 2 * time,
        "work": 5 + time, "work_wind": 2 * time, "hydraulic_loss": 3 * time,
        "oil_energy": time, "pump_work": 5 * time,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("off", "expected"),
    [
        ({}, "0 J (mechanism), 0 J (oil)"),
        (
            {"kinetic": 0.25},
            "0.25 J (mechanism), 0 J (oil)",
        ),
        (
            {"work_wind": -0.5},
            "0.5 J (mechanism), 0 J (oil)",
        ),
        ({"work": 0.5}, "0.5 J (mechanism), 0.5 J (oil)"),
        ({"pump_work": 2}, "0 J (mechanism), 2 J (oil)"),
    ],
)
def test_the_balance_of_energy(off, expected):
    time = np.arange(5.0)
    channels = energies(time)
    for name, most in off.items():
        channels[name] = channels[name] + np.array([0, 0, most, 0, 0])
    units = dict.fromkeys(channels, "J")
    recording = replace(make(time, **channels), channel_units=units)
    assert summarize(recording).to_markdown().splitlines()[-2:] == [
        "",
        f"maximum energy imbalance: {expected}",
    ]
    assert summarize(make(time, **channels)).balance_text == ""  # of no energies


def test_a_balance_that_is_simulated(slider_crank):
    recording = simulate(slider_crank, lambda t, q, v: [2.0 - v[0]], duration=0.2)
    gap = energy_imbalance(recording)
    assert 0 < np.abs(gap).max() < 1e-6 < np.ptp(recording.channels["work"])
    assert summarize(recording).balance_text == f"{np.abs(gap).max():.2g} J (mechanism)"


def test_potential_energy_counts_weight_from_the_world_s_origin_and_springs_from_their_rest(
    tmp_path,
):
    text = (DATA / "slider_crank.yaml").read_text().replace(": slider_", f": {DATA}/slider_")
    text = text.replace(f"name: {DATA}/", "name: ")
    springs = """forces:
  - {between: [base, slider], stiffness: 300, rest: 0.2}
  - {joint: theta, stiffness: 4, rest: 0.5}
  - {joint: phi, force: 3}
end_stops: {theta: {stiffness: 1.0e+3}}
"""
    (tmp_path / "my.yaml").write_text(text + springs)
    machine = load(tmp_path / "my.yaml")
    recording = simulate(machine, initial=([0.2], [-2.0]), duration=0.08)
    theta, phi, s = (recording.columns()[joint] for joint in ("theta", "phi", "s"))
    assert theta.min() < 0.1  # in the end stop
    along, across = np.cos(theta), np.sin(theta)
    crank = 0.07 * across + 0.01 * along
    rod = 0.2 * across + 0.16 * np.sin(theta + phi) - 0.02 * np.cos(theta + phi)
    expected = (
        9.81 * (0.8 * crank + 0.5 * rod + 1.3 * 0.3)  # the guide is 0.3 m high
        + 150 * (np.hypot(s, 0.3) - 0.2) ** 2
        + 2 * (theta - 0.5) ** 2
        - 3 * phi
        + 500 * np.maximum(0.1 - theta, 0) ** 2
    )
    np.testing.assert_allclose(recording.channels["potential"], expected, atol=1e-9)


def test_rounding_noise_reads_as_zero():
    noise = np.array([[-1e-18], [2e-18]])
    recording = Recording(
        [0, 1], ("q1",), noise, noise, noise, {"q1": "rad"}, {"reference_q1": [0.0, 0.0]}
    )
    row = summarize(recording).to_markdown().splitlines()[2]
    assert row.startswith("| q1 | 0.00 to 0.00 deg | 0.00 deg/s |")
    assert row.endswith("| 0.000 deg | 0.000 deg |")


# --- two runs in one figure ---------------------------------------------------------------------


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
