"""Tip error over time of all engines of the benchmark."""

from pathlib import Path

import numpy as np
from measuring import Call, measure, table
from peers import INTEGRATORS, ConstraintDynamics, MuJoCo
from precision import DURATION, Engine, Tip, draw, ratios
from scipy.integrate import solve_ivp
from subject import START, Array, Runner

import crane
from crane.control import ZeroForce
from crane.motion.kinematics import Kinematics
from crane.simulation.integration import Chart, PythonStepper

STEPS = (0.04, 0.03, 0.02, 0.01, 0.005, 0.002, 0.001, 0.0005)  # [s]


def engines_of(machine: crane.Machine) -> dict[str, Engine]:
    """What runs for `DURATION` with a step and returns what tells the tip's position then."""
    q_a, v_a = START
    q = machine.closure.solve(q_a)
    v, nq = machine.closure.gamma(q) @ v_a, machine.model.nq
    kinematics, free, peer = Kinematics(machine), ZeroForce(machine), ConstraintDynamics(machine)
    fast = Runner(machine, free, q_a, v_a)
    slow = PythonStepper(
        Chart.from_dynamics(crane.Dynamics(machine, backend="pinocchio")), free, 0
    )
    mujocos = {(name, h): MuJoCo(machine, h, name) for name in INTEGRATORS for h in STEPS}

    def ours(step: float) -> Tip:
        state = fast.run(step, round(DURATION / step))
        return lambda: kinematics.position_at_configuration(state[:nq])

    def pinocchio_backend(step: float) -> Tip:
        state = np.concatenate([q, v_a, np.zeros(2)])
        for i in range(round(DURATION / step)):
            rate, _ = slow.observe(i * step, state)
            state = slow.advance(i * step, state, rate, step)
        return lambda: kinematics.position_at_configuration(state[:nq])

    def constraints(step: float) -> Tip:
        end = peer.run(q, v, step, round(DURATION / step))
        return lambda: kinematics.position_at_configuration(end)

    def mujoco(name: str) -> Engine:
        def run(step: float) -> Tip:
            engine = mujocos[name, step]
            engine.start(q, v)
            engine.run(round(DURATION / step))
            return lambda: engine.tip() if engine.stable else None

        return run

    return {
        "compiled backend": ours,
        "Pinocchio backend": pinocchio_backend,
        "constraintDynamics": constraints,
        **{f"MuJoCo {name}": mujoco(name) for name in INTEGRATORS},
    }


def work_precision(machine: crane.Machine, rounds: int, picture: Path | None) -> str:
    """Tip error after `DURATION` over CPU time."""
    engines = engines_of(machine)
    steps = {step: round(DURATION / step) for step in STEPS}
    reference = engines["compiled backend"](2e-5)()
    q_a, v_a = START
    dynamics, none = crane.Dynamics(machine), np.zeros(len(q_a))

    def rate(_: float, state: Array) -> Array:
        x, speed = state[: len(q_a)], state[len(q_a) :]
        return np.concatenate([speed, dynamics.forward(x, speed, none)])

    check = solve_ivp(
        rate, (0, DURATION), np.concatenate([q_a, v_a]), "DOP853", rtol=1e-13, atol=1e-15
    )
    gap = np.abs(Kinematics(machine).position(check.y[: len(q_a), -1]) - reference).max()
    if gap > 1e-11:
        raise SystemExit(f"error: scipy's DOP853 ends {gap:.1e} m from the reference")
    curves: dict[str, list[tuple[float, float, float]]] = {name: [] for name in engines}
    for step in steps:
        if abs(steps[step] * step - DURATION) > 1e-9:
            raise SystemExit(f"error: {step} s does not divide {DURATION} s")
        ends = {name: run(step)() for name, run in engines.items()}
        stable = {name: end for name, end in ends.items() if end is not None}
        calls: dict[str, Call] = {
            name: lambda run=engines[name], step=step: run(step) for name in stable
        }
        times = measure(calls, rounds)
        for name, end in stable.items():
            curves[name].append((step, float(np.abs(end - reference).max()), times[name]))
    if picture is not None:
        draw(curves, picture)
    rows = [
        (
            name,
            *(
                next((f"{e:.0e}, {1e3 * t:.3g}" for h, e, t in points if h == step), "unstable")
                for step in STEPS
            ),
        )
        for name, points in curves.items()
    ]
    head = ("tip error [m], CPU time [ms]", *(f"{1e3 * step:g} ms" for step in STEPS))
    note = (
        "Reference: the compiled backend with steps of 0.02 ms; scipy's DOP853 on "
        f"`Dynamics.forward` ends {gap:.0e} m from it."
    )
    return "\n\n".join([table(head, rows), note, table(*ratios(curves))])
