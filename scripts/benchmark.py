"""Speed of crane against its peers on the mini forwarder, written as tables and a picture.

All candidates of a table take turns in one process, and medians of CPU time over the rounds are
given. Ratios carry over to other machines, times do not. Needs MuJoCo (extra "bench").

    python scripts/benchmark.py                              # print
    python scripts/benchmark.py --write docs/performance.md  # also into the page, with its picture
"""

import argparse
import dataclasses
import importlib.metadata
import os
import platform
import resource
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pinocchio as pin
from peers import Array, ConstraintDynamics, MuJoCo
from precision import DURATION, Engine, Tip, draw, ratios
from scipy.integrate import solve_ivp

import crane
from crane.control import PI, Free, TracedController
from crane.dynamics.compiled import QUANTITIES
from crane.integration import CompiledStepper, PythonStepper
from crane.kinematics import Kinematics
from crane.paths import task_path

BEGIN, END = "<!-- results: written by scripts/benchmark.py -->", "<!-- end of results -->"
PICTURE = "images/work_precision.png"
STACK = 60_000  # samples, a minute at 1 ms
STEPS = (0.04, 0.03, 0.02, 0.01, 0.005, 0.002, 0.001, 0.0005)  # [s]
START = np.array([0.3, 0.020, 0.010]), np.array([2.0, 0.02, 0.02])
INTEGRATORS = ("Euler", "implicitfast", "RK4")

Call = Callable[[], object]
Clock = Callable[[], float]


def measure(
    calls: dict[str, Call], rounds: int, clock: Clock = time.process_time
) -> dict[str, float]:
    """Median time of each call [s]; they take turns, after one turn that does not count."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for turn in range(rounds + 1):
        for name, call in calls.items():
            start = clock()
            call()
            if turn:
                times[name].append(clock() - start)
    return {name: statistics.median(samples) for name, samples in times.items()}


def table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """As Markdown, numbers to the right."""
    marks = ["---", *["---:"] * (len(head) - 1)]
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, tuple(marks), *rows))


def swinging(machine: crane.Machine) -> crane.Machine:
    """The machine in springs and dampers at its actuators, without friction and end stops.

    Under constant forces the crane falls chaotically, and no two engines could be compared. All
    bodies get a little more inertia, because MuJoCo refuses slender ones.
    """
    model = pin.Model(machine.model)
    for body in range(1, model.njoints):
        inertia = model.inertias[body]
        tensor = inertia.inertia + 1e-7 * np.eye(3)
        model.inertias[body] = pin.Inertia(inertia.mass, inertia.lever, tensor)
    machine = dataclasses.replace(machine, model=model)
    middle = np.array([0.0, 0.015, 0.015])
    weight = crane.Dynamics(machine, path="pinocchio").gravity(middle)
    springs = tuple(
        crane.ForceElement(joint, stiffness=k, rest=float(m + w / k), damping=c)
        for joint, k, c, m, w in zip(
            machine.active, (0.3, 3000.0, 5000.0), (0.02, 40.0, 40.0), middle, weight, strict=True
        )
    )
    return machine.replace(friction={}, forces=springs, end_stops=())


def along(count: int) -> tuple[Array, Array]:
    """Coordinates and velocities (N, 3) of a motion through most of the strokes at 1 ms."""
    t = 1e-3 * np.arange(count)[:, None]
    rate, phase = np.array([1.0, 0.7, 0.9]), np.array([0.0, 0.0, 1.5])
    middle, reach = np.array([0.0, 0.015, 0.015]), np.array([1.0, 0.012, 0.012])
    return middle + reach * np.sin(rate * t + phase), reach * rate * np.cos(rate * t + phase)


class Runner:
    """The simulation's loop in machine code, from one start.

    Args:
        machine: The machine.
        control: Its controller.
        q_a: (n,) start.
        v_a: (n,).
    """

    def __init__(self, machine: crane.Machine, control: TracedController, q_a: Array, v_a: Array):
        own = control.start(q_a)
        self._start = np.concatenate([machine.closure.solve(q_a), v_a, own, np.zeros(2)])
        self._stepper = CompiledStepper(crane.Dynamics(machine), control, len(own))
        self._columns = len(self._start) + 2 * len(v_a) + 2

    def run(self, step: float, steps: int) -> Array:
        """The state after so many steps."""
        state, out = self._start.copy(), np.empty((steps, self._columns))
        done = self._stepper.run(step * np.arange(steps), state, step, out)
        if done < steps:
            raise SystemExit(f"error: the loop stopped at step {done} of {steps}")
        return state


def agree(machine: crane.Machine) -> str:
    """That all engines simulate the same machine: mass, and accelerations at the start."""
    q_a, v_a = START
    active, rest = machine.closure.active, np.zeros(len(q_a))
    q = machine.closure.solve(q_a)
    v = machine.closure.gamma(q) @ v_a
    ours = crane.Dynamics(machine).forward(q_a, v_a, rest)
    # MuJoCo's connections give way by (1 - d) / d, d the impedance: three of them tell the limit
    soft = []
    for impedance in (0.9999, 0.9998, 0.9996):
        engine = MuJoCo(machine, 1e-3, "RK4", impedance)
        engine.start(q, v)
        soft.append(engine.acceleration()[active])
    give = np.array([1e-4 / 0.9999, 2e-4 / 0.9998, 4e-4 / 0.9996])
    others = {
        "Pinocchio path": (
            crane.Dynamics(machine, path="pinocchio").forward(q_a, v_a, rest),
            1e-11,
        ),
        "pin.constraintDynamics": (ConstraintDynamics(machine).acceleration(q, v)[active], 1e-9),
        "MuJoCo": (np.linalg.solve(np.vander(give, increasing=True), np.array(soft))[0], 1e-3),
    }
    mass = sum(inertia.mass for inertia in list(machine.model.inertias)[1:])
    if abs(engine.mass / mass - 1) > 1e-12:
        raise SystemExit(f"error: MuJoCo's crane has {engine.mass} kg, ours {mass} kg")
    gaps = []
    for name, (theirs, bound) in others.items():
        gap = float(np.abs(theirs - ours).max() / np.abs(ours).max())
        if not gap < bound:
            raise SystemExit(f"error: {name} disagrees, {theirs} and {ours}")
        gaps.append(f"{name} {gap:.0e}")
    give_way = np.abs(soft[0] - ours).max() / np.abs(ours).max()
    return (
        f"All engines carry {mass:.4f} kg. Largest difference of their accelerations at the start "
        f"from the compiled path, relative: {', '.join(gaps)} (MuJoCo's in the limit of rigid "
        f"connections; with its largest impedance, 0.9999, it is {give_way:.0e})."
    )


def forward_dynamics(machine: crane.Machine, rounds: int) -> str:
    """One evaluation, over 2,000 states of a motion."""
    q_a, v_a = along(2000)
    tau = np.zeros_like(q_a)
    q = machine.closure.solve(q_a)
    ours, slow = crane.Dynamics(machine), crane.Dynamics(machine, path="pinocchio")
    pairs = zip(q, v_a, tau, strict=True)
    v = np.array([ours.at("rates", *sample)[: machine.model.nv] for sample in pairs])
    samples, states = list(zip(q_a, v_a, tau, strict=True)), list(zip(q, v, strict=True))
    formula = ours._formula("forward")
    constants = formula._fast.geometry.numbers.ctypes.data, formula._numbers.ctypes.data
    inputs, out = np.hstack([v_a, tau]), np.empty(formula.size)
    addresses = [
        (*constants, one.ctypes.data, x.ctypes.data, out.ctypes.data)
        for one, x in zip(q, inputs, strict=True)
    ]
    peer, force = ConstraintDynamics(machine), np.zeros(machine.model.nv)
    model, data = machine.model, machine.model.createData()
    names = (
        "compiled path, a stack (loops closed, everything in machine code)",
        "compiled path, the formula alone, posture given, called through ctypes",
        "compiled path, one sample called from Python (loops closed)",
        "`pin.rnea` of the spanning tree, called from Python",
        "`pin.constraintDynamics`, posture given, called from Python",
        "Pinocchio path, one sample called from Python (loops closed)",
    )
    times = measure(
        {
            names[0]: lambda: ours.forward(q_a, v_a, tau),
            names[1]: lambda: [formula._formula(*address) for address in addresses],
            names[2]: lambda: [ours.forward(*sample) for sample in samples],
            names[3]: lambda: [pin.rnea(model, data, one, rate, rate) for one, rate in states],
            names[4]: lambda: [peer.forward(one, rate, force) for one, rate in states],
            names[5]: lambda: [slow.forward(*sample) for sample in samples[:100]],
        },
        rounds,
    )
    times = {name: t / (100 if name == names[5] else len(q_a)) for name, t in times.items()}
    return _microseconds("forward dynamics", times)


def one_step(mini: crane.Machine, bare: crane.Machine, rounds: int) -> str:
    """One step of each integrator at 1 ms."""
    path = task_path(mini, "lift")
    start = path(0.0)
    full, plain = Runner(mini, PI(mini, path), *start[:2]), Runner(bare, Free(bare), *START)
    q = bare.closure.solve(START[0])
    v = bare.closure.gamma(q) @ START[1]
    engines = {name: MuJoCo(bare, 1e-3, name) for name in INTEGRATORS}

    def theirs(name: str) -> None:
        engines[name].start(q, v)
        engines[name].run(1000)

    calls: dict[str, Call] = {
        "compiled path, RK4, with friction and PI controllers": lambda: full.run(1e-3, 1000),
        "compiled path, RK4, springs and dampers only": lambda: plain.run(1e-3, 1000),
        "MuJoCo Euler, springs and dampers only": lambda: theirs("Euler"),
        "MuJoCo implicitfast, springs and dampers only": lambda: theirs("implicitfast"),
        "MuJoCo RK4, springs and dampers only": lambda: theirs("RK4"),
    }
    times = measure(calls, rounds)
    return _microseconds("step of 1 ms", {name: t / 1000 for name, t in times.items()})


def _microseconds(what: str, times: dict[str, float]) -> str:
    unit = next(iter(times.values()))
    rows = [(name, f"{1e6 * t:.2f}", f"{t / unit:.1f}") for name, t in times.items()]
    return table((what, "time [us]", "ratio"), rows)


def task(mini: crane.Machine, rounds: int) -> str:
    """Ten seconds of the controlled lift at 1 ms."""
    path = task_path(mini, "lift")
    runner = Runner(mini, PI(mini, path), *path(0.0)[:2])
    times = measure(
        {
            "the loop in machine code alone": lambda: runner.run(1e-3, 10_000),
            "`crane.simulate`, from call to recording": lambda: crane.simulate(
                mini, PI(mini, path)
            ),
        },
        rounds,
    )
    rows = [(name, f"{t:.3f}", f"{10 / t:.0f}") for name, t in times.items()]
    return table(("10 s of lifting, PI control and friction", "time [s]", "times real time"), rows)


def stacks(machine: crane.Machine, rounds: int) -> str:
    """Stacks of many samples on one thread."""
    q_a, v_a = along(STACK)
    closure, ours, twin = machine.closure, crane.Dynamics(machine), crane.Dynamics(machine)
    q, rest = closure.solve(q_a), np.zeros_like(q_a)
    random = np.random.default_rng(1).uniform(machine.lower, machine.upper, q_a.shape)
    random[:, 0] = q_a[:, 0]

    def threads() -> None:
        other = threading.Thread(target=twin.forward, args=(q_a, v_a, rest))
        other.start()
        ours.forward(q_a, v_a, rest)
        other.join()

    times = measure(
        {
            "`closure.solve` along a motion": lambda: closure.solve(q_a),
            "`closure.solve` at random": lambda: closure.solve(random),
            "`closure.gamma`, postures given": lambda: closure.gamma(q),
            "`Dynamics.forward` along a motion": lambda: ours.forward(q_a, v_a, rest),
            "`Dynamics.regressor` along a motion": lambda: ours.regressor(q_a, v_a, v_a),
        },
        rounds,
    )
    rows = [(name, f"{t:.3f}", f"{1e6 * t / STACK:.2f}") for name, t in times.items()]
    result = table((f"{STACK:,} samples, one thread", "time [s]", "per sample [us]"), rows)
    if os.getloadavg()[0] > os.cpu_count() - 0.7:
        return result + "\n\nThreads were not measured, the machine was busy."
    calls: dict[str, Call] = {"one": lambda: ours.forward(q_a, v_a, rest), "two": threads}
    wall = measure(calls, 5 * rounds, time.perf_counter)
    return (
        f"{result}\n\nTwo threads with a `Dynamics` each do {2 * wall['one'] / wall['two']:.2f} "
        "times as many samples of `Dynamics.forward` in the same wall time as one."
    )


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
    rows = [(name, f"{seconds:.2f}") for name, seconds in _compiling()]
    return processes + "\n\n" + table(("tracing and compiling", "time [s]"), rows)


def _compiling() -> Iterator[tuple[str, float]]:
    mini = crane.load("mini_forwarder")
    start = time.perf_counter()
    _ = mini.closure.fast
    yield "closing the loops", time.perf_counter() - start
    dynamics, q, zero = crane.Dynamics(mini), mini.home, np.zeros(3)
    for quantity in QUANTITIES:
        start = time.perf_counter()
        dynamics.at(quantity, q, zero, zero)
        yield quantity, time.perf_counter() - start
    control = PI(mini, task_path(mini, "lift"))
    start = time.perf_counter()
    CompiledStepper(dynamics, control, 3)
    yield "the simulation's loop with PI control", time.perf_counter() - start


def engines_of(machine: crane.Machine) -> dict[str, Engine]:
    """What runs for `DURATION` with a step and returns what tells the tip's position then."""
    q_a, v_a = START
    q = machine.closure.solve(q_a)
    v, nq = machine.closure.gamma(q) @ v_a, machine.model.nq
    kinematics, free, peer = Kinematics(machine), Free(machine), ConstraintDynamics(machine)
    fast = Runner(machine, free, q_a, v_a)
    slow = PythonStepper(crane.Dynamics(machine, path="pinocchio"), free)
    mujocos = {(name, h): MuJoCo(machine, h, name) for name in INTEGRATORS for h in STEPS}

    def ours(step: float) -> Tip:
        state = fast.run(step, round(DURATION / step))
        return lambda: kinematics.position_at(state[:nq])

    def pinocchio_path(step: float) -> Tip:
        state = np.concatenate([q, v_a, np.zeros(2)])
        for i in range(round(DURATION / step)):
            rate, _ = slow.observe(i * step, state)
            state = slow.advance(i * step, state, rate, step)
        return lambda: kinematics.position_at(state[:nq])

    def constraints(step: float) -> Tip:
        end = peer.run(q, v, step, round(DURATION / step))
        return lambda: kinematics.position_at(end)

    def mujoco(name: str) -> Engine:
        def run(step: float) -> Tip:
            engine = mujocos[name, step]
            engine.start(q, v)
            engine.run(round(DURATION / step))
            return lambda: engine.tip() if engine.stable else None

        return run

    return {
        "compiled path": ours,
        "Pinocchio path": pinocchio_path,
        "constraintDynamics": constraints,
        **{f"MuJoCo {name}": mujoco(name) for name in INTEGRATORS},
    }


def work_precision(machine: crane.Machine, rounds: int, picture: Path | None) -> str:
    """Tip error after `DURATION` over CPU time."""
    engines = engines_of(machine)
    steps = {step: round(DURATION / step) for step in STEPS}
    reference = engines["compiled path"](2e-5)()
    q_a, v_a = START
    dynamics, none = crane.Dynamics(machine), np.zeros(len(q_a))

    def rate(_: float, state: Array) -> Array:
        x, speed = state[: len(q_a)], state[len(q_a) :]
        return np.concatenate([speed, dynamics.forward(x, speed, none)])

    check = solve_ivp(
        rate, (0, DURATION), np.concatenate([q_a, v_a]), "DOP853", rtol=1e-13, atol=1e-15
    )
    gap = np.abs(Kinematics(machine).position(check.y[: len(q_a), -1]) - reference).max()
    if gap > 1e-11:
        raise SystemExit(f"error: scipy's DOP853 ends {gap:.1e} m from the reference")
    curves: dict[str, list[tuple[float, float, float]]] = {name: [] for name in engines}
    for step in steps:
        if abs(steps[step] * step - DURATION) > 1e-9:
            raise SystemExit(f"error: {step} s does not divide {DURATION} s")
        ends = {name: run(step)() for name, run in engines.items()}
        stable = {name: end for name, end in ends.items() if end is not None}
        calls: dict[str, Call] = {
            name: lambda run=engines[name], step=step: run(step) for name in stable
        }
        times = measure(calls, rounds)
        for name, end in stable.items():
            curves[name].append((step, float(np.abs(end - reference).max()), times[name]))
    if picture is not None:
        draw(curves, picture)
    rows = [
        (
            name,
            *(
                next((f"{e:.0e}, {1e3 * t:.3g}" for h, e, t in points if h == step), "unstable")
                for step in STEPS
            ),
        )
        for name, points in curves.items()
    ]
    head = ("tip error [m], CPU time [ms]", *(f"{1e3 * step:g} ms" for step in STEPS))
    note = (
        "Reference: the compiled path with steps of 0.02 ms; scipy's DOP853 on "
        f"`Dynamics.forward` ends {gap:.0e} m from it."
    )
    return "\n\n".join([table(head, rows), note, table(*ratios(curves))])


def conditions() -> str:
    """What it was measured on."""
    names = ("pin", "mujoco", "numpy", "scipy", "llvmlite")
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in names)
    return (
        f"Measured with Python {platform.python_version()}, {versions} on {platform.system()}, "
        f"{platform.machine()}, {os.cpu_count()} cores, with other work on them as of a load "
        f"average of {os.getloadavg()[0]:.1f}: wall times suffer from it, CPU times hardly."
    )


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=15, help="of short measurements")
    parser.add_argument("--write", type=Path, help="page to put the results into")
    options = parser.parse_args()
    warnings.simplefilter("ignore", crane.CraneWarning)
    mini = crane.load("mini_forwarder")
    bare, few = swinging(mini), max(3, options.rounds // 5)
    picture = options.write and options.write.parent / PICTURE
    parts = [conditions(), agree(bare)]
    for title, part in (
        ("Forward dynamics", lambda: forward_dynamics(bare, options.rounds)),
        ("One step", lambda: one_step(mini, bare, options.rounds)),
        ("A controlled task", lambda: task(mini, few)),
        ("Stacks", lambda: stacks(mini, few)),
        ("Starting", lambda: starts(few)),
        ("Work and precision", lambda: work_precision(bare, few, picture)),
    ):
        parts += [f"### {title}", part()]
        print("\n\n".join(parts[-4:] if title == "Forward dynamics" else parts[-2:]) + "\n")
    if options.write:
        page = options.write.read_text(encoding="utf-8")
        before, rest = page.split(BEGIN)
        _, after = rest.split(END)
        text = "\n\n".join([before + BEGIN, *parts, END + after])
        options.write.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
