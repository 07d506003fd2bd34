"""What starting costs in the benchmark: processes, tracing and compiling."""

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
from crane.simulation.integration import CompiledStepper


def starts(rounds: int) -> str:
    """A whole process, and compiling each formula."""

    def process(cache: str | None) -> tuple[float, float]:
        with tempfile.TemporaryDirectory() as folder:
            environment = dict(os.environ)
            if cache is not None:
                environment["PYTHONPYCACHEPREFIX"] = str(Path(folder) / cache)
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
    for name, cache in (
        ("the first ever, Python's bytecode not yet cached", "cache"),
        ("any later one", None),
    ):
        wall, cpu = np.median([process(cache) for _ in range(rounds)], axis=0)
        rows.append((name, f"{wall:.2f}", f"{cpu:.2f}"))
    title = "process `crane simulate mini_forwarder --task lift`"
    processes = table((title, "wall [s]", "CPU [s]"), rows)
    # in a process of its own: machines of equal formulas share their machine code
    command = [sys.executable, __file__]
    compiling = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return f"{processes}\n\n{compiling.strip()}"


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
    CompiledStepper(dynamics, control, 3)
    yield "the simulation's loop with PI control", time.perf_counter() - start


if __name__ == "__main__":
    rows = [(name, f"{seconds:.2f}") for name, seconds in _compiling()]
    print(table(("tracing and compiling", "time [s]"), rows))
