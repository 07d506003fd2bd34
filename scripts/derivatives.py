"""CPU times of derivatives of forward dynamics and of gradients of motions."""

import time
from collections.abc import Callable

import numpy as np
import pinocchio as pin
from benchmark_machine import Array, FormulaLoop
from measuring import Call, measure, table

import crane
from crane.dynamics.compiled_dynamics import DERIVATIVES_OF

_STATES, _AGAIN = 100, 10  # results that stay in a cache, as one that is used does


def _states(machine: crane.Machine) -> tuple[Array, Array, Array]:
    """Closed postures around home, velocities and forces (N, n)."""
    random, n = np.random.default_rng(0), len(machine.active)
    span = np.minimum(machine.upper - machine.lower, 1.0)
    middle = np.clip(
        machine.home[machine.closure.active], machine.lower + 0.05 * span,
        machine.upper - 0.05 * span,
    )  # fmt: skip
    # a path, which stays within reach
    phases = np.linspace(0.0, 6.0, _STATES)[:, None] + random.uniform(0, 6, n)
    q_a = middle + 0.04 * span * np.sin(phases)
    return machine.closure.solve(q_a), random.normal(size=(_STATES, n)), 10 * q_a


def _again(call: Call) -> Call:
    return lambda: [call() for _ in range(_AGAIN)]


def derivatives(rounds: int) -> str:
    """Of the bundled machines; open arms beside Pinocchio, without the calls from Python."""
    rows = []
    for name in ("mini_forwarder", "patu655", "tx40", "kr300"):
        machine = crane.load(name)
        dynamics = crane.Dynamics(machine)
        q, v_a, tau = _states(machine)
        once = FormulaLoop(dynamics, q, v_a, tau)
        every = FormulaLoop(dynamics, q, v_a, tau, DERIVATIVES_OF + "forward")
        calls: dict[str, Call] = {"once": _again(once.run), "every": _again(every.run)}
        if not machine.closure.equations.loops:
            model, data = machine.model, machine.model.createData()
            theirs: dict[str, Call] = {
                "aba": lambda m=model, d=data, s=(q, v_a, tau): [
                    pin.aba(m, d, *row) for row in zip(*s, strict=True)
                ],
                "theirs": lambda m=model, d=data, s=(q, v_a, tau): [
                    pin.computeABADerivatives(m, d, *row) for row in zip(*s, strict=True)
                ],
                "nothing": lambda m=model, s=q: [pin.normalize(m, row) for row in s],
            }
            calls |= {key: _again(call) for key, call in theirs.items()}
        times = {key: t / (_STATES * _AGAIN) for key, t in measure(calls, rounds).items()}
        row = [name, f"{1e6 * times['once']:.2f}", f"{1e6 * times['every']:.2f}"]
        row.append(f"{times['every'] / times['once']:.1f}")
        if "aba" in times:
            aba, all_of_it = (times[key] - times["nothing"] for key in ("aba", "theirs"))
            row += [f"{1e6 * aba:.2f}", f"{1e6 * all_of_it:.2f}", f"{all_of_it / aba:.1f}"]
        else:
            row += [""] * 3
        rows.append(tuple(row))
    head = (
        "machine", "forward [us]", "with all derivatives [us]", "ratio",
        "`pin.aba` [us]", "`pin.computeABADerivatives` [us]", "ratio",
    )  # fmt: skip
    return table(head, rows)


_OUTPUTS = ("X_lift", "X_tilt", "pressure_X_lift_a", "tip_z")
_MANY = 200  # numbers forwards, a minute


def gradients() -> str:
    """Ten seconds of a crane on two valves, by some of its numbers and by all."""
    machine = crane.load(
        "patu655", changes={"payload.mass": 150.0}, lock={"X_ext": 0.1, "slew": 0.0}
    )
    levers = crane.joystick(machine, "stir")

    def spent(call: Callable[[], object]) -> float:
        call()  # compiles
        start = time.process_time()
        call()
        return time.process_time() - start

    def back(by: list[str] | None) -> crane.simulation.Gradient:
        return crane.simulation.gradient(
            machine,
            levers,
            None,
            10.0,
            functional=lambda _, y: (0.5 * np.sum(y**2), y),
            parameters=by,
            outputs=_OUTPUTS,
        )

    def forwards(by: list[str]) -> object:
        return crane.sensitivities(machine, levers, None, 10.0, parameters=by, outputs=_OUTPUTS)

    every = list(back(None).parameters)
    rows = []
    for count in (6, 50, 200, len(every)):
        some = every[:: len(every) // count][:count]
        took = spent(lambda some=some: back(some))
        ahead = spent(lambda some=some: forwards(some)) if count <= _MANY else 0.0
        row = f"{count}", f"{took:.2f}", f"{ahead:.2f}" if ahead else ""
        rows.append((*row, f"{ahead / took:.1f}" if ahead else ""))
    return table(("numbers", "back [s]", "forwards [s]", "ratio"), rows)
