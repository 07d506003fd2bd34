"""How a number that is made of a whole motion depends on all numbers of a machine."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from crane.codegen import Parts
from crane.common.errors import CraneWarning, InputError, known
from crane.common.samples import Array
from crane.common.shown import Brief
from crane.common.waiting import telling
from crane.control import Command, Controller
from crane.description.sensors import VELOCITY
from crane.machine import Machine
from crane.recordings.recording import Recording
from crane.simulation.readings import read_off
from crane.simulation.run import Force, Progress
from crane.simulation.sensitivity.adjoint import Gatherer
from crane.simulation.sensitivity.asked import Asked
from crane.simulation.sensitivity.setup import Setup
from crane.simulation.sensitivity.track import Track

Functional = Callable[[Array, Array], tuple[ArrayLike, ArrayLike]]
"""Times (N + 1,), outputs (N + 1, k) -> J, dJ/dy (N + 1, k); of several, with an axis first."""


@dataclass(frozen=True, eq=False, repr=False)
class Gradient(Brief):
    """A motion, a number J made of it, and the derivatives of J by numbers of the machine.

    Attributes:
        recording: The motion.
        outputs: Names (k,) of what is observed.
        observed: (N + 1, k) these, SI units.
        by: Names (p,) of the numbers.
        values: (p,) of these.
        total: J; (K,) of several.
        slopes: (p,) dJ/dp, SI units; (K, p) of several.
    """

    recording: Recording
    outputs: tuple[str, ...]
    observed: Array
    by: tuple[str, ...]
    values: Array
    total: Array
    slopes: Array

    def _line(self) -> str:
        """Of what, by how much."""
        return f"Gradient of {', '.join(self.outputs)} by {len(self.by)} numbers"

    def of(self, by: str) -> Array:
        """DJ / d number; (K,) of several.

        Raises:
            InputError: There is no such number.
        """
        if by not in self.by:
            raise InputError(f"'{by}' is not among them, {known(self.by, by)}")
        found: Array = self.slopes[..., self.by.index(by)]
        return found

    def to_text(self, most: int = 20) -> str:
        """A table, Markdown: what matters most, by what a hundredth of each number does to J."""
        slopes, total = np.atleast_2d(self.slopes), np.atleast_1d(self.total)
        effects = np.abs(slopes * 0.01 * self.values)
        order = np.argsort(-effects.max(axis=0), kind="stable")[:most].tolist()
        heads = ["J"] if self.total.ndim == 0 else [f"J{i + 1}" for i in range(len(total))]
        lines = [f"| number | value | {' | '.join(f'1 % does to {head}' for head in heads)} |"]
        lines += ["| --- | ---: |" + " ---: |" * len(heads)]
        for i in order:
            cells = " | ".join(f"{x:.3g}" for x in 0.01 * self.values[i] * slopes[:, i])
            lines.append(f"| {self.by[i]} | {self.values[i]:.6g} | {cells} |")
        said = ", ".join(f"{head} = {x:.6g}" for head, x in zip(heads, total, strict=True))
        return "\n".join([*lines, "", f"{said}; {len(order)} of {len(self.by)} numbers."])


def gradient(
    machine: Machine | str | Path,
    controller: Controller | Command | Force | None = None,
    initial: ArrayLike | tuple[ArrayLike, ArrayLike] | None = None,
    duration: float | None = None,
    step: float = 1e-3,
    *,
    of: Functional | ArrayLike,
    by: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    method: str | None = None,
    tolerance: float | None = None,
    progress: Progress | None = None,
) -> Gradient:
    """Simulate a machine, with the exact derivatives of a sum over its motion by many numbers.

    Of J = sum over instants of w_i . y_i, or of any J(y) with dJ/dy_i = w_i, with the slopes that
    `sensitivities` gives as S,

        dJ/dp = sum_i w_i . (dy_i/dp),

    without these: a way back along the motion gathers what all numbers of the simulation do to J,
    at a cost that does not grow with how many are asked for; see
    `crane.simulation.sensitivity.adjoint`. What a number of the machine does to those of the
    simulation is found beforehand, for each by itself.

    Args:
        machine: The machine, or what `crane.load` takes.
        controller: See `sensitivities`.
        initial: See `simulate`.
        duration: See `simulate`.
        step: See `simulate`.
        of: J: weights w (N + 1, k) of the outputs at N + 1 instants; or a function of their times
            (N + 1,) and of the outputs (N + 1, k) that gives J and w. Several at once have an axis
            more, (K,) and (K, N + 1, k).
        by: Numbers, see `sensitivities`; all of the machine that change something if not given.
        outputs: See `sensitivities`.
        method: See `simulate`.
        tolerance: See `simulate`.
        progress: See `simulate`.

    Raises:
        InputError: As `sensitivities`, or weights of another shape.
        SimulationError: As `sensitivities`.
    """
    progress = telling(progress)
    asked = Asked.of(machine, controller, initial, duration, step, outputs, method, tolerance)
    directions = asked.directions
    by = None if by is None else list(dict.fromkeys(by))
    for name in by or ():
        directions.value(name)
    track = Track(asked.motion, progress)
    found = directions.by_all(track.time) if by is None else directions.by(by, track.time)
    for name in [x for x, direction in found.items() if direction.references.any()]:
        if by is not None:
            raise InputError(
                f"'{name}' changes when signals arrive, which a gradient takes as they are: ask "
                "`sensitivities` for it"
            )
        del found[name]
    if not found:
        raise InputError("no number is named that changes anything, give `by`")
    sizes = {name: directions.size(name) for name in found}
    changes = _changes(found, sizes)
    gatherer = Gatherer(track, asked.outputs, directions.base(track.time), changes)
    parts = track.layout.view(track.rows[::2])
    recording = asked.recorded(track.time[::2], parts)
    observed = _observed(track.chart.machine, recording, parts, asked.outputs)
    total, weights = _weighed(of, recording.time, observed)
    gathered = gatherer.run(weights.reshape(-1, *observed.shape))
    # references are the controller's, which none of these changes
    slopes = sum(
        (getattr(gathered, part) @ np.array([getattr(x, part) for x in found.values()]).T
         for part in Setup._fields if part != "references"),
        np.zeros(()),
    )  # fmt: skip
    for note in track.notes:
        warnings.warn(note, CraneWarning, stacklevel=2)
    return Gradient(
        recording,
        asked.outputs,
        observed,
        tuple(found),
        np.array([directions.value(name) for name in found]),
        total,
        slopes.reshape(*total.shape, -1),
    )


def _changes(directions: Mapping[str, Setup], sizes: Mapping[str, float]) -> Setup:
    """By how much numbers of a simulation change that do, see `Gatherer`."""
    total: list[Array] = []
    for name, direction in directions.items():
        still = direction._replace(references=np.zeros(direction.references.shape[-1]))
        rows = [sizes[name] * np.abs(part) for part in still]
        total = [*map(np.maximum, total, rows)] if total else rows
    return Setup(*total)


def _weighed(of: Functional | ArrayLike, time: Array, observed: Array) -> tuple[Array, Array]:
    """J and dJ/dy (N + 1, k), or several.

    Raises:
        InputError: They are of another shape, or not finite.
    """
    if callable(of):
        total, weights = (np.asarray(x, dtype=np.float64) for x in of(time, observed))
    else:
        weights = np.asarray(of, dtype=np.float64)
        if weights.shape[-2:] == observed.shape:
            total = np.asarray(np.tensordot(weights, observed, 2))
        else:
            total = np.zeros(weights.shape[:-2])
    if weights.shape != (*total.shape, *observed.shape) or total.ndim > 1:
        count, k = observed.shape
        raise InputError(
            f"weights of outputs have the shape {weights.shape}, give ({count}, {k}): {count} "
            f"instants, {k} outputs"
        )
    if not (np.isfinite(weights).all() and np.isfinite(total).all()):
        raise InputError("weights of outputs are not finite, look at the function")
    return total, weights


def _observed(
    machine: Machine, recording: Recording, parts: Parts, outputs: Sequence[str]
) -> Array:
    """Outputs (N + 1, k), those of passive joints' velocities among them."""
    columns, found = recording.columns(), []
    for name in outputs:
        joint = name.removesuffix(VELOCITY)
        if name not in columns and joint in machine.joints:
            rows = machine.closure.gamma(parts.q)[:, machine.joints.index(joint)]
            found.append(np.einsum("ni,ni->n", rows, parts.v_a))
        else:
            found.append(read_off(machine, recording, [name])[:, 0])
    return np.column_stack(found)
