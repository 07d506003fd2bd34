"""Recordings with defects: each defect causes one warning that names the column."""

import dataclasses
import warnings
from pathlib import Path

import numpy as np
import pytest
import warned
from rig import Rig, Tolerances
from warned import quiet

import crane
from crane.common.errors import CraneWarning, RecordingError
from crane.identification.excitation.fourier_trajectory import FourierTrajectory
from crane.identification.mechanics.identify import identify
from crane.identification.mechanics.smoothed_motion import smoothed_motion
from crane.identification.signals.signal_quality import (
    outlier_mask,
    replace_outliers,
    strongest_spectral_line,
)
from crane.recordings.logs import read_log
from crane.recordings.measured_recordings import read_measured

DATA = Path(__file__).parents[1] / ".." / "shared" / "data"
COLUMNS = Path(__file__).parents[1] / "scripts" / "columns"
recorded = pytest.mark.skipif(
    not DATA.is_dir(), reason="the recordings, ../shared/data, are not there"
)
RANGE, MIDDLE = np.array([1.0, 0.011, 0.011]), np.array([0.0, 0.015, 0.015])


def reference(seed):
    """Five harmonics of 0.1 Hz, twice, over most of the strokes."""
    rows = np.random.default_rng(seed).normal(size=(11, 3))
    rows[0] = 0
    q = FourierTrajectory(rows, 10.0).position(np.linspace(0, 10, 2000))
    scale = 2 * RANGE / np.ptp(q, axis=0)
    rows[1:] *= scale
    rows[0] = MIDDLE - scale * (q.max(axis=0) + q.min(axis=0)) / 2
    return FourierTrajectory(rows, 10.0, 2)


def rig_recording(machine, rig, seed):
    """Of a virtual rig, every fourth sample."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        found = Rig(machine, rig, Tolerances(pins=0.0)).run(reference(seed))
    return crane.Recording(
        found.time[::4], found.joints, found.q[::4], found.v[::4], found.tau[::4], found.units
    )


@pytest.fixture(scope="module")
def clean(mini):
    return rig_recording(mini, 2, 20)


def told(call):
    """Lines that a call tells of the recording's defects, not of what its motion leaves open."""
    _, lines = warned.told(call)
    return [line for line in lines if not line.startswith("this motion does not determine")]


def late(recording, seconds):
    count = round(seconds / (recording.time[1] - recording.time[0]))
    tau = np.concatenate([np.repeat(recording.tau[:1], count, axis=0), recording.tau[:-count]])
    return dataclasses.replace(recording, tau=tau)


def spoilt(recording, name, column, seed=0):
    """One in a hundred samples off by five times the column's standard deviation."""
    rng = np.random.default_rng(seed)
    values = getattr(recording, name).copy()
    at = rng.choice(len(values), len(values) // 100, replace=False)
    values[at, column] += rng.choice([-5, 5], len(at)) * values[:, column].std()
    return dataclasses.replace(recording, **{name: values}), at


def humming(recording, column, amplitude):
    tau = recording.tau.copy()
    tau[:, column] += amplitude * np.sin(2 * np.pi * 50 * recording.time + 0.3)
    return dataclasses.replace(recording, tau=tau)


@pytest.mark.slow
def test_a_clean_recording_is_told_nothing_of(mini, clean):
    lines = told(lambda: identify(mini, clean, bandwidth=20.0))
    assert lines == []


@pytest.mark.parametrize("seconds", [0.008, 0.06])
def test_forces_that_come_late(mini, clean, seconds):
    """At least q1, whose time is known best, within 3 ms."""
    (line,) = told(lambda: identify(mini, late(clean, seconds), bandwidth=20.0))
    assert line.startswith("'q1_force' is ") and line.endswith("shift_columns)")
    found = float(line.split(" is ")[1].split(" ms")[0])
    assert abs(found - 1e3 * seconds) < 3 and "behind its motion" in line


@pytest.mark.parametrize(("name", "column", "words"), [("tau", 1, "X1_force"), ("q", 2, "X2")])
def test_outliers_are_told_and_left_out(mini, clean, name, column, words):
    bad, at = spoilt(clean, name, column)
    lines = []

    def call():
        found = smoothed_motion(mini, bad)
        true = smoothed_motion(mini, clean)
        for one, other in ((found.q, true.q), (found.tau, true.tau), (found.v, true.v)):
            # at almost all samples as without them: noise of what was bridged, two hidden ones
            off = np.abs(one - other).max(axis=1) / other.std(axis=0).max()
            assert np.mean(off > 0.1) < 1e-3
        lines.append(True)

    (line,) = told(call)
    assert lines and line.startswith("outliers are left out and bridged: ")
    count = int(line.split(": ")[1].split()[0])
    assert 0.97 * len(at) <= count <= len(at)
    assert f"in '{words}' (the first at {clean.time[at.min()]:.6g} s) of 7501 samples" in line


def test_too_many_outliers_are_refused_unless_trusted(mini, clean):
    tau = clean.tau.copy()
    tau[::15, 0] = 1e3
    bad = dataclasses.replace(clean, tau=tau)
    with pytest.raises(RecordingError, match=r"'q1_force' has \d+ outliers in 7501 samples"):
        smoothed_motion(mini, bad)
    found = []
    told(lambda: found.append(smoothed_motion(mini, bad, trust=True)))
    np.testing.assert_array_equal(found[0].tau, tau)


def test_hum_is_told_with_its_frequency(mini, clean):
    level = 0.02 * clean.tau[:, 1].std()
    (line,) = told(lambda: smoothed_motion(mini, humming(clean, 1, level)))
    assert line.startswith("hum in 'X1_force' of 50 Hz (") and "2 % of it" in line


def test_all_defects_at_once(mini, clean):
    bad = spoilt(humming(late(clean, 0.03), 2, 0.5), "tau", 1)[0]
    lines = told(lambda: identify(mini, bad, bandwidth=20.0))
    starts = [line.split("'")[0] + line.split("'")[1] for line in lines]
    assert starts[:2] == ["outliers are left out and bridged: 75 in X1_force", "hum in X2_force"]
    assert len(lines) == 3 and "ms" in lines[2] and "behind its motion" in lines[2]


def test_a_locked_joint_has_to_stand(mini, clean):
    locked = quiet(crane.load, "mini_forwarder", lock={"q1": 0.0})
    text = "'q1' is locked at 0 rad, but goes from -2.* to 1.* rad in the recording"
    with pytest.raises(RecordingError, match=text):
        smoothed_motion(locked, clean)
    (line,) = told(lambda: smoothed_motion(locked, clean, trust=True))
    assert line.endswith("or lock it where it is: trusted")
    q = clean.q.copy()
    q[:, 0] = 1e-3 * np.random.default_rng(0).normal(size=len(q))
    still = dataclasses.replace(clean, q=q)
    assert told(lambda: smoothed_motion(locked, still)) == []
    with pytest.raises(RecordingError, match="is locked at 0 rad, but goes from 0.297"):
        smoothed_motion(locked, dataclasses.replace(clean, q=q + [0.3, 0, 0]))


def test_a_validation_that_is_far_worse_is_remarked_on(mini, clean):
    other = dataclasses.replace(clean, tau=clean.tau * [1, 1, 2])
    lines = told(lambda: identify(mini, clean, other, bandwidth=20.0, prior=0.1))
    (line,) = [x for x in lines if x.startswith("errors on the validation are far above")]
    assert "'X2' " in line and "'q1'" not in line


# --- the parts ----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["noise", "steps", "coarse", "smooth", "walk", "constant"])
def test_what_is_no_outlier(kind):
    rng = np.random.default_rng(1)
    time = np.arange(20_000) * 1e-3
    x = {
        "noise": rng.standard_t(6, len(time)),
        "steps": np.sign(np.sin(7 * time)) + 1e-3 * rng.normal(size=len(time)),
        "coarse": np.round(50 * np.sin(time)) / 50,
        "smooth": np.sin(200 * time) ** 9,
        "walk": np.cumsum(rng.normal(size=len(time))),
        "constant": np.full(len(time), 3.0),
    }[kind]
    assert not outlier_mask(x).any()


def test_neighbouring_outliers_are_found():
    """Alone, in pairs up to three apart, and three in a row; a line takes their place."""
    time = np.arange(5000) * 1e-3
    true = np.sin(3 * time) + 1e-3 * np.random.default_rng(2).normal(size=len(time))
    at = [100, 200, 201, 300, 302, 400, 403, 500, 501, 502]
    x = true.copy()
    x[at] += [1, 1, -1, 2, 1, -1, -1, 1, 1.2, 0.9]
    found = outlier_mask(x)
    assert np.flatnonzero(found).tolist() == at
    assert np.abs(replace_outliers(x, found) - true).max() < 5e-3


def test_lines_have_their_frequency_and_amplitude():
    time = np.arange(20_000) * 1e-3
    noise = np.random.default_rng(3).normal(size=len(time))
    motion = 30 * np.sin(2 * np.pi * 0.3 * time)
    sweep = 3 * np.sin(2 * np.pi * (20 + 4 * time) * time)
    assert strongest_spectral_line(motion + noise + sweep, 1e-3, 5.0) is None
    frequency, amplitude = strongest_spectral_line(
        motion + noise + 0.5 * np.cos(2 * np.pi * 60.2 * time), 1e-3, 5.0
    )
    assert abs(frequency - 60.2) < 0.1 and abs(amplitude / 0.5 - 1) < 0.1


# --- recordings that nobody here made -----------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rig", "seed"),
    [(1, 10),
     *(pytest.param(*x, marks=pytest.mark.long) for x in ((4, 40), (3, 31), (5, 50), (6, 60)))],
)  # fmt: skip
def test_clean_rigs_raise_no_alarm_and_late_ones_do(mini, rig, seed):
    clean = rig_recording(mini, rig, seed)
    assert told(lambda: identify(mini, clean, bandwidth=20.0)) == []
    for seconds in (0.03, 0.06):
        lines = told(lambda s=seconds: identify(mini, late(clean, s), bandwidth=20.0))
        assert len(lines) == 1 and "behind its motion" in lines[0]


@recorded
@pytest.mark.slow
def test_measured_arms_run_through(tmp_path):
    """Doubts are the joints where friction and rotors outweigh, and some outliers.

    KR300's q6 is 10.6 +- 2.4 times its model, by the regression beside friction: its unit is
    not in doubt.
    """
    from crane.recordings import timeseries

    runs = {}
    for name, log in (("kr300", "kr300_A"), ("kr300", "kr300_B"), ("tx40", "tx40_recording")):
        table = read_log(DATA / name / f"{log}.npz", COLUMNS / f"{name}.txt")
        timeseries.write_table(tmp_path / f"{log}.csv", table)
        runs[log] = read_measured(crane.load(name), tmp_path / f"{log}.csv")
    for name, learn, judge, doubtful in (
        ("kr300", "kr300_A", "kr300_B", []),
        ("tx40", "tx40_recording", None, ["'q5_force'", "'q6_force'"]),
    ):
        judge = None if judge is None else runs[judge]
        lines = told(
            lambda n=name, x=learn, y=judge: identify(crane.load(n), runs[x], y, prior=0.3)
        )
        doubts = [x for x in lines if "this recording cannot say" in x]
        assert [w for x in doubts for w in x.split() if w.startswith("'")] == doubtful
        others = [x for x in lines if x not in doubts and not x.startswith("outliers")]
        assert all(x.startswith("errors on the validation") for x in others), others
