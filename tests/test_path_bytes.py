"""Paths whose bytes are no text in UTF-8 are read, written and shown."""

import os
import shutil

import pytest
from command_line import typed
from conftest import DATA

import crane
from crane.recordings.recording import Recording

NAME, SHOWN = os.fsdecode(b"caf\xe9"), "caf\\udce9"


@pytest.fixture
def machine(tmp_path):
    """A machine file of such a name, in such a folder."""
    folder = tmp_path / NAME
    try:
        folder.mkdir()
    except OSError as error:
        pytest.skip(f"this file system takes text only ({error})")
    shutil.copytree(DATA / "four_bar", folder / "four_bar")
    return shutil.copy(DATA / "four_bar.yaml", folder / f"{NAME}.yaml")


def command(*words):
    done = typed(*words)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_run_names_its_machine_as_it_is(machine, tmp_path):
    out = tmp_path / NAME / "run"
    for suffix, options in (("csv", []), ("npz", ["--npz"])):
        words = ["simulate", machine, "--duration", "0.05", "--out", out, "--force", *options]
        assert f"{SHOWN}/run" in command(*words)
        recording = Recording.read(out / f"recording.{suffix}")
        assert recording.machine == str(machine)
        assert crane.load(recording.machine).name == "four_bar"
        assert SHOWN in command("view", out, "--no-open") and (out / "view.html").is_file()
        command("plot", out, "--out", tmp_path / f"{NAME}.png", "--force")


def test_tables_of_such_machines(machine, tmp_path):
    words = ["study", machine, "--vary", "crank_arm.mass=0.5:1:2", "--measure", "mass"]
    command(*words, "--processes", "1", "--out", tmp_path / "study")
    first = (tmp_path / "study" / "study.csv").read_bytes().splitlines()[0]
    assert first == b"# machine: " + os.fsencode(machine)
    command("check", machine)
    command("modes", machine, "--out", tmp_path / NAME / "modes")
    command("convert", machine, tmp_path / NAME / "copy")
    assert crane.load(tmp_path / NAME / "copy" / "four_bar.yaml").active == ("crank",)


def test_errors_escape_the_bytes(tmp_path):
    done = typed("info", tmp_path / f"{NAME}.yaml")
    assert done.returncode == 2 and f"{SHOWN}.yaml: no such file" in done.stderr
    table = tmp_path / "table.csv"
    table.write_bytes(b"# machine: \xe9\ntime [s],q\xe9 [m]\n0,1\n")
    with pytest.raises(crane.CraneError, match="is not text, give a file in UTF-8"):
        Recording.read(table)
    table.write_bytes(b"# machine: \xe9\ntime [s],q [m],q_force [N]\n0,1,0\n1,\xe9,0\n")
    with pytest.raises(crane.CraneError, match="is not text, give a file in UTF-8"):
        Recording.read(table)
