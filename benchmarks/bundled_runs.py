"""Part: simulations of bundled machines, in times faster than real time."""

import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from report import table
from timing import medians

import crane
from crane.control import PI, ComputedTorque, ValveDrive, ValvePD

MINUTE = 60.0  # of levers [s]
TASK = 10.0  # of a task [s]
PAYLOAD = {"payload.mass": 200.0}
FEET = ((1.6, 2.0), (1.6, -2.0), (-1.6, -2.0), (-1.6, 2.0))  # below the carrier, x and y [m]
CARRIER = """\
<robot name="carrier">
  <link name="carrier">
    <inertial>
      <origin xyz="-1 0 -0.3"/>
      <mass value="8000"/>
      <inertia ixx="4000" iyy="20000" izz="22000" ixy="0" ixz="0" iyz="0"/>
    </inertial>
  </link>
  {feet}
</robot>
"""
FOOT = """\
  <link name="foot{i}"/>
  <joint name="to_foot{i}" type="fixed">
    <parent link="carrier"/><child link="foot{i}"/><origin xyz="{x} {y} -1.1"/>
  </joint>
"""
GROUNDS = {
    "supports": "supports: [foot0, foot1, foot2, foot3]\n",
    "contacts": "floating: [z, rx, ry]\nground: {height: -1.11}\n"
    "contacts: [{frame: foot0}, {frame: foot1}, {frame: foot2}, {frame: foot3}]\n",
}
Run = tuple[float, Callable[[], object]]  # duration [s], and what computes it


def measure(quick: bool) -> list[dict[str, Any]]:
    """Simulated time and CPU time [s] of each run."""
    found = []
    for name, (duration, call) in (tasks() | ({} if quick else minutes())).items():
        spent = medians({name: call}, 1 if quick else 3)[name]
        found.append({"run": name, "duration": duration, "time": spent})
    return found


def tasks() -> dict[str, Run]:
    """Controlled tasks of 10 s, recorded every ms."""
    mini, valves = crane.load("mini_forwarder"), crane.load("patu655")
    lift, push = crane.task_trajectory(mini, "lift"), crane.task_trajectory(valves, "push")
    return {
        "`mini_forwarder` lifts, `PI`, friction, `rk4` at 1 ms": (
            TASK, lambda: crane.simulate(mini, PI(mini, lift), method="rk4"),
        ),
        "the same, `ComputedTorque`": (
            TASK, lambda: crane.simulate(mini, ComputedTorque(mini, lift), method="rk4"),
        ),
        "`patu655` pushes on its valves, `ValvePD`, every ms": (
            TASK, lambda: crane.simulate(valves, ValveDrive(valves, ValvePD(valves, push))),
        ),
    }  # fmt: skip


def minutes() -> dict[str, Run]:
    """A minute under levers: all functions to and fro every 6 s, recorded every 10 ms."""
    with tempfile.TemporaryDirectory() as folder:
        machines = on_the_ground(Path(folder))
    return {
        f"{name}, a minute under levers": (MINUTE, partial(_minute, machine))
        for name, machine in machines.items()
    }


def on_the_ground(folder: Path) -> dict[str, crane.Machine]:
    """A crane on its valves, with a grapple, and on a carrier that stands on the ground."""
    grapple = crane.load("patu655_grapple", changes=PAYLOAD)
    feet = "".join(FOOT.format(i=i, x=x, y=y) for i, (x, y) in enumerate(FEET))
    (folder / "carrier.urdf").write_text(CARRIER.format(feet=feet))
    chains = "".join(
        f"  - {{name: {chain.name}, urdf: {chain.urdf}, parent: {chain.parent or 'carrier'}}}\n"
        for chain in crane.load(grapple.path).chains  # without the log's
    )
    text = (
        f"extends: {grapple.path}\nname: standing\nchains:\n"
        f"  - {{name: carrier, urdf: carrier.urdf}}\n{chains}"
    )
    found = {
        "`patu655` on its valves": crane.load("patu655", changes=PAYLOAD),
        "`patu655_grapple`, which hangs on two pins": grapple,
    }
    for ground, keys in GROUNDS.items():
        path = folder / "standing.yaml"
        path.write_text(text + keys)
        found[f"the same on a carrier with four `{ground}`"] = crane.load(path, changes=PAYLOAD)
    return found


def _minute(machine: crane.Machine) -> crane.Recording:
    assert machine.hydraulics is not None
    levers = {
        joint: [(0, 0), (1, 0.2 * (-1) ** k)]
        + [(t, 0.2 * (-1) ** (i + k)) for i, t in enumerate(range(4, 58, 6), 1)]
        for k, joint in enumerate(machine.hydraulics.joints)
    }
    command = crane.joystick(machine, levers)
    return crane.simulate(machine, command, duration=MINUTE, step=1e-2)


def tables(results: Sequence[dict[str, Any]]) -> list[str]:
    """How much faster than real time."""
    rows = [
        [found["run"], f"{1e3 * found['time'] / found['duration']:.3g}",
         f"{found['duration'] / found['time']:.3g}"]
        for found in results
    ]  # fmt: skip
    head = ["run, the whole call of `simulate`", "CPU time per second [ms]", "times real time"]
    return [table(head, rows)]
