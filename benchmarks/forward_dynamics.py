"""Forward dynamics over the number of joints: crane, Pinocchio's algorithms and MuJoCo.

    python benchmarks/forward_dynamics.py MACHINE --rounds 15

measures one machine in this process and prints JSON; `measure` runs it in a process of its own
with an empty cache, and once more with the cache.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from dense_equations import exact_forward
from engines.mujoco_engine import MuJoCo
from engines.pinocchio_engine import best_forward, sample_states
from multibody import Array, Multibody
from problem import load_machine
from timing import Call, in_turns

import crane

SIZES = {
    "chain": (10, 19, 40, 100, 199),
    "tree": (10, 19, 40, 100, 199),
    "ring": (4, 7, 10, 20, 60),
    "spatial ring": (6, 8, 10, 20, 60),
}
MAX_SAMPLES = 200
SHARE = 0.05  # [s] of a round for each candidate, about
LIMIT = 300  # of a process [s]


def measure(machine: str, rounds: int) -> dict[str, Any]:
    """Times of a machine; `cached` is the first call of a later process [s]."""
    with tempfile.TemporaryDirectory() as cache:
        environment = dict(os.environ, XDG_CACHE_HOME=cache, OMP_NUM_THREADS="1")
        found = _run_process(machine, rounds, environment)
        if "failure" not in found:
            found["cached"] = _run_process(machine, 0, environment)["first"]
    return {"machine": machine} | found


def _run_process(machine: str, rounds: int, environment: dict[str, str]) -> dict[str, Any]:
    command = [sys.executable, __file__, machine, "--rounds", str(rounds)]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, env=environment, timeout=LIMIT, check=True
        )
    except subprocess.TimeoutExpired:
        return {"failure": f"longer than {LIMIT} s"}
    except subprocess.CalledProcessError as error:
        return {"failure": (error.stderr.strip().splitlines() or ["killed"])[-1]}
    return json.loads(done.stdout.splitlines()[-1])


def candidates(
    system: Multibody, dynamics: crane.Dynamics
) -> tuple[dict[str, Call], int, dict[str, Any]]:
    """Calls over all samples, the number of samples, and settings and errors of the peers."""
    active = system.machine.closure.active
    few = sample_states(system, 5)
    start = time.process_time()
    for q, v, tau in few:
        dynamics.forward(q[active], v[active], tau[active])
    count = int(np.clip(5 * SHARE / (time.process_time() - start), 5, MAX_SAMPLES))
    exact = exact_forward(system)
    full = [(q, v, tau + system.joint_forces(q, v)) for q, v, tau in few]
    expected = [exact(*sample) for sample in full]
    told: dict[str, Any] = {}
    own = [dynamics.forward(q[active], v[active], tau[active]) for q, v, tau in few]
    told["crane difference"] = largest_difference(own, [a[active] for a in expected])
    samples = sample_states(system, count)
    samples = samples[::2] + samples[1::2][::-1]  # there and back, without a jump between rounds
    arrays = [np.array(values) for values in zip(*samples, strict=True)]
    q_a, v_a, tau_a = (np.ascontiguousarray(values[:, active]) for values in arrays)
    rows = list(zip(q_a, v_a, tau_a, strict=True))
    samples = [(q, v, tau + system.joint_forces(q, v)) for q, v, tau in samples]
    calls: dict[str, Call] = {
        "crane, one call": lambda: [dynamics.forward(*row) for row in rows],
        "crane, a stack": lambda: dynamics.forward(q_a, v_a, tau_a),
        "crane, closed stack": lambda: dynamics.evaluate_closed("forward", arrays[0], v_a, tau_a),
    }
    for algorithm in ("constraintDynamics", "lcaba"):
        solver, settings = best_forward(system, algorithm, full, expected)
        told |= {f"{algorithm} {key}": value for key, value in settings.items()}
        if settings["difference"] < 1e-6:
            calls[f"pin.{algorithm}"] = peer_call(solver, samples)
    if MuJoCo.version():
        calls["mj_forward"] = mujoco_call(system, samples)
    return calls, count, told


def peer_call(solver: Callable[..., Array], samples: list) -> Call:
    """A call of a solver for each of the samples."""
    return lambda: [solver(*sample) for sample in samples]


def mujoco_call(system: Multibody, samples: list) -> Call:
    """mj_forward for each of the samples, with connections of the largest impedance."""
    import mujoco
    from engines.mujoco_engine import mjcf

    model = mujoco.MjModel.from_xml_string(mjcf(system, "Euler", 1e-3, 2e-3, 0.9999))
    data = mujoco.MjData(model)

    def call() -> None:
        for q, v, tau in samples:
            data.qpos[:], data.qvel[:], data.qfrc_applied[:] = q, v, tau
            mujoco.mj_forward(model, data)

    return call


def largest_difference(found: list[Array], expected: list[Array]) -> float:
    """Largest relative difference of accelerations."""
    return max(
        float(np.abs(one - other).max() / np.abs(other).max())
        for one, other in zip(found, expected, strict=True)
    )


def main() -> None:
    """Measure one machine and print JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("machine")
    parser.add_argument("--rounds", type=int, default=15)
    options = parser.parse_args()
    warnings.simplefilter("ignore", crane.CraneWarning)
    start = time.process_time()
    machine = load_machine(options.machine)
    loaded = time.process_time()
    dynamics = crane.Dynamics(machine)
    active = machine.closure.active
    rest = np.zeros(len(active))
    dynamics.forward(machine.home[active], rest, rest)
    first = time.process_time()
    found: dict[str, Any] = {
        "joints": machine.model.nv,
        "loops": len(machine.closure.equations.loops),
        "freedoms": len(active),
        "backend": dynamics.backend_of("forward"),
        "load": loaded - start,
        "first": first - loaded,
    }
    if options.rounds:
        calls, count, told = candidates(Multibody.from_machine(machine, {}), dynamics)
        times = in_turns(calls, options.rounds)
        found["times"] = {name: statistics.median(t) / count for name, t in times.items()}
        found["spreads"] = {
            name: float(np.subtract(*np.percentile(t, [75, 25])) / np.median(t))
            for name, t in times.items()
        }
        found["settings"] = told
    print(json.dumps(found))


if __name__ == "__main__":
    main()
