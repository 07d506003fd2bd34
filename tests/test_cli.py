import re
import subprocess
import sys
from pathlib import Path

import pytest

import crane


def run(*arguments, cwd=None):
    """The command line in a process of its own, as a user has it."""
    return subprocess.run(
        [sys.executable, "-c", "from crane.cli import main; main()", *map(str, arguments)],
        capture_output=True,
        text=True,
        cwd=cwd,
        timeout=300,
    )


def one_error(result) -> str:
    """The only line on stderr that is not a warning."""
    lines = [line for line in result.stderr.splitlines() if not line.startswith("warning: ")]
    assert result.returncode == 2, result.stderr
    assert len(lines) == 1 and lines[0].startswith("error: "), result.stderr
    assert result.stdout == ""
    return lines[0]


@pytest.fixture(scope="module")
def free_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "fall"
    result = run("simulate", "mini_forwarder", "--duration", "0.02", "--out", folder)
    assert result.returncode == 0, result.stderr
    return folder, result


def test_help_names_every_command_and_imports_nothing_heavy():
    result = run("--help")
    assert result.returncode == 0
    for command in ("list", "info", "check", "simulate", "view", "plot", "demo"):
        assert re.search(rf"\b{command}\b", result.stdout)
    code = "import sys, crane.cli; print([m for m in ('numpy', 'pinocchio') if m in sys.modules])"
    imported = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert imported.stdout.strip() == "[]"


def test_list():
    result = run("list")
    assert result.returncode == 0
    assert "  mini_forwarder\n" in result.stdout and "ur5_robot" in result.stdout


def test_info_says_what_the_machine_is():
    result = run("info", "mini_forwarder")
    assert result.returncode == 0
    assert "11, of which 3 active; moving mass 1.287 kg" in result.stdout
    assert "4: 8 independent equations, 12 redundant" in result.stdout
    assert "q4+q9, then q10+q2, then q6+q11, then q7+q3" in result.stdout
    assert "task        lift, 10 s: lifts along a straight line" in result.stdout


def test_check_tells_warnings_by_its_status():
    result = run("check", "mini_forwarder")
    assert result.returncode == 1
    assert "3 degrees of freedom" in result.stdout
    assert result.stderr.startswith("warning: mini_forwarder.yaml:")
    assert run("check", "ur5_robot").returncode == 0


def test_simulate_writes_recording_and_summary(free_run):
    folder, result = free_run
    assert sorted(path.name for path in folder.iterdir()) == ["recording.csv", "summary.md"]
    recording = crane.Recording.from_csv(folder / "recording.csv")
    assert len(recording.time) == 21 and recording.machine == "mini_forwarder"
    assert "| X1 |" in result.stdout


def test_simulate_a_task(tmp_path):
    result = run(
        "simulate", "mini_forwarder", "--task", "lift", "--duration", "0.01",
        "--controller", "computed-torque", "--out", tmp_path / "run",
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    recording = crane.Recording.from_csv(tmp_path / "run" / "recording.csv")
    assert recording.task == "lift" and "reference_X1" in recording.channels


def test_nothing_is_overwritten_without_force(free_run):
    folder, _ = free_run
    before = (folder / "recording.csv").read_bytes()
    again = ("simulate", "mini_forwarder", "--duration", "0.01", "--out", folder)
    assert "is not empty, choose another folder or add --force" in one_error(run(*again))
    assert (folder / "recording.csv").read_bytes() == before
    assert run(*again, "--force").returncode == 0
    assert (folder / "recording.csv").read_bytes() != before


def test_plot_and_view_of_a_run(free_run, tmp_path):
    folder, _ = free_run
    assert run("plot", folder, "--out", tmp_path / "a.svg").returncode == 0
    assert (tmp_path / "a.svg").read_text().lstrip().startswith("<?xml")
    result = run("view", folder, "--out", tmp_path / "a.html", "--no-open")
    assert result.returncode == 0, result.stderr
    assert "<html" in (tmp_path / "a.html").read_text()[:200].lower()
    again = run("view", folder, "--out", tmp_path / "a.html", "--no-open")
    assert "exists already, choose another name or add --force" in one_error(again)
    bad = run("plot", folder, "--out", tmp_path / "a.xyz")
    assert "a.xyz" in one_error(bad)


def test_view_of_a_machine_goes_to_the_working_folder(tmp_path):
    assert run("view", "mini_forwarder", "--no-open", cwd=tmp_path).returncode == 0
    assert (tmp_path / "mini_forwarder.html").is_file()


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["fly"], "No such command 'fly'"),
        (["info"], "Missing argument 'MACHINE'"),
        (["info", "mini_forwardr"], "did you mean 'mini_forwarder'?"),
        (["check", "nothing.yaml"], "nothing.yaml: no such file"),
        (["simulate", "mini_forwarder"], "Missing option '--out'"),
        (["simulate", "mini_forwarder", "--out", "x"], "name a --task (loading, return, lift)"),
        (
            ["simulate", "mini_forwarder", "--out", "x", "--task", "lft"],
            "has no task 'lft', did you mean 'lift'?",
        ),
        (
            ["simulate", "mini_forwarder", "--out", "x", "--task", "lift", "--controller", "pid"],
            "controller 'pid' is unknown",
        ),
        (
            ["simulate", "mini_forwarder", "--out", "x", "--controller", "pi", "--duration", "1"],
            "has nothing to follow, name a --task",
        ),
        (
            ["simulate", "mini_forwarder", "--out", "x", "--duration", "1", "--step", "0"],
            "the step is 0.0 s",
        ),
        (["simulate", "mini_forwarder", "--out", "x", "--step", "a"], "'--step'"),
        (["plot", "nowhere"], "nowhere: no such file"),
        (["plot", "."], "no recording.csv in this folder"),
        (["view", "nowhere.csv"], "nowhere.csv: no such file"),
        (["view", "mini_forwarder", "--no-open", "--out", "no/folder.html"], "no/folder.html"),
    ],
)
def test_errors_are_one_line_and_write_nothing(arguments, text, tmp_path):
    assert text in one_error(run(*arguments, cwd=tmp_path))
    assert list(tmp_path.iterdir()) == []


def test_debug_shows_where_an_error_comes_from():
    result = run("info", "nothing", "--debug")
    assert "Traceback" in result.stderr and "DescriptionError" in result.stderr


@pytest.mark.slow
def test_demo(tmp_path):
    result = run("demo", "--out", tmp_path / "demo")
    assert result.returncode == 0, result.stderr
    for task in ("loading", "return", "lift"):
        names = {path.name for path in (tmp_path / "demo" / task).iterdir()}
        assert names == {"recording.csv", "summary.md", "figure.png", "view.html"}
    assert Path(tmp_path / "demo" / "summary.md").read_text().count("# mini_forwarder: ") == 3
