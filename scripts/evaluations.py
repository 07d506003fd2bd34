"""Times of single evaluations, steps, tasks and stacks of samples; agreement of all engines."""

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable

import numpy as np
import pinocchio as pin
from benchmark_machine import START, FormulaLoop, Runner, along
from measuring import Call, measure, microseconds, table
from peers import INTEGRATORS, ConstraintDynamics, MuJoCo

import crane
from crane.control import PI, ComputedTorque, ControlLaw, ValveDrive, ValvePD, ZeroForce
from crane.motion.task_trajectories import task_trajectory


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
        "Pinocchio backend": (
            crane.Dynamics(machine, backend="pinocchio").forward(q_a, v_a, rest),
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
        f"from the compiled backend, relative: {', '.join(gaps)} (MuJoCo's in the limit of rigid "
        f"connections; with its largest impedance, 0.9999, it is {give_way:.0e})."
    )


def forward_dynamics(machine: crane.Machine, rounds: int) -> str:
    """One evaluation, over 2,000 states of a motion."""
    q_a, v_a = along(2000)
    tau = np.zeros_like(q_a)
    q = machine.closure.solve(q_a)
    ours, slow = crane.Dynamics(machine), crane.Dynamics(machine, backend="pinocchio")
    samples = list(zip(q_a, v_a, tau, strict=True))
    rates = (ours.evaluate_closed("rates", *sample) for sample in zip(q, v_a, tau, strict=True))
    states = [(x, rate[: machine.model.nv]) for x, rate in zip(q, rates, strict=True)]
    formula = FormulaLoop(ours, q, v_a, tau)
    peer, force = ConstraintDynamics(machine), np.zeros(machine.model.nv)
    model, data = machine.model, machine.model.createData()
    few = samples[:100]
    calls: dict[str, Call] = {
        "compiled backend, formula in a loop of machine code, configuration given": formula.run,
        "the same, called from Python": formula.call_each,
        "compiled backend, a stack (loops closed, everything in machine code)": (
            lambda: ours.forward(q_a, v_a, tau)
        ),
        "compiled backend, one sample called from Python (loops closed)": (
            lambda: [ours.forward(*sample) for sample in samples]
        ),
        "`pin.rnea` of the spanning tree, called from Python": (
            lambda: [pin.rnea(model, data, x, rate, rate) for x, rate in states]
        ),
        "`pin.constraintDynamics`, configuration given, called from Python": (
            lambda: [peer.forward(x, rate, force) for x, rate in states]
        ),
        "`pin.normalize`, which does nothing here, called from Python": (
            lambda: [pin.normalize(model, x) for x, _ in states]
        ),
        "Pinocchio backend, one sample called from Python (loops closed)": (
            lambda: [slow.forward(*sample) for sample in few]
        ),
    }
    counts = dict.fromkeys(calls, len(q_a)) | {list(calls)[-1]: len(few)}
    times = measure(calls, rounds)
    later = "the same in a third process, which finds everything cached, from `machine.home`"
    times[later], counts[later] = _later_process(), 1
    if not np.allclose(formula.out, ours.forward(q_a, v_a, tau), rtol=1e-9):
        raise SystemExit("error: the formula in the loop is not Dynamics.forward")
    return microseconds("forward dynamics", {name: t / counts[name] for name, t in times.items()})


def _later_process() -> float:
    """Time [s] of one forward dynamics in a process that finds results of two earlier ones."""
    code = """
import time, numpy as np, crane
machine = crane.load("mini_forwarder")
dynamics = crane.Dynamics(machine)
q = machine.home[machine.closure.active]
v, tau = np.zeros(len(q)), dynamics.gravity(q)
def once():
    start = time.process_time()
    for _ in range(2000):
        dynamics.forward(q, v, tau)
    return (time.process_time() - start) / 2000
print(np.median([once() for _ in range(15)]))
"""
    command = [sys.executable, "-W", "ignore", "-c", code]
    runs = [subprocess.run(command, capture_output=True, check=True) for _ in range(3)]
    return float(runs[-1].stdout)


def one_step(mini: crane.Machine, bare: crane.Machine, rounds: int) -> str:
    """One step of each integrator at 1 ms."""
    path = task_trajectory(mini, "lift")
    start = path(0.0)
    full, plain = Runner(mini, PI(mini, path), *start[:2]), Runner(bare, ZeroForce(bare), *START)
    q = bare.closure.solve(START[0])
    v = bare.closure.gamma(q) @ START[1]
    engines = {name: MuJoCo(bare, 1e-3, name) for name in INTEGRATORS}

    def theirs(name: str) -> None:
        engines[name].start(q, v)
        engines[name].run(1000)

    calls: dict[str, Call] = {
        "compiled backend, RK4, with friction and PI controllers": lambda: full.run(1e-3, 1000),
        "compiled backend, RK4, springs and dampers only": lambda: plain.run(1e-3, 1000),
        "MuJoCo Euler, springs and dampers only": lambda: theirs("Euler"),
        "MuJoCo implicitfast, springs and dampers only": lambda: theirs("implicitfast"),
        "MuJoCo RK4, springs and dampers only": lambda: theirs("RK4"),
    }
    times = measure(calls, rounds)
    return microseconds("step of 1 ms", {name: t / 1000 for name, t in times.items()})


def task(mini: crane.Machine, rounds: int) -> str:
    """Ten seconds of tasks at 1 ms: from call to recording, over the loop in machine code."""
    valves = crane.load("patu655")
    lift, push = task_trajectory(mini, "lift"), task_trajectory(valves, "push")

    def driven() -> ValveDrive:
        return ValveDrive(valves, ValvePD(valves, push))

    cases: dict[str, tuple[crane.Machine, Callable[[], ControlLaw], crane.motion.Trajectory]] = {
        "`mini_forwarder` lifts, `PI`": (mini, lambda: PI(mini, lift), lift),
        "the same, `ComputedTorque`": (mini, lambda: ComputedTorque(mini, lift), lift),
        "`patu655` pushes on its valves, `ValvePD`": (valves, driven, push),
    }
    rows = []
    for name, (machine, control, path) in cases.items():
        q_a = path.position(0.0)
        runner = Runner(machine, control(), q_a, np.zeros_like(q_a))
        calls: dict[str, Call] = {
            "loop": lambda runner=runner: runner.run(1e-3, 10_000),
            "all": lambda machine=machine, control=control: crane.simulate(
                machine, control(), method=None if machine is valves else "rk4"
            ),
        }
        times = measure(calls, rounds)
        loop, whole = times["loop"], times["all"]
        rows.append(
            (name, f"{loop:.3f}", f"{whole:.3f}", f"{whole / loop:.2f}", f"{10 / whole:.0f}")
        )
    head = ("10 s at 1 ms, with friction", "the loop [s]", "`crane.simulate` [s]", "ratio")
    return table((*head, "times real time"), rows)


STACK = 60_000  # samples, a minute at 1 ms


def stacks(machine: crane.Machine, rounds: int) -> str:
    """Stacks of many samples on one thread."""
    q_a, v_a = along(STACK)
    closure, ours = machine.closure, crane.Dynamics(machine)
    q, rest = closure.solve(q_a), np.zeros_like(q_a)
    random = np.random.default_rng(1).uniform(machine.lower, machine.upper, q_a.shape)
    random[:, 0] = q_a[:, 0]

    times = measure(
        {
            "`closure.solve` along a motion": lambda: closure.solve(q_a),
            "`closure.solve` at random": lambda: closure.solve(random),
            "`closure.gamma`, configurations given": lambda: closure.gamma(q),
            "`Dynamics.forward` along a motion": lambda: ours.forward(q_a, v_a, rest),
            "`Dynamics.regressor` along a motion": lambda: ours.regressor(q_a, v_a, v_a),
        },
        rounds,
    )
    rows = [(name, f"{t:.3f}", f"{1e6 * t / STACK:.2f}") for name, t in times.items()]
    return table((f"{STACK:,} samples, one thread", "time [s]", "per sample [us]"), rows)


def threads(machine: crane.Machine, rounds: int) -> str:
    """The same work on each of two threads, and what the cores deliver to machine code alone."""
    q_a, v_a = along(STACK)
    q, rest = machine.closure.solve(q_a), np.zeros_like(q_a)
    loops = [FormulaLoop(crane.Dynamics(machine), q, v_a, rest) for _ in range(2)]
    both = [crane.Dynamics(machine) for _ in range(2)]
    work: dict[str, list[Call]] = {
        "`Dynamics.forward` of a stack, a `Dynamics` each": [
            lambda dynamics=dynamics: dynamics.forward(q_a, v_a, rest) for dynamics in both
        ],
        "control: the formula in a loop of machine code, without Python": [
            loop.run for loop in loops
        ],
    }
    calls: dict[str, Call] = {}
    for name, (one, two) in work.items():
        calls[f"one {name}"] = one
        calls[f"two {name}"] = lambda one=one, two=two: _together(one, two)
    load = os.getloadavg()[0]
    wall = measure(calls, 8 * rounds, time.perf_counter)
    rows = []
    for name in work:
        alone, together = wall[f"one {name}"], wall[f"two {name}"]
        rows.append((name, f"{alone:.4f}", f"{together:.4f}", f"{2 * alone / together:.2f}"))
    head = f"{STACK:,} samples per thread, wall time"
    result = table((head, "one thread [s]", "two threads [s]", "gain"), rows)
    if load > os.cpu_count() - 0.7:
        result += (
            f"\n\nThe load average was {load:.1f} on {os.cpu_count()} cores, 1 of them "
            "this process: the two threads had to share."
        )
    return result


def _together(one: Call, two: Call) -> None:
    other = threading.Thread(target=two)
    other.start()
    one()
    other.join()
