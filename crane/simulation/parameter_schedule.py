"""Simulation of a machine whose parameters change at instants of the run."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import RecordingError
from crane.common.progress import ignore_progress
from crane.control.control_law import ControlLaw
from crane.dynamics.dynamics import Dynamics
from crane.formats.machine_loading import MachineVariants
from crane.machine.machine import Machine
from crane.recordings.recording import CHANGES_NOTE, Recording
from crane.simulation.recorded_run import IntegrationResult, record_run, stop_with_recording
from crane.simulation.simulation_run import Progress, integrate
from crane.simulation.simulation_setup import machine_under_control

# note of a run in the active coordinates throughout, also near their dead centres
COORDINATES_NOTE, KEPT_COORDINATES = "coordinates", "kept"
_INSTANT_TOLERANCE = 1e-6  # of a step


@dataclass(frozen=True)
class ParameterSchedule:
    """Changes of parameters during a run.

    At an instant the parameters jump, while positions, velocities, pressures and all other states
    stay: a load is taken or dropped at the speed of the tip.

    Attributes:
        changes: Times [s], increasing, and new values by name, see `crane.description.parameters`.
        keeps_chart: See `crane.simulation.simulation_run.integrate`.
    """

    changes: Sequence[tuple[float, Mapping[str, float]]]
    keeps_chart: bool = False

    @classmethod
    def from_notes(cls, notes: Mapping[str, str]) -> "ParameterSchedule":
        """Read the note `changes` of a recording, as [[3.25, {"payload.mass": 200}]].

        Raises:
            RecordingError: It has another form.
        """
        try:
            pairs = [
                (float(time), {str(name): float(x) for name, x in values.items()})
                for time, values in json.loads(notes.get(CHANGES_NOTE, "[]"))
            ]
        except (ValueError, TypeError, AttributeError, RecursionError):
            pairs = [(0.0, {})]
        times = [0.0, *(time for time, _ in pairs)]
        if not (np.diff(times) > 0).all():
            raise RecordingError(
                f"the line '# {CHANGES_NOTE}:' is no list of increasing times and parameters, "
                'write [[3.25, {"payload.mass": 200}]]'
            )
        return cls(pairs, notes.get(COORDINATES_NOTE) == KEPT_COORDINATES)

    def simulate(
        self,
        machine: Machine,
        control: ControlLaw,
        initial: ArrayLike | tuple[ArrayLike, ArrayLike] | None,
        step_count: int,
        step: float,
        label: str = "",
        progress: Progress = ignore_progress,
    ) -> Recording:
        """Simulate a machine with the changes; see `crane.simulate`.

        Raises:
            RecordingError: A change is not at an output instant.
            SimulationError: The simulation halts.
        """
        first_indices = [0, *(round(time / step) for time, _ in self.changes)]
        for index, (time, _) in zip(first_indices[1:], self.changes, strict=True):
            if abs(index * step - time) > _INSTANT_TOLERANCE * step:
                raise RecordingError(
                    f"parameters change at {time:g} s, which is no multiple of the step of "
                    f"{step:g} s: give --step 0.01"
                )
        parts: list[Recording] = []
        run: IntegrationResult | None = None
        variants, values = MachineVariants(machine), dict(machine.parameter_changes)
        for k, first in enumerate(i for i in first_indices if i < step_count):
            variant = machine_under_control(machine, control)
            if k:
                values |= self.changes[k - 1][1]
                variant = variants.machine(values)
                loads = machine.external_forces[len(variant.external_forces) :]
                variant = machine_under_control(variant.with_external_forces(*loads), control)
            law = control.for_machine(variant)
            last = min([*first_indices[k + 1 : k + 2], step_count])

            def report(share: float, start: int = first, end: int = last) -> None:
                progress((start + share * (end - start)) / step_count)

            run = integrate(
                Dynamics(variant), law, initial, last - first, step, progress=report, earlier=run,
                keeps_chart=self.keeps_chart,
            )  # fmt: skip
            if run.stop is not None:
                raise stop_with_recording(variant, law, run, run.stop, label, step_count * step)
            part = record_run(variant, law, run.time, run.rows, label)
            parts.append(part.at(np.arange(len(part.time)) > 0) if parts else part)
        columns = {
            name: np.concatenate([part[name] for part in parts if name in part.columns()])
            for name in parts[0]
            if all(name in part.columns() for part in parts)
        }
        pairs = [[time, dict(changed)] for time, changed in self.changes]
        text = json.dumps(pairs) if pairs else ""
        return replace(parts[0].with_columns(columns), changes=text)
