"""What starting costs in the benchmark: processes, tracing and compiling."""

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from measuring import table

import crane
from crane.control import PI
from crane.dynamics.compiled import QUANTITIES
from crane.motion.trajectories import task_trajectory
from crane.simulation.integration import Chart, CompiledStepper


def starts(rounds: int) -> str:
    """A whole process, and compiling each formula; machine code is kept in folders of its own."""

    def process(kept: str | None) -> tuple[float, float]:
        with tempfile.TemporaryDirectory() as folder:
            environment = dict(os.environ, XDG_CACHE_HOME=kept or folder)
            if kept is None:
                environment["PYTHONPYCACHEPREFIX"] = str(Path(folder) / "bytecode")
            words = ["simulate", "mini_forwarder", "--task", "lift", "--out", f"{folder}/run"]
            code = (
                f"import sys; sys.argv = ['crane', *{words}]; import crane.cli; crane.cli.main()"
            )
            before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
            command = [sys.executable, "-c", code]
            subprocess.run(command, check=True, capture_output=True, env=environment)
            wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
        cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        return wall, cpu

    rows = []
    with tempfile.TemporaryDirectory() as kept:
        process(kept)
        for name, cache in (
            ("the first ever, neither Python's bytecode nor machine code kept", None),
            ("any later one", kept),
        ):
            wall, cpu = np.median([process(cache) for _ in range(rounds)], axis=0)
            rows.append((name, f"{wall:.2f}", f"{cpu:.2f}"))
    title = "process `crane simulate mini_forwarder --task lift`"
    processes = table((title, "wall [s]", "CPU [s]"), rows)
    # in processes of their own: machines of equal formulas share their machine code
    with tempfile.TemporaryDirectory() as kept:
        first, later = (_spent(kept) for _ in range(2))
    each = [(name, f"{seconds:.3f}", f"{later[name]:.3f}") for name, seconds in first.items()]
    title = "tracing and compiling, or reading what is kept"
    return f"{processes}\n\n{table((title, 'first time [s]', 'later [s]'), each)}"


def _spent(kept: str) -> dict[str, float]:
    command, environment = [sys.executable, __file__], dict(os.environ, XDG_CACHE_HOME=kept)
    out = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
    return json.loads(out.stdout)


def _compiling() -> Iterator[tuple[str, float]]:
    warnings.simplefilter("ignore", crane.CraneWarning)
    mini = crane.load("mini_forwarder")
    start = time.perf_counter()
    _ = mini.closure.fast
    yield "closing the loops", time.perf_counter() - start
    dynamics, q, zero = crane.Dynamics(mini), mini.home, np.zeros(3)
    for quantity in QUANTITIES:
        start = time.perf_counter()
        dynamics.at(quantity, q, zero, zero)
        yield quantity, time.perf_counter() - start
    control = PI(mini, task_trajectory(mini, "lift"))
    start = time.perf_counter()
    CompiledStepper(Chart.of(dynamics), control, 3)
    yield "the simulation's loop with PI control", time.perf_counter() - start


if __name__ == "__main__":
    print(json.dumps(dict(_compiling())))
