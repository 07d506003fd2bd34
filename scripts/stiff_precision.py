"""Work and precision of the methods on stiff machines, times over errors: figure and table.

All methods run in one process on one computer; only ratios are significant. Errors are those of
recorded coordinates, in rad and characteristic lengths, against DOP853 with a tolerance of 1e-13.
The overhead of a call (reading its arguments, checking the result) is measured separately by a run
of a nanosecond.
"""

import argparse
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

import crane
from crane.common.samples import Array
from crane.control import ZeroForce
from crane.machine import Machine

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from benchmark_mechanisms import governor  # noqa: E402

OURS, SCIPYS = ("DOP853", "Radau", "rosenbrock"), ("Radau", "BDF", "LSODA")
TOLERANCES = {
    "ours": (1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 3e-11, 1e-11),
    "scipy": (1e-4, 1e-6, 1e-8, 1e-10),
}
NOTHING = 1e-9  # [s], a run without steps to speak of
STEPS = (1e-3, 5e-4, 2e-4, 1e-4, 5e-5, 2e-5)  # [s] of rk4
Problem = tuple[Machine, Callable[[], object], tuple[Array, Array], float, float]


class InPython:
    """A law that cannot be traced, so that a method is scipy's."""

    def __init__(self, law: object):
        self._law = law
        self.reference = getattr(law, "reference", None)

    def start(self, q_a: Array) -> Array:
        """See `Controller`."""
        return self._law.start(q_a)

    def __call__(self, *seen: object) -> tuple[Array, Array]:
        """See `Controller`."""
        return self._law(*seen)


def problems(folder: Path) -> dict[str, Problem]:
    """Machines, laws, starts, durations and recorded steps."""
    flyballs = governor(folder)
    mini = crane.load("mini_forwarder").replace(friction={})
    path = crane.task_trajectory(mini, "return")
    mass = crane.Dynamics(mini).mass_matrix(path.position(0.0)).diagonal()
    fast = 2 * np.pi * 1000.0
    gains = {
        joint: crane.description.PIGains(float(m) * fast**2, float(m) * fast**2 * 10.0)
        for joint, m in zip(mini.active, mass, strict=True)
    }
    damped = mini.replace(
        forces=tuple(
            crane.description.ForceElement(joint, damping=float(2 * m * fast))
            for joint, m in zip(mini.active, mass, strict=True)
        )
    )
    hit = mini.replace(end_stops=(crane.description.EndStop("X1", 1e9, 0.5),))
    law = ZeroForce
    return {
        "flyball governor, 10 s": (
            flyballs, lambda: law(flyballs),
            (flyballs.home[flyballs.closure.active], np.array([2 * np.pi, 0.0])), 10.0, 1e-2,
        ),
        "PI loop of 1 kHz, 10 s": (
            damped, lambda: crane.PI(damped, path, gains), path(0.0)[:2], 10.0, 5e-2,
        ),
        "stop of 1e9 N/m hit at 1 m/s, 4 ms": (
            hit, lambda: law(hit),
            (np.array([0.0, 0.029, 0.015]), np.array([0.0, 1.0, 0.0])), 4e-3, 1e-3,
        ),
    }  # fmt: skip


def measured(problem: Problem, repeats: int) -> dict[str, list[tuple[float, float]]]:
    """Errors and times [s] by method, beside their call's own."""
    machine, law, start, duration, step = problem
    calls: dict[object, float] = {}
    units = machine.closure.units[machine.closure.active]
    wanted = crane.simulate(
        machine, law(), start, duration, step, method="DOP853", tolerance=1e-13
    ).q

    def run(control: object, repeats: int, **how: object) -> tuple[float, float]:
        def took(duration: float, repeats: int, **length: float) -> tuple[float, crane.Recording]:
            best = np.inf
            for _ in range(repeats):
                begun = time.perf_counter()
                found = crane.simulate(machine, control, start, duration, **{**how, **length})
                best = min(best, time.perf_counter() - begun)
            return best, found

        kind = type(control), how["method"]
        if kind not in calls:
            took(NOTHING, 1, step=NOTHING)
            calls[kind] = took(NOTHING, 5, step=NOTHING)[0]
        best, found = took(duration, repeats)
        best = max(best - calls[kind], 0.0)
        every = round(step / how["step"])
        return float((np.abs(found.q[::every] - wanted) / units).max()), best

    out: dict[str, list[tuple[float, float]]] = {}
    for method in OURS:
        for tolerance in TOLERANCES["ours"]:
            how = {"step": step, "method": method, "tolerance": tolerance}
            run(law(), 1, **how)
            out.setdefault(method, []).append(run(law(), repeats, **how))
    for length in STEPS:
        try:
            out.setdefault("rk4", []).append(run(law(), repeats, step=length, method="rk4"))
        except crane.CraneError:
            continue
    for method in SCIPYS:
        for tolerance in TOLERANCES["scipy"]:
            how = {"step": step, "method": method, "tolerance": tolerance}
            try:
                found = run(InPython(law()), 1, **how)
            except crane.CraneError:
                continue
            out.setdefault(f"scipy {method}", []).append(found)
    return out


def gains(found: dict[str, list[tuple[float, float]]]) -> dict[str, float]:
    """How many times faster ours is than each of the others at their errors, at least.

    Ours are the points that no other of ours beats in both, and lines between them.
    """
    ours = sorted(point for method in OURS for point in found[method])
    front = [
        (error, took)
        for error, took in ours
        if not any(other[0] <= error and other[1] < took for other in ours)
    ]
    errors, times = np.log(np.array(front).T)
    out = {}
    for name, points in found.items():
        within = [p for p in points if errors[0] <= np.log(p[0]) <= errors[-1]]
        if name not in OURS and within:
            ratios = [took / np.exp(np.interp(np.log(e), errors, times)) for e, took in within]
            out[name] = float(min(ratios))
    return out


def main() -> None:
    """Measure, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--write", type=Path, help="picture to write")
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        every = problems(Path(folder))
        found = {name: measured(one, options.repeats) for name, one in every.items()}
    for name, by_method in found.items():
        print(f"\n{name}")
        for method, points in by_method.items():
            shown = "  ".join(f"{1e3 * t:.2f} ms to {e:.0e}" for e, t in points)
            print(f"  {method:<12} {shown}")
        worst = "  ".join(f"{method} {ratio:.0f}" for method, ratio in gains(by_method).items())
        print(f"  times faster at an error no larger, without the calls, at least: {worst}")
    if options.write is None:
        return
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(found), figsize=(12, 4), sharey=True)
    for ax, (name, by_method) in zip(axes, found.items(), strict=True):
        for method, points in by_method.items():
            error, took = np.array(sorted(points)).T
            solid = method in OURS
            ax.loglog(
                np.maximum(error, 1e-14), 1e3 * took, "o-" if solid else "s--", ms=3, label=method
            )
        ax.set_title(name, fontsize=9)
        ax.set_xlabel("error [rad, machine's size]")
        ax.invert_xaxis()
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("time [ms]")
    axes[0].legend(fontsize=7)
    figure.tight_layout()
    options.write.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.write, dpi=110)


if __name__ == "__main__":
    main()
