"""Recordings of an hour at 1 ms need little memory and keep their values."""

import json
import subprocess
import sys
import tracemalloc
import zipfile

import numpy as np
import pytest
from command_line import typed

import crane
from crane.common import scratch_arrays
from crane.recordings.measured_recordings import read_run
from crane.recordings.recording import Recording

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
    monkeypatch.setattr(scratch_arrays, "_MIN_FILE_ELEMENTS", 1)
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

    monkeypatch.setattr(scratch_arrays, "_MIN_FILE_ELEMENTS", 1)
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
