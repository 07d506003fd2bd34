"""Signals of valves that tell as much as possible about numbers that a calibration fits."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crane.common.errors import InputError, known
from crane.common.samples import Array, as_count, as_number, as_seed
from crane.common.shown import Brief, counted
from crane.common.tables import aligned
from crane.common.threads import on_one_thread
from crane.common.units import quantity
from crane.common.waiting import telling
from crane.control.valves import circuit_of
from crane.description.sensors import SIGNAL
from crane.identification.calibration.unknowns import Unknown
from crane.identification.excitation.exchange import Exchange
from crane.identification.excitation.information import CRITERIA, Quality
from crane.identification.excitation.signal_limits import SignalLimits
from crane.identification.excitation.told import Told
from crane.machine import Machine
from crane.recordings import timeseries
from crane.recordings.recording import IDEAL, SENSORS, Recording
from crane.recordings.timeseries import Table

_VAGUE = 0.5  # standard deviation, of a number's size, that says nothing
_SHORTEST, _FINEST = 2.0, 1e-3  # duration and step [s]
_COARSEST = 0.05  # step [s], of which a pulse still has enough

Progress = Callable[[float], None]


@dataclass(frozen=True, eq=False, repr=False)
class SignalExcitation(Brief):
    """Signals of valves to calibrate a machine with.

    Attributes:
        machine: The machine.
        fit: The numbers that are wanted.
        run: The machine as described, driven by the signals.
        table: Signals, and what sensors without noise say of it.
        noise: Standard deviations of the sensors by column.
        before: What one lever after the other, out and back, would tell in the same time.
        after: What these signals will tell; `std` in the numbers' own units.
        left: (m,) what the strokes keep to their ends, as a share of the stroke.
        doubted: (m,) the same of the worst machine whose wanted numbers are off, one at a time.
        pump: The largest share of the pump's flow; 0 where it has no limit.
        pressure: (m,) largest pressure in a cylinder [Pa].
        rate: (m,) fastest change of the signals [V/s].
        criterion: They are best in.
        seed: Of the random signals.
    """

    machine: Machine
    fit: tuple[Unknown, ...]
    run: Recording
    table: Table
    noise: Mapping[str, float]
    before: Quality
    after: Quality
    left: Array
    doubted: Array
    pump: float
    pressure: Array
    rate: Array
    criterion: str
    seed: int

    def _line(self) -> str:
        """For what, how long, and what it tells."""
        return (
            f"SignalExcitation of '{self.machine.name}', {self.run.time[-1]:.6g} s: "
            f"{len(self.fit) - len(self.vague)} of {counted(len(self.fit), 'number')} told"
        )

    @property
    def signals(self) -> dict[str, Array]:
        """(N,) by joint at `run.time` [V], as `crane.Signals` takes them."""
        joints = circuit_of(self.machine).joints
        return {joint: self.run.channels[SIGNAL + joint] for joint in joints}

    @property
    def std(self) -> dict[str, float]:
        """Expected standard deviations by name, infinite for what is not told."""
        return {one.name: float(x) for one, x in zip(self.fit, self.after.std, strict=True)}

    @property
    def vague(self) -> list[str]:
        """Names of numbers that these sensors do not tell, whatever the signals here."""
        return [one.name for one in self.fit if not self.std[one.name] <= _VAGUE * one.scale]

    def to_csv(self, path: str | Path) -> None:
        """Write signals and expected readings: a recording of no noise.

        Raises:
            OutputError: It cannot be written there.
        """
        notes = {"machine": self.machine.call, "task": "excitation through the valves"}
        notes[SENSORS] = IDEAL
        timeseries.write(path, Table(self.table.units, self.table.values, notes))

    def to_text(self) -> str:
        """Tables for reading: numbers before and after, strokes, and what is not told."""
        numbers: list[tuple[str, ...]] = [("number", "value", "std, plain", "std, designed")]
        for one, plain, designed in zip(self.fit, self.before.std, self.after.std, strict=True):
            words = (f"{one.start:.5g}", f"{plain:.3g}", f"{designed:.3g}")
            numbers.append((one.name, *words))
        gain = (f"{self.before.logdet:.1f}", f"{self.after.logdet:.1f}")
        numbers.append(("ln det (1 + M)", "", *gain))
        strokes: list[tuple[str, ...]] = [
            ("stroke", "least left", "numbers off", "largest pressure", "fastest signal")
        ]
        for i, joint in enumerate(circuit_of(self.machine).joints):
            strokes.append((
                joint, f"{self.left[i]:.0%}", f"{self.doubted[i]:.0%}",
                quantity(self.pressure[i], "Pa"), f"{self.rate[i]:.3g} V/s",
            ))  # fmt: skip
        parts = ["\n".join(aligned(rows)) for rows in (numbers, strokes)]
        if self.pump:
            parts.append(f"largest share of the pump's flow: {self.pump:.0%}")
        if self.vague:
            names = ", ".join(self.vague)
            parts.append(
                f"not told by these sensors in this time: {names}\n"
                "leave them out, name further --sensors, or give a longer --duration"
            )
        return "\n\n".join(parts)


@on_one_thread
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
    """Find signals of a machine's valves that determine numbers best, fitted by `calibrate`.

    Pulses of all valves (see `Levers`) from rest at home to rest, the best of some at random and
    of what the exchange of single slots makes of them (Meyer and Nachtsheim, 1995), judged by
    the information of the simulated readings (see `Told`). Signals that leave the limits of
    `crane.identification.excitation.signal_limits.SignalLimits` are not taken.

    Args:
        machine: A machine with valves.
        fit: Numbers by name, as `crane.calibrate` takes them; with (start, low, high) the
            strokes hold from low to high, else for numbers that are off by 30 %.
        duration: [s].
        sensors: Columns that will be measured; strokes and pressures of all cylinders if not
            given.
        noise: Their standard deviations by column, SI; where not given 0.5 mm, 1 mrad, 2 mm/s,
            5 mrad/s, 0.3 bar.
        criterion: "logdet", the volume of the confidence ellipsoid of the numbers, each against
            its size; or "condition".
        rate: The fastest change of a signal, in strokes of the spool per second; 2 is an
            operator's hand that moves a lever to its end in half a second.
        margin: Share of every stroke that is left unused at both ends, and of the pump's flow.
        step: Between samples of the signals [s].
        trials: How many signals are judged.
        seed: Of the random signals: the same seed gives the same bits.
        progress: Called with the finished share, 0 to 1.

    Raises:
        InputError: Arguments out of range, no valves, or no signals within the limits.

    Source: Goodwin, Payne 1977, Dynamic System Identification, chapter 6; Meyer, Nachtsheim
    1995, Technometrics 37(1).
    """
    progress = telling(progress)
    circuit_of(machine)
    if criterion not in CRITERIA:
        raise InputError(f"criterion '{criterion}' is unknown, {known(CRITERIA, criterion)}")
    step = as_number(step, "the step", "s", above=0, most=_COARSEST)
    duration = as_number(duration, "the duration", "s", above=0)
    if step < _FINEST or duration < _SHORTEST:
        raise InputError(
            f"{duration:g} s in steps of {step:g} s: give a duration of at least {_SHORTEST:g} s "
            f"and a step from {_FINEST:g} to {_COARSEST:g} s"
        )
    rate = as_number(rate, "the rate", "1/s", above=0)
    if not 0 <= as_number(margin, "the margin", "") < 0.5:
        raise InputError(f"the margin is {margin:g}, give a share from 0 to below 0.5")
    trials = as_count(trials, "the number of trials")
    told = Told(machine, fit, sensors, noise, as_seed(seed))
    limits = SignalLimits(told, margin)
    search = Exchange(told, limits, CRITERIA[criterion], duration, step, rate)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        plain, best = search.run(trials, np.random.default_rng(seed), progress)
        before, after = told.quality(plain), told.quality(best)
        doubted = limits.doubted(best)
    return _result(told, limits, best, before, after, doubted, criterion, seed)


def _result(
    told: Told,
    limits: SignalLimits,
    run: Recording,
    before: Quality,
    after: Quality,
    doubted: Array,
    criterion: str,
    seed: int,
) -> SignalExcitation:
    table, joints = told.table(run), circuit_of(told.machine).joints
    slopes = np.abs(np.diff([run.channels[SIGNAL + joint] for joint in joints])).max(axis=1)
    return SignalExcitation(
        machine=told.machine,
        fit=tuple(told.unknowns),
        run=run,
        table=table,
        noise=dict(zip(told.units, told.noise.tolist(), strict=True)),
        before=before,
        after=after,
        left=limits.left(run),
        doubted=doubted,
        pump=limits.pump(run),
        pressure=limits.pressures(run),
        rate=slopes / (run.time[1] - run.time[0]),
        criterion=criterion,
        seed=seed,
    )
