"""What the use of an engine costs: set-up, calls from Python, steps, memory, lines of code.

    python benchmarks/cost_of_use.py PROBLEM ENGINE

measures one engine in this process and prints JSON. `measure` runs it in two processes: the first
one has an empty cache of machine code or kernels, the other one has what the first one compiled.
"""

import ast
import importlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from engines import ENGINES
from engines.engine import Engine, Simulator, UnsupportedError
from problem import Problem, load_machine, problems
from report import table
from trajectories import available_engines

import crane

PROBLEMS = ("mini_forwarder", "n_four_bar_40")
NAMES = (
    "crane rk4", "pin.constraintDynamics", "pin.lcaba", "MuJoCo RK4", "Exudyn GeneralizedAlpha",
    "Exudyn tree GeneralizedAlpha", "Drake SAP", "MuJoCo Warp RK4", "Newton Kamino",
)  # fmt: skip
STEP = 5e-3  # [s]
COUNTS = (100, 1000)  # steps of a short and a long run
LONG_RUN = 0.05  # CPU time of a short run [s] from which it is enough
ROUNDS = 7
LONG_MEASUREMENT = 5.0  # time [s] after which nothing is repeated
LIMIT = 300  # of a process [s]
USER_CODE = Path(__file__).parent / "user_code"
IMPORTS = {"pydrake": "pydrake.all", "exudyn": "exudyn.utilities", "newton": "newton.solvers"}


def measure(quick: bool) -> list[dict[str, Any]]:
    """Costs of all installed engines on the mini forwarder and, unless quick, the 40-four-bar.

    Returns:
        For each problem and engine: `setup`, `setup_cached` [s], `memory`, `memory_cached` [MB],
        `first`, `thousandth`, `step` [s], or `failure`.
    """
    results = []
    for problem in PROBLEMS[: 1 if quick else None]:
        for engine in available_engines()[0]:
            if engine.name in NAMES:
                results.append(measure_engine(problem, engine.name))
    return results


def measure_engine(problem: str, engine: str) -> dict[str, Any]:
    """Costs of an engine on a problem."""
    with tempfile.TemporaryDirectory() as cache:
        environment = dict(os.environ, XDG_CACHE_HOME=cache, OMP_NUM_THREADS="1")
        found = _run_process(problem, engine, environment)
        again = _run_process(problem, engine, environment) if "failure" not in found else found
        if "failure" in again:
            found = again
        else:
            found |= {f"{key}_cached": again[key] for key in ("setup", "memory")}
            found |= {key: again[key] for key in ("first", "thousandth", "step")}
    return {"problem": problem, "engine": engine} | found


def _run_process(problem: str, engine: str, environment: dict[str, str]) -> dict[str, Any]:
    command = [sys.executable, __file__, problem, engine]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, env=environment, timeout=LIMIT, check=True
        )
    except subprocess.TimeoutExpired:
        return {"failure": f"longer than {LIMIT} s"}
    except subprocess.CalledProcessError as error:
        lines = error.stderr.strip().splitlines()
        return {"failure": lines[-1] if lines else f"ended with {error.returncode}"}
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    """Measure one engine in this process and print JSON."""
    warnings.simplefilter("ignore", crane.CraneWarning)
    problem = replace(problems([sys.argv[1]])[0], duration=COUNTS[0] * STEP)
    engine = next(engine for engine in ENGINES if engine.name == sys.argv[2])
    try:
        found = costs(problem, engine)
    except Exception as error:  # an engine that gives up
        found = {"failure": f"{type(error).__name__}: {error}".splitlines()[0]}
    print(json.dumps(found))


def costs(problem: Problem, engine: Engine) -> dict[str, Any]:
    """Costs of an engine in this process, in which it has not been used yet."""
    importlib.import_module(IMPORTS.get(engine.module, engine.module))
    is_crane = engine.module == "crane"
    if not is_crane:
        _ = problem.system  # other engines do not load the machine by crane
    bare, start = peak_memory(), time.process_time()
    if is_crane:
        load_machine(problem.machine_name)
    load = time.process_time() - start
    setting, simulator, build = first_simulator(problem, engine)
    found = {"setup": load + build}
    found |= call_times(simulator.single_call())
    found["memory"] = peak_memory() - bare
    found["step"] = step_time(problem, engine, setting, simulator)
    return found


def peak_memory() -> float:
    """Largest resident memory of this process until now [MB].

    That of `getrusage` starts with what the process had that started this one.
    """
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:")) / 1024


def first_simulator(problem: Problem, engine: Engine) -> tuple[Any, Simulator, float]:
    """The first setting with the step length that simulates to the end, and its simulator.

    The third value is the CPU time of the first build, which compiles what is compiled [s].

    Raises:
        UnsupportedError: None does.
    """
    times = []
    for setting in settings(problem, engine):
        start = time.process_time()
        simulator = engine.build(problem, setting)
        times.append(time.process_time() - start)
        if len(simulator.states(simulator.run())) == len(problem.times) - 1:
            return setting, simulator, times[0]
    raise UnsupportedError(f"no setting simulates {STEP:g} s steps")


def settings(problem: Problem, engine: Engine) -> Iterator[Any]:
    """Settings with the step length, the last one first: stiff and accurate."""
    for setting in reversed(engine.settings(problem)):
        step = setting[0] if isinstance(setting, tuple) else setting
        if step == STEP:
            yield setting


def call_times(call: Callable[[], object]) -> dict[str, float]:
    """CPU time of the first call, and of one after a thousand, median of 100 [s]."""
    times = []
    for _ in range(1100):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
        if sum(times) > LONG_MEASUREMENT:
            break
    return {"first": times[0], "thousandth": statistics.median(times[-100:])}


def step_time(problem: Problem, engine: Engine, setting: Any, simulator: Simulator) -> float:
    """CPU time of a step in the engine's own loop, without the cost of a run's begin [s]."""
    short = run_time(simulator)
    if short > LONG_RUN:
        return short / COUNTS[0]
    longer = replace(problem, duration=COUNTS[1] * STEP)
    long = run_time(engine.build(longer, setting))
    return (long - short) / (COUNTS[1] - COUNTS[0])


def run_time(simulator: Simulator) -> float:
    """CPU time of a run, the least of several [s]."""
    times = []
    for _ in range(ROUNDS):
        start = time.process_time()
        simulator.run()
        times.append(time.process_time() - start)
        if sum(times) > LONG_MEASUREMENT:
            break
    return min(times)


def code_lines(path: Path) -> int:
    """Lines of a program with code: without blank lines, comments and its docstring."""
    text = path.read_text(encoding="utf-8")
    first = ast.parse(text).body[0]
    lines = [line.strip() for line in text.splitlines()[first.end_lineno :]]
    return sum(bool(line) and not line.startswith(("#", '"""')) for line in lines)


def tables(results: Sequence[dict[str, Any]]) -> list[str]:
    """A table for each problem, and one of the lines of user code."""
    head = ["engine", "set-up [s]", "set-up, cached [s]", "memory [MB]", "memory, cached [MB]",
            "first call [us]", "thousandth call [us]", "step in its own loop [us]"]  # fmt: skip
    parts = []
    for name in dict.fromkeys(found["problem"] for found in results):
        rows = []
        for found in results:
            if found["problem"] != name:
                continue
            if "failure" in found:
                rows.append([found["engine"], *["-"] * (len(head) - 2), found["failure"]])
                continue
            rows.append([
                found["engine"], f"{found['setup']:.2g}", f"{found['setup_cached']:.2g}",
                f"{found['memory']:.0f}", f"{found['memory_cached']:.0f}",
                *(f"{1e6 * found[key]:.3g}" for key in ("first", "thousandth", "step")),
            ])  # fmt: skip
        parts += [f"#### {problems([name])[0].title}", table(head, rows)]
    about = (
        f"Steps of {STEP:g} s. Set-up: from the loaded problem to a simulator, with crane from "
        "the machine file; cached: in a later process. Memory: the peak, less that of the "
        "imports. Call from Python: accelerations by crane and Pinocchio, a step by the others, "
        "a run of one step by Exudyn. Step: Runge-Kutta of order 4 by crane, Pinocchio (in "
        "Python) and MuJoCo; crane's runs of the 40-four-bar pass change points."
    )
    scripts = sorted(USER_CODE.glob("with_*.py"), key=code_lines)
    rows = [[path.stem.removeprefix("with_"), str(code_lines(path))] for path in scripts]
    return [about, *parts, "#### Lines of code for a four-bar", table(["engine", "lines"], rows)]


if __name__ == "__main__":
    main()
