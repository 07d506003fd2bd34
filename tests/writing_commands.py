"""Every command that writes, with cheap arguments, and the files that it reads."""

import shutil
import warnings
from pathlib import Path

import numpy as np
import typer
import yaml
from excavators import planar
from hydraulic_rig import COMPENSATED, rig
from test_add_loops import five_bar
from test_section_forces import write as write_boom

import crane
from crane.cli import program
from crane.cli.simulate import add_task_loads, task_control

DATA = Path(__file__).parent / "data"
_HOIST = [
    "digger.urdf",
    "--between",
    "house:0.6,0,0.7",
    "boom:1.9,0,0.3",
    "--bore",
    "0.1",
    "--rod",
    "0.07",
    "--stroke",
    "0.9",
]

# by command: its arguments, and the file or folder that it writes
COMMANDS = {
    "add cylinder": ([*_HOIST, "--out", "result.yaml"], "result.yaml"),
    "add loops": (["bars.urdf", "--out", "result.yaml"], "result.yaml"),
    "breakout": (["excavator", "--out", "result"], "result"),
    "calibrate": (["rig.yaml", "rig.csv", "--fit", "load_x.mass", "--out", "result"], "result"),
    "capacity": (["mini_forwarder", "--step", "0.3", "--out", "result"], "result"),
    "check": (["mine/four_bar.yaml", "--write-home"], "mine/four_bar.yaml"),
    "circuit": (
        ["rig.yaml", "rig.csv", "--joint", "x", "--model", "friction", "--out", "result"],
        "result",
    ),
    "convert": (["four_bar.yaml", "result"], "result"),
    "demo": (["--out", "result"], "result"),
    "design": (
        ["mini_forwarder", "--vary", "link7.mass=0.1~0.2", "--minimise", "mass", "--starts", "1",
         "--processes", "1", "--out", "result"],
        "result",
    ),
    "export": (["mini_forwarder", "--out", "result"], "result"),
    "excite": (
        ["slider_crank.yaml", "--harmonics", "2", "--periods", "1", "--step", "0.1",
         "--out", "result"],
        "result",
    ),
    "identify": (["mini_forwarder", "mini.csv", "--prior", "0.3", "--out", "result"], "result"),
    "import": (["log.csv", "--columns", "columns.txt", "--out", "result.csv"], "result.csv"),
    "modes": (["four_bar.yaml", "--out", "result"], "result"),
    "new": (["fourbar", "--out", "result.yaml"], "result.yaml"),
    "plot": (["run.csv", "--out", "result.png"], "result.png"),
    "power": (["rig.yaml", "rig.csv", "--out", "result"], "result"),
    "sensitivities": (
        ["four_bar.yaml", "--by", "crank_arm.mass", "--duration", "0.01", "--out", "result"],
        "result",
    ),
    "sections": (
        ["boom.yaml", "boom.csv", "--body", "boom", "--out", "result"],
        "result",
    ),
    "settle": (["mine/four_bar.yaml", "--write"], "mine/four_bar.yaml"),
    "simulate": (["four_bar.yaml", "--duration", "0.01", "--out", "result"], "result"),
    "sketch": (["four_bar.yaml", "--out", "result.svg"], "result.svg"),
    "study": (
        ["mini_forwarder", "--vary", "payload.mass=1:2:2", "--measure", "mass",
         "--processes", "1", "--out", "result"],
        "result",
    ),
    "view": (["run.csv", "--no-open", "--out", "result.html"], "result.html"),
    "working-range": (["mini_forwarder", "--out", "result"], "result"),
    "workspace": (["four_bar.yaml", "--samples", "100", "--out", "result"], "result"),
}  # fmt: skip


def writing():
    """Names of the commands that take a place to write to, or write into what they read.

    `draw` writes when its page asks for it, see `test_draw.py`.
    """
    return {
        name
        for name, command in walked(typer.main.get_command(program()))
        if {one.name for one in command.params} & {"out", "force", "write_home"} and name != "draw"
    }


def walked(command, words=()):
    for name, inner in command.commands.items():
        if hasattr(inner, "commands"):
            yield from walked(inner, (*words, name))
        else:
            yield " ".join((*words, name)), inner


def read(folder):
    """Write what the commands read into a folder."""
    for name in ("four_bar", "slider_crank"):
        shutil.copy(DATA / f"{name}.yaml", folder)
        shutil.copytree(DATA / name, folder / name)
    shutil.copytree(DATA / "four_bar", folder / "mine" / "four_bar")
    shutil.copy(DATA / "four_bar.yaml", folder / "mine")
    swing = yaml.safe_load((DATA / "four_bar.yaml").read_text())
    del swing["tasks"]["reach"]
    (folder / "swing.yaml").write_text(yaml.safe_dump(swing))
    (folder / "bars.urdf").write_text(five_bar("closing_foot_1", "closing_foot_2"))
    planar(folder)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        mini = crane.load("mini_forwarder")
        control = task_control(mini, "lift", None)
        crane.simulate(add_task_loads(mini, "lift"), control, step=0.01).to_csv(
            folder / "mini.csv"
        )
        crane.simulate(crane.load(folder / "four_bar.yaml"), duration=0.01).to_csv(
            folder / "run.csv"
        )
        boom = crane.load(write_boom(folder))
        crane.simulate(boom, duration=0.01).to_csv(folder / "boom.csv")
        machine = rig(folder, COMPENSATED, friction={"viscous": 600.0})
        time = np.arange(0.0, 4.0, 0.01)
        signals = {"x": 5.8 + 2.8 * np.array([0.3, -0.3, 0.4, -0.4])[time.astype(int)]}
        run = crane.simulate(
            machine, crane.control.ValveSignals(machine, time, signals), [0.2], 4.0, 0.01
        )
        run.to_csv(folder / "rig.csv")
    (folder / "log.csv").write_text("t,x\n" + "".join(f"{i / 10},{i}\n" for i in range(20)))
    (folder / "columns.txt").write_text("time [s] = t\nx [m] = x\n")
