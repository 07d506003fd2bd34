"""Stacks of many samples in the benchmark, on one thread and on two."""

import os
import threading
import time

import numpy as np
from measuring import Call, measure, table
from subject import FormulaLoop, along

import crane

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
            "`closure.gamma`, postures given": lambda: closure.gamma(q),
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
