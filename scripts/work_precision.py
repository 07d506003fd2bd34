"""Tip error over CPU time of all engines: table, interpolation and figure."""

from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl
import numpy as np
from benchmark_machine import START, Array, Runner
from matplotlib.figure import Figure
from measuring import Call, measure, table
from peers import INTEGRATORS, ConstraintDynamics, MuJoCo
from scipy.integrate import solve_ivp

import crane
from crane.control import ZeroForce
from crane.motion.kinematics import Kinematics
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.python_stepper import PythonStepper
from crane.view.plots.figure_style import FIGURE_STYLE, INK_COLOUR, RECORDED_COLOUR

Tip = Callable[[], np.ndarray | None]  # its position (3,) [m], None if unstable
Engine = Callable[[float], Tip]  # runs with a step [s]
Curves = dict[str, list[tuple[float, float, float]]]  # (step [s], tip error [m], time [s])

DURATION = 2.4  # [s], a whole number of each step
LOOKS = {
    "compiled backend": (RECORDED_COLOUR, "o"),
    "Pinocchio backend": ("#7fb0e0", "s"),
    "constraintDynamics": ("#3c8c4a", "^"),
    "MuJoCo Euler": ("#b9b9b9", "v"),
    "MuJoCo implicitfast": ("#e0a060", "D"),
    "MuJoCo RK4": ("#c8501a", "P"),
}


def time_for(points: list[tuple[float, float, float]], error: float) -> float | None:
    """Least time [s] in which an engine gets below an error, None if it never does.

    Times between two steps are interpolated on logarithmic scales; an error above that of the
    longest step takes the time of the longest step.
    """
    frontier: list[tuple[float, float]] = []
    for _, e, t in sorted(points, key=lambda point: point[2]):
        if not frontier or e < frontier[-1][0]:
            frontier.append((e, t))
    if not frontier or frontier[-1][0] > error:
        return None
    if frontier[0][0] <= error:
        return frontier[0][1]
    errors, times = np.log(frontier[::-1]).T
    return float(np.exp(np.interp(np.log(error), errors, times)))


def ratios(curves: Curves) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Head and rows of a table: times of all engines at equal errors, relative to the first."""
    ours, *others = curves
    head = ("tip error", f"{ours} [ms]", *(f"{name}, ratio" for name in others))
    rows = []
    for power in range(-4, -12, -1):
        own = time_for(curves[ours], 10.0**power)
        if own is None:
            break
        row = [f"1e{power} m", f"{1e3 * own:.3g}"]
        for name in others:
            theirs = time_for(curves[name], 10.0**power)
            row.append("not reached" if theirs is None else f"{theirs / own:.0f}")
        rows.append(tuple(row))
    return head, rows


def draw(curves: Curves, path: Path) -> None:
    """The curves as a picture."""
    with mpl.rc_context(FIGURE_STYLE):
        figure = Figure(figsize=(7.2, 4.4), layout="constrained")
        axes = figure.add_subplot()
        for name, points in curves.items():
            colour, marker = LOOKS[name]
            _, errors, times = np.array(points).T
            axes.loglog(1e3 * times, errors, marker + "-", color=colour, ms=5, label=name)
        first = curves["compiled backend"]
        for step, error, t in first:
            axes.annotate(
                f"{1e3 * step:g} ms", (1e3 * t, error), (-5, -3), textcoords="offset points",
                ha="right", va="top", color=INK_COLOUR, fontsize=7,
            )  # fmt: skip
        axes.set(
            xlabel="CPU time [ms]",
            ylabel=f"error of the tip after {DURATION:g} s [m]",
            title=f"{DURATION:g} s of the mini forwarder in springs and dampers",
        )
        low = min(t for _, _, t in first)
        axes.set_xlim(left=1e3 * low / 3)
        figure.legend(loc="outside right upper")
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=160)


STEPS = (0.04, 0.03, 0.02, 0.01, 0.005, 0.002, 0.001, 0.0005)  # [s]


def engines_of(machine: crane.Machine) -> dict[str, Engine]:
    """What runs for `DURATION` with a step and returns what tells the tip's position then."""
    q_a, v_a = START
    q = machine.closure.solve(q_a)
    v, nq = machine.closure.gamma(q) @ v_a, machine.model.nq
    kinematics, free, peer = Kinematics(machine), ZeroForce(machine), ConstraintDynamics(machine)
    fast = Runner(machine, free, q_a, v_a)
    slow = PythonStepper(
        Chart.from_dynamics(crane.Dynamics(machine, backend="pinocchio"), free, 0)
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
