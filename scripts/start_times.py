"""Starting times in the benchmark: processes, tracing and compiling."""

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from measuring import table

import crane
from crane.control import PI
from crane.description import example_robots
from crane.dynamics.compiled_dynamics import QUANTITIES
from crane.motion.task_trajectories import task_trajectory
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.machine_code_stepper import RungeKuttaStepper

_MAIN = "import sys; sys.argv[0] = 'crane'; import crane.cli; crane.cli.main()"
_FORWARD = (
    "import crane; m = crane.load('mini_forwarder'); q = m.home[m.closure.active]; "
    "crane.Dynamics(m).forward(q, 0 * q, 0 * q)"
)
_RUN = ("simulate", "mini_forwarder", "--task", "lift", "--force", "--out", "run")


def _processes() -> Iterator[tuple[str, tuple[str, ...]]]:
    """What is started, and Python's arguments; the robot's file goes by its full path."""
    yield "`crane --help`", (_MAIN, "--help")
    yield "`crane check ur5_robot.urdf`", (_MAIN, "check", str(example_robots()["ur5_robot"]))
    yield "`crane simulate mini_forwarder --task lift`", (_MAIN, *_RUN)
    yield '`crane.Dynamics(crane.load("mini_forwarder")).forward(...)`', (_FORWARD,)


def starts(rounds: int) -> str:
    """Whole processes, and compiling each formula; what is kept is in folders of its own."""
    with tempfile.TemporaryDirectory() as kept:
        rows = [
            (name, *_both(lambda arguments=arguments: _process(arguments, kept), rounds))
            for name, arguments in _processes()
        ]
    first = _both(lambda: _process((_MAIN, *_RUN), None), rounds)
    rows.append(("the simulation with an empty cache (no bytecode, no machine code)", *first))
    title = "process; bytecode, machine code and results in the cache"
    processes = table((title, "wall [s]", "CPU [s]"), rows)
    # in processes of their own: machines of equal formulas share their machine code
    with tempfile.TemporaryDirectory() as kept:
        first, later = (_spent(kept) for _ in range(2))
    each = [(name, f"{seconds:.3f}", f"{later[name]:.3f}") for name, seconds in first.items()]
    title = "tracing and compiling, or reading from the cache"
    return f"{processes}\n\n{table((title, 'first time [s]', 'later [s]'), each)}"


def _both(run: Callable[[], tuple[float, float]], rounds: int) -> tuple[str, str]:
    """Medians of wall and CPU time, after a run that does not count."""
    run()
    wall, cpu = np.median([run() for _ in range(rounds)], axis=0)
    return f"{wall:.2f}", f"{cpu:.2f}"


def _process(arguments: tuple[str, ...], kept: str | None) -> tuple[float, float]:
    """Wall and CPU time [s]; what Python and crane keep is in a folder, or not there."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(kept or folder)
        environment = dict(os.environ, XDG_CACHE_HOME=str(place))
        environment["PYTHONPYCACHEPREFIX"] = str(place / "bytecode")
        environment.pop("PYTHONDONTWRITEBYTECODE", None)
        before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        command = [sys.executable, "-c", *arguments]
        subprocess.run(command, check=True, capture_output=True, env=environment, cwd=folder)
        wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def _spent(kept: str) -> dict[str, float]:
    command, environment = [sys.executable, __file__], dict(os.environ, XDG_CACHE_HOME=kept)
    out = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
    return json.loads(out.stdout)


def _compiling() -> Iterator[tuple[str, float]]:
    warnings.simplefilter("ignore", crane.CraneWarning)
    mini = crane.load("mini_forwarder")
    start = time.perf_counter()
    _ = mini.closure.compiled_closure
    yield "closing the loops", time.perf_counter() - start
    dynamics, q, zero = crane.Dynamics(mini), mini.home, np.zeros(3)
    for quantity in QUANTITIES:
        start = time.perf_counter()
        dynamics.evaluate_closed(quantity, q, zero, zero)
        yield quantity, time.perf_counter() - start
    control = PI(mini, task_trajectory(mini, "lift"))
    start = time.perf_counter()
    RungeKuttaStepper(Chart.from_dynamics(dynamics, control, 3))
    yield "the simulation's loop with PI control", time.perf_counter() - start


if __name__ == "__main__":
    print(json.dumps(dict(_compiling())))
