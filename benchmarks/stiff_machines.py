"""Part: crane's methods and scipy's on stiff machines, error against time.

All run on crane's equations: scipy's methods on the rates that `simulate` gives them under a
controller that cannot be traced. Errors are those of the recorded coordinates in rad and
characteristic lengths, against DOP853 with a tolerance of 1e-13; times include the call.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from multibody import Array
from problem import load_machine
from report import table
from timing import medians
from trajectories import Point, time_at_error

import crane
from crane.control import ZeroForce
from crane.description import EndStop, ForceElement, PIGains

OWN, SCIPYS = ("DOP853", "Radau", "rosenbrock"), ("Radau", "BDF", "LSODA")
TOLERANCES = {
    "crane": (1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 3e-11, 1e-11),
    "scipy": (1e-4, 1e-6, 1e-8, 1e-10),
}
ERRORS = (1e-4, 1e-6, 1e-8, 1e-10)
LONGEST_RUN = 1.0  # CPU time [s] after which finer tolerances are left out
FAST = 2 * np.pi * 1000.0  # of the PI loop [rad/s]


@dataclass(frozen=True)
class StiffMachine:
    """A machine with its controller, start (q_a, v_a), duration and recorded step [s]."""

    machine: crane.Machine
    controller: Callable[[], crane.control.ControlLaw]
    start: tuple[Array, Array]
    duration: float
    step: float

    def simulate(self, method: str, tolerance: float, is_traced: bool = True) -> crane.Recording:
        """A run, by scipy's method where the controller is not traced."""
        law: Any = self.controller()
        return crane.simulate(
            self.machine, law if is_traced else Untraced(law), self.start, self.duration,
            self.step, method=method, tolerance=tolerance,
        )  # fmt: skip


class Untraced:
    """A controller that cannot be traced, so that a method is scipy's."""

    def __init__(self, law: crane.control.ControlLaw):
        self._law, self.reference = law, getattr(law, "reference", None)

    def start(self, q_a: Array) -> Array:
        """See `crane.control.Controller`."""
        return self._law.start(q_a)

    def __call__(self, *arguments: Any) -> tuple[Array, Array]:
        """See `crane.control.Controller`."""
        return self._law(*arguments)


def machines() -> dict[str, StiffMachine]:
    """A governor's collar on a stiff spring, a fast control loop, a hard end stop."""
    governor = load_machine("flyball_governor.yaml")
    mini = crane.load("mini_forwarder").replace(friction={})
    path = crane.task_trajectory(mini, "return")
    mass = crane.Dynamics(mini).mass_matrix(path.position(0.0)).diagonal()
    gains = {
        joint: PIGains(float(m) * FAST**2, float(m) * FAST**2 * 10.0)
        for joint, m in zip(mini.active, mass, strict=True)
    }
    dampers = tuple(
        ForceElement(joint, damping=float(2 * m * FAST))
        for joint, m in zip(mini.active, mass, strict=True)
    )
    damped, hit = mini.replace(forces=dampers), mini.replace(end_stops=(EndStop("X1", 1e9, 0.5),))
    spin = governor.home[governor.closure.active], np.array([2 * np.pi, 0.0])
    blow = np.array([0.0, 0.029, 0.015]), np.array([0.0, 1.0, 0.0])
    return {
        "flyball governor": StiffMachine(governor, partial(ZeroForce, governor), spin, 10.0, 1e-2),
        "PI loop of 1 kHz": StiffMachine(
            damped, partial(crane.PI, damped, path, gains), path(0.0)[:2], 10.0, 5e-2
        ),
        "end stop of 1e9 N/m": StiffMachine(hit, partial(ZeroForce, hit), blow, 4e-3, 1e-3),
    }


def measure(quick: bool) -> list[Point]:
    """Points of all methods on all machines; quick ones of crane's methods on one."""
    points = []
    for name, machine in list(machines().items())[: 1 if quick else None]:
        methods = [("crane", method) for method in OWN]
        methods += [("scipy", method) for method in SCIPYS if not quick]
        expected = machine.simulate("DOP853", 1e-13).q
        closure = machine.machine.closure
        units = closure.units[closure.active]
        for package, method in methods:
            for tolerance in TOLERANCES[package][:: 3 if quick else 1]:
                run = partial(machine.simulate, method, tolerance, package == "crane")
                points.append(_point(name, f"{package} {method}", tolerance, run, expected, units))
                if points[-1].time > LONGEST_RUN:
                    break
        print(f"{name}: done", flush=True)
    return points


def _point(
    name: str,
    engine: str,
    tolerance: float,
    run: Callable[[], crane.Recording],
    expected: Array,
    units: Array,
) -> Point:
    """The point of a setting; scipy's runs take longer and are timed once."""
    found: dict[str, crane.Recording] = {}
    try:
        rounds = 3 if engine.startswith("crane") else 1
        spent = medians({engine: lambda: found.update(run=run())}, rounds)[engine]
    except crane.CraneError as error:
        return Point(name, engine, f"{tolerance:g}", failure=str(error))
    gap = float(np.abs((found["run"].q - expected) / units).max())
    return Point(name, engine, f"{tolerance:g}", error=gap, time=spent)


def tables(points: Sequence[Point]) -> list[str]:
    """Times at equal errors."""
    parts = []
    for name in dict.fromkeys(point.problem for point in points):
        own = [point for point in points if point.problem == name]
        rows = []
        for engine in dict.fromkeys(point.engine for point in own):
            of_engine = [point for point in own if point.engine == engine]
            times = [time_at_error(of_engine, error) for error in ERRORS]
            rows.append(
                [engine, *("-" if time is None else f"{1e3 * time:.3g}" for time in times)]
            )
        head = [name, *(f"{error:.0e} [ms]" for error in ERRORS)]
        parts.append(table(head, rows))
    return parts
