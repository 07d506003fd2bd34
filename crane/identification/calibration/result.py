"""What a calibration found, how well it is known, and how well the machine follows now."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from crane.common.samples import Array
from crane.common.shown import Brief, counted
from crane.common.units import reading
from crane.identification.calibration.ends import Ends
from crane.identification.calibration.lacking import Lacking
from crane.identification.calibration.problem import noise_of
from crane.identification.calibration.together import together
from crane.machine import Machine

_WORSE = 1.1  # times what was left before
HIGHER = (
    "Near these numbers the machine follows better still, where the search did not end: calibrate "
    "again from there, or fit fewer numbers."
)


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
        unit: Its SI unit, "" of a common factor.
        members: Numbers of the machine and its sensors that it changed, as they were.
        ends: What the simulation says of the interval's ends.
    """

    name: str
    start: float
    value: float
    interval: float
    bound: bool
    vague: bool
    unit: str = ""
    members: tuple[tuple[str, float], ...] = ()
    ends: Ends = Ends()

    @property
    def shared(self) -> bool:
        """Whether it is a common factor of several numbers."""
        return "*" in self.name

    @property
    def before(self) -> float:
        """What the machine had, 1 of a common factor."""
        return 1.0 if self.shared or not self.members else self.members[0][1]

    @property
    def moved(self) -> bool:
        """Whether what the machine had is outside of the interval of what is told."""
        return not (self.vague or self.bound) and abs(self.value - self.before) > self.interval

    @property
    def remark(self) -> str:
        """What is to be known beside the interval."""
        told = "on its bound" if self.bound else "not told by the recordings" * self.vague
        return ", ".join(filter(None, (told, self.ends.remark)))

    @property
    def notes(self) -> dict[str, str]:
        """Words for each number of the machine, as comments of a file have them."""
        found, remark = f"±{self.interval:.2g}, 95 %", self.remark and f", {self.remark}"
        if not self.shared:
            return {name: f"fitted {found}{remark} (was {was:.6g})" for name, was in self.members}
        how = f"{self.value:.5g} {found}{remark}"
        return {
            name: f"fitted by {self.name} = {how} (was {was:.6g})" for name, was in self.members
        }


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

    @property
    def noise(self) -> float:
        """Standard deviation of its noise, see `noise_of`."""
        return noise_of(self.measured)

    def rms(self, simulated: Array, train: bool) -> float:
        """Root mean square of simulated less measured, over what was fitted or held out."""
        some = self.train if train else np.logical_not(self.train)
        left = (simulated - self.measured)[some]
        return float(np.sqrt(np.mean(left**2))) if len(left) else float("nan")


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(Brief):
    """A machine fitted to recordings.

    Attributes:
        machine: With the fitted numbers.
        fitted: Numbers, in the order in which they were named.
        sensors: Channels before and after.
        changes: Numbers of the machine that differ, as `crane.load(changes=)` takes them.
        coupled: Pairs of names that the recordings tell apart badly, with their correlation.
        runs: Simulations it took.
        lacking: Numbers that were not fitted and would help.
        correlation: (n, n) of the numbers.
        states: By recording, velocities and chamber pressures of the drives of the fitted machine.
        lowest: Whether no lower minimum was seen at the ends of the intervals.
        left: Numbers that were chosen and of which nothing was seen; they stay as they were.
    """

    machine: Machine
    fitted: tuple[Fitted, ...]
    sensors: tuple[Channel, ...]
    changes: Mapping[str, float]
    coupled: tuple[tuple[str, str, float], ...]
    runs: int
    lacking: tuple[Lacking, ...] = ()
    correlation: Array = field(default_factory=lambda: np.zeros((0, 0)))
    states: Mapping[str, Mapping[str, Array]] = field(default_factory=dict)
    lowest: bool = True
    left: tuple[str, ...] = ()

    def _line(self) -> str:
        """What was fitted to, and the numbers that are told."""
        told = [x for x in self.fitted if not (x.bound or x.vague)]
        values = ", ".join(f"{x.name} = {x.value:.5g}" for x in told)
        numbers, channels = counted(len(self.fitted), "number"), len(self.sensors)
        return (
            f"Calibration of '{self.machine.name}': {len(told)} of {numbers} told by "
            f"{counted(channels, 'channel')}{': ' * bool(told)}{values}"
        )

    @property
    def notes(self) -> dict[str, str]:
        """What is to be said of the fitted numbers beside them, by name."""
        return {name: text for one in self.fitted for name, text in one.notes.items()}

    @property
    def directions(self) -> list[dict[str, float]]:
        """What the recordings cannot tell apart, see `together`."""
        ends = [one.interval for one in self.fitted]
        return together([one.name for one in self.fitted], self.correlation, np.array(ends))

    @property
    def values(self) -> dict[str, float]:
        """Fitted numbers by name."""
        return {one.name: one.value for one in self.fitted}

    @property
    def worse(self) -> list[str]:
        """Channels that were held out and are followed worse than before."""
        several = len({x.recording for x in self.sensors}) > 1
        return [
            f"{x.recording}: {x.name}" if several else x.name
            for x in self.sensors
            if x.rms(x.after, False) > max(_WORSE * x.rms(x.before, False), x.noise)
        ]

    @property
    def cautions(self) -> list[str]:
        """What is to be said of it as a whole."""
        found = [] if self.lowest else [HIGHER]
        if self.worse:
            found.append(
                f"Held out, the machine follows worse than before in {', '.join(self.worse)}: fit "
                "fewer numbers, or record more."
            )
        if self.left:
            found.append(
                "Nothing of these was seen, they are left as the machine has them: "
                f"{', '.join(self.left)}."
            )
        return found

    @property
    def options(self) -> str:
        """What the command line takes for the same machine."""
        return " ".join(f"--set {name}={value:.8g}" for name, value in self.changes.items())

    def words(self, direction: Mapping[str, float]) -> str:
        """A direction in words: numbers that may change together."""
        units = {one.name: one.unit for one in self.fitted}
        return ", ".join(f"{x} by {by:+.2g} {units[x]}".rstrip() for x, by in direction.items())

    def to_text(self) -> str:
        """A report, Markdown."""
        lines = [
            "| number | before | fitted | 95 % interval | |",
            "| --- | ---: | ---: | ---: | --- |",
        ]
        for one in self.fitted:
            width = f"± {one.interval:.2g}"
            lines.append(
                f"| {one.name} | {one.start:.5g} | {one.value:.5g} | {width} | {one.remark} |"
            )
        for caution in self.cautions:
            lines += ["", caution]
        if self.coupled:
            lines += ["", "Told apart badly, of which a combination alone is known:", ""]
            lines += [f"- {a} and {b} (correlation {r:+.3f})" for a, b, r in self.coupled]
        if self.directions:
            lines += ["", "What changes together without the recordings telling it:", ""]
            lines += [f"- {self.words(direction)}" for direction in self.directions]
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
