"""Batches of simulations in threads: variants of a machine, initial states, payloads."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed, wait
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import CraneError, InputError
from crane.common.one_line_repr import OneLineRepr, format_count
from crane.common.progress import progress_reporter
from crane.common.samples import Array
from crane.control.control_law import Controller
from crane.dynamics.dynamics import Dynamics
from crane.machine.machine import Machine
from crane.simulation.run_checks import run_warnings
from crane.simulation.simulation_run import Progress, has_fixed_steps, integrate
from crane.simulation.simulation_setup import (
    count_steps,
    machine_under_control,
    reference_limits_text,
    resolve_controller,
)

_Result = tuple[Array, Array, Array, Array, Array, str]


@dataclass(frozen=True, eq=False, repr=False)
class Batch(OneLineRepr):
    """Results of B simulations of N instants with n active joints.

    Attributes:
        time: (N,) [s].
        q: (B, N, n) active coordinates [m], [rad]; NaN where a simulation failed.
        v: (B, N, n) their velocities [m/s], [rad/s].
        tau: (B, N, n) active forces [N], [N m].
        energy: (B, N, 4) kinetic, potential, work of the active forces, dissipated [J].
        failures: Errors of failed simulations, by index.
        warnings: Warnings of the other simulations, by index.
    """

    time: Array
    q: Array
    v: Array
    tau: Array
    energy: Array
    failures: dict[int, str]
    warnings: dict[int, str]

    def _one_line(self) -> str:
        return (
            f"Batch of {format_count(len(self.q), 'simulation')}, {self.time[-1]:.6g} s in "
            f"{format_count(len(self.time), 'sample')}: {len(self.failures)} failed"
        )


def simulate_batch(
    machines: Machine | Sequence[Machine],
    controller: Callable[[Machine], Controller] | None = None,
    initial: Sequence[ArrayLike | tuple[ArrayLike, ArrayLike] | None] | None = None,
    duration: float | None = None,
    step: float = 1e-3,
    *,
    method: str | None = None,
    tolerance: float | None = None,
    threads: int | None = None,
    progress: Progress | None = None,
) -> Batch:
    """Simulate many variants in threads; see `simulate`.

    Variants made by `Machine.replace` and `Machine.with_payload` share their machine code. A
    variant that fails does not stop the others.

    Args:
        machines: B machines with the same active joints, or one for all initial states.
        controller: Creates the controller of a machine; None for no force.
        initial: B initial states, see `simulate`; None for its default.
        duration: Duration [s]; that of the reference of the controller if not given.
        step: Output interval [s].
        method: See `simulate`.
        tolerance: See `simulate`.
        threads: Number of threads; one per core if not given.
        progress: Function that is called with the finished share, 0 to 1.

    Raises:
        InputError: Lengths or active joints differ, or all simulations failed.
    """
    progress = progress_reporter(progress)
    if isinstance(machines, Machine):
        machines = [machines] * (1 if initial is None else len(initial))
    if not machines:
        raise InputError("there are no machines, give at least one")
    initial_states = [None] * len(machines) if initial is None else list(initial)
    if len(initial_states) != len(machines):
        raise InputError(
            f"{len(machines)} machines and {len(initial_states)} initial states do not go "
            "together, give one state per machine, or one machine"
        )
    active = machines[0].active
    for i, machine in enumerate(machines):
        if machine.active != active:
            raise InputError(
                f"machine {i} is driven at {', '.join(machine.active)}, the first one at "
                f"{', '.join(active)}: simulate them apart"
            )

    def run(i: int) -> _Result:
        machine = machines[i]
        control = resolve_controller(None if controller is None else controller(machine), machine)
        machine = machine_under_control(machine, control)
        steps = count_steps(control, duration, step)
        dynamics = Dynamics(machine)
        found = integrate(
            dynamics,
            control,
            initial_states[i],
            steps,
            step,
            method,
            tolerance=tolerance,
            ends_with_command=duration is None,
        )
        if found.stop is not None:
            raise found.stop
        time, rows = found.time, found.rows
        energy = np.hstack([rows.kinetic, rows.potential, rows.work[:, :1], rows.dissipated])
        every_step = has_fixed_steps(dynamics, control, method)
        texts = [
            reference_limits_text(machine, control, steps * step),
            *found.notes,
            *run_warnings(machine, time, rows, step, every_step),
        ]
        q_a = rows.q[:, machine.closure.active]
        return time, q_a, rows.v_a, rows.tau, energy, "; ".join(filter(None, texts))

    results: dict[int, _Result] = {}
    failures: dict[int, str] = {}
    with ThreadPoolExecutor(threads or os.cpu_count() or 1) as pool:
        futures = {pool.submit(run, 0): 0}
        wait(futures)  # the first one compiles the machine code of the others
        futures |= {pool.submit(run, i): i for i in range(1, len(machines))}
        for future in as_completed(futures):
            error = future.exception()
            if isinstance(error, CraneError):
                failures[futures[future]] = str(error)
            else:
                results[futures[future]] = future.result()
            progress((len(results) + len(failures)) / len(machines))
    if not results:
        raise InputError(f"all {len(machines)} simulations failed, the first: {failures[0]}")
    return _stack_results(results, failures, len(machines))


def _stack_results(results: dict[int, _Result], failures: dict[int, str], count: int) -> Batch:
    lengths = {len(result[0]) for result in results.values()}
    if len(lengths) > 1:
        raise InputError(
            f"the paths give recordings of {sorted(lengths)} samples, give one duration for all"
        )
    first = next(iter(results.values()))
    stacks = [np.full((count, *part.shape), np.nan) for part in first[1:5]]
    for i, result in results.items():
        for stack, part in zip(stacks, result[1:5], strict=True):
            stack[i] = part
    texts = {i: results[i][5] for i in sorted(results) if results[i][5]}
    q, v, tau, energy = stacks
    return Batch(first[0], q, v, tau, energy, dict(sorted(failures.items())), texts)
