"""Files and folders are written completely or not at all, also by killed commands."""

import os
import re
import shutil
import sys
from collections import Counter
from unittest import mock

import numpy as np
import pytest
from command_line import typed
from killed_processes import killed_at
from writing_commands import COMMANDS, read, writing

import crane.cli.simulate
import crane.common.temporary_files
from crane.common.atomic_output import (
    check_file_is_writable,
    check_folder_is_writable,
    portable_file_name,
    replace_file,
    replace_folder,
)
from crane.common.errors import OutputError
from crane.recordings.measured_recordings import read_run
from crane.recordings.recording import Recording
from crane.recordings.recording_summary import recorded_machine_name, result_title


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


# --- places that cannot be written to -----------------------------------------------------------


@pytest.fixture
def recording():
    zeros = np.zeros((2, 1))
    return Recording([0.0, 1.0], ("q1",), zeros, zeros, zeros, {"q1": "rad"})


class TestStaging:
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


# --- killed commands ----------------------------------------------------------------------------


_TEMPORARY = re.compile(r"\.[0-9a-f]{8}\.(part|old)(?=/|$)")
_UNFINISHED = "/unfinished.csv"  # of a computation that goes on with --resume
_WRITES = os.O_WRONLY | os.O_RDWR
# These write their folders as the others do, and compute for longer.
EXPENSIVE = ("breakout", "calibrate", "capacity", "circuit", "design", "excite", "identify",
             "power", "working-range")  # fmt: skip
_before_call = None  # a hook stays until its process ends


def _hook(event, arguments):
    if _before_call is not None and event.startswith(("open", "os.", "shutil.", "ctypes.dl")):
        _before_call(event, arguments)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    sys.addaudithook(_hook)
    folder = tmp_path_factory.mktemp("inputs")
    read(folder)
    return folder


def contents(folder):
    """Contents by path, None of folders; of what is temporary without its random part."""
    return {
        _TEMPORARY.sub(r".\1", str(path.relative_to(folder))): path.read_bytes()
        if path.is_file()
        else None
        for path in sorted(folder.rglob("*"))
    }


def watched(place, run):
    """Run a command; a copy of the place, by what is in it, of each instant it may be killed at.

    Returns:
        (copies, instants): Of each state the first copy, and in how many instants it was seen.
    """
    copies, instants = {}, {}

    def look(event, arguments):
        global _before_call
        _before_call = None
        try:
            if event == "open" and (arguments[2] or 0) & _WRITES:
                path = os.path.abspath(os.fsdecode(arguments[0]))
                is_own = _TEMPORARY.search(path) or path.endswith(_UNFINISHED)
                assert not path.startswith(f"{place}/") or is_own, path
            state = frozenset(contents(place).items())
            if state not in copies:
                copies[state] = place.parent / f"killed{len(copies)}" / place.name
                shutil.copytree(place, copies[state], symlinks=True)
            instants[state] = instants.get(state, 0) + 1
        finally:
            _before_call = look

    global _before_call
    _before_call = look
    try:
        run()
    finally:
        _before_call = None
    return copies, instants


def temporary(found):
    return {name for name in found if re.search(rf"\.(part|old)(/|$)|{_UNFINISHED}$", name)}


def test_every_command_that_writes_is_here():
    assert writing() == set(COMMANDS)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [pytest.param(x, marks=pytest.mark.long) if x in EXPENSIVE else x for x in COMMANDS],
)
def test_old_or_new_wherever_it_is_killed(name, inputs, tmp_path):
    words, target = COMMANDS[name]
    place = tmp_path / "place"
    shutil.copytree(inputs, place)

    def run(folder=place):
        force = ["--force"] if name not in ("check", "settle") else []
        with mock.patch("crane.cli.simulate.DEMO_MACHINES", (str(inputs / "swing.yaml"),)):
            done = typed(*name.split(), *words, *force, cwd=folder)
        assert done.returncode == 0, done.stderr

    if name not in ("check", "settle"):  # they write into what they read
        run()
        for path in place.rglob("*"):  # so that no new file is like its old one
            if path.is_file() and not (inputs / path.relative_to(place)).exists():
                path.write_text("old")
    if (place / target).is_dir():
        (place / target / "notes").write_text("the user's own")
    old = contents(place)
    copies, instants = watched(place, run)
    new = contents(place)
    assert old.keys() == new.keys() and not temporary(new)
    seen, again = Counter(), {}
    for state, copy in copies.items():
        left = temporary(dict(state))
        which = kind({path: x for path, x in state if path not in left}, old, new)
        assert which != "half", copy
        seen[which] += instants[state]
        if len(left) > len(again.get(which, (set(),))[0]):
            again[which] = left, copy  # where most is left behind
    print(name, dict(seen))
    assert again
    # of `crane add` several files stand in the user's own folder, see docs/security.md
    assert set(seen) - ({"mixed"} if name.startswith("add ") else set()) == {"old", "new"}
    for _, copy in again.values():
        run(copy)
        assert contents(copy).keys() == new.keys(), copy


def kind(found, old, new):
    """Whether files are those of before, those of after, some of both, or parts of files."""
    if found == old:
        return "old"
    if found == new:
        return "new"
    whole = found.keys() == new.keys() and all(x in (old[p], new[p]) for p, x in found.items())
    return "mixed" if whole else "half"
