"""Design of valve signals for the calibration of a machine."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crane.common.errors import InputError, check_name
from crane.common.one_line_repr import format_count
from crane.common.progress import Progress, progress_reporter
from crane.common.result import Result
from crane.common.samples import Array, as_count, as_number, as_seed
from crane.common.threads import with_single_threaded_blas
from crane.common.units import format_quantity, format_table
from crane.control.valve_commands import require_circuit
from crane.description.sensors import VALVE_SIGNAL_PREFIX
from crane.identification.calibration.unknowns import Unknown
from crane.identification.excitation.exchange_algorithm import ExchangeAlgorithm
from crane.identification.excitation.fisher_information import CRITERIA, InformationMeasures
from crane.identification.excitation.signal_information import SignalInformation, SignalLimits
from crane.machine.machine import Machine
from crane.recordings import timeseries
from crane.recordings.recording import IDEAL_SENSORS, SENSORS_NOTE, Recording
from crane.recordings.timeseries import Table

_MAX_STD_SHARE = 0.5  # standard deviation per scale, above which a parameter is unidentifiable
_MIN_DURATION, _MIN_STEP = 2.0, 1e-3  # least duration and step [s]
_MAX_STEP = 0.05  # largest step [s] that resolves a pulse


@dataclass(frozen=True, eq=False, repr=False)
class SignalExcitation(Result):
    """Valve signals for the calibration of a machine.

    Attributes:
        machine: The machine.
        unknowns: Parameters to be calibrated.
        run: Simulation of the described machine with the signals.
        expected_readings: Signals and readings of sensors without noise.
        noise: Standard deviations of the sensors by column.
        initial_information: Information measures of reference signals of the same duration, one
            valve after the other.
        optimized_information: Information measures of these signals; `std` in units of the
            parameters.
        stroke_margins: (m,) smallest distances to the ends of the strokes, per stroke.
        worst_case_stroke_margins: (m,) the same for the worst deviation of a single parameter.
        pump_flow_share: Largest share of the pump's flow; 0 without a limit.
        peak_pressures: (m,) largest pressures in the cylinders [Pa].
        signal_rates: (m,) largest rates of the signals [V/s].
        criterion: Optimization criterion.
        seed: Seed of the random plans.
    """

    machine: Machine
    unknowns: tuple[Unknown, ...]
    run: Recording
    expected_readings: Table
    noise: Mapping[str, float]
    initial_information: InformationMeasures
    optimized_information: InformationMeasures
    stroke_margins: Array
    worst_case_stroke_margins: Array
    pump_flow_share: float
    peak_pressures: Array
    signal_rates: Array
    criterion: str
    seed: int

    def _one_line(self) -> str:
        """Machine, duration and number of identifiable parameters."""
        return (
            f"SignalExcitation of '{self.machine.name}', {self.run.time[-1]:.6g} s: "
            f"{len(self.unknowns) - len(self.unidentifiable)} of "
            f"{format_count(len(self.unknowns), 'parameter')} identifiable"
        )

    @property
    def signals(self) -> dict[str, Array]:
        """Signals (N,) by joint at `run.time` [V], as for `crane.control.ValveSignals`."""
        joints = require_circuit(self.machine).joints
        return {joint: self.run.channels[VALVE_SIGNAL_PREFIX + joint] for joint in joints}

    @property
    def std(self) -> dict[str, float]:
        """Expected standard deviations by name, infinite if not identifiable."""
        return {
            one.name: float(x)
            for one, x in zip(self.unknowns, self.optimized_information.std, strict=True)
        }

    @property
    def unidentifiable(self) -> list[str]:
        """Names of parameters that these sensors do not determine."""
        return [
            one.name
            for one in self.unknowns
            if not self.std[one.name] <= _MAX_STD_SHARE * one.scale
        ]

    def to_csv(self, path: str | Path) -> None:
        """Write signals and expected readings as a recording without noise.

        Raises:
            OutputError: The file cannot be written.
        """
        notes = {"machine": self.machine.load_expression, "task": "excitation through the valves"}
        notes[SENSORS_NOTE] = IDEAL_SENSORS
        timeseries.write_table(
            path, Table(self.expected_readings.units, self.expected_readings.values, notes)
        )

    def to_text(self) -> str:
        """Tables of standard deviations, strokes and unidentifiable parameters."""
        numbers: list[tuple[str, ...]] = [
            ("parameter", "value", "std, initial signals", "std, optimized signals")
        ]
        for one, initial_std, optimized_std in zip(
            self.unknowns,
            self.initial_information.std,
            self.optimized_information.std,
            strict=True,
        ):
            words = (f"{one.start:.5g}", f"{initial_std:.3g}", f"{optimized_std:.3g}")
            numbers.append((one.name, *words))
        gain = (
            f"{self.initial_information.logdet:.1f}",
            f"{self.optimized_information.logdet:.1f}",
        )
        numbers.append(("ln det (1 + M)", "", *gain))
        strokes: list[tuple[str, ...]] = [
            ("stroke", "smallest margin", "worst case", "largest pressure", "fastest signal")
        ]
        for i, joint in enumerate(require_circuit(self.machine).joints):
            strokes.append((
                joint, f"{self.stroke_margins[i]:.0%}", f"{self.worst_case_stroke_margins[i]:.0%}",
                format_quantity(self.peak_pressures[i], "Pa"), f"{self.signal_rates[i]:.3g} V/s",
            ))  # fmt: skip
        parts = ["\n".join(format_table(rows)) for rows in (numbers, strokes)]
        if self.pump_flow_share:
            parts.append(f"largest share of the pump's flow: {self.pump_flow_share:.0%}")
        if self.unidentifiable:
            names = ", ".join(self.unidentifiable)
            parts.append(
                f"not determined by these sensors in this time: {names}\n"
                "leave them out, name further --sensors, or give a longer --duration"
            )
        return "\n\n".join(parts)


@with_single_threaded_blas
def excite_valves(
    machine: Machine,
    fit: Mapping[str, object] | Sequence[str],
    *,
    duration: float = 20.0,
    sensors: Sequence[str] | None = None,
    noise: Mapping[str, float] | None = None,
    criterion: str = "logdet",
    rate: float = 2.0,
    margin: float = 0.1,
    step: float = 0.01,
    trials: int = 60,
    seed: int = 0,
    progress: Progress | None = None,
) -> SignalExcitation:
    """Design valve signals with the most information about parameters for `calibrate`.

    The signals are pulses of all valves (see `PulseSignals`) from rest at home to rest: the best
    of random plans, improved by the exchange of single slots (Meyer and Nachtsheim, 1995), by the
    Fisher information of the simulated readings (see `SignalInformation`). Signals that exceed the
    limits of `SignalLimits` are rejected.

    Args:
        machine: A machine with valves.
        fit: Parameters by name, as for `crane.calibrate`; strokes are within their limits from low
            to high of (start, low, high), else for deviations of 30 %.
        duration: [s].
        sensors: Columns that will be measured; default strokes and pressures of all cylinders.
        noise: Standard deviations by column in SI units; default 0.5 mm, 1 mrad, 2 mm/s, 5 mrad/s,
            0.3 bar.
        criterion: "logdet", the volume of the confidence ellipsoid of the scaled parameters, or
            "condition".
        rate: Largest rate of a signal in spool strokes per second; an operator reaches about 2.
        margin: Unused share of every stroke at both ends, and of the pump's flow.
        step: Step of the signals [s].
        trials: Number of plans that are evaluated.
        seed: Seed of the random plans; the result is reproducible to the last bit.
        progress: Called with the finished share, 0 to 1.

    Raises:
        InputError: Arguments are out of range, there are no valves, or no signals are within the
            limits.

    Source: Goodwin, Payne 1977, Dynamic System Identification, chapter 6; Meyer, Nachtsheim
    1995, Technometrics 37(1).
    """
    progress = progress_reporter(progress)
    require_circuit(machine)
    check_name(criterion, CRITERIA, f"criterion '{criterion}' is unknown")
    step = as_number(step, "the step", "s", greater_than=0, max_magnitude=_MAX_STEP)
    duration = as_number(duration, "the duration", "s", greater_than=0)
    if step < _MIN_STEP or duration < _MIN_DURATION:
        raise InputError(
            f"{duration:g} s in steps of {step:g} s: give a duration of at least "
            f"{_MIN_DURATION:g} s and a step from {_MIN_STEP:g} to {_MAX_STEP:g} s"
        )
    rate = as_number(rate, "the rate", "1/s", greater_than=0)
    if not 0 <= as_number(margin, "the margin", "") < 0.5:
        raise InputError(f"the margin is {margin:g}, give a share from 0 to below 0.5")
    trials = as_count(trials, "the number of trials")
    information = SignalInformation(machine, fit, sensors, noise, as_seed(seed))
    limits = SignalLimits(information, margin)
    search = ExchangeAlgorithm(information, limits, CRITERIA[criterion], duration, step, rate)
    with warnings.catch_warnings(action="ignore"):
        reference_run, best = search.run(trials, np.random.default_rng(seed), progress)
        initial_information, optimized_information = map(
            information.measures, (reference_run, best)
        )
        worst_case_margins = limits.worst_case_stroke_margins(best)
    joints = require_circuit(machine).joints
    largest_changes = np.abs(
        np.diff([best.channels[VALVE_SIGNAL_PREFIX + joint] for joint in joints])
    ).max(axis=1)
    return SignalExcitation(
        machine=information.machine,
        unknowns=tuple(information.unknowns),
        run=best,
        expected_readings=information.expected_readings(best),
        noise=dict(zip(information.units, information.noise.tolist(), strict=True)),
        initial_information=initial_information,
        optimized_information=optimized_information,
        stroke_margins=limits.stroke_margins(best),
        worst_case_stroke_margins=worst_case_margins,
        pump_flow_share=limits.pump_flow_share(best),
        peak_pressures=limits.peak_pressures(best),
        signal_rates=largest_changes / (best.time[1] - best.time[0]),
        criterion=criterion,
        seed=seed,
    )
