"""How a simulated motion depends on numbers of the machine and on its start."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import CraneWarning, InputError, known
from crane.common.samples import Array
from crane.common.shown import Brief
from crane.common.units import reading
from crane.common.waiting import telling
from crane.control import Command, Controller
from crane.description.sensors import (
    FORCE,
    FORCE_UNITS,
    INCLINATION,
    VELOCITY,
    VELOCITY_UNITS,
)
from crane.machine import Machine
from crane.recordings import timeseries
from crane.recordings.recording import Recording
from crane.recordings.timeseries import Table
from crane.simulation.run import Force, Progress
from crane.simulation.sensitivity.asked import Asked
from crane.simulation.sensitivity.directions import START
from crane.simulation.sensitivity.follow import follow
from crane.simulation.sensitivity.setup import Setup

NOTHING = 1e-9  # of an output, in the unit that it is read in


@dataclass(frozen=True, eq=False, repr=False)
class Sensitivities(Brief):
    """A motion, and its derivatives by numbers.

    Attributes:
        recording: The motion.
        outputs: Names (k,) of what is observed.
        by: Names (p,) of the numbers.
        values: (p,) of these.
        slopes: (N, k, p) derivatives of the outputs, SI units.
    """

    recording: Recording
    outputs: tuple[str, ...]
    by: tuple[str, ...]
    values: Array
    slopes: Array

    def _line(self) -> str:
        """Of what, by what."""
        return f"Sensitivities of {', '.join(self.outputs)} by {', '.join(self.by)}"

    def of(self, output: str, by: str) -> Array:
        """(N,) d output / d number over time.

        Raises:
            InputError: There is no such output or number.
        """
        for name, names in ((output, self.outputs), (by, self.by)):
            if name not in names:
                raise InputError(f"'{name}' is not among them, {known(names, name)}")
        found: Array = self.slopes[:, self.outputs.index(output), self.by.index(by)]
        return found

    @property
    def changes(self) -> Array:
        """(p,) small changes of the numbers: a hundredth, or a thousandth [SI] of starts and 0."""
        numbers = [not name.startswith(START) for name in self.by]
        small: Array = np.where(numbers & (self.values != 0), 0.01 * np.abs(self.values), 1e-3)
        return small

    def unit(self, output: str) -> str:
        """SI unit of an output."""
        units = self.recording.units | self.recording.channel_units
        if output in units:
            return units[output]
        if output.startswith(INCLINATION):
            return "rad/s" if output.endswith(VELOCITY) else "rad"
        for end, kinds in ((VELOCITY, VELOCITY_UNITS), (FORCE, FORCE_UNITS)):
            if (joint := output.removesuffix(end)) != output and joint in units:
                return kinds[units[joint]]
        return ""

    def to_text(self) -> str:
        """A table, Markdown: what a small change of each number does to each output."""
        effects = self.slopes * self.changes
        units = [
            reading(self.unit(output), float(np.abs(effects[:, k]).max()))
            for k, output in enumerate(self.outputs)
        ]
        head = [f"{x} [{unit}]" for x, (unit, _) in zip(self.outputs, units, strict=True)]
        lines = [f"| number | value | more by | {' | '.join(head)} |"]
        lines += ["| --- | ---: | ---: |" + " ---: |" * len(head)]
        for i, (name, value) in enumerate(zip(self.by, self.values, strict=True)):
            sizes = np.sqrt(np.mean(effects[:, :, i] ** 2, axis=0))
            shown = [scale * x for x, (_, scale) in zip(sizes, units, strict=True)]
            cells = [f"{x:.3g}" if x > NOTHING else "0" for x in shown]
            lines.append(f"| {name} | {value:.6g} | {self.changes[i]:.3g} | {' | '.join(cells)} |")
        return "\n".join([*lines, "", "Root mean square of the change over the motion."])

    def to_csv(self, path: str | Path) -> None:
        """Write all derivatives over time, a column "OUTPUT by NUMBER" each.

        Raises:
            OutputError: It cannot be written.
        """
        names = [f"{output} by {name}" for output in self.outputs for name in self.by]
        values = np.column_stack([self.recording.time, self.slopes.reshape(len(self.slopes), -1)])
        units = {"time": "s"} | dict.fromkeys(names, "")
        timeseries.write(path, Table(units, values, {"machine": self.recording.machine}))


def sensitivities(
    machine: Machine | str | Path,
    controller: Controller | Command | Force | None = None,
    initial: ArrayLike | tuple[ArrayLike, ArrayLike] | None = None,
    duration: float | None = None,
    step: float = 1e-3,
    *,
    by: Sequence[str],
    outputs: Sequence[str] | None = None,
    method: str | None = None,
    tolerance: float | None = None,
    progress: Progress | None = None,
) -> Sensitivities:
    """Simulate a machine, with the exact derivatives of its motion by numbers.

    With the minimal state s = (q_A, v_A, controller), s' = r(s, t, p), and S = ds/dp,

        S' = dr/ds S + dr/dp,    S(0) = ds(0)/dp,

    between the instants at which a joint starts or stops, at which S jumps by (r - r_+) dt/dp; dr
    is differentiated operation by operation through the closed loops. The equations are solved
    along the states of the simulation, by Lobatto's method IIIC, extrapolated to order 5, over its
    recorded steps, which are taken in up to 4,096 parts where something jumps.

    Args:
        machine: The machine, or what `crane.load` takes.
        controller: See `simulate`; it stays the same where the machine changes, as do starting
            coordinates.
        initial: See `simulate`.
        duration: See `simulate`.
        step: See `simulate`.
        by: Numbers of the machine as `crane.description.parameters` lists them, such as
            "payload.mass" or "oil.bulk_modulus", and `start.JOINT`, `start.JOINT_velocity` of
            active joints.
        outputs: Names of joints, `JOINT_velocity`, `JOINT_force` of active ones, channels of the
            circuit such as `pressure_JOINT_a`, "kinetic", "potential", `tip_x`,
            `inclination_LINK` and `inclination_LINK_velocity`. If not given, the active joints,
            and with valves the chambers' pressures.
        method: See `simulate`.
        tolerance: See `simulate`.
        progress: See `simulate`.

    Raises:
        InputError: Unknown names, a machine that floats, or one without formulas.
        SimulationError: The motion comes to a dead centre; else as `simulate`.
    """
    progress = telling(progress)
    if not by:
        raise InputError("no number is named, give `by` such as ['payload.mass']")
    asked = Asked.of(machine, controller, initial, duration, step, outputs, method, tolerance)
    directions = asked.directions
    values = np.array([directions.value(name) for name in by])
    sizes = np.array([directions.size(name) for name in by])

    def setup(times: Array) -> tuple[Setup, Setup]:
        every = directions.by(list(dict.fromkeys(by)), times)
        parts = zip(*(every[name] for name in by), strict=True)
        return directions.base(times), Setup(*map(np.array, parts))

    followed = follow(asked.motion, asked.outputs, setup, sizes, progress=progress)
    for note in followed.notes:
        warnings.warn(note, CraneWarning, stacklevel=2)
    return Sensitivities(
        asked.recorded(followed.time, followed.parts),
        asked.outputs,
        tuple(by),
        values,
        followed.slopes,
    )
