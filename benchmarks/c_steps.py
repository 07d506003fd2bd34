"""Part: steps of machines written as C against those of the package's machine code."""

import ctypes
import shutil
import subprocess
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from report import table
from timing import in_turns

import crane
from crane.export import InstanceProgram
from crane.export.c_sources import CSources
from crane.simulation.integration.machine_code_stepper import RungeKuttaStepper

STEPS, STEP, INTERVAL = 500, 1e-3, 0.01  # joints of the mini forwarder stick for 0.5 s
FLAGS = ("-fno-math-errno", "-fno-tree-slp-vectorize")  # as in the CMakeLists.txt
NATIVE = ("-march=native", "-ffp-contract=fast", "-mtune=generic")  # as with its CRANE_NATIVE
BUILDS = [
    (*compiler, *flags, *FLAGS)
    for flags in ((), NATIVE)
    for compiler in (("gcc", "-O2"), ("gcc", "-O3"), ("clang", "-O2"))
]
_DRIVER = """
#include "m.h"
int run(m *x, int n, const double *inputs, int k)
{
    int i, j, status = 1;
    for (i = 0; i < n && status == 1; ++i) {
        for (j = 0; j < k; ++j) (&x->@)[j] = inputs[i * k + j];
        STEP
    }
    return status;
}
"""


@dataclass(frozen=True)
class StepTime:
    """Time of a step.

    Attributes:
        machine: The machine.
        method: What is integrated, and how.
        build: Compiler with its flags, or machine code of the package.
        time: Least CPU time of a step, or of an output interval [s].
        ratio: That over the time in the package's machine code.
    """

    machine: str
    method: str
    build: str
    time: float
    ratio: float


class CMachine:
    """A machine in C.

    Args:
        program: The machine.
        step: C code of a step of the instance x, that sets status.
        folder: Folder of its files.
        build: Compiler and flags.
    """

    def __init__(self, program: InstanceProgram, step: str, folder: Path, build: tuple[str, ...]):
        sources = CSources(program, "m")
        driver = _DRIVER.replace("@", sources.first_input()).replace("STEP", step)
        files = {"m.h": sources.header(), "m.c": sources.source(), "driver.c": driver}
        for name, text in files.items():
            (folder / name).write_text(text)
        library = folder / f"{program.machine.name}{''.join(build)}.so"  # one path is loaded once
        command = [*build, "-std=c99", "-shared", "-fPIC", "m.c", "driver.c", "-o", str(library)]
        subprocess.run([*command, "-lm"], cwd=folder, check=True)
        self._library = ctypes.CDLL(str(library))

    def call(self, name: str, *arguments: "np.ndarray | int") -> None:
        """Call a function of the instance, which is the first argument."""
        words = [x if isinstance(x, int) else ctypes.c_void_p(x.ctypes.data) for x in arguments]
        status = getattr(self._library, name)(*words)
        if status != 1:
            raise RuntimeError(f"{name} returns {status}")


def measure(quick: bool = False) -> list[StepTime]:
    """Times of the steps in machine code, and of each compiler that is here."""
    builds = [build for build in BUILDS[: 1 if quick else None] if shutil.which(build[0])]
    with tempfile.TemporaryDirectory() as folder:
        return [
            *forwarder(Path(folder), builds, 3 if quick else 30),
            *valve_crane(Path(folder), builds, 1 if quick else 8),
        ]


def forwarder(folder: Path, builds: list[tuple[str, ...]], rounds: int) -> list[StepTime]:
    """Runge-Kutta steps of `mini_forwarder` with friction, from the same state."""
    program = InstanceProgram(crane.load("mini_forwarder"), quantities=())
    machines = {" ".join(x): CMachine(program, "status = m_advance_fixed(x);", folder, x)
                for x in builds}  # fmt: skip
    if not machines:
        return []
    start = program.defaults.copy()
    at = program.layout.view(start)
    at.step[:] = STEP
    next(iter(machines.values())).call("m_initialize", start)
    stepper, no_inputs = RungeKuttaStepper(program.chart), np.zeros(1)
    stepper.bounds[:] = at.bounds
    program.chart.dynamics.formula_constants[:] = at.dynamics
    state = np.concatenate([getattr(at, part) for part in program.chart.state_layout.parts])
    rows = np.empty((STEPS, stepper.state_layout.size + stepper.output_layout.size))

    def steps_of_package() -> None:
        times = STEP * np.arange(STEPS)
        if stepper.run(times, state.copy(), STEP, rows) != STEPS:
            raise RuntimeError("a step stops")

    calls = {"machine code": steps_of_package}
    for build, machine in machines.items():
        calls[build] = lambda x=machine: x.call("run", start.copy(), STEPS, no_inputs, 0)
    return step_times("mini_forwarder", "Runge-Kutta", calls, rounds, STEPS)


def valve_crane(folder: Path, builds: list[tuple[str, ...]], rounds: int) -> list[StepTime]:
    """Intervals of 10 ms of `patu655` on valves, by Rosenbrock steps, with outputs."""
    machine = crane.load("patu655")
    program, times = InstanceProgram(machine, quantities=()), INTERVAL * np.arange(STEPS + 1)
    spools = program.control.circuit.hydraulics.spools
    moved = {
        name: spool.neutral
        + 0.25 * (spool.full - spool.neutral) * np.sin(3 * times + i) * (times > 0.1)
        for i, (name, spool) in enumerate(spools.items())
    }
    inputs = np.column_stack(list(moved.values()))
    command = crane.control.ValveSignals(machine, times, moved)
    step = "status = m_advance(x); m_update_outputs(x);"
    calls: dict[str, Callable[[], object]] = {
        "machine code": lambda: crane.simulate(machine, command, duration=times[-1], step=INTERVAL)
    }
    first = program.defaults.copy()
    at = program.layout.view(first)
    at.step[:], at.inputs[: inputs.shape[1]] = INTERVAL, inputs[0]
    rest = np.ascontiguousarray(inputs[1:])
    for build in builds:
        in_c = CMachine(program, step, folder, build)
        started = first.copy()
        in_c.call("m_initialize", started)
        calls[" ".join(build)] = lambda x=in_c, start=started: x.call(
            "run", start.copy(), STEPS, rest, rest.shape[1]
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", crane.CraneWarning)
        return step_times("patu655", "valves, Rosenbrock, 10 ms", calls, rounds, STEPS)


def step_times(
    machine: str, method: str, calls: dict[str, Callable[[], object]], rounds: int, steps: int
) -> list[StepTime]:
    """Times of calls in turns, the first of which is the package's machine code."""
    least = {name: min(times) / steps for name, times in in_turns(calls, rounds).items()}
    own = next(iter(least.values()))
    return [StepTime(machine, method, name, x, x / own) for name, x in least.items()]


def tables(rows: list[StepTime]) -> list[str]:
    """Builds down, machines across."""
    methods = dict.fromkeys((x.machine, x.method) for x in rows)
    found = {(x.machine, x.build): x for x in rows}
    head = ["build", *(f"`{name}`, {method}" for name, method in methods)]
    lines = [
        [f"`{build}`" if "-O" in build else build]
        + [f"{1e6 * x.time:.2f} us, {x.ratio:.2f}" for x in (found[m, build] for m, _ in methods)]
        for build in dict.fromkeys(x.build for x in rows)
    ]
    return [table(head, lines)] if rows else ["No C compiler is here."]
