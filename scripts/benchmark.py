"""Time of one call, ours and Pinocchio's, on the mini forwarder.

All candidates take turns in one process; medians over the rounds and their ratios to one call of
pin.rnea on the spanning tree are printed as a Markdown table. Ratios carry over to other
machines, times do not.
"""

import argparse
import statistics
import time
import warnings
from collections.abc import Callable

import numpy as np
import pinocchio as pin

import crane


def constraint_dynamics(machine: crane.Machine) -> Callable[..., np.ndarray]:
    """pin.constraintDynamics of the closed machine, with the settings that suit it best."""
    model, data = machine.model, machine.model.createData()
    models, datas = pin.StdVec_RigidConstraintModel(), pin.StdVec_RigidConstraintData()
    for loop in machine.closure.equations.loops:
        one, two = (
            model.frames[machine.frame(name)] for name in (loop.predecessor, loop.successor)
        )
        models.append(
            pin.RigidConstraintModel(
                pin.ContactType.CONTACT_3D,
                model,
                one.parentJoint,
                one.placement,
                two.parentJoint,
                two.placement,
                pin.LOCAL,
            )
        )
    for constraint in models:
        datas.append(constraint.createData())
    pin.initConstraintDynamics(model, data, models, datas)
    settings = pin.ProximalSettings(1e-12, 1e-4, 3)

    def call(q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> np.ndarray:
        return pin.constraintDynamics(model, data, q, v, tau, models, datas, settings)

    return call


def candidates(machine: crane.Machine) -> dict[str, Callable[[], object]]:
    """Calls to compare, all at the same posture and velocities."""
    closure, dynamics = machine.closure, crane.Dynamics(machine)
    q_a, v_a = np.array([0.3, 0.021, 0.012]), np.array([0.5, 0.01, -0.02])
    tau_a = dynamics.inverse(q_a, v_a, np.zeros(3))
    q = closure.solve(q_a)
    v, near = closure.gamma(q) @ v_a, closure.solve(q_a + 1e-5)
    tau = np.zeros(machine.model.nv)
    tau[closure.active] = tau_a
    data, peer = machine.model.createData(), constraint_dynamics(machine)
    ours = dynamics.forward(q_a, v_a, tau_a)
    theirs = peer(q, v, tau)[closure.active]
    if np.abs(ours - theirs).max() > 1e-6 * (1 + np.abs(ours).max()):
        raise SystemExit(f"error: the engines disagree, {ours} and {theirs}")
    return {
        "pin.rnea, spanning tree": lambda: pin.rnea(machine.model, data, q, v, v),
        "pin.constraintDynamics, posture given": lambda: peer(q, v, tau),
        "closure.solve, near guess": lambda: closure.solve(q_a, guess=near),
        "closure.gamma": lambda: closure.gamma(q),
        "Dynamics.inverse": lambda: dynamics.inverse(q_a, v_a, v_a),
        "Dynamics.forward": lambda: dynamics.forward(q_a, v_a, tau_a),
        "Dynamics.regressor": lambda: dynamics.regressor(q_a, v_a, v_a),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=50)
    parser.add_argument("--calls", type=int, default=50, help="per round and candidate")
    options = parser.parse_args()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", crane.CraneWarning)
        calls = candidates(crane.load("mini_forwarder"))
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(options.rounds):
        for name, call in calls.items():
            start = time.perf_counter()
            for _ in range(options.calls):
                call()
            times[name].append((time.perf_counter() - start) / options.calls)
    unit = statistics.median(times["pin.rnea, spanning tree"])
    print("| call | median [us] | ratio |\n| --- | ---: | ---: |")
    for name, samples in times.items():
        median = statistics.median(samples)
        print(f"| {name} | {1e6 * median:.1f} | {median / unit:.1f} |")


if __name__ == "__main__":
    main()
