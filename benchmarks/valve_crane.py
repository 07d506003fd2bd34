"""The bundled crane `patu655` on its valves: error of the strokes over time, and where it goes.

There is no second engine with this circuit. The reference is crane itself with a tolerance of
1e-11; the equations are compared with others in the problems of `drives`.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import crane
from crane.codegen import Program
from crane.simulation.integration.integrators import StickSlipIntegrator

MACHINE, CHANGES = "patu655", {"payload.mass": 211.4}
DURATION, OUTPUT_INTERVAL = 20.0, 0.1
REFERENCE_TOLERANCE = 1e-11
TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9)
STROKES = slice(1, 4)  # columns of the cylinders; the first joint slews


@dataclass(frozen=True)
class ValveCraneRun:
    """A run with a tolerance.

    Attributes:
        tolerance: See `crane.simulate`.
        time: CPU time of the whole call, median [s].
        error: Largest error of the strokes at outputs [m].
        angle_error: Largest error of the slewing angle [rad].
        shares: Shares of the time: set-up and recording, steps in machine code, transitions
            between sticking and slipping, rest in Python.
    """

    tolerance: float
    time: float
    error: float
    angle_error: float
    shares: dict[str, float] = field(default_factory=dict)


def levers(machine: crane.Machine) -> Any:
    """All levers to and fro."""
    joints = machine.hydraulics.joints if machine.hydraulics else ()
    return crane.joystick(
        machine,
        {
            joint: [(0, 0), *((t, 0.2 * (-1) ** (i + k)) for i, t in enumerate((4, 11, 18)))]
            for k, joint in enumerate(joints)
        },
    )


def measure(quick: bool = False) -> list[ValveCraneRun]:
    """Runs over tolerances."""
    machine = crane.load(MACHINE, changes=CHANGES)
    command = levers(machine)

    def simulate(tolerance: float) -> crane.Recording:
        return crane.simulate(
            machine, command, duration=DURATION, step=OUTPUT_INTERVAL, tolerance=tolerance
        )

    reference = simulate(REFERENCE_TOLERANCE).q
    return [
        measure_tolerance(simulate, reference, tolerance)
        for tolerance in (TOLERANCES[2:4] if quick else TOLERANCES)
    ]


def measure_tolerance(
    simulate: Callable[[float], crane.Recording], reference: np.ndarray, tolerance: float
) -> ValveCraneRun:
    """Median of runs with a tolerance, and one that tells where the time goes."""
    times = []
    for _ in range(3):
        begin = time.process_time()
        run = simulate(tolerance)
        times.append(time.process_time() - begin)
    errors = np.abs(run.q - reference).max(axis=0)
    with spent_in_calls() as spent:
        begin = time.process_time()
        simulate(tolerance)
        whole = time.process_time() - begin
    steps, transitions = spent["steps"], spent["transitions"]
    parts = {
        "set-up and recording": whole - spent["run"],
        "steps": steps,
        "transitions": transitions,
        "other Python": spent["run"] - steps - transitions,
    }
    shares = {name: part / whole for name, part in parts.items()}
    return ValveCraneRun(
        tolerance, float(np.median(times)), float(errors[STROKES].max()), float(errors[0]), shares
    )


@contextmanager
def spent_in_calls() -> Iterator[dict[str, float]]:
    """CPU times [s] of the methods that a run consists of, while the context is open."""
    spent = dict.fromkeys(("run", "steps", "transitions"), 0.0)
    places: dict[str, tuple[Any, str]] = {
        "run": (StickSlipIntegrator, "run"),
        "steps": (Program, "call"),
        "transitions": (StickSlipIntegrator, "_find_modes"),
    }

    def timed(label: str, method: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            if label == "steps" and arguments[1] != "run":
                return method(*arguments, **options)
            begin = time.thread_time()
            try:
                return method(*arguments, **options)
            finally:
                spent[label] += time.thread_time() - begin

        return call

    originals = {label: getattr(owner, name) for label, (owner, name) in places.items()}
    for label, (owner, name) in places.items():
        setattr(owner, name, timed(label, originals[label]))
    try:
        yield spent
    finally:
        for label, (owner, name) in places.items():
            setattr(owner, name, originals[label])


def tables(runs: list[ValveCraneRun]) -> list[str]:
    """Heading, text and table."""
    head = ["tolerance", "error of the strokes [m]", "of the slewing angle [rad]", "time [ms]",
            "times real time", *runs[0].shares]  # fmt: skip
    rows = [
        [
            f"{run.tolerance:g}", f"{run.error:.1e}", f"{run.angle_error:.1e}",
            f"{1e3 * run.time:.3g}", f"{DURATION / run.time:.0f}",
            *(f"{100 * share:.0f} %" for share in run.shares.values()),
        ]
        for run in runs
    ]  # fmt: skip
    marks = ["---:"] * len(head)
    return [
        f"#### `{MACHINE}` on its valves",
        (
            f"All four levers to and fro for {DURATION:g} s, with friction that sticks; recorded "
            f"every {OUTPUT_INTERVAL:g} s by `crane.simulate`. Errors are those against a "
            f"tolerance of {REFERENCE_TOLERANCE:g}: no other engine here has this circuit. The "
            "last columns tell where the time goes."
        ),
        "\n".join(f"| {' | '.join(row)} |" for row in (head, marks, *rows)),
    ]


if __name__ == "__main__":
    print("\n\n".join(tables(measure())))
