"""What all first derivatives of forward dynamics take, beside forward dynamics and Pinocchio's."""

import numpy as np
import pinocchio as pin
from measuring import Call, measure, table
from subject import Array, FormulaLoop

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
