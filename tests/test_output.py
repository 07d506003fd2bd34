"""Files and folders are written completely or not at all."""

import ast
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from killed_processes import killed_at

import crane.common.temporary_files
from crane.common.atomic_output import check_folder_is_writable, replace_file, replace_folder
from crane.common.errors import OutputError


def test_file_appears_whole_at_the_end(tmp_path):
    path = tmp_path / "result.txt"
    path.write_text("old")
    with replace_file(path) as part:
        part.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert os.listdir(tmp_path) == ["result.txt"]


def test_failure_leaves_what_was_there(tmp_path):
    path = tmp_path / "result.txt"
    path.write_text("old")
    with pytest.raises(ZeroDivisionError), replace_file(path) as part:
        part.write_text("half")
        1 / 0  # noqa: B018
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["result.txt"]


def test_permissions_follow_the_umask(tmp_path):
    with replace_file(tmp_path / "result.txt") as part:
        part.write_text("new")
    (tmp_path / "plain.txt").write_text("new")
    modes = {path.stat().st_mode for path in tmp_path.iterdir()}
    assert len(modes) == 1


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("folder", "is a folder"),
        ("file/result.txt", "file: is a file, give the name of a folder"),
        ("file/a/result.txt", "file is a file, give the name of a folder"),
    ],
)
def test_bad_places(tmp_path, name, message):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("x")
    with pytest.raises(OutputError, match=message), replace_file(tmp_path / name) as part:
        part.write_text("x")


def test_folders_are_made_as_soon_as_there_is_something_to_put_there(tmp_path):
    path = tmp_path / "a" / "b" / "result.txt"
    with pytest.raises(ZeroDivisionError), replace_file(path) as part:
        part.write_text("half")
        1 / 0  # noqa: B018
    assert os.listdir(tmp_path) == []
    with replace_file(path) as part:
        part.write_text("new")
        assert part.parent == tmp_path
    assert path.read_text() == "new" and len(list(tmp_path.rglob("*"))) == 3


def test_operating_system_error_is_told(tmp_path):
    with (
        pytest.raises(OutputError, match="No space left on device"),
        replace_file(tmp_path / "result.txt"),
    ):
        raise OSError(28, "No space left on device")


def test_what_a_killed_process_left_of_a_file_goes_with_the_next(tmp_path):
    path = tmp_path / "result.txt"
    path.write_text("old")

    def write():
        with replace_file(path) as part:
            part.write_text("new" * 1000)

    call = 0
    while killed_at(write, call):
        assert path.read_text() in ("old", "new" * 1000)
        write()
        assert os.listdir(tmp_path) == ["result.txt"], call
        path.write_text("old")
        call += 1
    assert call > 4


def test_what_a_living_process_writes_stays(tmp_path):
    with replace_file(tmp_path / "result.txt") as part:
        part.write_text("first")
        with replace_file(tmp_path / "result.txt") as other:
            other.write_text("second")
        assert part.read_text() == "first"
    assert (tmp_path / "result.txt").read_text() == "first"
    assert os.listdir(tmp_path) == ["result.txt"]


OLD = {"one": "old", "inner": None, "inner/two": "old", "inner/stale": "old", "mine": "my own",
       "my": None, "my/notes": "my own"}  # fmt: skip
NEW = {"one": "new", "three": "new", "inner": None, "inner/two": "new", "mine": "my own",
       "my": None, "my/notes": "my own"}  # fmt: skip


def fill(folder, content):
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in content.items():
        if text is None:
            (folder / name).mkdir(exist_ok=True)
        else:
            (folder / name).write_text(text)


def tree(folder):
    return {
        str(path.relative_to(folder)): path.read_text() if path.is_file() else None
        for path in folder.rglob("*")
    }


def replace_all(target):
    with replace_folder(target, stale=["inner/*"]) as part:
        fill(part, {name: text for name, text in NEW.items() if text != "my own" and name != "my"})


@pytest.fixture(params=["exchange", "two renames"])
def kernel(request, monkeypatch):
    """As it is, and one that exchanges no folders."""
    if request.param == "two renames":
        monkeypatch.setattr(
            crane.common.temporary_files, "_exchange_atomically", lambda *paths: False
        )
    return request.param


@pytest.mark.slow
def test_a_folder_is_wholly_old_or_wholly_new_wherever_a_run_is_killed(tmp_path, kernel):
    target, call, seen = tmp_path / "run", 0, set()
    fill(target, OLD)
    while killed_at(lambda: replace_all(target), call):
        if kernel == "two renames" and not target.exists():
            seen.add("aside")
        else:
            assert tree(target) in (OLD, NEW), call
        check_folder_is_writable(target)  # as each command does at first
        found = tree(target)
        assert found in (OLD, NEW), call
        seen.add("new" if found == NEW else "old")
        assert os.listdir(tmp_path) == ["run"], call
        replace_all(target)
        assert tree(target) == NEW and os.listdir(tmp_path) == ["run"], call
        shutil.rmtree(target)
        fill(target, OLD)
        call += 1
    assert seen == {"old", "new"} | ({"aside"} if kernel == "two renames" else set())


def test_a_new_folder_is_not_there_or_whole_wherever_a_run_is_killed(tmp_path):
    target, call = tmp_path / "a" / "run", 0
    while killed_at(lambda: replace_all(target), call):
        if (tmp_path / "a").exists():
            assert set(tree(target)) == {"one", "three", "inner", "inner/two"}, call
        replace_all(target)
        assert os.listdir(tmp_path) == ["a"] and os.listdir(tmp_path / "a") == ["run"], call
        shutil.rmtree(tmp_path / "a")
        call += 1


def test_the_current_folder_stays_the_same_folder(tmp_path, monkeypatch):
    target = tmp_path / "run"
    fill(target, OLD)
    monkeypatch.chdir(target)
    replace_all(target)
    assert tree(target) == NEW
    assert sorted(os.listdir(".")) == sorted(os.listdir(target))
    assert os.listdir(tmp_path) == ["run"]


def test_folders_on_file_systems_without_links_are_filled(tmp_path, monkeypatch):
    def without(*args, **options):
        raise PermissionError(1, "Operation not permitted")

    target = tmp_path / "run"
    fill(target, OLD)
    monkeypatch.setattr(os, "link", without)
    replace_all(target)
    assert tree(target) == NEW and os.listdir(tmp_path) == ["run"]


@pytest.mark.parametrize("there", ["nothing", "an empty folder", "the current folder"])
def test_of_two_runs_into_a_new_folder_one_is_told(tmp_path, monkeypatch, there):
    target = tmp_path / "run"
    if there != "nothing":
        target.mkdir()
    if there == "the current folder":
        monkeypatch.chdir(target)
    with (
        pytest.raises(OutputError, match=rf"^{target}: is there now, another program has filled"),
        replace_folder(target, overwrite=False) as slower,
    ):
        (slower / "one").write_text("slower")
        with replace_folder(target, overwrite=False) as faster:
            (faster / "two").write_text("faster")
    assert tree(target) == {"two": "faster"}
    assert os.listdir(tmp_path) == ["run"]


def test_of_two_runs_that_replace_a_folder_the_last_is_there_whole(tmp_path, kernel):
    target = tmp_path / "run"
    for _ in range(2):
        with replace_folder(target, stale=["one", "two"]) as slower:
            (slower / "one").write_text("slower")
            with replace_folder(target, stale=["one", "two"]) as faster:
                (faster / "two").write_text("faster")
        assert tree(target) == {"one": "slower"}
        assert os.listdir(tmp_path) == ["run"]


@pytest.mark.slow
@pytest.mark.parametrize("times", [16, pytest.param(200, marks=pytest.mark.long)])
def test_a_run_is_wholly_old_or_wholly_new_whenever_it_is_killed(tmp_path, times):
    """Half of the times in the last 100 ms."""
    here = Path(__file__).parent
    paths = os.pathsep.join([str(here.parent), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, here / "killed_processes.py", tmp_path, str(times)],
        capture_output=True, text=True, env={**os.environ, "PYTHONPATH": paths},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-500:]
    seen = ast.literal_eval(done.stdout)
    assert sum(seen.values()) >= times and min(seen.values()) > 0  # how many depends on others
