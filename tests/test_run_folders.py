"""Folders of runs: recording, summary and metadata."""

import os
import re

import numpy as np
import pytest

import crane.cli.simulate
from crane.common.atomic_output import (
    check_file_is_writable,
    check_folder_is_writable,
    portable_file_name,
    replace_folder,
)
from crane.common.errors import OutputError
from crane.recordings.measured_recordings import read_run
from crane.recordings.recording import Recording
from crane.recordings.recording_summary import recorded_machine_name, result_title


@pytest.fixture
def recording():
    zeros = np.zeros((2, 1))
    return Recording([0.0, 1.0], ("q1",), zeros, zeros, zeros, {"q1": "rad"})


def tree(folder):
    """Texts of all files below a folder by their paths, and None for folders."""
    return {
        str(path.relative_to(folder)): path.read_text() if path.is_file() else None
        for path in folder.rglob("*")
    }


class TestStaging:
    def test_folder_appears_whole_at_the_end(self, tmp_path):
        target = tmp_path / "a" / "b"
        with replace_folder(target) as part:
            (part / "inner").mkdir()
            (part / "inner" / "file").write_text("new")
            assert not (tmp_path / "a").exists()
        assert tree(tmp_path) == {
            "a": None, "a/b": None, "a/b/inner": None, "a/b/inner/file": "new",
        }  # fmt: skip

    def test_files_of_the_same_names_are_replaced_and_others_stay(self, tmp_path):
        target = tmp_path / "run"
        (target / "inner").mkdir(parents=True)
        for name in ("one", "inner/two", "inner/three"):
            (target / name).write_text("old")
        with replace_folder(target) as part:
            (part / "inner").mkdir()
            (part / "inner" / "two").write_text("new")
            (part / "one").write_text("new")
            assert (target / "one").read_text() == "old"
        assert tree(target) == {
            "one": "new", "inner": None, "inner/two": "new", "inner/three": "old",
        }  # fmt: skip

    @pytest.mark.parametrize("error", [ZeroDivisionError, KeyboardInterrupt])
    @pytest.mark.parametrize("there", [False, True])
    def test_whatever_stops_it_leaves_what_was_there(self, tmp_path, error, there):
        target = tmp_path / "a" / "b"
        if there:
            target.mkdir(parents=True)
            (target / "file").write_text("old")
        before = tree(tmp_path)
        with pytest.raises(error), replace_folder(target) as part:
            (part / "file").write_text("new")
            raise error
        assert tree(tmp_path) == before

    @pytest.mark.parametrize("name", ["one", "two/three"])
    def test_what_is_in_the_way_is_found_before_anything_is_moved(self, tmp_path, name):
        (tmp_path / "zero").write_text("old")
        (tmp_path / "one").mkdir()
        (tmp_path / "two").write_text("old")
        before = tree(tmp_path)
        with pytest.raises(OutputError, match="is a f"), replace_folder(tmp_path) as part:
            (part / "zero").write_text("new")
            (part / name).parent.mkdir(exist_ok=True)
            (part / name).write_text("new")
        assert tree(tmp_path) == before

    def test_errors_name_the_place_asked_for(self, tmp_path):
        target = tmp_path / "run"
        with (
            pytest.raises(OutputError, match=rf"^{target}/file: is full$"),
            replace_folder(target) as part,
        ):
            raise OutputError(f"{part / 'file'}: is full")
        with (
            pytest.raises(OutputError, match=rf"^{target}: cannot be written \(No space"),
            replace_folder(target),
        ):
            raise OSError(28, "No space left on device")

    def test_a_link_stays_a_link(self, tmp_path):
        (tmp_path / "link").symlink_to(tmp_path / "run")
        for text in ("one", "two"):
            with replace_folder(tmp_path / "link") as part:
                (part / "file").write_text(text)
            assert (tmp_path / "link").is_symlink()
            assert (tmp_path / "run" / "file").read_text() == text


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("file", "is a file, give the name of a folder"),
        ("file/run", r"\S*/file is a file, give the name of a folder"),
        ("file/deeper/run", r"\S*/file is a file, give the name of a folder"),
        ("full", "is not empty, choose another folder or add --force"),
        ("x" * 300, "cannot be written"),
    ],
)
def test_folders_that_results_cannot_go_to(tmp_path, name, message):
    (tmp_path / "file").write_text("x")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").write_text("x")
    before = tree(tmp_path)
    with pytest.raises(OutputError, match=rf"^{re.escape(str(tmp_path / name))}: {message}"):
        check_folder_is_writable(tmp_path / name, overwrite=False)
    assert tree(tmp_path) == before
    check_folder_is_writable(tmp_path / "full", overwrite=True)
    check_folder_is_writable(tmp_path / "new" / "run", overwrite=False)
    assert tree(tmp_path) == before


def test_folders_that_may_not_be_written_to(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(os, "access", lambda path, mode: asked.append((path, mode)))
    for check, place in (
        (check_folder_is_writable, tmp_path / "a" / "b"),
        (check_file_is_writable, tmp_path / "page"),
    ):
        with pytest.raises(OutputError, match=rf"the folder {tmp_path} may not be written to"):
            check(place, False)
    assert asked == [(tmp_path, os.W_OK | os.X_OK)] * 2


def test_files_that_results_cannot_go_to(tmp_path):
    (tmp_path / "file").write_text("x")
    os.mkfifo(tmp_path / "pipe")
    for name, force, message in (
        ("file", False, "exists already"),
        ("pipe", True, "is no plain file"),
        ("", True, "is a folder"),
        ("file/page", True, "is a file, give the name of a folder"),
        ("x" * 300, True, "cannot be written"),
    ):
        with pytest.raises(OutputError, match=message):
            check_file_is_writable(tmp_path / name, force)
    check_file_is_writable(tmp_path / "file", True)
    check_file_is_writable(tmp_path / "new", False)
    check_file_is_writable(tmp_path / "none" / "page", False)
    assert not (tmp_path / "none").exists()


def test_views_of_an_earlier_run_do_not_stay_beside_a_new_one(tmp_path, recording):
    old = "figure.png", "view.html", "comparison.md", "comparison.png"
    for name in ("recording.csv", "notes.txt", *old):
        (tmp_path / name).write_text("old")
    text = recording.write(tmp_path, overwrite=True)
    assert set(tree(tmp_path)) == {"recording.csv", "summary.md", "notes.txt"}
    assert (tmp_path / "summary.md").read_text() == text
    assert text.startswith(f"# {result_title(recorded_machine_name(recording), recording.task)}\n")
    np.testing.assert_array_equal(read_run(tmp_path).time, recording.time)


@pytest.mark.parametrize("error", [KeyboardInterrupt, OutputError("no room")])
def test_demo_that_stops_leaves_nothing(tmp_path, monkeypatch, error, recording):
    drawn = []

    def stop(recording, folder):
        drawn.append(folder)
        if len(drawn) == 2:  # the second task
            raise error

    monkeypatch.setattr("crane.simulation.simulate", lambda *_, **__: recording)
    monkeypatch.setattr("crane.view.result_files._write_views", stop)
    with (
        pytest.raises(BaseException, match="no room|^$"),
        replace_folder(tmp_path / "demo") as part,
    ):
        crane.cli.simulate.write_demo(part, lambda share: None)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("mini_forwarder", "mini_forwarder"),
        ("../../etc/passwd", "etc_passwd"),
        ("a b: <c>", "a_b_c"),
        ("kran-ü.2", "kran-ü.2"),
        ("///", "unnamed"),
        ("x" * 300, "x" * 60),
    ],
)
def test_names_of_files(text, name):
    assert portable_file_name(text) == name
