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
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pinocchio as pin
from dense_equations import exact_forward
from engines.mujoco_engine import MuJoCo
from engines.pinocchio_engine import best_forward, sample_states
from multibody import Array, Multibody
from problem import THIRD_PARTY, load_machine
from scipy.linalg.blas import dsymm
from scipy.linalg.lapack import dposv

import crane

SIZES = {
    "chain": (10, 19, 40, 100, 199),
    "tree": (10, 19, 40, 100, 199),
    "ring": (4, 7, 10, 20, 60),
    "spatial ring": (6, 8, 10, 20, 60),
}
QUICK = ("chain 10", "ring 7", "mini_forwarder/mini_forwarder.yaml")
THIRD_PARTY_START = 0.8  # [rad]: grbda's four-bars are flat at zero, where branches meet
MAX_SAMPLES = 200
SHARE = 0.05  # [s] of a round for each candidate, about
LIMIT = 300  # of a process [s]
MAX_DIFFERENCE = 1e-6  # of an engine's accelerations or forces, relative: beyond, it has no time
Call = Callable[[], object]
Calls = tuple[dict[str, Call], int, dict[str, Any]]


def machines(quick: bool) -> list[str]:
    """Names of the machines: the mini forwarder, our families, and grbda's where they are."""
    if quick:
        return list(QUICK)
    families = [f"{family} {joints}" for family, sizes in SIZES.items() for joints in sizes]
    files = sorted((THIRD_PARTY / "grbda").glob("*.urdf"))
    if not files:
        print("grbda's machines are left out: there is no ../shared/data/third_party/grbda")
    return [QUICK[-1], *families, *(f"third_party/grbda/{path.name}" for path in files)]


def measure(machine: str, rounds: int) -> dict[str, Any]:
    """Times of a machine; `cached` is the first call of a later process [s]."""
    with tempfile.TemporaryDirectory() as cache:
        found = run_process(__file__, machine, rounds, cache)
        if "failure" not in found:
            found["cached"] = run_process(__file__, machine, 0, cache)["first"]
    return {"machine": machine} | found


def run_process(script: str, machine: str, rounds: int, cache: str) -> dict[str, Any]:
    """What a script of one machine prints, or why there is nothing.

    Args:
        script: Whose `main` is the one below.
        machine: Its argument.
        rounds: Of calls, 0 for none.
        cache: Folder of the cache.
    """
    environment = dict(os.environ, XDG_CACHE_HOME=cache, OMP_NUM_THREADS="1")
    command = [sys.executable, script, machine, "--rounds", str(rounds)]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, env=environment, timeout=LIMIT, check=True
        )
    except subprocess.TimeoutExpired:
        return {"failure": f"longer than {LIMIT} s"}
    except subprocess.CalledProcessError as error:
        return {"failure": (error.stderr.strip().splitlines() or ["killed"])[-1]}
    return json.loads(done.stdout.splitlines()[-1])


def candidates(system: Multibody, dynamics: crane.Dynamics) -> Calls:
    """Calls over all samples, the number of samples, and settings and errors of the peers."""
    active = system.machine.closure.active
    few = sample_states(system, 5)
    own, count = timed_samples(dynamics.forward, [tuple(x[active] for x in row) for row in few])
    full = peer_samples(system, few)
    exact = exact_forward(system)
    expected = [exact(*sample) for sample in full]
    told = {"crane difference": largest_difference(own, [a[active] for a in expected])}
    samples = there_and_back(sample_states(system, count))
    q, v_a, tau_a = stacks(samples, active)
    rows = list(zip(q[:, active], v_a, tau_a, strict=True))
    q_a = np.ascontiguousarray(q[:, active])
    calls: dict[str, Call] = {
        "crane, one call": lambda: [dynamics.forward(*row) for row in rows],
        "crane, a stack": lambda: dynamics.forward(q_a, v_a, tau_a),
        "crane, closed stack": lambda: dynamics.evaluate_closed("forward", q, v_a, tau_a),
    }
    samples = peer_samples(system, samples)
    for name, (solver, settings) in peer_solvers(system, full, expected).items():
        told |= {f"{name} {key}": value for key, value in settings.items()}
        if settings["difference"] < MAX_DIFFERENCE:
            calls[f"pin.{name}"] = peer_call(solver, samples)
    if MuJoCo.version():
        try:
            calls["mj_forward"] = mujoco_call(system, samples)
        except ValueError as error:
            told["mj_forward failure"] = str(error)
    return calls, count, told


def timed_samples(call: Callable, few: Sequence[tuple[Array, ...]]) -> tuple[list[Array], int]:
    """Results of a call for a few samples, and how many of them fill the share of a round."""
    start = time.process_time()
    found = [call(*sample) for sample in few]
    needed = (time.process_time() - start) / len(few)
    return found, int(np.clip(SHARE / needed, 5, MAX_SAMPLES))


def there_and_back(samples: list) -> list:
    """The same samples in an order without a jump between rounds."""
    return samples[::2] + samples[1::2][::-1]


def stacks(samples: list, active: Array) -> tuple[Array, Array, Array]:
    """Stacks of all coordinates (N, n), and of the active joints' velocities and third values."""
    q, v, x = (np.array(values) for values in zip(*samples, strict=True))
    return q, np.ascontiguousarray(v[:, active]), np.ascontiguousarray(x[:, active])


def peer_samples(system: Multibody, samples: list) -> list:
    """Pinocchio's configurations, velocities, and forces with those of springs and dampers."""
    return [(system.configuration(q), v, tau + system.joint_forces(q, v)) for q, v, tau in samples]


def peer_solvers(
    system: Multibody, samples: list, expected: list[Array]
) -> dict[str, tuple[Callable[..., Array], dict[str, Any]]]:
    """Solvers of Pinocchio with their settings and differences."""
    if not len(system.couplings):
        return {
            algorithm: best_forward(system, algorithm, samples, expected)
            for algorithm in ("constraintDynamics", "lcaba")
        }
    if system.loops:
        return {}
    solver = coupled_forward(system)
    difference = largest_difference([solver(*sample) for sample in samples], expected)
    return {"crba": (solver, {"difference": difference})}


def coupled_forward(system: Multibody) -> Callable[..., Array]:
    """Forward dynamics of couplings without loops: (G' M G) a_A = G' (tau - h) with constant G.

    Neither constraintDynamics nor lcaba has couplings; mass matrix and bias are as in Pinocchio's
    example mimic_dynamics.py.
    """
    model, data = system.model, system.model.createData()
    gamma = np.asfortranarray(system.machine.closure.gamma(system.q))

    def forward(q: Array, v: Array, tau: Array) -> Array:
        mass = pin.crba(model, data, q)  # its upper triangle
        right = gamma.T @ (tau - pin.nonLinearEffects(model, data, q, v))
        return gamma @ dposv(gamma.T @ dsymm(1.0, mass, gamma), right)[1]

    return forward


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


def in_turns(calls: dict[str, Call], rounds: int) -> dict[str, list[float]]:
    """CPU times of each call [s]; they take turns, after one turn that does not count."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for turn in range(rounds + 1):
        for name, call in calls.items():
            start = time.process_time()
            call()
            if turn:
                times[name].append(time.process_time() - start)
    return times


def main(quantity: str, prepare: Callable[[Multibody, crane.Dynamics], Calls]) -> None:
    """Measure one machine and print JSON.

    Args:
        quantity: "forward" or "inverse".
        prepare: Gives the calls.
    """
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
    getattr(dynamics, quantity)(machine.home[active], rest, rest)
    first = time.process_time()
    found: dict[str, Any] = {
        "joints": machine.model.nv,
        "loops": len(machine.closure.equations.loops),
        "freedoms": len(active),
        "backend": dynamics.backend_of(quantity),
        "load": loaded - start,
        "first": first - loaded,
    }
    if options.rounds:
        start = THIRD_PARTY_START if options.machine.startswith("third_party/") else 0.0
        calls, count, told = prepare(Multibody.from_machine(machine, {}, start), dynamics)
        times = in_turns(calls, options.rounds)
        found["times"] = {name: statistics.median(t) / count for name, t in times.items()}
        found["spreads"] = {
            name: float(np.subtract(*np.percentile(t, [75, 25])) / np.median(t))
            for name, t in times.items()
        }
        found["settings"] = told
    print(json.dumps(found))


if __name__ == "__main__":
    main("forward", candidates)
