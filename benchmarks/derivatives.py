"""Part: derivatives of forward dynamics, and gradients of a motion forwards and backwards."""

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

MACHINES = ("mini_forwarder", "patu655", "tx40", "kr300")
SAMPLES = 1000
OUTPUTS = ("X_lift", "X_tilt", "pressure_X_lift_a", "tip_z")
COUNTS = (6, 50)  # of parameters, and then all of them
MAX_FORWARD = 50  # sensitivities of more take long


def measure(quick: bool) -> list[dict[str, Any]]:
    """Times of derivatives [s] for each machine, and of gradients for numbers of parameters."""
    found = [_derivatives(name, 3 if quick else 15) for name in MACHINES[:: 3 if quick else 1]]
    return found if quick else found + _gradients((*COUNTS, None))


def _derivatives(name: str, rounds: int) -> dict[str, Any]:
    """Times per sample; the overhead of a call from Python is taken off Pinocchio's."""
    machine = crane.load(name)
    dynamics = crane.Dynamics(machine)
    q_a, v_a, tau = states(machine)
    calls: dict[str, Call] = {
        "forward": lambda: dynamics.forward(q_a, v_a, tau),
        "derivatives": lambda: dynamics.derivatives("forward", q_a, v_a, tau),
    }
    if not machine.closure.equations.loops:
        model, data = machine.model, machine.model.createData()
        rows = list(zip(q_a, v_a, tau, strict=True))
        calls |= {
            "aba": lambda: [pin.aba(model, data, *row) for row in rows],
            "aba derivatives": lambda: [
                pin.computeABADerivatives(model, data, *row) for row in rows
            ],
            "overhead": lambda: [pin.normalize(model, row) for row in q_a],
        }
    times = {key: value / SAMPLES for key, value in medians(calls, rounds).items()}
    overhead = times.pop("overhead", 0.0)
    theirs = {key: times[key] - overhead for key in ("aba", "aba derivatives") if key in times}
    return {"machine": name} | times | theirs


def states(machine: crane.Machine) -> tuple[Array, Array, Array]:
    """Coordinates about home, velocities and forces (N, n)."""
    random, n = np.random.default_rng(0), len(machine.active)
    span = np.minimum(machine.upper - machine.lower, 1.0)
    lower, upper = machine.lower + 0.05 * span, machine.upper - 0.05 * span
    middle = np.clip(machine.home[machine.closure.active], lower, upper)
    phases = np.linspace(0.0, 60.0, SAMPLES)[:, None] + random.uniform(0, 6, n)
    q_a = middle + 0.04 * span * np.sin(phases)
    return q_a, random.normal(size=(SAMPLES, n)), 10 * q_a


def _gradients(counts: Sequence[int | None]) -> list[dict[str, Any]]:
    """Ten seconds of a crane on two valves, by some of its parameters and by all."""
    changes, lock = {"payload.mass": 150.0}, {"X_ext": 0.1, "slew": 0.0}
    machine = crane.load("patu655", changes=changes, lock=lock)
    levers = crane.joystick(machine, "stir")
    run: dict[str, Any] = {"initial": None, "duration": 10.0, "outputs": OUTPUTS}

    def functional(_: Array, y: Array) -> tuple[float, Array]:
        return 0.5 * float(np.sum(y**2)), y

    backward = partial(crane.simulation.gradient, machine, levers, functional=functional, **run)
    forward = partial(crane.sensitivities, machine, levers, **run)
    every = list(backward().parameters)
    found = []
    for count in counts:
        count = count or len(every)
        some = every[:: len(every) // count][:count]
        times = {"backward": seconds(partial(backward, parameters=some))}
        if count <= MAX_FORWARD:
            times["forward"] = seconds(partial(forward, parameters=some))
        found.append({"parameters": count, **times})
    return found


def seconds(call: Callable[[], object]) -> float:
    """CPU time of a call [s] after one that compiles."""
    call()
    start = time.process_time()
    call()
    return time.process_time() - start


def tables(results: Sequence[dict[str, Any]]) -> list[str]:
    """Derivatives of a call, gradients of a motion."""
    head = [
        "machine", "forward dynamics [us]", "with all derivatives [us]", "ratio",
        "`pin.aba` [us]", "`pin.computeABADerivatives` [us]", "ratio",
    ]  # fmt: skip
    rows = []
    for found in results:
        if "machine" in found:
            cells = [found["machine"], *_pair(found["forward"], found["derivatives"])]
            is_open = "aba" in found
            rows.append(
                [*cells, *(_pair(found["aba"], found["aba derivatives"]) if is_open else [""] * 3)]
            )
    gradients = [
        [f"{found['parameters']}", f"{found['backward']:.2f}",
         f"{found['forward']:.2f}" if "forward" in found else ""]
        for found in results if "parameters" in found
    ]  # fmt: skip
    title = ["parameters of 10 s of `patu655`", "gradient, backwards [s]", "forwards [s]"]
    return [table(head, rows)] + ([table(title, gradients)] if gradients else [])


def _pair(one: float, other: float) -> list[str]:
    return [f"{1e6 * one:.2f}", f"{1e6 * other:.2f}", f"{other / one:.1f}"]
