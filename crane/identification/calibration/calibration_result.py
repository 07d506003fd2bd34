"""Result of a calibration: parameters with intervals, channels before and after, report."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from crane.common.one_line_repr import OneLineRepr, format_count
from crane.common.result import Result
from crane.common.samples import Array, root_mean_square
from crane.common.units import display_unit
from crane.description.sensors import PRESSURE_PREFIX, VELOCITY_SUFFIX, VELOCITY_UNITS
from crane.identification.calibration.calibration_statistics import (
    ProfileEnds,
    ScoreTestResult,
    correlated_directions,
)
from crane.identification.calibration.model_selection import SelectionStep
from crane.identification.calibration.recording_case import NOISE_LEVEL, noise_std
from crane.machine.machine import Machine

_DEGRADATION_FACTOR = 1.1  # times the residual before
_WINDOW_SIZE = 20  # samples whose mean shows slow residuals
LOWER_MINIMUM_WARNING = (
    "There is a lower minimum near these parameters: calibrate again from there, or fit fewer "
    "parameters."
)
_MAX_GROUPS = 8  # groups of about equal size
_WIDER_FACTOR = 1.5  # of half widths that are told apart
_REST_SPEED_SHARE = 0.02  # of the largest speed, below which a drive is at rest


@dataclass(frozen=True)
class FittedParameter:
    """Fitted parameter.

    Attributes:
        name: Name of the parameter.
        start: Value before.
        value: Fitted value.
        interval_half_width: Half width of its 95 % interval, without regard to bounds.
        at_bound: Whether a bound is active.
        is_unidentifiable: Whether the recordings do not determine it.
        unit: SI unit, "" for a common factor.
        members: Parameters that it changed, with their values before.
        profile_ends: Profile likelihood at the ends of the interval.
        has_model_error: Whether residuals are more than noise: its interval is that of noise, and
            excludes the error of the model.
        candidate_half_width: Half width with the candidates that a selection left out free within
            their priors.
    """

    name: str
    start: float
    value: float
    interval_half_width: float
    at_bound: bool
    is_unidentifiable: bool
    unit: str = ""
    members: tuple[tuple[str, float], ...] = ()
    profile_ends: ProfileEnds = ProfileEnds()
    has_model_error: bool = False
    candidate_half_width: float = 0.0

    @property
    def is_common_factor(self) -> bool:
        """Whether it is a common factor of several parameters."""
        return "*" in self.name

    @property
    def initial_value(self) -> float:
        """Value of the machine before, 1 for a common factor."""
        return 1.0 if self.is_common_factor or not self.members else self.members[0][1]

    @property
    def changed_significantly(self) -> bool:
        """Whether the value before is outside of the interval of an identifiable parameter."""
        return (
            not (self.is_unidentifiable or self.at_bound)
            and abs(self.value - self.initial_value) > self.interval_half_width
        )

    @property
    def remark(self) -> str:
        """Remark beside the interval, or ""."""
        status = (
            "on its bound"
            if self.at_bound
            else "not determined by the recordings" * self.is_unidentifiable
        )
        is_wider = self.candidate_half_width > _WIDER_FACTOR * self.interval_half_width
        wider = f"±{self.candidate_half_width:.2g} with all candidates" * is_wider
        excluded = "excludes model error" * self.has_model_error
        return ", ".join(filter(None, (status, wider, self.profile_ends.remark, excluded)))

    @property
    def notes(self) -> dict[str, str]:
        """Comment for each changed parameter in a machine file."""
        interval_text, remark = (
            f"±{self.interval_half_width:.2g}, 95 %",
            self.remark and f", {self.remark}",
        )
        if not self.is_common_factor:
            return {
                name: f"fitted {interval_text}{remark} (was {was:.6g})"
                for name, was in self.members
            }
        factor_text = f"{self.value:.5g} {interval_text}{remark}"
        return {
            name: f"fitted by {self.name} = {factor_text} (was {was:.6g})"
            for name, was in self.members
        }


@dataclass(frozen=True, eq=False, repr=False)
class CalibrationChannel(OneLineRepr):
    """Channel of a recording before and after the calibration, in SI units.

    Attributes:
        recording: Name of the file.
        name: Name of the column.
        unit: Unit of the channel.
        time: (N,) [s].
        train_mask: (N,) mask of the training data.
        measured: (N,) measured values.
        simulated_before: (N,) simulated values of the machine before.
        simulated_after: (N,) simulated values of the fitted machine.
    """

    recording: str
    name: str
    unit: str
    time: Array
    train_mask: NDArray[np.bool_]
    measured: Array
    simulated_before: Array
    simulated_after: Array

    @property
    def noise(self) -> float:
        """Standard deviation of the noise, see `noise_std`."""
        return noise_std(self.measured)

    def rms(self, simulated: Array, training: bool) -> float:
        """Root mean square of simulated minus measured over training or held-out data."""
        mask = self.train_mask if training else np.logical_not(self.train_mask)
        residual = (simulated - self.measured)[mask]
        return root_mean_square(residual) if len(residual) else float("nan")

    @property
    def exceeds_noise(self) -> bool:
        """Whether the residual over the training data, or its means, are more than white noise."""
        residual, size = (self.simulated_after - self.measured)[self.train_mask], _WINDOW_SIZE
        means = residual[: len(residual) // size * size].reshape(-1, size).mean(axis=1)
        most = NOISE_LEVEL * self.noise * np.sqrt([len(means) / size, len(residual)])
        return bool(np.any([np.linalg.norm(means), np.linalg.norm(residual)] > most))


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(Result):
    """Result of a calibration.

    Attributes:
        machine: The fitted machine.
        parameters: Fitted parameters, in the given order.
        channels: Channels before and after.
        changes: Parameter changes, as in `crane.load(changes=)`.
        correlated_pairs: Pairs of strongly correlated parameters, with their correlation.
        simulation_count: Number of simulations.
        score_tests: Score tests of parameters that were not fitted.
        correlation: (n, n) correlations of the parameters.
        states: Velocities and chamber pressures of the drives of the fitted machine, by recording.
        is_lowest_minimum: Whether no lower minimum was found at the ends of the intervals.
        unselected_parameters: Candidates that the selection left out; they are unchanged.
        selection: Steps of the selection of parameters.
        block_errors: By channel, RMS error in blocks of the training data that were left out of
            the fit: of all blocks, and of the worst.
        minima: Costs of the minima of searches from several starts with smoothed friction,
            relative to the first, from which the search went on.
        findings: Texts about what is not plausible.
    """

    machine: Machine
    parameters: tuple[FittedParameter, ...]
    channels: tuple[CalibrationChannel, ...]
    changes: Mapping[str, float]
    correlated_pairs: tuple[tuple[str, str, float], ...]
    simulation_count: int
    score_tests: tuple[ScoreTestResult, ...] = ()
    correlation: Array = field(default_factory=lambda: np.zeros((0, 0)))
    states: Mapping[str, Mapping[str, Array]] = field(default_factory=dict)
    is_lowest_minimum: bool = True
    unselected_parameters: tuple[str, ...] = ()
    selection: tuple[SelectionStep, ...] = ()
    block_errors: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    minima: tuple[float, ...] = ()
    findings: tuple[str, ...] = ()

    def _one_line(self) -> str:
        """Machine, channels, and identifiable parameters."""
        identifiable = [x for x in self.parameters if not (x.at_bound or x.is_unidentifiable)]
        values = ", ".join(f"{x.name} = {x.value:.5g}" for x in identifiable)
        return (
            f"Calibration of '{self.machine.name}': {len(identifiable)} of "
            f"{format_count(len(self.parameters), 'parameter')} determined by "
            f"{format_count(len(self.channels), 'channel')}{': ' * bool(identifiable)}{values}"
        )

    @property
    def notes(self) -> dict[str, str]:
        """Comments on the changed parameters by name."""
        return {name: text for one in self.parameters for name, text in one.notes.items()}

    @property
    def correlated_directions(self) -> list[dict[str, float]]:
        """Directions that the recordings do not determine, see `correlated_directions`."""
        return correlated_directions(
            [one.name for one in self.parameters],
            self.correlation,
            np.array([one.interval_half_width for one in self.parameters]),
        )

    @property
    def values(self) -> dict[str, float]:
        """Fitted values by name."""
        return {one.name: one.value for one in self.parameters}

    @property
    def degraded_channels(self) -> list[str]:
        """Channels with larger residuals on held-out data than before."""
        several = len({x.recording for x in self.channels}) > 1
        return [
            f"{x.recording}: {x.name}" if several else x.name
            for x in self.channels
            if x.rms(x.simulated_after, False)
            > max(_DEGRADATION_FACTOR * x.rms(x.simulated_before, False), x.noise)
        ]

    @property
    def unexplained_channels(self) -> list[str]:
        """Channels whose residuals over the training data are more than noise."""
        return list(dict.fromkeys(x.name for x in self.channels if x.exceeds_noise))

    @property
    def quality_warnings(self) -> list[str]:
        """Warnings about the calibration as a whole."""
        texts = [*self.findings]
        if not self.is_lowest_minimum:
            texts.append(LOWER_MINIMUM_WARNING)
        if self.unexplained_channels:
            texts.append(
                f"The residuals of {', '.join(self.unexplained_channels)} are more than noise: "
                "the model lacks something, and the intervals do not contain that error."
            )
        if self.degraded_channels:
            texts.append(
                "On held-out data the residuals are larger than before in "
                f"{', '.join(self.degraded_channels)}: fit fewer parameters, or record more."
            )
        return texts

    @property
    def command_line_options(self) -> str:
        """Options of the command line for the same machine."""
        return " ".join(f"--set {name}={value:.8g}" for name, value in self.changes.items())

    def describe_direction(self, direction: Mapping[str, float]) -> str:
        """Text of a direction: parameters that may change together."""
        units = {one.name: one.unit for one in self.parameters}
        return ", ".join(f"{x} by {by:+.2g} {units[x]}".rstrip() for x, by in direction.items())

    def to_text(self) -> str:
        """Report in Markdown."""
        lines = [
            "| parameter | before | fitted | 95 % interval | |",
            "| --- | ---: | ---: | ---: | --- |",
        ]
        for one in self.parameters:
            width = f"± {one.interval_half_width:.2g}"
            lines.append(
                f"| {one.name} | {one.start:.5g} | {one.value:.5g} | {width} | {one.remark} |"
            )
        for text in self.quality_warnings:
            lines += ["", text]
        if self.correlated_pairs:
            lines += ["", "Strongly correlated, of which only a combination is identifiable:", ""]
            lines += [f"- {a} and {b} (correlation {r:+.3f})" for a, b, r in self.correlated_pairs]
        if self.correlated_directions:
            lines += ["", "Directions that the recordings do not determine:", ""]
            lines += [
                f"- {self.describe_direction(direction)}"
                for direction in self.correlated_directions
            ]
        if self.score_tests:
            lines += ["", "Parameters whose fit would reduce the cost further:", ""]
            lines += [
                f"- {x.name} at about {x.value:.3g}: {100 * x.cost_reduction:.0f} %"
                for x in self.score_tests
            ]
        lines += self._selection_lines()
        has_held_out = any(not sensor.train_mask.all() for sensor in self.channels)
        lines += [
            "",
            "| channel | unit | before | fitted |"
            + " held out, before | held out |" * has_held_out,
            "| --- | --- | ---: | ---: |" + " ---: | ---: |" * has_held_out,
        ]
        several = len({sensor.recording for sensor in self.channels}) > 1
        for sensor in self.channels:
            unit, scale = display_unit(sensor.unit, float(np.ptp(sensor.measured)))
            words = [
                f"{scale * sensor.rms(simulated, train):.3g}"
                for train in ((True, False) if has_held_out else (True,))
                for simulated in (sensor.simulated_before, sensor.simulated_after)
            ]
            name = f"{sensor.recording}: {sensor.name}" if several else sensor.name
            words = ["" if word == "nan" else word for word in words]
            lines.append(f"| {name} | {unit} | {' | '.join(words)} |")
        lines += ["", f"RMS of simulated less measured; {self.simulation_count} simulations."]
        if len(self.minima) > 1:
            minima = ", ".join(f"{x:.3g}" for x in self.minima)
            lines += ["", f"Searches from several starts ended at {minima} times the sum of "
                      "squares of the first, from which this fit went on."]  # fmt: skip
        if self.changes:
            lines += ["", f"    {self.command_line_options}"]
        return "\n".join(lines)

    def _selection_lines(self) -> list[str]:
        """Path of the selection, and errors in the blocks that were left out, in Markdown."""
        if not self.selection:
            return []
        units = {x.name: display_unit(x.unit, float(np.ptp(x.measured))) for x in self.channels}
        names = list(self.selection[0].errors)
        columns = [f"{name} [{units[name][0]}]" for name in names]

        def cells(errors: Mapping[str, float]) -> str:
            return " | ".join(f"{units[name][1] * errors[name]:.3g}" for name in names)

        lines = ["", "Selection: parameters in the order of what they reduce in blocks that are "
                 "left out, by linearization, with the errors there:", "",
                 f"| | score | BIC | {' | '.join(columns)} |",
                 "| --- | ---: | ---: |" + " ---: |" * len(names)]  # fmt: skip
        for step in self.selection:
            word = (
                f"{'without' if step.is_removal else 'with'} {step.name}" if step.name else "start"
            )
            lines.append(
                f"| {word} | {step.score:.1f} | {step.information_criterion:.1f} | "
                f"{cells(step.errors)} |"
            )
        for k, word in enumerate(("blocks left out", "the worst block")):
            errors = {name: self.block_errors[name][k] for name in names}
            lines.append(f"| simulated, {word} | | | {cells(errors)} |")
        lines += ["", "Left out, exact to the intervals but for those with all candidates: "
                  + ", ".join(self.unselected_parameters)]  # fmt: skip
        return lines


@dataclass(frozen=True, eq=False, repr=False)
class ResidualDependence(OneLineRepr):
    """Residuals of a channel over the training data, and the motion of a drive.

    Attributes:
        name: Name of the channel.
        unit: Unit of the channel.
        residual: (N,) simulated minus measured.
        drive: Joint whose motion is compared.
        speed_unit: Unit of its speed.
        chamber: Chamber "a" or "b" of the pressure.
        motion: Speed, pressure and direction (-1, 0 at rest, 1), (N,) each.
        correlation_ratios: Correlation ratio of the residual with each of these.
    """

    name: str
    unit: str
    residual: Array
    drive: str
    speed_unit: str
    chamber: str
    motion: Mapping[str, Array]
    correlation_ratios: Mapping[str, float]


def residual_dependences(calibration: Calibration) -> list[ResidualDependence]:
    """Residual dependence of every fitted channel, over all recordings.

    A channel is compared with the drive in its name, else with the drive of the largest
    correlation ratio with the speed. The list is empty for a machine without valves.
    """
    channels: dict[str, list[CalibrationChannel]] = {}
    for channel in calibration.channels:
        if channel.train_mask.any() and channel.recording in calibration.states:
            channels.setdefault(channel.name, []).append(channel)
    dependences = []
    for name, same_name in channels.items():
        drives = [
            x.removesuffix(VELOCITY_SUFFIX)
            for x in calibration.states[same_name[0].recording]
            if x.endswith(VELOCITY_SUFFIX)
        ]
        named_drives = [drive for drive in drives if f"_{drive}_" in f"_{name}_"]
        options = [
            _residual_dependence(calibration, same_name, x)
            for x in ([max(named_drives, key=len)] if named_drives else drives)
        ]
        dependences += (
            [max(options, key=lambda one: one.correlation_ratios["speed"])] if options else []
        )
    return dependences


def group_samples(x: Array) -> list[NDArray[np.intp]]:
    """Groups of samples (N,) by x, of about equal size, or one per value if x has few values."""
    values = np.unique(x)
    if len(values) <= _MAX_GROUPS:
        return [np.flatnonzero(x == value) for value in values]
    return list(np.array_split(np.argsort(x, kind="stable"), _MAX_GROUPS))


def correlation_ratio(residual: Array, x: Array) -> float:
    """Correlation ratio of a residual (N,) with x (N,), 0 to 1."""
    deviation = residual - residual.mean()
    total = float(deviation @ deviation)
    explained = sum(len(some) * float(deviation[some].mean()) ** 2 for some in group_samples(x))
    return explained / total if total else 0.0


def _residual_dependence(
    calibration: Calibration, channels: list[CalibrationChannel], drive: str
) -> ResidualDependence:
    """Dependence of channels of one name on the motion of a drive."""
    name, unit = channels[0].name, channels[0].unit
    chamber = "b" if name == f"{PRESSURE_PREFIX}{drive}_b" else "a"

    def joined(column: str) -> Array:
        return np.concatenate(
            [calibration.states[x.recording][column][x.train_mask] for x in channels]
        )

    residual = np.concatenate([(x.simulated_after - x.measured)[x.train_mask] for x in channels])
    speed = joined(drive + VELOCITY_SUFFIX)
    direction = np.sign(speed) * (np.abs(speed) > _REST_SPEED_SHARE * np.abs(speed).max())
    motion = {"speed": speed, "pressure": joined(f"{PRESSURE_PREFIX}{drive}_{chamber}"),
              "direction": direction}  # fmt: skip
    return ResidualDependence(
        name, unit, residual, drive, VELOCITY_UNITS[calibration.machine.unit(drive)], chamber,
        motion, {what: correlation_ratio(residual, x) for what, x in motion.items()},
    )  # fmt: skip
