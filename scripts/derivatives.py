"""What all first derivatives of forward dynamics take, beside forward dynamics and Pinocchio's."""

import numpy as np
import pinocchio as pin
from measuring import Call, measure, table
from subject import Array, FormulaLoop

import crane
from crane.dynamics.compiled import SLOPES

_STATES = 1000


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


def derivatives(rounds: int) -> str:
    """Of the bundled machines; open arms beside Pinocchio, without the calls from Python."""
    rows = []
    for name in ("mini_forwarder", "patu655", "tx40", "kr300"):
        machine = crane.load(name)
        dynamics = crane.Dynamics(machine)
        q, v_a, tau = _states(machine)
        once = FormulaLoop(dynamics, q, v_a, tau)
        every = FormulaLoop(dynamics, q, v_a, tau, SLOPES + "forward")
        calls: dict[str, Call] = {"once": once.run, "every": every.run}
        if not machine.closure.equations.loops:
            model, data = machine.model, machine.model.createData()
            calls |= {
                "aba": lambda m=model, d=data, s=(q, v_a, tau): [
                    pin.aba(m, d, *row) for row in zip(*s, strict=True)
                ],
                "theirs": lambda m=model, d=data, s=(q, v_a, tau): [
                    pin.computeABADerivatives(m, d, *row) for row in zip(*s, strict=True)
                ],
                "nothing": lambda m=model, s=q: [pin.normalize(m, row) for row in s],
            }
        times = {key: t / _STATES for key, t in measure(calls, rounds).items()}
        row = [name, f"{1e6 * times['once']:.2f}", f"{1e6 * times['every']:.2f}"]
        row.append(f"{times['every'] / times['once']:.1f}")
        if "aba" in times:
            aba, theirs = times["aba"] - times["nothing"], times["theirs"] - times["nothing"]
            row += [f"{1e6 * aba:.2f}", f"{1e6 * theirs:.2f}", f"{theirs / aba:.1f}"]
        else:
            row += [""] * 3
        rows.append(tuple(row))
    head = (
        "machine", "forward [us]", "with all derivatives [us]", "ratio",
        "`pin.aba` [us]", "`pin.computeABADerivatives` [us]", "ratio",
    )  # fmt: skip
    return table(head, rows)
