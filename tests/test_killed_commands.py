"""A killed command leaves either the old files or the new ones, never a mixture.

What SIGKILL leaves is what is on the disk: so the disk is copied before each call that a command
makes on files, and looked at. Buffers of the process are lost, as they would be, and so are locks.
"""

import os
import re
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path
from unittest import mock

import pytest
from command_line import MAIN, typed
from writing_commands import COMMANDS, read, writing

import crane

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


def tree(folder):
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
            state = frozenset(tree(place).items())
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
        force = ["--force"] if name != "check" else []
        with mock.patch("crane.cli.simulate.DEMO_MACHINES", (str(inputs / "swing.yaml"),)):
            done = typed(*name.split(), *words, *force, cwd=folder)
        assert done.returncode == 0, done.stderr

    if name != "check":  # it writes into what it reads
        run()
        for path in place.rglob("*"):  # so that no new file is like its old one
            if path.is_file() and not (inputs / path.relative_to(place)).exists():
                path.write_text("old")
    if (place / target).is_dir():
        (place / target / "notes").write_text("the user's own")
    old = tree(place)
    copies, instants = watched(place, run)
    new = tree(place)
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
        assert tree(copy).keys() == new.keys(), copy


def kind(found, old, new):
    """Whether files are those of before, those of after, some of both, or parts of files."""
    if found == old:
        return "old"
    if found == new:
        return "new"
    whole = found.keys() == new.keys() and all(x in (old[p], new[p]) for p, x in found.items())
    return "mixed" if whole else "half"


@pytest.mark.slow
def test_of_two_processes_at_once_into_one_new_folder_one_is_told(inputs, tmp_path):
    gated = f"import sys, crane.simulation; sys.stdin.readline(); {MAIN}"
    both = [
        subprocess.Popen(
            [sys.executable, "-c", gated, "simulate", inputs / "four_bar.yaml", "--duration",
             duration, "--out", "run"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])},
        )
        for duration in ("0.01", "0.02")
    ]  # fmt: skip
    for process in both:
        process.stdin.write("\n")
        process.stdin.flush()
    told = [process.communicate()[1] for process in both]
    assert sorted(process.returncode for process in both) == [0, 2], told
    won = [process.returncode for process in both].index(0)
    (line,) = told[1 - won].splitlines()
    assert line.startswith("error: run: is ") and "choose another folder or add --force" in line
    assert os.listdir(tmp_path) == ["run"]
    assert sorted(os.listdir(tmp_path / "run")) == ["recording.csv", "summary.md"]
    recording = crane.Recording.from_csv(tmp_path / "run" / "recording.csv")
    assert recording.time[-1] == pytest.approx((0.01, 0.02)[won])
