"""Recordings in blocks and of an hour: same results, and bounded memory."""

import json
import subprocess
import sys
import tracemalloc
import zipfile
from functools import partial

import forwarder_motions
import numpy as np
import pytest
from command_line import typed
from scipy.signal import butter, lfilter, sosfiltfilt

import crane
from crane.common import scratch_arrays
from crane.identification.estimation import estimators, regressor
from crane.identification.estimation.estimators import (
    huber,
    instrumental_variables,
    least_squares,
    weighted_least_squares,
)
from crane.identification.mechanics import regression_equations, smoothed_motion
from crane.identification.mechanics.identification_model import IdentificationModel, default_terms
from crane.identification.mechanics.identify import build_equations, identify
from crane.identification.mechanics.model_terms import PreslidingFriction
from crane.identification.mechanics.regression_equations import (
    CombinedRegressor,
    RegressionEquations,
)
from crane.identification.signals import kalman_smoother, signal_processing
from crane.identification.signals.signal_processing import Motion
from crane.recordings.measured_recordings import _remove_free_forces, read_run
from crane.recordings.recording import Recording
from crane.recordings.timeseries import Table

pytestmark = pytest.mark.filterwarnings("ignore::crane.CraneWarning")
motion = partial(forwarder_motions.motion, period=8.0, duration=16.0, step=2e-3, noise=1.0)


def rows(seed=0, count=3000):
    """A regressor, forces with noise that remembers, groups with missing rows, out of order."""
    from scipy.signal import lfilter

    rng = np.random.default_rng(seed)
    W = lfilter([1.0], [1, -0.95], rng.normal(size=(count, 5)), axis=0)
    noise = lfilter([1.0], [1, -1.2, 0.5], rng.standard_t(4, size=count))
    groups, samples = np.arange(count) % 3, np.arange(count) // 3
    kept = np.flatnonzero((samples < 400) | (samples > 640) | (groups == 2))
    kept = kept[np.argsort(groups[kept], kind="stable")]
    return W[kept], (W @ [1, -2, 3, 0.5, 0] + noise)[kept], groups[kept], samples[kept]


@pytest.mark.parametrize(
    "estimator", [least_squares, weighted_least_squares, huber, instrumental_variables]
)
@pytest.mark.parametrize("prior", [None, (np.ones(5), np.array([0.1, np.inf, 1, 1e3, 0.01]))])
def test_estimates_do_not_depend_on_the_blocks(estimator, prior, monkeypatch):
    W, y, groups, samples = rows()
    parts = [W, W + 0.1 * np.random.default_rng(1).normal(size=W.shape)]
    parts = parts if estimator is instrumental_variables else parts[:1]
    whole = estimator(parts[0], y, *parts[1:], groups=groups, samples=samples, prior=prior)
    stored = regressor.StoredRegressor.__init__.__defaults__
    monkeypatch.setattr(regressor.StoredRegressor.__init__, "__defaults__", (50,))
    monkeypatch.setattr(estimators, "_GAP_BLOCK", 7)
    found = estimator(parts[0], y, *parts[1:], groups=groups, samples=samples, prior=prior)
    assert stored == (8192,)  # what the first call had: all rows in one block
    keys = ("values", "covariance", "residuals", "noise")
    for key in (*keys, "degrees_of_freedom", "condition"):
        one, other = getattr(found, key), getattr(whole, key)
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9 * np.abs(other).max())


def test_covariance_is_that_of_all_rows_at_once():
    """Q^T C Q by a dense C = (a^-1 a^-T) of one group with missing rows."""
    from scipy.linalg import toeplitz

    from crane.identification.estimation.noise_model import NoiseModel

    W, y, groups, samples = (x[rows()[2] == 1] for x in rows())
    found = least_squares(W, y, groups - 1, samples)
    noise = NoiseModel.fit(found.residuals / found.noise, samples)
    impulse = np.eye(1, 2000)
    answer = lfilter([1.0], noise.a, impulse)
    lags = np.correlate(answer[0], answer[0], "full")[1999:]
    C = toeplitz(lags)[samples][:, samples]
    inverse = np.linalg.inv(W.T @ W)
    wanted = inverse @ W.T @ C @ W @ inverse
    # the jackknife may widen single deviations, never narrow them, and leaves correlations
    unit, wanted_unit = np.sqrt(np.diag(found.covariance)), np.sqrt(np.diag(wanted))
    correlation = found.covariance / np.outer(unit, unit)
    assert correlation == pytest.approx(wanted / np.outer(wanted_unit, wanted_unit), abs=1e-6)
    scale = np.sqrt(np.nanvar(noise.innovations)) * found.noise[0]
    assert (unit > 0.98 * scale * wanted_unit).all()


@pytest.mark.parametrize("bandwidth", [12.0, 200.0])
def test_a_recording_in_blocks_is_that_as_a_whole(mini, monkeypatch, bandwidth):
    """Also with a term that depends on earlier samples; no block stays in memory."""
    given = motion(mini, duration=10.0)
    terms = [*default_terms(mini), PreslidingFriction(mini, "X1", 1e-3)]
    settings = {"prior": 0.3, "bandwidth": bandwidth, "terms": terms}
    whole = identify(mini, given, motion(mini, duration=8.0, seed=1), **settings)
    monkeypatch.setattr(regression_equations, "_BLOCK_BYTES", 3 << 20)
    monkeypatch.setattr(regression_equations, "_CACHE_BYTES", 0)
    found = identify(mini, given, motion(mini, duration=8.0, seed=1), **settings)
    for fit in ("training", "validation"):
        for key in ("measured", "modelled"):
            one, other = (getattr(getattr(x, fit), key) for x in (found, whole))
            assert np.abs(one - other).max() < 1e-9 * np.abs(other).max()
    assert np.abs((found.values - whole.values) / whole.std).max() < 1e-6
    np.testing.assert_allclose(found.std, whole.std, rtol=1e-6)


def test_what_is_held_does_not_grow_with_the_recording(mini, monkeypatch):
    monkeypatch.setattr(regression_equations, "_BLOCK_BYTES", 1 << 21)
    monkeypatch.setattr(regression_equations, "_CACHE_BYTES", 1 << 20)
    unfiltered, sizes = RegressionEquations._unfiltered_block, []

    def spied(*arguments):
        out = unfiltered(*arguments)
        sizes.append(out.nbytes)
        return out

    monkeypatch.setattr(RegressionEquations, "_unfiltered_block", spied)
    given = motion(mini, duration=3.0)
    for copies in (2, 5):
        parts = (np.tile(x, (copies, 1)) for x in (given.q, given.v, given.a, given.tau))
        time = 2e-3 * np.arange(copies * len(given.time))
        rows, base = build_equations(
            IdentificationModel(mini), [Motion(time, *parts)], bandwidth=100.0
        )
        columns = CombinedRegressor(rows, rows.column_selection(base))
        assert len(list(columns.blocks())) >= copies
        assert max(sizes) < 1.5 * (1 << 21)  # with what the filter needs around
        assert sum(W.nbytes for W in rows._block_cache.values()) <= 1 << 20
    assert len(sizes) > 10


def test_smoothing_does_not_depend_on_the_blocks(monkeypatch):
    rng = np.random.default_rng(0)
    y = np.sin(0.01 * np.arange(3000)) + 1e-3 * rng.normal(size=3000)
    whole = kalman_smoother.kalman_smooth(y, 0.01)
    monkeypatch.setattr(kalman_smoother, "_BLOCK_SAMPLES", 101)
    for one, other in zip(kalman_smoother.kalman_smooth(y, 0.01), whole, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-9 * np.abs(other).max())


def test_progress_goes_up_to_one(mini):
    told = []
    identify(mini, motion(mini, duration=4.0), prior=0.3, progress=told.append)
    assert len(told) > 3 and told[-1] == 1.0
    assert (np.diff(told) >= 0).all()


# --- an hour at 1 ms ----------------------------------------------------------------------------


MEASURED = """
import json, resource, sys
from crane.cli import main
import crane.view.page.report_page, crane.view.plots.recording_figure
import crane.formats, crane.simulation
base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
try:
    main()
finally:
    print(json.dumps([base, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss]))
"""


@pytest.fixture
def small(monkeypatch):
    """Scratch files for short recordings, too, in blocks of a few samples."""
    monkeypatch.setattr(scratch_arrays, "MIN_FILE_ELEMENTS", 1)
    monkeypatch.setattr(scratch_arrays, "BLOCK_SIZE", 64)
    monkeypatch.setattr("crane.recordings.timeseries.BLOCK_ROWS", 50)


@pytest.mark.parametrize("suffix", ["csv", "npz"])
def test_what_is_in_scratch_files_is_the_same(mini, tmp_path, monkeypatch, request, suffix):
    control = crane.PI(mini, crane.task_trajectory(mini, "lift"))
    plain = crane.simulate(mini, control, duration=0.3, label="lift")
    request.getfixturevalue("small")
    before = len(scratch_arrays._memory_maps)
    found = crane.simulate(mini, control, duration=0.3, label="lift")
    assert len(scratch_arrays._memory_maps) > before
    path = tmp_path / f"run.{suffix}"
    getattr(found, f"to_{suffix}")(path)
    again = Recording.read(path)
    for other in (found, again):
        assert list(other.columns()) == list(plain.columns())
        for one, two in zip(other.columns().values(), plain.columns().values(), strict=True):
            np.testing.assert_array_equal(one, two)
        for name in ("units", "channel_units", "machine", "task", "controller", "ideal", "free"):
            assert getattr(other, name) == getattr(plain, name)
    del found, again, other, one
    scratch_arrays.release_pages()
    assert len(scratch_arrays._memory_maps) == before  # files go with the arrays


def test_what_was_released_is_still_there(small):
    values = scratch_arrays.empty_array(1000, 3)
    values[:] = np.arange(3000.0).reshape(1000, 3)
    scratch_arrays.release_pages()
    np.testing.assert_array_equal(values, np.arange(3000.0).reshape(1000, 3))
    squares = scratch_arrays.compute_in_blocks(lambda part: values[part] ** 2, 1000)
    np.testing.assert_array_equal(squares, values**2)


def test_where_there_is_no_room_it_is_in_memory(small, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(scratch_arrays.os, "posix_fallocate", full)
    before = len(scratch_arrays._memory_maps)
    values = scratch_arrays.empty_array(10, 2)
    assert (
        values.shape == (10, 2)
        and values.flags.f_contiguous
        and len(scratch_arrays._memory_maps) == before
    )


@pytest.mark.slow
def test_a_motion_is_smoothed_in_a_few_columns(mini, monkeypatch):
    """Whole series are in scratch files, and blocks take as much for any recording."""
    from crane.identification.mechanics.smoothed_motion import smoothed_motion

    monkeypatch.setattr(scratch_arrays, "MIN_FILE_ELEMENTS", 1)
    time = np.arange(0.0, 200.0, 1e-3)
    rates = 2 * np.pi * np.array([0.31, 0.43, 0.57])
    middle, reach = 0.5 * (mini.lower + mini.upper), 0.2 * (mini.upper - mini.lower)
    q = middle + reach * np.sin(np.outer(time, rates))
    v = reach * rates * np.cos(np.outer(time, rates))
    tau = 1.0 + q + v
    q = q + 1e-6 * np.random.default_rng(0).normal(size=q.shape)
    units = {joint: mini.unit(joint) for joint in mini.active}
    recording = Recording(time, mini.active, q, v, tau, units)
    tracemalloc.start()
    try:
        found = smoothed_motion(mini, recording)
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert np.abs(found.v - v)[100:-100].max() < 1e-3 * np.abs(v).max()
    assert most < 25 * time.nbytes, most / time.nbytes


def test_a_run_as_npz_is_viewed_and_takes_the_place_of_a_csv(tmp_path):
    out = tmp_path / "run"
    for option in ([], ["--npz"]):
        made = typed("simulate", "mini_forwarder", "--task", "lift", "--duration", "0.05",
                     "--out", out, "--force", *option)  # fmt: skip
        assert made.returncode == 0, made.stderr
    assert {path.name for path in out.iterdir()} == {"recording.npz", "summary.md"}
    with zipfile.ZipFile(out / "recording.npz") as archive:
        assert archive.comment.decode().splitlines()[:2] == [
            "# crane recording", "# machine: mini_forwarder",
        ]  # fmt: skip
    assert np.load(out / "recording.npz")["q1_velocity [rad/s]"].shape == (51,)
    recording = read_run(out)
    assert (recording.machine, recording.task, recording.ideal) == ("mini_forwarder", "lift", True)
    shown = typed("view", out, "--no-open")
    assert shown.returncode == 0 and (out / "view.html").is_file()
    recording.write(out, overwrite=True)
    assert {path.name for path in out.iterdir()} == {"recording.csv", "summary.md"}


def peak(*arguments):
    """Memory [bytes] that a command takes beside what it is made of."""
    made = subprocess.run(
        [sys.executable, "-c", MEASURED, *map(str, arguments)], capture_output=True, text=True
    )
    assert made.returncode == 0, made.stderr
    base, most = json.loads(made.stdout.splitlines()[-1])
    return 1024 * (most - base)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="memory is counted otherwise here")
@pytest.mark.long
def test_memory_grows_by_less_than_a_recording(tmp_path):
    """Memory grows by 320 bytes per sample of 40 columns."""
    taken = {}
    for duration in (90, 270):
        out = tmp_path / str(duration)
        made = ("simulate", "mini_forwarder", "--task", "lift", "--duration", duration)
        taken[duration] = [
            peak(*made, "--out", out), peak("view", out, "--no-open"), peak("plot", out),
        ]  # fmt: skip
    growth = [(long - short) / 180e3 for short, long in zip(*taken.values(), strict=True)]
    assert max(growth) < 160, growth  # half of that: some columns at a time


@pytest.mark.parametrize("cutoff", [1.0, 20.0])
def test_a_low_pass_in_blocks_is_that_of_the_whole(cutoff, monkeypatch):
    time = 1e-3 * np.arange(200_000)
    x = np.cumsum(np.random.default_rng(0).normal(size=(len(time), 2)), axis=0)
    whole = sosfiltfilt(butter(4, cutoff, output="sos", fs=1e3), x, axis=0)
    monkeypatch.setattr(signal_processing, "MIN_FILE_ELEMENTS", 1)
    for columns, expected in ((x, whole), (x[:, 0], whole[:, 0])):
        found = signal_processing.low_pass(time, columns, cutoff)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10 * np.abs(x).max())


def test_velocities_of_a_long_recording_are_compared_at_fewer_instants(monkeypatch):
    monkeypatch.setattr(smoothed_motion, "_MAX_COMPARED_SAMPLES", 1000)
    time = 1e-3 * np.arange(30_000)
    phase = 2 * np.pi * np.outer(time, [0.7, 1.9]) + [0.0, 1.0]
    rng = np.random.default_rng(0)
    q, v = np.sin(phase).sum(axis=1), (2 * np.pi * np.cos(phase) * [0.7, 1.9]).sum(axis=1)
    q, v = (x[:, None] + 1e-3 * rng.normal(size=(len(time), 1)) for x in (q, v))
    check = partial(smoothed_motion.check_recording, joints=("j",), units={"j": "rad"})
    check(time, q, np.cos(q), v=v)
    for wrong, told in (
        (np.degrees(v), r"57\.\d times the derivative of 'j', 'j_velocity' looks like deg"),
        (9 * np.sin(20 * time)[:, None], "'j_velocity' is not the derivative of 'j'"),
        (np.roll(v, 150, axis=0), "'j_velocity' is 150 ms behind"),
    ):
        with pytest.raises(crane.CraneError, match=told):
            check(time, q, np.cos(q), v=wrong)


def test_columns_of_a_recording_are_not_copied(mini):
    names = [x + suffix for suffix in ("", "_velocity", "_force") for x in mini.active]
    units = dict.fromkeys(["time", *names], "")
    table = Table(units, np.asfortranarray(np.random.default_rng(0).normal(size=(50, 10))), {})
    assert np.shares_memory(_remove_free_forces(mini, table).values, table.values)
