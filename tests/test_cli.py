"""The command line: output, errors in one line, imports, interrupts and written files."""

import os
import pty
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import typer
from broken_machines import DATA, MINI, copy_machine
from command_line import MAIN, typed
from writing_commands import walked

import crane
from crane.cli import entry
from crane.cli.describe import list_machines
from crane.common.errors import InputError
from crane.description import bundled_machines, example_robots
from crane.view.plots.recording_figure import recording_figure

SHARED = (  # options of blocks, in the order of every help
    "--set", "--lock", "--packages", "--arg", "--active", "--free", "--floating", "--from",
    "--until", "--columns", "--processes", "--scheduler", "--out", "--force",
)  # fmt: skip


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
    result = typed("simulate", "mini_forwarder", "--duration", "0.02", "--out", folder)
    assert result.returncode == 0, result.stderr
    return folder, result


def test_help_names_every_command_and_imports_nothing_heavy(tmp_path):
    result = typed("--help")
    assert result.returncode == 0
    for command in (
        "list", "info", "check", "simulate", "study", "excite", "identify", "payload", "view",
        "plot", "demo",
    ):  # fmt: skip
        assert re.search(rf"\b{command}\b", result.stdout)
    assert typed("-h").stdout == result.stdout
    heavy = (*SLOW, "numpy", "pinocchio", "yaml", "lxml.etree", "llvmlite")
    assert loaded_by(tmp_path, "--help", slow=heavy) == "[]"


def test_list():
    result = typed("list")
    assert result.returncode == 0
    lines = result.stdout.splitlines()
    told = dict(line.strip().split(maxsplit=1) for line in lines if line.startswith("  "))
    assert list(told) == list(bundled_machines())
    assert told["patu655"] == "The PATU 655, a full-size log crane"
    # each says what it is, in a line of a terminal's width
    assert all(what.startswith(("An ", "The ")) for what in told.values())
    assert max(map(len, lines)) <= 100
    assert len(lines) == len(bundled_machines()) + 2
    robots = len(example_robots())
    assert lines[-1].startswith(f"{robots} robots of example-robot-data")
    assert lines[-1].endswith(": crane list --robots")
    others = typed("list", "--robots")
    assert others.returncode == 0
    assert others.stdout.splitlines()[1:] == [f"  {name}" for name in example_robots()]
    assert "ur5_robot" in others.stdout and "some are refused" in others.stdout


def test_no_robots_are_an_error_in_one_line(monkeypatch, capsys):
    monkeypatch.setattr("crane.description.machine_lookup.example_root", lambda: None)
    example_robots.cache_clear()
    try:
        with pytest.raises(InputError, match="no robots here, install example-robot-data"):
            list_machines(robots=True)
        list_machines(robots=False)
        assert "robots" not in capsys.readouterr().out
    finally:
        example_robots.cache_clear()


def test_info_says_what_the_machine_is():
    result = typed("info", "mini_forwarder")
    assert result.returncode == 0
    assert "11, of which 3 active; moving mass 1.287 kg" in result.stdout
    assert "4: 8 independent equations, 12 redundant" in result.stdout
    assert "q4+q9, then q10+q2, then q6+q11, then q7+q3" in result.stdout
    assert "task        lift, 10 s: lifts along a straight line" in result.stdout
    assert "coordinates condition number of the active ones 2.71 at home\n" in result.stdout
    assert re.search(r"^  driven ", result.stdout, re.M) is None  # free ones are among them


def listed(*words):
    """Kind and name of each line, and what is said of it."""
    done = typed("info", "patu655", *words)
    assert (done.returncode, done.stderr) == (0, "")
    rows = (line.split(maxsplit=2) for line in done.stdout.splitlines())
    return {(row[0], row[1]): " ".join(row[2:]) for row in rows}


def test_info_finds_names_by_a_part_of_them(mini):
    machine = crane.load("patu655")
    found = listed("--names", "X_LIFT")
    assert found == listed("x_lift")  # with the option or without, in any case
    names = {kind: [name for of, name in found if of == kind] for kind, _ in found}
    assert list(names) == ["joint", "column", "parameter"]
    assert names["joint"] == ["X_lift"]
    assert found["column", "pressure_X_lift_a"] == "Pa"
    assert found["column", "voltage_X_lift"] == "V"
    area = machine.hydraulics.cylinders["X_lift"].area_a
    assert found["parameter", "cylinder.X_lift.area_a"] == f"{area:.6g} m2"
    # each is one that the machine has
    eyes = listed("--names", "lift_*e*")
    assert {kind for kind, _ in eyes} == {"joint", "frame", "column", "parameter"}
    for kind, name in eyes:
        assert name.startswith("lift_"), name
        if kind == "frame":
            machine.frame(name)
        elif kind == "joint":
            machine.column(name)
    assert not [name for kind, name in listed("barrel") if name.startswith("voltage_")]


@pytest.mark.parametrize(
    ("pattern", "hint"),
    [
        ("X_lft", "did you mean 'X_lift' or"), ("X_lift?", "did you mean 'X_lift' or"),
        ("bulk_modulos", "did you mean 'oil.bulk_modulus' or"), ("zqjk", "leave it out for"),
    ],
)  # fmt: skip
def test_names_that_nothing_has_are_answered_by_the_nearest(pattern, hint):
    line = one_error(typed("info", "patu655", "--names", pattern))
    assert f"nothing is called like '{pattern}', {hint}" in line


def test_info_has_the_whole_home_posture_and_the_path(mini):
    lines = typed("info", "mini_forwarder").stdout.splitlines()
    told = dict(
        re.match(r"    (\w+) .* home (\S+)", line).groups() for line in lines if " home " in line
    )
    assert set(told) == set(mini.joints)
    for joint, value in told.items():
        assert float(value) == pytest.approx(mini.home[mini.column(joint)], rel=1e-4)
    assert "  dynamics    compiled to machine code" in lines


SLOW = (
    "casadi", "matplotlib", "rich.progress", "scipy.fft", "scipy.integrate", "scipy.interpolate",
    "scipy.linalg", "scipy.optimize", "scipy.sparse", "scipy.spatial", "scipy.special",
    "trimesh", "urllib.request", "viser",
)  # fmt: skip


def loaded_by(tmp_path, *arguments, code=MAIN, slow=SLOW):
    """Modules that a command imports, of those that are slow to import; as of long ago."""
    told = f"print('loaded:', [m for m in {slow} if m in sys.modules])"
    early = "import crane; crane.LOADED += 3600.0"  # the package's files may be of this minute
    code = f"import atexit, sys; atexit.register(lambda: {told}); {early}; {code}"
    command = [sys.executable, "-c", code, *map(str, arguments)]
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path / "cache")}
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment)
    assert done.returncode == 0, done.stderr
    return re.search(r"^loaded: (.*)$", done.stdout, re.MULTILINE)[1]


def test_check_of_a_tree_imports_no_scipy(tmp_path):
    """scipy is not imported: that would double the time of the command."""
    urdf = (DATA / "four_bar" / "ground.urdf").read_text()
    (tmp_path / "tree.urdf").write_text(urdf)
    others = (*SLOW, "crane.cli.simulate", "crane.formats.sdf.sdf_translation", "llvmlite.binding")
    assert loaded_by(tmp_path, "check", "tree.urdf", slow=others) == "[]"


def test_a_run_imports_no_pictures_and_no_network(tmp_path):
    run = ("simulate", "mini_forwarder", "--task", "lift", "--duration", "1", "--force", "--out")
    assert "scipy.interpolate" in loaded_by(tmp_path, *run, "first")
    wanted = (tmp_path / "first" / "recording.csv").read_bytes()
    if not (tmp_path / "cache").is_dir():
        pytest.skip("folders of the user are elsewhere here")
    # the second one finds what the first has kept, in which joints start and stop
    assert loaded_by(tmp_path, *run, "second") == "[]"
    assert (tmp_path / "second" / "recording.csv").read_bytes() == wanted


def test_a_machine_s_dynamics_import_no_scipy_the_second_time(tmp_path):
    code = (
        "m = crane.load('mini_forwarder'); q = m.home[m.closure.active]; "
        "print(crane.Dynamics(m).forward(q, 0 * q, 0 * q))"
    )
    assert "scipy.linalg" in loaded_by(tmp_path, code=code)
    if not (tmp_path / "cache").is_dir():
        pytest.skip("folders of the user are elsewhere here")
    assert loaded_by(tmp_path, code=code) == "[]"


def test_every_command_is_found_where_it_is():
    """A command of its own imports its module alone; the table of them may not miss one."""
    app = entry.program()
    names = {
        command.name or command.callback.__name__: command.callback.__module__
        for command in app.registered_commands
        if command.callback.__module__.startswith("crane.cli.")
    }
    names |= {group.name: "crane.cli.describe" for group in app.registered_groups}
    told = {
        name: f"crane.cli.{group}"
        for group, known in entry.GROUPS.items()
        for name in known.split()
    }
    assert told == names


def test_help_is_one_screen_with_examples_that_run(tmp_path):
    lines = typed("--help").stdout.splitlines()
    assert len(lines) <= 40 and max(map(len, lines)) <= 80
    examples = [line.split("   ")[0].split()[1:] for line in lines if line.startswith("  crane ")]
    assert len(examples) == 3
    for words in examples:
        words += ["--no-open"] if words[0] == "view" else []
        done = typed(*words, cwd=tmp_path)
        assert done.returncode == 0, done.stderr


def test_without_a_command_the_help_is_shown():
    done = typed()
    assert (done.returncode, done.stdout, done.stderr) == (2, typed("--help").stdout, "")


def test_an_option_has_one_text_in_all_commands():
    """But for those whose meaning depends on the command."""
    own = {
        "--at", "--controller", "--drive", "--duration", "--method", "--name", "--out", "--over",
        "--period", "--step", "--task", "--to", "--vary",
    }  # fmt: skip
    texts = {}
    for name, command in walked(typer.main.get_command(entry.program())):
        options = {x.opts[0]: x.help for x in command.params if x.param_type_name == "option"}
        assert [x for x in options if x in SHARED] == [x for x in SHARED if x in options], name
        for option, text in options.items():
            texts.setdefault(option, {}).setdefault(text, []).append(name)
    assert {x for x, text in texts.items() if len(text) > 1} <= own, texts


def test_version_and_units_in_help():
    assert typed("--version").stdout == f"crane {crane.__version__}\n"
    text = " ".join(typed("simulate", "-h").stdout.replace("│", " ").split())
    assert re.search("--duration SECONDS Duration; that of the task", text)
    assert re.search("--step SECONDS Step of the recorded samples", text)


def test_without_a_task_a_controller_holds_and_none_lets_go(free_run, tmp_path):
    assert free_run[1].stdout.startswith("# mini_forwarder: free motion\n")
    time = "--duration", "0.02"
    held = typed(
        "simulate", "mini_forwarder", *time, "--controller", "pi", "--out", tmp_path / "h"
    )
    assert held.stdout.startswith("# mini_forwarder: hold\n")
    runs = [crane.Recording.from_csv(x / "recording.csv") for x in (free_run[0], tmp_path / "h")]
    assert (runs[0].tau == 0).all() and np.ptp(runs[0].q, axis=0).max() > 1e-5
    assert np.ptp(runs[1].q, axis=0).max() < 1e-9
    words = " ".join(typed("simulate", "-h").stdout.replace("│", " ").split())
    assert "without it, drive forces are zero and valves stay at neutral." in words


@pytest.mark.parametrize("arguments", [["info", "ur5_robot"], ["--version"]])
def test_output_that_cannot_be_written_is_one_line(arguments):
    command = [sys.executable, "-c", MAIN, *arguments]
    with open("/dev/full", "w") as full:
        result = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    assert result.returncode == 2
    assert result.stderr.startswith("error: output: No space left on device")
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize("arguments", [["list"], ["simulate", "--help"]])
def test_a_reader_that_has_gone_is_no_error(arguments):
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-c", MAIN, *arguments]
    result = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, text=True)
    os.close(writing)
    assert (result.returncode, result.stderr) == (1, "")


@pytest.mark.parametrize("delay", [0.0, 0.5])
def test_interrupt_is_one_line_and_leaves_nothing(tmp_path, delay):
    # a shell that starts tests in the background has them ignore the signal
    code = f"import signal; signal.signal(signal.SIGINT, signal.default_int_handler); {MAIN}"
    path = copy_machine(MINI, tmp_path)
    text = path.read_text()
    assert ", drives: true" in text
    path.write_text(text.replace(", drives: true", ""))  # which a warning tells
    command = [sys.executable, "-c", code, "study", str(path), "--processes", "1"]
    command += ["--vary", "payload.mass=0:0.3:2000", "--out", str(tmp_path / "new" / "run")]
    before = set(tmp_path.rglob("*"))
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr.readline().startswith("warning: ")  # the machine has been read
        try:
            process.wait(delay)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGINT)
        out, rest = process.communicate(timeout=300)
    assert (process.returncode, out) == (130, "")
    *before_it, line = rest.splitlines()
    assert line == "error: interrupted, no result was written"
    left = set(tmp_path.rglob("*")) - before
    if left:  # variants were finished
        file = tmp_path / "new" / "run" / "unfinished.csv"
        assert left == {file, *file.parents[:2]}
        said = f"what is finished is kept in {file}: add --resume to go on"
        assert before_it.pop() == said
    assert all(other.startswith("warning: ") for other in before_it)


DRAWN = """
import os, time
import crane.view.plots.figure_style as figure_style


class Object:
    def __del__(self):  # where Python ignores what is raised
        os.kill(os.getpid(), {number})
        for _ in range(1000):
            pass


def ignored():
    Object()
    time.sleep(30)


def replaced():
    try:
        os.kill(os.getpid(), {number})
        time.sleep(30)
    except BaseException as error:
        raise RuntimeError("something of a library's own") from error


def write_figure(path, draw):
    path.write_bytes(b"half")
    {what}()


figure_style.write_figure = write_figure
"""


@pytest.mark.slow
@pytest.mark.parametrize("what", ["ignored", "replaced"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_while_figures_are_drawn_is_one_line_and_leaves_no_parts(tmp_path, what, number):
    out = tmp_path / "new" / "run"
    code = f"import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n{DRAWN}"
    command = [sys.executable, "-c", code.format(number=int(number), what=what) + MAIN, "study"]
    command += ["mini_forwarder", "--vary", "payload.mass=0:0.3:2", "--measure", "mass"]
    command += ["--processes", "1", "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (128 + number, "")
    assert done.stderr.splitlines() == [
        f"what is finished is kept in {out / 'unfinished.csv'}: add --resume to go on",
        "error: interrupted, no result was written",
    ]
    left = [path.relative_to(tmp_path) for path in tmp_path.rglob("*")]
    assert sorted(map(str, left)) == ["new", "new/run", "new/run/unfinished.csv"]


CUT = """
import contextlib
import crane.cli.simulate


@contextlib.contextmanager
def progress_bar(what):
    def report(share):
        if share > 0.5:
            raise KeyboardInterrupt
    yield report


crane.cli.simulate.progress_bar = progress_bar
"""


def test_an_interrupted_run_leaves_what_it_has(tmp_path):
    out, machine = tmp_path / "run", Path(__file__).parent / "data" / "four_bar.yaml"
    command = [sys.executable, "-c", CUT + MAIN, "simulate", str(machine), "--duration", "8"]
    done = subprocess.run([*command, "--out", str(out)], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (130, "")
    line = done.stderr.splitlines()[-1]
    assert line.startswith("interrupted at t = ") and str(out) in line
    recording = crane.Recording.from_csv(out / "recording.csv")
    last = recording.time[-1]
    assert 4 < last < 8 and line.startswith(f"interrupted at t = {last:g} s")
    assert recording.task == "free motion"
    assert recording.stopped == f"at t = {last:g} s of 8 s: interrupted"
    assert f"stopped at {last:.4g} s" in (out / "summary.md").read_text().splitlines()[0]
    whole = crane.simulate(machine, duration=0.5)
    np.testing.assert_allclose(recording.q[: len(whole.time)], whole.q, rtol=0, atol=1e-12)


def test_results_are_headed_with_the_machine_s_own_name(tmp_path):
    data, other = Path(__file__).parent / "data", tmp_path / "my.yaml"
    text = (data / "slider_crank.yaml").read_text().replace("urdf: ", f"urdf: {data}/")
    other.write_text(text.replace("name: slider_crank\n", "name: Press No. 1\n"))
    out = tmp_path / "run"
    for command in (
        ("simulate", other, "--duration", "0.05", "--out", out), ("view", out, "--no-open"),
    ):  # fmt: skip
        result = typed(*command)
        assert result.returncode == 0, result.stderr
    assert (out / "summary.md").read_text().startswith("# Press No. 1: free motion\n")
    assert "<title>Press No. 1: free motion</title>" in (out / "view.html").read_text()
    figure = recording_figure(crane.Recording.read(out / "recording.csv"))
    assert figure.get_suptitle() == "Press No. 1: free motion"


def test_results_go_to_a_folder_called_as_the_command(tmp_path):
    machine = Path(__file__).parent / "data" / "slider_crank.yaml"
    command = "simulate", machine, "--duration", "0.01"
    assert "written to simulate; see it with" in typed(*command, cwd=tmp_path).stdout
    assert (tmp_path / "simulate" / "summary.md").is_file()
    assert "simulate: is not empty" in one_error(typed(*command, cwd=tmp_path))
    assert typed("working-range", "excavator", "--frame", "bucket", cwd=tmp_path).returncode == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["simulate", "working_range"]


def test_plot_and_view_of_a_run(free_run, tmp_path):
    folder, _ = free_run
    assert typed("plot", folder, "--out", tmp_path / "a.svg").returncode == 0
    assert (tmp_path / "a.svg").read_text().lstrip().startswith("<?xml")
    result = typed("view", folder, "--out", tmp_path / "a.html", "--no-open")
    assert result.returncode == 0, result.stderr
    assert "<html" in (tmp_path / "a.html").read_text()[:200].lower()
    again = typed("view", folder, "--out", tmp_path / "a.html", "--no-open")
    assert "exists already, choose another name or add --force" in one_error(again)
    bad = typed("plot", folder, "--out", tmp_path / "a.xyz")
    assert "a.xyz" in one_error(bad)


def test_view_of_a_run_whose_machine_has_moved(tmp_path):
    data = Path(__file__).parent / "data"
    machine = Path(shutil.copy(data / "slider_crank.yaml", tmp_path))
    shutil.copytree(data / "slider_crank", tmp_path / "slider_crank")
    simulate = ("simulate", machine, "--duration", "0.01", "--out", tmp_path / "run")
    assert typed(*simulate).returncode == 0
    machine.unlink()
    page = tmp_path / "run" / "view.html"
    view = ("view", tmp_path / "run", "--no-open")
    error = one_error(typed(*view))
    assert "slider_crank.yaml: no such file" in error and "add --machine" in error
    assert not page.exists()
    result = typed(*view, "--machine", data / "slider_crank.yaml")
    assert result.returncode == 0, result.stderr
    assert page.is_file()


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["fly"], "No such command 'fly'"),
        (
            ["info", "zzzzzz"],
            "known: excavator, excavator_ls, excavator_two_pumps, kr300, mini_forwarder, patu655, "
            "patu655_grapple, patu655_ls, tx40; crane list --robots names more",
        ),
        (["demo", "--out", ""], "the name after --out is empty"),
        (["demo", "--out", "/dev/null"], "/dev/null: is a file"),
        (["view", "ur5_robot", "--no-open", "--out", "page.png"], "end the name in .html"),
        (["view", "ur5_robot", "--machine", "ur5_robot"], "--machine is for runs"),
        (
            ["simulate", "nothing", "--duration", "1", "--out", "/dev/null/run"],
            "/dev/null/run: /dev/null is a file, give the name of a folder",
        ),
        (["info"], "Missing argument 'MACHINE'"),
        (["info", "mini_forwardr"], "did you mean 'mini_forwarder'?"),
        (["check", "nothing.yaml"], "nothing.yaml: no such file"),
        (["simulate", "mini_forwarder"], "name a --task (loading, return, lift)"),
        (["study", "mini_forwarder"], "Missing option '--vary'"),
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
            ["simulate", "mini_forwarder", "--out", "x", "--duration", "1", "--step", "0"],
            "the step is 0.0 s",
        ),
        (["simulate", "mini_forwarder", "--out", "x", "--step", "a"], "'--step'"),
        (["plot", "nowhere"], "nowhere: no such file"),
        (["plot", "."], "no recording.csv in this folder"),
        (["view", "nowhere.csv"], "nowhere.csv: no such file"),
        (
            ["convert", "mini_forwarder", "/dev/null/x.urdf"],
            "/dev/null: is a file, give the name of a folder",
        ),
    ],
)
def test_errors_are_one_line_and_write_nothing(arguments, text, tmp_path):
    assert text in one_error(typed(*arguments, cwd=tmp_path))
    assert list(tmp_path.iterdir()) == []


def test_debug_shows_where_an_error_comes_from():
    result = typed("info", "nothing", "--debug")
    assert "Traceback" in result.stderr and "DescriptionError" in result.stderr


@pytest.mark.slow
def test_demo(tmp_path):
    (tmp_path / "demo" / "lift").mkdir(parents=True)
    for name in ("notes.txt", "lift/view.html"):
        (tmp_path / "demo" / name).write_text("old")
    result = typed("demo", "--out", tmp_path / "demo", "--force")
    assert result.returncode == 0, result.stderr
    names = {path.name for path in (tmp_path / "demo").iterdir()}
    tasks = {"loading", "return", "lift", "dig", "load_truck", "grade"}
    pages = {f"{name}_drive.html" for name in ("excavator", "mini_forwarder", "patu655")}
    assert names == tasks | pages | {"summary.md", "notes.txt"}
    assert (tmp_path / "demo" / "lift" / "view.html").stat().st_size > 1000
    for task in tasks:
        names = {path.name for path in (tmp_path / "demo" / task).iterdir()}
        assert names == {"recording.csv", "summary.md", "figure.png", "view.html"}
    text = Path(tmp_path / "demo" / "summary.md").read_text()
    assert (text.count("# mini_forwarder: "), text.count("# excavator: dig")) == (3, 1)


def test_study(tmp_path):
    command = (
        "study", "mini_forwarder", "--vary", "payload.mass=0:0.1:3", "--task", "lift",
        "--measure", "peak_X1", "--processes", "1", "--out", "study",
    )  # fmt: skip
    result = typed(*command, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "*                 0      62.10" in result.stdout
    assert "3 variants, best peak_X1 first" in result.stdout
    assert {path.name for path in (tmp_path / "study").iterdir()} == {"study.csv", "study.png"}
    assert "is not empty" in one_error(typed(*command, cwd=tmp_path))


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--vary", "payload.mass=0:1"], "'0:1' is no grid, give NAME=start:stop:count"),
        (["--vary", "payload.mas=0:1:2"], "did you mean 'payload.mass'?"),
        (["--vary", "payload.mass=0~1"], "say how often with --draws"),
        (["--vary", "payload.mass=0:1:2", "--task", "lft"], "did you mean 'lift'?"),
        (
            ["--vary", "payload.mass=0:1:2", "--scheduler", "no"],
            "'no' is no address of a scheduler",
        ),
        ([], "Missing option '--vary'"),
    ],
)
def test_wrong_studies_are_one_line_and_write_nothing(arguments, text, tmp_path):
    assert text in one_error(
        typed("study", "mini_forwarder", "--out", "s", *arguments, cwd=tmp_path)
    )
    assert list(tmp_path.iterdir()) == []


def test_help_keeps_its_units():
    """What stands in square brackets is markup to the help, and disappears."""
    for file in (Path(crane.__file__).parent / "cli").glob("*.py"):
        for text in re.findall(r'help="([^"]*)"', file.read_text()):
            assert "[" not in text, text


# --- progress -----------------------------------------------------------------------------------


PROGRAM = """
import sys
import time
from crane.cli import entry
from crane.common import progress
from crane.cli import terminal
from crane.cli.command import app
from crane.cli.terminal import progress_bar

progress.REPORT_DELAY, progress.REPORT_INTERVAL = float(sys.argv.pop()), 0.05

@app.command()
def wait(seconds: float, bar: bool = False, served: bool = False):
    if served:
        with terminal.hide_activity_line():
            time.sleep(seconds)
        return
    if bar:
        with progress_bar("counting") as tell:
            for share in range(10):
                time.sleep(seconds / 10)
                tell(share / 10)
        return
    exec(compile("time.sleep(seconds)", "there", "exec"),
         {"__name__": "crane.closure.there", "time": time, "seconds": seconds})
    print("half a", end=" ", flush=True)
    time.sleep(seconds)
    print("line")

sys.argv = ["crane", "wait", *sys.argv[1:]]
entry.main()
"""


def on_terminal(*words, out=None, after="0.3"):
    """What a command writes to a terminal, both streams unless the output goes elsewhere."""
    ours, theirs = pty.openpty()
    done = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, *words, after],
        stdout=theirs if out is None else out,
        stderr=theirs,
        env=os.environ | {"TERM": "xterm"},
    )
    os.close(theirs)
    told = b""
    try:
        while part := os.read(ours, 4096):
            told += part
    except OSError:  # its other end is closed
        pass
    finally:
        os.close(ours)
    assert done.wait() == 0
    return told.decode()


def left(told):
    """What stands on the screen in the end: each line from its last erasure on."""
    return [line.rsplit("\x1b[2K", 1)[-1] for line in told.replace("\r\n", "\n").split("\n")]


def test_a_terminal_is_told_what_goes_on_and_the_line_goes():
    told = on_terminal("0.8")
    assert "crane wait: closing the loops, " in told
    assert left(told) == ["half a line", ""]


def test_output_into_a_file_stays_as_it_is(tmp_path):
    with (tmp_path / "out").open("w") as out:
        told = on_terminal("0.8", out=out)
    assert "closing the loops" in told and left(told) == [""]
    assert (tmp_path / "out").read_text() == "half a line\n"


def test_what_is_quick_says_nothing():
    assert on_terminal("0.01", after="60") == "half a line\r\n"


def test_a_bar_stands_alone():
    told = on_terminal("0.9", "--bar", after="0.1")
    before, after = told.split("counting", 1)
    assert "crane wait:" in before and "crane wait:" not in after
    assert left(told)[-1] == ""


def test_a_bar_is_only_for_what_takes_a_while():
    assert "counting" not in on_terminal("0.01", "--bar")


def test_what_waits_for_the_user_says_nothing():
    told = on_terminal("0.8", "--served", after="0.6")
    assert left(told) == [""] and told.count("crane wait:") == 0


def test_pipes_hear_nothing():
    words = [sys.executable, "-c", PROGRAM, "0.8", "0.3"]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("half a line\n", "")
