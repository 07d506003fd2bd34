"""Cranes on valves: minutes of levers, compared with scipy, with a grapple and on the ground."""

import tempfile
import time
from pathlib import Path

import numpy as np
from measuring import Call, measure, table

import crane
from crane.simulation.integration.rosenbrock import ROSENBROCK_TOLERANCE

_SAMPLES = 2000
_MINUTE = 60.0  # of levers [s]
_COARSE = 1e-6  # tolerance
_PAYLOAD = {"payload.mass": 200.0}
_FEET = ((1.6, 2.0), (1.6, -2.0), (-1.6, -2.0), (-1.6, 2.0))  # below the carrier, x and y [m]
_CARRIER = """\
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
_FOOT = """\
  <link name="foot{i}"/>
  <joint name="to_foot{i}" type="fixed">
    <parent link="carrier"/><child link="foot{i}"/><origin xyz="{x} {y} -1.1"/>
  </joint>
"""
_SUPPORTS = "supports: [foot0, foot1, foot2, foot3]\n"
_CONTACTS = """\
floating: [z, rx, ry]
ground: {height: -1.11}
contacts: [{frame: foot0}, {frame: foot1}, {frame: foot2}, {frame: foot3}]
"""


def at_work(rounds: int) -> str:
    """Forward dynamics of stacks, and minutes under levers, against the crane without."""
    with tempfile.TemporaryDirectory() as folder:
        machines = _machines(Path(folder))
    stacks = measure({name: _stack(one) for name, one in machines.items()}, 5 * rounds)
    first = next(iter(stacks.values()))
    minutes = [
        measure({name: _minute(one, tolerance) for name, one in machines.items()}, rounds)
        for tolerance in (ROSENBROCK_TOLERANCE, _COARSE)
    ]
    head = "", "forward dynamics of a stack [us]", "ratio", *(
        f"a minute on its valves, tolerance {tolerance:g}: times faster than real time"
        for tolerance in (ROSENBROCK_TOLERANCE, _COARSE)
    )  # fmt: skip
    rows = [
        (name, f"{1e6 * one / _SAMPLES:.2f}", f"{one / first:.2f}")
        + tuple(f"{_MINUTE / times[name]:.0f}" for times in minutes)
        for name, one in stacks.items()
    ]
    return table(head, rows)


def _machines(folder: Path) -> dict[str, crane.Machine]:
    grapple = crane.load("patu655_grapple", changes=_PAYLOAD)
    feet = "".join(_FOOT.format(i=i, x=x, y=y) for i, (x, y) in enumerate(_FEET))
    (folder / "carrier.urdf").write_text(_CARRIER.format(feet=feet))
    chains = "".join(
        f"  - {{name: {chain.name}, urdf: {chain.urdf}, parent: {chain.parent or 'carrier'}}}\n"
        for chain in crane.load(grapple.path).chains  # without the log's
    )
    text = (
        f"extends: {grapple.path}\nname: standing\nchains:\n"
        f"  - {{name: carrier, urdf: carrier.urdf}}\n{chains}"
    )
    found = {
        "`patu655`": crane.load("patu655", changes=_PAYLOAD),
        "`patu655_grapple`, which hangs on two pins": grapple,
    }
    for name, more in (
        ("the same on a carrier with four `supports`", _SUPPORTS),
        ("the same, pitching and rolling on four `contacts`", _CONTACTS),
    ):
        path = folder / "standing.yaml"
        path.write_text(text + more)
        found[name] = crane.load(path, changes=_PAYLOAD)
    return found


def _stack(machine: crane.Machine) -> Call:
    """Forward dynamics along a way near home."""
    dynamics, random = crane.Dynamics(machine), np.random.default_rng(1)
    home = machine.home[machine.closure.active]
    way = 0.02 * np.sin(np.linspace(0, 6, _SAMPLES))[:, None] * random.uniform(0.5, 1, len(home))
    q_a, v_a, tau = home + way, way, np.zeros_like(way)
    return lambda: dynamics.forward(q_a, v_a, tau)


def _minute(machine: crane.Machine, tolerance: float) -> Call:
    """All levers to and fro every 6 s, recorded every 10 ms."""
    levers = {
        joint: [(0, 0), (1, 0.2 * (-1) ** k)]
        + [(t, 0.2 * (-1) ** (i + k)) for i, t in enumerate(range(4, 58, 6), 1)]
        for k, joint in enumerate(machine.hydraulics.joints)
    }
    levers = crane.joystick(machine, levers)
    return lambda: crane.simulate(
        machine, levers, duration=_MINUTE, step=1e-2, tolerance=tolerance
    )


_SHORT = 1.0  # of the minute, for what takes long [s]


def hydraulic_crane(rounds: int) -> str:
    """Time of a minute under levers, all functions, with pressures, spools and pump."""
    machine = crane.load("patu655", changes={"payload.mass": 211.4})
    levers = {
        joint: [(0, 0), *((t, 0.2 * (-1) ** (i + k)) for i, t in enumerate(range(4, 57, 7)))]
        for k, joint in enumerate(machine.hydraulics.joints)
    }
    minute = crane.joystick(machine, levers)

    def spent(duration: float, **options) -> float:
        start = time.process_time()
        crane.simulate(machine, minute, duration=duration, **options)
        return time.process_time() - start

    crane.simulate(machine, minute, duration=0.1)  # compiles
    rows = []
    for step in (1e-3, 1e-2):
        took = sorted(spent(60.0, step=step) for _ in range(rounds))[rounds // 2]
        rows.append((f"crane, recorded every {1e3 * step:g} ms", took, 60.0))
    slow = spent(_SHORT, step=1e-2, backend="pinocchio")
    rows.append(("scipy's BDF on the Pinocchio backend", slow, _SHORT))
    best = rows[0][1] / 60.0
    return table(
        ("", "CPU time per second of work [ms]", "times faster than real time", "ratio"),
        [
            (name, f"{1e3 * took / span:.3g}", f"{span / took:.3g}", f"{took / span / best:.3g}")
            for name, took, span in rows
        ],
    )
