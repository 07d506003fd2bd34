"""Part: calls of crane on the mini forwarder, one sample and stacks, one thread and two."""

import hashlib
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import pinocchio as pin
from multibody import Array
from report import table
from timing import Call, medians

import crane

SAMPLES = 2000
THREAD_SAMPLES = 60_000
NOISE = bytes(16_000_000)  # hashed without Python's lock


def measure(quick: bool) -> list[dict[str, Any]]:
    """Times per sample [s] of each function; gain of a second thread."""
    machine = crane.load("mini_forwarder")
    rounds = 3 if quick else 15
    return [_calls(machine, rounds), _threads(machine, 4 * rounds)]


def motion(count: int) -> tuple[Array, Array]:
    """Coordinates and velocities (N, 3) of a motion through most of the strokes at 1 ms."""
    t = 1e-3 * np.arange(count)[:, None]
    rate, phase = np.array([1.0, 0.7, 0.9]), np.array([0.0, 0.0, 1.5])
    middle, reach = np.array([0.0, 0.015, 0.015]), np.array([1.0, 0.012, 0.012])
    return middle + reach * np.sin(rate * t + phase), reach * rate * np.cos(rate * t + phase)


def _calls(machine: crane.Machine, rounds: int) -> dict[str, Any]:
    q_a, v_a = motion(SAMPLES)
    x = np.zeros_like(q_a)
    random = np.random.default_rng(1).uniform(machine.lower, machine.upper, q_a.shape)
    random[:, 0] = q_a[:, 0]
    closure, dynamics = machine.closure, crane.Dynamics(machine)
    q = closure.solve(q_a)
    v = np.array([closure.gamma(one) @ rate for one, rate in zip(q, v_a, strict=True)])
    functions: dict[str, tuple[Callable[..., Any], tuple[Array, ...]]] = {
        "`closure.solve` along a motion": (closure.solve, (q_a,)),
        "`closure.solve` at random": (closure.solve, (random,)),
        "`closure.gamma`, configuration given": (closure.gamma, (q,)),
        "`Dynamics.forward`": (dynamics.forward, (q_a, v_a, x)),
        "`Dynamics.inverse`": (dynamics.inverse, (q_a, v_a, x)),
        "`Dynamics.mass_matrix`": (dynamics.mass_matrix, (q_a,)),
        "`Dynamics.energy`": (dynamics.energy, (q_a, v_a)),
        "`Dynamics.regressor`": (dynamics.regressor, (q_a, v_a, x)),
    }
    model, data = machine.model, machine.model.createData()
    theirs: dict[str, Call] = {
        "`pin.rnea` of the tree": lambda: [
            pin.rnea(model, data, one, rate, rate) for one, rate in zip(q, v, strict=True)
        ],
        "`pin.normalize`, which does nothing here": lambda: [pin.normalize(model, x) for x in q],
    }
    one: dict[str, Call] = {name: partial(_each, *call) for name, call in functions.items()}
    stack = {name: partial(function, *call) for name, (function, call) in functions.items()}
    times = medians(one | theirs, rounds), medians(stack, rounds)
    return {
        name: {"one": time / SAMPLES, "stack": times[1].get(name, np.nan) / SAMPLES}
        for name, time in times[0].items()
    }


def _each(function: Callable[..., object], arguments: tuple[Array, ...]) -> None:
    for row in zip(*arguments, strict=True):
        function(*row)


def _threads(machine: crane.Machine, rounds: int) -> dict[str, Any]:
    """Work on two threads in the wall time of one, and what the cores give to a hash function."""
    q_a, v_a = motion(THREAD_SAMPLES)
    both = [crane.Dynamics(machine) for _ in range(2)]
    work: dict[str, list[Call]] = {
        "gain": [partial(one.forward, q_a, v_a, 0 * q_a) for one in both],
        "control": [partial(hashlib.sha256, NOISE)] * 2,
    }
    found = {}
    for name, (one, two) in work.items():
        calls: dict[str, Call] = {"one": one, "two": partial(_together, one, two)}
        wall = medians(calls, rounds, time.perf_counter)
        found[name] = 2 * wall["one"] / wall["two"]
    return found


def _together(one: Call, two: Call) -> None:
    other = threading.Thread(target=two)
    other.start()
    one()
    other.join()


def tables(results: Sequence[dict[str, Any]]) -> list[str]:
    """Times per sample, and a line on threads."""
    calls, threads = results
    head = ["mini forwarder, loops closed in each call", "one call [us]", "in a stack [us]"]
    rows = [
        [name, f"{1e6 * times['one']:.2f}",
         f"{1e6 * times['stack']:.2f}" if np.isfinite(times["stack"]) else ""]
        for name, times in calls.items()
    ]  # fmt: skip
    return [
        table(head, rows),
        f"Two threads with a `Dynamics` each do {threads['gain']:.2f} times the work of one in "
        f"the\nsame wall time; a hash function without Python's lock, at that moment, "
        f"{threads['control']:.2f} times.",
    ]
