"""Measure forward dynamics of one machine and pin.constraintDynamics in a process of its own.

    python scripts/one_machine.py MACHINE --rounds 15

prints the times as JSON: CPU times of loading, of the first call (tracing and compiling, or
reading from the cache), and of a call, the medians of `rounds` turns; with 0 rounds the latter are
omitted.
"""

import argparse
import json
import time
import warnings
from pathlib import Path

import numpy as np
from measuring import Call, turns
from peers import ConstraintDynamics

import crane

MOST = 200  # states of a round
SHARE = 0.1  # [s] of a round for each candidate, about
SETTINGS = [(k, mu) for k in (1, 2, 3, 5, 10) for mu in (1e-4, 1e-6, 1e-8, 1e-10)]
ENOUGH = 1e-9  # relative, of accelerations
Array = np.ndarray
Sample = tuple[Array, Array, Array]


def motion(machine: crane.Machine, count: int) -> list[Sample]:
    """Coordinates, velocities and forces (n,) along a motion about home, every 10 ms.

    Less of it the longer the loops are, so that they can be closed.
    """
    n, random = len(machine.active), np.random.default_rng(1)
    rate, phase = random.uniform(0.5, 1.5, n), random.uniform(0, 2 * np.pi, n)
    turn = 0.01 * np.arange(count)[:, None] * rate + phase
    loops = machine.closure.equations.loops
    home, reach = machine.home[machine.closure.active], min(0.1, len(loops) / machine.model.nv)
    q_a = home + reach * (np.sin(turn) - np.sin(phase))
    tau = 10 * random.normal(size=(count, n))
    return list(zip(q_a, reach * rate * np.cos(turn), tau, strict=True))


def closed(machine: crane.Machine, samples: list[Sample]) -> list[Sample]:
    """The same for all joints: postures, velocities and forces (nv,)."""
    q = machine.closure.solve(np.array([q_a for q_a, _, _ in samples]))
    found = []
    for x, (_, v_a, tau_a) in zip(q, samples, strict=True):
        tau = np.zeros(machine.model.nv)
        tau[machine.closure.active] = tau_a
        found.append((x, machine.closure.gamma(x) @ v_a, tau))
    return found


def gap(machine: crane.Machine, peer: ConstraintDynamics, a_a: Array, full: list[Sample]) -> float:
    """Largest relative difference of accelerations (N, n) of the active joints from a peer's."""
    theirs = np.array([peer.forward(*sample)[machine.closure.active] for sample in full])
    return float(np.max(np.abs(theirs - a_a).max(axis=1) / np.abs(a_a).max(axis=1)))


def suited(
    machine: crane.Machine, a_a: Array, full: list[Sample]
) -> tuple[ConstraintDynamics, dict[str, float]]:
    """The peer with the fewest iterations that agrees, or else the one that differs least.

    Machines whose loops all have one point in common with a plane are closed by that point; where
    this leaves freedoms, by two on the axis.
    """
    rows, loops = machine.model.nv - len(machine.active), machine.closure.equations.loops
    along = (0.0,) if rows <= 2 * len(loops) else (0.0, 0.3)
    best: tuple[float, ConstraintDynamics, dict[str, float]] | None = None
    for iterations, mu in SETTINGS:
        peer = ConstraintDynamics(machine, along, mu, iterations)
        found = gap(machine, peer, a_a, full)
        if best is None or not found >= best[0]:
            told = {"gap": found, "iterations": iterations, "mu": mu, "points": len(along)}
            best = found, peer, told
        if found < ENOUGH:
            break
    assert best is not None
    return best[1:]


def compare(machine: crane.Machine, dynamics: crane.Dynamics, rounds: int) -> dict[str, float]:
    """Times of a call [s] and their ratios to the peer's, medians over rounds in turn.

    `one`: a sample called from Python; `stack`: of a stack; `given`: of a stack of postures that
    are closed already, as the peer gets them.
    """
    few, ours = motion(machine, 5), dynamics.forward
    start = time.process_time()
    a_a = np.array([ours(*sample) for sample in few])
    count = int(np.clip(5 * SHARE / (time.process_time() - start), 5, MOST))
    peer, told = suited(machine, a_a, closed(machine, few))
    samples = motion(machine, count)
    q_a, v_a, tau_a = (np.array(x) for x in zip(*samples, strict=True))
    full = closed(machine, samples)
    q = np.array([x for x, _, _ in full])
    calls: dict[str, Call] = {
        "one": lambda: [ours(*sample) for sample in samples],
        "stack": lambda: ours(q_a, v_a, tau_a),
        "given": lambda: dynamics.evaluate_closed("forward", q, v_a, tau_a),
        "theirs": lambda: [peer.forward(*sample) for sample in full],
    }
    times = {name: np.array(spent) / count for name, spent in turns(calls, rounds).items()}
    ratios = {f"{name} ratio": np.median(times["theirs"] / times[name]) for name in calls}
    return told | {name: np.median(spent) for name, spent in times.items()} | ratios


def main() -> None:
    """Load, compute, and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("machine", type=Path)
    parser.add_argument("--rounds", type=int, default=15)
    options = parser.parse_args()
    warnings.simplefilter("ignore", crane.CraneWarning)
    start = time.process_time()
    machine = crane.load(options.machine)
    loaded = time.process_time()
    dynamics = crane.Dynamics(machine)
    dynamics.forward(*motion(machine, 1)[0])
    found = {
        "joints": machine.model.nv,
        "loops": len(machine.closure.equations.loops),
        "freedoms": len(machine.active),
        "backend": dynamics.backend_of("forward"),
        "load": loaded - start,
        "first": time.process_time() - loaded,
    }
    if options.rounds:
        found |= compare(machine, dynamics, options.rounds)
    print(json.dumps(found))


if __name__ == "__main__":
    main()
