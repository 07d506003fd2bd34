"""What a calibration found, how well it is known, and how well the machine follows now."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crane.common.samples import Array, Brief
from crane.common.units import reading
from crane.identification.calibration.lacking import Lacking
from crane.machine import Machine


@dataclass(frozen=True)
class Fitted:
    """One number.

    Attributes:
        name: Its name.
        start: Before.
        value: Fitted.
        interval: Half of its interval of 95 %, as if there were no bounds.
        bound: Whether it is on a bound.
        vague: Whether the recordings do not tell it.
    """

    name: str
    start: float
    value: float
    interval: float
    bound: bool
    vague: bool


@dataclass(frozen=True, eq=False, repr=False)
class Channel(Brief):
    """A channel of a recording, SI units.

    Attributes:
        recording: Name of its file.
        name: Of the column.
        unit: Its unit.
        time: (N,) [s].
        train: (N,) which instants were fitted.
        measured: (N,).
        before: (N,) simulated as the machine was.
        after: (N,) as it is now.
    """

    recording: str
    name: str
    unit: str
    time: Array
    train: NDArray[np.bool_]
    measured: Array
    before: Array
    after: Array

    def rms(self, simulated: Array, train: bool) -> float:
        """Root mean square of simulated less measured, over what was fitted or held out."""
        some = self.train if train else np.logical_not(self.train)
        left = (simulated - self.measured)[some]
        return float(np.sqrt(np.mean(left**2))) if len(left) else float("nan")


@dataclass(frozen=True, eq=False)
class Calibration:
    """A machine fitted to recordings.

    Attributes:
        machine: With the fitted numbers.
        fitted: Numbers, in the order in which they were named.
        sensors: Channels before and after.
        changes: Numbers of the machine that differ, as `crane.load(changes=)` takes them.
        coupled: Pairs of names that the recordings tell apart badly, with their correlation.
        runs: Simulations it took.
        lacking: Numbers that were not fitted and would help.
    """

    machine: Machine
    fitted: tuple[Fitted, ...]
    sensors: tuple[Channel, ...]
    changes: Mapping[str, float]
    coupled: tuple[tuple[str, str, float], ...]
    runs: int
    lacking: tuple[Lacking, ...] = ()

    @property
    def values(self) -> dict[str, float]:
        """Fitted numbers by name."""
        return {one.name: one.value for one in self.fitted}

    @property
    def options(self) -> str:
        """What the command line takes for the same machine."""
        return " ".join(f"--set {name}={value:.8g}" for name, value in self.changes.items())

    def to_text(self) -> str:
        """A report, Markdown."""
        lines = [
            "| number | before | fitted | 95 % interval | |",
            "| --- | ---: | ---: | ---: | --- |",
        ]
        for one in self.fitted:
            note = "on its bound" if one.bound else "not told by the recordings" * one.vague
            width = f"± {one.interval:.2g}"
            lines.append(f"| {one.name} | {one.start:.5g} | {one.value:.5g} | {width} | {note} |")
        if self.coupled:
            lines += ["", "Told apart badly, of which a combination alone is known:", ""]
            lines += [f"- {a} and {b} (correlation {r:+.3f})" for a, b, r in self.coupled]
        if self.lacking:
            lines += ["", "What would take away more of what is left, if it were fitted, too:", ""]
            lines += [
                f"- {x.name} at about {x.value:.3g}: {100 * x.share:.0f} %" for x in self.lacking
            ]
        held = any(not sensor.train.all() for sensor in self.sensors)
        lines += [
            "",
            "| channel | unit | before | fitted |" + " held out, before | held out |" * held,
            "| --- | --- | ---: | ---: |" + " ---: | ---: |" * held,
        ]
        several = len({sensor.recording for sensor in self.sensors}) > 1
        for sensor in self.sensors:
            unit, scale = reading(sensor.unit, float(np.ptp(sensor.measured)))
            words = [
                f"{scale * sensor.rms(simulated, train):.3g}"
                for train in ((True, False) if held else (True,))
                for simulated in (sensor.before, sensor.after)
            ]
            name = f"{sensor.recording}: {sensor.name}" if several else sensor.name
            words = ["" if word == "nan" else word for word in words]
            lines.append(f"| {name} | {unit} | {' | '.join(words)} |")
        lines += ["", f"RMS of simulated less measured; {self.runs} simulations."]
        if self.changes:
            lines += ["", f"    {self.options}"]
        return "\n".join(lines)
