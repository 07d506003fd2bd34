"""Calls every command with extreme option values; `test_fuzz.py` runs this.

    python tests/fuzz_options.py reported
    python tests/fuzz_options.py FIRST COUNT [COMMAND]

runs the calls of a list, or draws calls FIRST to FIRST + COUNT - 1. Each runs in a process of its
own with bounded memory and time of computing; a line of JSON is printed per call that is not well,
and one at the end. Options are those that the program itself has, so a new one is drawn without
being named here.
"""

import contextlib
import json
import os
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")

import numpy as np  # noqa: E402
from hydraulic_rig import rig  # noqa: E402
from typer.main import get_command  # noqa: E402

import crane  # noqa: E402
import crane.cli.entry as entry  # noqa: E402
import crane.studies  # noqa: E402
import crane.view.live.live_server  # noqa: E402
import crane.view.page.report_page  # noqa: E402
import crane.view.plots.recording_figure  # noqa: E402
from crane.common.errors import CraneWarning  # noqa: E402
from crane.description import parameters
from crane.formats import read_machine_spec  # noqa: E402
from crane.identification.excitation.fourier_trajectory import FourierTrajectory  # noqa: E402

DATA = Path(__file__).parent / "data"
SECONDS = 60  # of computing, on a slow machine: this ends what hangs
MEMORY = 2 << 30  # beyond what the program has when it starts [bytes]
PATIENCE = 400.0  # [s] for a call that waits for something that never comes
LONGEST = 4100  # characters of a line

NUMBERS = (
    "0", "-0", "-1", "1", "2", "7", "2000", "300000", "1e-320", "1e-300", "-1e-300", "1e-9",
    "1e-3", "0.3", "1e3", "1e6", "1e19", "1e300", "1e308", "-1e308", "1e309", "inf", "-inf", "nan",
    "2147483648", "-2147483649", "9223372036854775808", "123456789012345678901234567890", "0x10",
    "1_000", "1,5", "\uff11",
)  # fmt: skip
TEXTS = (
    "", " ", "x" * 100_000, "9" * 5000, "\u00fc\u2202\u2603", "a\nb", "\x1b[31m", "a\tb", "-", "=",
    "==", "=1", "$\\bad$", "%s{}", "\udcff", "..", "/", "a/b", "tcp://localhost:1", "~", "*",
    "CON", "yes", "null", "[]",
)  # fmt: skip
FILES = (
    "missing.csv", "folder", "empty.csv", "garbage.csv", "garbage.npz", "garbage.yaml", "head.csv",
    "row.csv", "nan.csv", "words.csv", "unreadable.csv", "slider.yaml", "motion.csv", "/dev/null",
    "/dev/full", "missing/folder/out", "folder/out.png", "slider.yaml/x", "motion.csv/x",
    "empty.yaml", "empty.urdf", "unreadable.yaml", "slider_crank", "out.svg", "out.pdf", "out.tif",
    "n" * 300, "n" * 300 + ".csv",
)  # fmt: skip
RANGES = (
    "{0}:{1}:2", "{0}:{1}:{2}", "{0}~{1}", "1:2:{0}", "0.9:1.1:2", "1:2", ":::", "~", "1:1:1",
    "0.9~1.1",
)  # fmt: skip

# What each command needs, and words that it understands; {out} is a name that is free.
CALLS = {
    "add cylinder": [
        "slider.yaml --between base:-0.3,0,-0.1 crank:0.15,0,0 --bore 0.02 --rod 0.01 "
        "--stroke 0.25 --out {out}.yaml",
    ],
    "add loops": ["slider.yaml --out {out}.yaml"],
    "breakout": [
        "patu655 --bucket X_tilt --out {out}",
        "patu655 --direction up --step 2 --out {out}",
    ],
    "list": [""],
    "info": ["slider.yaml", "rig.yaml"],
    "check": ["slider.yaml", "rig.yaml"],
    "view": ["slider.yaml --no-open --out {out}.html", "motion.csv --no-open --out {out}.html"],
    "plot": ["motion.csv --out {out}.png", "valves.csv --out {out}.png"],
    "demo": ["--out motion.csv"],  # nothing of it depends on its options
    "calibrate": ["rig.yaml valves.csv --fit load_x.mass --train 0:1 --out {out}"],
    "capacity": ["excavator --frame bucket --rule iso10567 --step 1 --out {out}"],
    "convert": ["slider.yaml {out}.urdf", "slider.yaml {out}", "slider.yaml {out}.xml"],
    "study": ["slider.yaml --out {out} --vary crank.mass=0.7:0.9:2 --processes 1"],
    "design": [
        "slider.yaml --out {out} --vary crank.mass=0.7~0.9 --minimise crank.mass "
        "--starts 1 --points 2 --processes 1",
    ],
    "excite": ["slider.yaml --out {out} --period 4 --harmonics 1 --step 0.05"],
    "import": ["motion.csv --columns columns.txt --out {out}.csv"],
    "identify": ["slider.yaml motion.csv --out {out}"],
    "payload": ["slider.yaml motion.csv"],
    "circuit": [
        "rig.yaml valves.csv --joint x --out {out}",
        "rig.yaml valves.csv --joint x --model valve",
        "rig.yaml valves.csv --joint x --model friction",
    ],
    "power": ["rig.yaml valves.csv --out {out}", "rig.yaml valves.csv --until 0.3 --out {out}"],
    "live": ["slider.yaml", "motion.csv"],
    "sketch": [
        "slider.yaml --out {out}.png",
        "rig.yaml --out {out}.svg",
        "rig.yaml --circuit --out {out}.svg",
    ],
    "modes": ["slider.yaml --out {out}", "rig.yaml --vary x=0.1:0.3:2 --out {out}"],
    "simulate": [
        "slider.yaml --task swing --out {out}",
        "slider.yaml --duration 0.1 --out {out}",
        "rig.yaml --task lift --step 0.01 --out {out}",
        "rig.yaml --inputs valves.csv --out {out}",
    ],
    "sensitivities": [
        "slider.yaml --task swing --duration 0.1 --by crank.mass --out {out}",
        "rig.yaml --duration 0.1 --by load_x.mass --by start.x",
    ],
    "stability": ["excavator --task dig"],
    "sway": ["patu655_grapple --task swing --payload 200 --damping 0"],
    "working-range": ["patu655 --out {out}"],
    "workspace": ["slider.yaml --samples 100 --out {out}", "rig.yaml --samples 100 --out {out}"],
}
# Calls that once ended in a traceback, in silence or never.
REPORTED = (
    "info slider.yaml --lock s=1e308",
    "simulate slider.yaml --task swing --out o --lock s=1e308",
    "sketch slider.yaml --out o.png --lock theta=1e308",
    "sketch slider.yaml --out o.png --lock phi=-1e308",
    "convert slider.yaml o --set crank.mass=1e308",
    "excite slider.yaml --out o --period 1e308",
    "excite slider.yaml --out o --period 1e-300",
    "excite slider.yaml --out o --harmonics 9223372036854775808",
    "excite slider.yaml --out o --harmonics 2147483648",
    "excite slider.yaml --out o --harmonics 100000",
    "excite slider.yaml --out o --periods 9223372036854775808",
    "excite slider.yaml --out o --periods 2147483648",
    "excite slider.yaml --out o --step 1e-300",
    "excite slider.yaml --out o --step 1e-320",
    "excite slider.yaml --out o --step 1e-9",
    "excite slider.yaml --out o --noise theta=1e-320",
    "excite slider.yaml --out o --noise theta=1e308",
    "excite slider.yaml --out o --acceleration theta=1e-320",
    "identify slider.yaml motion.csv --out o --prior 1e-300",
    "identify slider.yaml motion.csv --out o --prior 1e-300 --feasible",
    "identify slider.yaml motion.csv --out o --prior 1e308",
    "identify slider.yaml motion.csv --out o --prior nan",
    "identify slider.yaml motion.csv --out o --bandwidth 1e308",
    "identify slider.yaml motion.csv --out o --min-speed theta=-1e308",
    "simulate slider.yaml --task swing --out o --step 1e-300",
    "simulate slider.yaml --duration 1e308 --out o",
    "study slider.yaml --out o --vary crank.mass=0.7:0.9:3 --processes 2147483648",
    "study slider.yaml --out o --vary crank.mass=0.7~0.9 --draws 2147483648",
    "study slider.yaml --out o --vary crank.mass=1e307:1e308:2",
    "workspace slider.yaml --out o --samples 2147483648",
    "workspace slider.yaml --out o --samples 100 --seed -1",
    "workspace rig.yaml --out o --samples 100",
    "circuit rig.yaml valves.csv --joint x --period 1e-300",
    "circuit rig.yaml valves.csv --joint x --period 1e308",
    "sketch slider.yaml --out o.png --at theta=1e308",
)
WORDS = (
    "swing", "lift", "pi", "computed-torque", "valve-pd", "tip-velocity", "ols", "wls", "huber",
    "logdet", "condition", "weak", "chambers", "ls", "orifices", "valve", "friction", "xy", "xz",
    "urdf+", "mjcf", "machine", "rod_middle", "theta", "x", "peak_theta", "reach", "energy",
    "motion.csv", "other.csv", "valves.csv", "slider.yaml", "rig.yaml", "127.0.0.1",
)  # fmt: skip
SLIDER = """name: slider
chains:
  - {name: crank, urdf: slider_crank/crank.urdf}
  - {name: slider, urdf: slider_crank/slider.urdf, parent: guide}
loops:
  - {name: wrist, type: revolute, predecessor: slider, successor: rod_eye, axis: [0, 1, 0]}
active: [theta]
home: {theta: 1.0, phi: -0.5, s: 0.37}
tip: rod_middle
friction: {theta: {viscous: 0.5, coulomb: 0.4, smoothing: 0.05}}
control: {theta: {kp: 200, ki: 50}}
tasks:
  swing: {duration: 0.5, active: {theta: [1.0, 0, 2.0, -2.0]}}
  reach: {duration: 0.5, tip: {x: [0.2, 0.1], y: [0], z: [0.3]}}
"""


def prepare(folder):
    """Machines, recordings, and what is none, in a folder that no call writes to."""
    (folder / "slider_crank").mkdir()
    for part in (DATA / "slider_crank").iterdir():
        (folder / "slider_crank" / part.name).write_bytes(part.read_bytes())
    (folder / "slider.yaml").write_text(SLIDER)
    machine = crane.load(folder / "slider.yaml")
    for name, w in (("motion", 3.0), ("other", 2.3)):
        path = FourierTrajectory([[1.4], [0.9], [0.5], [0.6], [-0.2]], 2 * np.pi / w)
        run = crane.simulate(machine, crane.ComputedTorque(machine, path), duration=4.0, step=5e-3)
        rng = np.random.default_rng(1)
        noisy = run.tau + 0.02 * rng.normal(size=run.tau.shape)
        names = "time [s],theta [rad],theta_velocity [rad/s],theta_force [N m]"
        rows = np.column_stack([run.time, run.q, run.v, noisy])
        np.savetxt(folder / f"{name}.csv", rows, delimiter=",", header=names, comments="")
        text = (folder / f"{name}.csv").read_text()
        (folder / f"{name}.csv").write_text(f"# machine: {folder / 'slider.yaml'}\n{text}")
    (folder / "columns.txt").write_text(
        "time [s] = 'time [s]'\ntheta [rad] = 'theta [rad]' - 0.1\n"
        "theta_force [N m] = 2 * 'theta_force [N m]' / 2\n"
    )
    rig(folder, mass=700.0, control={"kp": 20.0, "kd": 1.0})
    text = (folder / "rig.yaml").read_text()
    (folder / "rig.yaml").write_text(
        text + "tip: load_x\ntasks:\n"
        "  lift: {duration: 1.0, joystick: {x: [0, 0, 0.2, 0.3, 0.6, -0.3, 0.9, 0]}}\n"
    )
    machine = crane.load(folder / "rig.yaml")
    run = crane.simulate(machine, crane.joystick(machine, "lift"), duration=1.0, step=2e-3)
    run.to_csv(folder / "valves.csv")
    (folder / "folder").mkdir()
    for name in ("empty.csv", "empty.yaml", "empty.urdf"):
        (folder / name).write_text("")
    for name in ("garbage.csv", "garbage.npz", "garbage.yaml"):
        (folder / name).write_bytes(random.Random(0).randbytes(2000))
    (folder / "head.csv").write_text("time [s],theta [rad],theta_force [N m]\n")
    (folder / "row.csv").write_text("time [s],theta [rad],theta_force [N m]\n0,1,2\n")
    (folder / "nan.csv").write_text("time [s],theta [rad],theta_force [N m]\n0,1,nan\n1,1,1\n")
    (folder / "words.csv").write_text("time [s],theta [rad],theta_force [N m]\n0,a,b\n1,c,d\n")
    for name in ("unreadable.csv", "unreadable.yaml"):
        (folder / name).write_text("x")
        (folder / name).chmod(0)


def names(folder):
    """Names of joints and parameters by machine."""
    found = {}
    for name in ("slider.yaml", "rig.yaml"):
        machine = crane.load(folder / name)
        found[name] = [*machine.joints, *parameters(read_machine_spec(folder / name))]
    return found


def every_command(group, before=""):
    """Commands by name, those of groups by both their words."""
    found = {}
    for name, command in group.commands.items():
        inner = getattr(command, "commands", None)
        found |= every_command(command, f"{name} ") if inner else {before + name: command}
    return found


def draw(seed, known, only=None):
    """A call: its words, one of them at the edge."""
    rng = random.Random(seed)
    commands = every_command(get_command(entry.program()))
    missing = commands.keys() - CALLS.keys()
    assert not missing, f"say in CALLS what a call of {missing} needs"
    every = [
        (command, parameter)
        for command in sorted(commands)
        for parameter in commands[command].params
        if only in (None, command) and command != "list"
    ]
    command, parameter = every[seed % len(every)] if only is None else rng.choice(every)
    words = [word.format(out=f"out{seed}") for word in rng.choice(CALLS[command]).split()]
    owner = next((known[word] for word in words if word in known), known["slider.yaml"])
    options = [other for other in commands[command].params if other.opts[0][0] == "-"]
    for other in rng.sample(options, min(len(options), rng.choice((0, 0, 1, 2)))):
        if other is not parameter and other.opts[0] not in words:
            words += [other.opts[0]]
            words += [] if other.is_flag else [sensible(rng, other, owner)]
    if parameter.opts[0][0] == "-":
        if getattr(parameter, "is_flag", False):
            return [*command.split(), *words, parameter.opts[0]]
        if not parameter.multiple and parameter.opts[0] in words:
            at = words.index(parameter.opts[0])
            del words[at : at + 2]
        for _ in range(rng.choice((1, 1, 1, 2))):
            words += [parameter.opts[0], edge(rng, parameter, owner)]
        return [*command.split(), *words]
    arguments = [p for p in commands[command].params if p.opts[0][0] != "-"]
    words[arguments.index(parameter)] = rng.choice((*FILES, *TEXTS, *NUMBERS))
    if rng.random() < 0.05:
        words.insert(0, rng.choice((*TEXTS, *NUMBERS)))
    return [*command.split(), *words]


def edge(rng, parameter, owner):
    """A value at the edge of what an option takes, or far beyond."""
    if "=" in (parameter.metavar or ""):
        numbers = [rng.choice(NUMBERS) for _ in range(3)]
        value = numbers[0]
        if "VALUES" in parameter.metavar:
            value = rng.choice(RANGES).format(*numbers)
        if rng.random() < 0.15:
            return rng.choice((*TEXTS, *NUMBERS))
        name = rng.choice(owner) if rng.random() < 0.9 else rng.choice(TEXTS)
        return f"{name}={value}"
    kind = rng.random()
    if kind < 0.6:
        return rng.choice(NUMBERS)
    return rng.choice(WORDS) if kind < 0.65 else rng.choice((*TEXTS, *FILES))


def sensible(rng, parameter, owner):
    if "=" in (parameter.metavar or ""):
        return f"{rng.choice(owner[:3])}={rng.choice(('0.5', '1', '0.9:1.1:2'))}"
    return rng.choice((*WORDS, "1", "2", "0.5", "0.01"))


# --- a call in a process of its own ------------------------------------------------------------


def begin(words, place):
    """Become the program (in a process of its own)."""
    os.setpgid(0, 0)
    for number, name in ((1, "stdout"), (2, "stderr")):
        os.dup2(os.open(place / name, os.O_WRONLY | os.O_CREAT, 0o600), number)
    sys.stdout = open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    sys.stderr = open(2, "w", encoding="utf-8", errors="backslashreplace", closefd=False)  # noqa: SIM115
    os.chdir(place / "cwd")
    resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS + 5))
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, size + MEMORY))
    sys.argv = ["crane", *words]
    crane.view.live.live_server._take_requests = lambda *_: None  # serving ends at once
    show = entry._show_warning
    entry._show_warning = lambda message, category, *rest: (
        show(message)
        if issubclass(category, CraneWarning)
        else entry.print_message(f"LEAK {message}")
    )
    status = 0
    try:
        entry.main()
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else 0 if end.code is None else 1
    except BaseException:
        traceback.print_exc()
        status = 99
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(status)


def judge(words, folder):
    """None if a call is well, or what is wrong."""
    with tempfile.TemporaryDirectory() as temporary:
        place = Path(temporary)
        shutil.copytree(folder, place / "cwd", copy_function=copied)
        before = {*(place / "cwd").rglob("*")}
        child = os.fork()
        if not child:
            begin(words, place)
        ended, status, start = 0, 0, time.monotonic()
        while not ended and time.monotonic() - start < PATIENCE:
            ended, status = os.waitpid(child, os.WNOHANG)
            time.sleep(0.01)
        if not ended:
            os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return "waits for ever"
        out, err = ((place / name).read_text(errors="replace") for name in ("stdout", "stderr"))
        if os.WIFSIGNALED(status):
            return f"signal {os.WTERMSIG(status)}: {err[-500:]}"
        left = {*(place / "cwd").rglob("*")} - before
        return wrong(words, os.WEXITSTATUS(status), out, err, left)


def copied(source, target):
    """A copy of a file, also of one that may not be read."""
    if not os.access(source, os.R_OK):
        return os.symlink(source, target)
    return shutil.copy(source, target)


def wrong(words, code, out, err, left):
    if "Traceback" in out + err or code == 99:
        return f"traceback: {err[-900:]}"
    lines = err.splitlines()
    if err and not err.endswith("\n"):
        return f"half a line: {err[-200:]}"
    if code == 2 and words[0] != "check":
        errors = [line for line in lines if line.startswith("error: ")]
        if len(errors) != 1:
            return f"{len(errors)} errors: {err[-500:]}"
        if out:
            return f"speaks before an error: {out[:200]}"
        if left:
            return f"an error leaves {sorted(path.name for path in left)}: {err[-300:]}"
    elif code == 1 and words[0] == "check":
        pass
    elif code not in (0, 2):
        return f"exit status {code}: {err[-300:]}"
    for line in lines:
        if not line.startswith(("error: ", "warning: ")) or not line.isprintable():
            return f"a line on stderr: {line[:300]!r}"
    longest = max(map(len, lines), default=0)
    if longest > LONGEST:
        return f"a line of {longest} characters: {max(lines, key=len)[:100]}"
    if code:
        return None
    told = {"stdout": out}
    for path in left:
        if path.suffix in (".csv", ".md", ".txt", ".yaml", ".urdf", ".xml") and path.is_file():
            told[path.name] = path.read_text(errors="replace")
    for name, text in told.items():
        if found := endless(text, words):
            return f"exit 0, and {name} says {found}"
    return None


FIGURE = re.compile(r"(?<![\w.])(?:nan|[-+]?inf|[-+]?\d[\d.]*e\+?\d+)(?![\w.])", re.IGNORECASE)


def endless(text, words):
    """A line with a figure that no machine has, other than those that were given."""
    given = " ".join(words)
    for line in text.splitlines():
        for figure in FIGURE.findall(line):
            if not abs(float(figure)) < 1e30 and figure not in given:
                return line[:300]
    return None


def main():
    reported = sys.argv[1] == "reported"
    first, count = (0, len(REPORTED)) if reported else map(int, sys.argv[1:3])
    only = sys.argv[3] if len(sys.argv) > 3 else None
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        prepare(folder)
        known = names(folder)
        done = 0
        for seed in range(first, first + count):
            words = REPORTED[seed].split() if reported else draw(seed, known, only)
            if problem := judge(words, folder):
                shown = [word if len(word) < 200 else f"{word[:20]}..." for word in words]
                print(json.dumps({"seed": seed, "call": shown, "wrong": problem}), flush=True)
            done += 1
    print(json.dumps({"done": done}), flush=True)


if __name__ == "__main__":
    main()
