"""Part: starting times of processes, and first calls with and without the cache.

python benchmarks/start_times.py prints the first calls of a process as JSON.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from report import table

import crane
from crane.description import example_robots

MAIN = "import sys; sys.argv[0] = 'crane'; import crane.cli; crane.cli.main()"
FORWARD = (
    "import crane; m = crane.load('mini_forwarder'); q = m.home[m.closure.active]; "
    "crane.Dynamics(m).forward(q, 0 * q, 0 * q)"
)
SIMULATE = (MAIN, "simulate", "mini_forwarder", "--task", "lift", "--force", "--out", "run")


def measure(quick: bool) -> list[dict[str, Any]]:
    """Wall and CPU times of processes [s], and first calls in two processes one after another."""
    rounds = 1 if quick else 5
    processes: dict[str, tuple[str, ...]] = {
        "`crane --help`": (MAIN, "--help"),
        "`crane check ur5_robot.urdf`": (MAIN, "check", str(example_robots()["ur5_robot"])),
        "`crane simulate mini_forwarder --task lift`": SIMULATE,
        '`crane.Dynamics(crane.load("mini_forwarder")).forward(...)`': (FORWARD,),
    }
    found = []
    with tempfile.TemporaryDirectory() as cache:
        for name, arguments in processes.items():
            _spent(arguments, Path(cache))
            found.append(_medians(name, [_spent(arguments, Path(cache)) for _ in range(rounds)]))
    empty = "the simulation with an empty cache (no bytecode, no machine code)"
    runs = []
    for _ in range(min(rounds, 3)):
        with tempfile.TemporaryDirectory() as cache:
            runs.append(_spent(SIMULATE, Path(cache)))
    found.append(_medians(empty, runs))
    with tempfile.TemporaryDirectory() as cache:
        first, later = (_first_calls(cache) for _ in range(2))
    return found + [
        {"call": name, "first": seconds, "later": later[name]} for name, seconds in first.items()
    ]


def _medians(name: str, times: Sequence[tuple[float, float]]) -> dict[str, Any]:
    wall, cpu = np.median(times, axis=0)
    return {"process": name, "wall": float(wall), "cpu": float(cpu)}


def _spent(arguments: Sequence[str], cache: Path) -> tuple[float, float]:
    """Wall and CPU time [s] of a process; what Python and crane keep is in a folder."""
    environment = dict(os.environ, XDG_CACHE_HOME=str(cache))
    environment["PYTHONPYCACHEPREFIX"] = str(cache / "bytecode")
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    with tempfile.TemporaryDirectory() as folder:
        before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        command = [sys.executable, "-c", *arguments]
        subprocess.run(command, check=True, capture_output=True, env=environment, cwd=folder)
        wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def _first_calls(cache: str) -> dict[str, float]:
    command, environment = [sys.executable, __file__], dict(os.environ, XDG_CACHE_HOME=cache)
    out = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
    return json.loads(out.stdout)


def first_calls() -> Iterator[tuple[str, float]]:
    """Names and CPU times [s] of first calls in this process."""
    machine = crane.load("mini_forwarder")
    dynamics = crane.Dynamics(machine)
    q_a, zero = machine.home[machine.closure.active], np.zeros(3)
    calls: dict[str, Callable[[], object]] = {
        "`closure.solve`": lambda: machine.closure.solve(q_a + 1e-3),
        "`Dynamics.inverse`": lambda: dynamics.inverse(q_a, zero, zero),
        "`Dynamics.forward`": lambda: dynamics.forward(q_a, zero, zero),
        "`Dynamics.mass_matrix`": lambda: dynamics.mass_matrix(q_a),
        "`Dynamics.regressor`": lambda: dynamics.regressor(q_a, zero, zero),
        "`simulate` of 10 s with PI control": lambda: crane.simulate(
            machine, crane.PI(machine, crane.task_trajectory(machine, "lift")), method="rk4"
        ),
    }
    for name, call in calls.items():
        start = time.process_time()
        call()
        yield name, time.process_time() - start


def tables(results: Sequence[dict[str, Any]]) -> list[str]:
    """Processes, and first calls."""
    processes = [
        [found["process"], f"{found['wall']:.2f}", f"{found['cpu']:.2f}"]
        for found in results if "process" in found
    ]  # fmt: skip
    calls = [
        [found["call"], f"{found['first']:.3f}", f"{found['later']:.3f}"]
        for found in results if "call" in found
    ]  # fmt: skip
    title = "process; bytecode, machine code and results in the cache"
    first = "first call in a process"
    return [
        table([title, "wall [s]", "CPU [s]"], processes),
        table([first, "with an empty cache [s]", "in a later process [s]"], calls),
    ]


if __name__ == "__main__":
    warnings.simplefilter("ignore", crane.CraneWarning)
    print(json.dumps(dict(first_calls())))
