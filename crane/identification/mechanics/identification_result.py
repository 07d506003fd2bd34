"""Result of an identification: parameters, covariance, prediction errors, tables."""

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from crane.common.atomic_output import write_csv
from crane.common.result import Result
from crane.common.samples import Array
from crane.common.units import format_table
from crane.identification.estimation.estimators import Estimate, EstimatedValues
from crane.identification.mechanics.base_parameters import BaseParameters
from crane.identification.mechanics.force_comparison import ForceComparison
from crane.identification.mechanics.force_delays import ForceDelays
from crane.identification.mechanics.identifiability import weak_directions
from crane.identification.mechanics.identification_model import IdentificationModel
from crane.identification.mechanics.settings_selection import SettingsSelection
from crane.machine.machine import Machine

_IMPOSSIBLE_FACTOR = 10.0  # times the magnitude, above which a parameter is impossible
_MAX_SHOWN = 3  # directions in a table


@dataclass(frozen=True, eq=False, repr=False)
class Identification(EstimatedValues, Result):
    """Result of an identification.

    Attributes:
        model: The identified model.
        base: Base parameters that the recording determines.
        values: (r,) values of the base parameters.
        covariance: (r, r) covariance of the values.
        parameters: (p,) values of all parameters with a prior or feasibility constraints, else
            None: forces determine the base parameters only.
        estimate: Result of the estimator, with noise and condition numbers; of all parameters if
            these are estimated.
        method: Name of the estimator.
        feasible: Whether every body of `parameters` is physically feasible.
        training: Comparison of forces on the training data.
        magnitude: (r,) magnitudes of the base parameters: sqrt(sum_j (K_ij s_j)^2) for the group
            K_i and the `parameter_magnitudes` s.
        advice: Text that recommends a motion for the parameters that are not determined.
        bandwidth: Bandwidth of the low-pass [Hz].
        min_speed: (n,) standstill velocities, below which rows were omitted [m/s], [rad/s].
        validation: Comparison of forces on held-out data, None without them.
        delays: Delays of the forces, one object per recording.
        selection: Settings that were selected within the training data, None if all are given.
    """

    model: IdentificationModel
    base: BaseParameters
    values: Array
    covariance: Array
    parameters: Array | None
    estimate: Estimate
    method: str
    feasible: bool
    training: ForceComparison
    magnitude: Array
    advice: str
    bandwidth: float
    min_speed: Array
    validation: ForceComparison | None = None
    delays: tuple[ForceDelays, ...] = ()
    selection: SettingsSelection | None = None

    def _one_line(self) -> str:
        """Machine, number of parameters, method, and errors."""
        kind = "feasible, " if self.feasible else ""
        fits = {"error": self.training, "validation": self.validation}
        error_texts = (
            f", {name} {fit.overall_relative_error:.3%}"
            for name, fit in fits.items()
            if fit is not None and not math.isnan(fit.overall_relative_error)
        )
        vague = self.marks.count("not determined")
        return (
            f"Identification of '{self.described_machine.name}': {len(self.values)} base "
            f"parameters{f', {vague} not determined' if vague else ''}, "
            f"{kind}{self.method}{''.join(error_texts)}"
        )

    @property
    def names(self) -> tuple[str, ...]:
        """First parameter (r,) of each group."""
        return tuple(self.base.names[i] for i in self.base.independent)

    @property
    def degrees_of_freedom(self) -> float:  # type: ignore[override]
        """Degrees of freedom of the covariance."""
        return self.estimate.degrees_of_freedom

    @cached_property
    def marks(self) -> tuple[str, ...]:
        """Mark of each parameter (r,): "not determined", "impossible", or "".

        A parameter is not determined if its standard deviation exceeds its magnitude. It is
        impossible if it exceeds ten times its magnitude by more than two standard deviations.
        """
        beyond = np.abs(self.values) - 2 * self.std > _IMPOSSIBLE_FACTOR * self.magnitude
        return tuple(
            "not determined" if vague else "impossible" if far else ""
            for vague, far in zip(self.std > self.magnitude, beyond, strict=True)
        )

    @cached_property
    def undetermined_directions(self) -> list[tuple[float, str]]:
        """Directions that the recording does not determine, see `weak_directions`."""
        return weak_directions(self.names, self.covariance, self.magnitude)

    @property
    def delay_text(self) -> str:
        """Text about delays of forces, "" without any."""
        return "; ".join(filter(None, (one.text for one in self.delays)))

    @property
    def remedy(self) -> str:
        """Text of measures that would determine more parameters."""
        if self.delay_text:
            return "take the delays of the forces out first"
        if self.parameters is not None:
            return f"leave such terms out, or {self.advice}"
        return f"give a prior, require physically feasible bodies, or {self.advice}"

    @property
    def warning(self) -> str:
        """Warning about parameters that are not determined or impossible, else ""."""
        vague, wrong = (
            [name for name, mark in zip(self.names, self.marks, strict=True) if mark == kind]
            for kind in ("not determined", "impossible")
        )
        parts = []
        if vague:  # weak combinations of determined parameters are in the table only
            weakest = (
                self.undetermined_directions[0][1] if self.undetermined_directions else vague[0]
            )
            parts.append(
                f"this motion does not determine {len(vague)} of {len(self.names)} base "
                f"parameters, the least {weakest}: {self.remedy}"
            )
        if wrong:
            parts.append(
                f"{', '.join(wrong[:_MAX_SHOWN])} {'is' if len(wrong) == 1 else 'are'} beyond "
                "what such a machine can have: look at units, signs and zeros of the recording"
            )
        return "; ".join(parts)

    @cached_property
    def nominal(self) -> Array:
        """Base parameters (r,) by the description of the machine."""
        return self.base.values(self.model.nominal)

    def predict(
        self, q_a: ArrayLike, v_a: ArrayLike, a_a: ArrayLike, step: float | None = None
    ) -> Array:
        """Predict the forces of a motion with the identified parameters.

        Args:
            q_a: (N, n) [m], [rad].
            v_a: (N, n).
            a_a: (N, n).
            step: Step of the samples [s], for terms that depend on time.

        Returns:
            (N, n) [N], [N m].
        """
        at = self.model.samples(q_a, v_a, a_a, step)
        W, values = self.model.regressor(at), self.parameters
        if values is None:
            W, values = W[:, :, self.base.independent], self.values
        return W @ values + self.model.known_forces(at)

    @property
    def described_machine(self) -> Machine:
        """The described machine; `write_identified` writes the identified one."""
        return self.model.machine

    def to_text(self) -> str:
        """Tables of the errors and of the parameters."""

        def percent(share: float) -> str:
            return "-" if math.isnan(share) else f"{100 * share:.2f} %"

        lines = [
            f"{self.described_machine.name}: {self.base.rank} base parameters of "
            f"{len(self.base.names)}, {self.method}{', feasible' if self.feasible else ''}; "
            f"condition number {self.estimate.condition:.3g}, columns scaled "
            f"{self.estimate.scaled_condition:.3g}",
            "",
        ]
        for title, fit in (("training", self.training), ("validation", self.validation)):
            if fit is None:
                continue
            rows = [["force", "RMS error", "", "relative error", "all rows in motion"]]
            for i, joint in enumerate(fit.joints):
                unit = "N" if self.described_machine.unit(joint) == "m" else "N m"
                share = f"{100 * fit.relative_error[i]:.2f} %"
                if joint in self.described_machine.free:
                    share = "free"
                row = [joint, f"{fit.rmse[i]:.4g}", unit, share, percent(fit.motion_error[i])]
                rows.append(row if fit.is_moving[:, i].any() else [joint, "-", "", "-", "-"])
            if not np.isnan(fit.overall_relative_error):
                errors = fit.relative_error, fit.motion_error
                means = [percent(float(np.nanmean(x))) for x in errors]
                overall = percent(fit.overall_relative_error)
                rows.append(["mean of the joints", "", "", *means])
                rows.append(["all joints together", "", "", overall, ""])
            heading = (
                f"{title}, samples near standstill excluded, last column: all with the joint's "
                f"speed above its least; both sides below {self.bandwidth:.3g} Hz (zero phase)"
            )
            lines += [heading, *format_table(rows, (0, 2)), ""]
        if self.selection is not None:
            lines += [self.selection.to_text(), ""]
        rows = [["parameter", "value", "std", "rel. std", "description", ""]]
        for name, value, std, before, mark in zip(
            self.names, self.values, self.std, self.nominal, self.marks, strict=True
        ):
            share = f"{100 * std / abs(value):.1f} %" if std < 10 * abs(value) else "-"
            rows.append([name, f"{value:.6g}", f"{std:.2g}", share, f"{before:.6g}", mark])
        lines += format_table(rows, (0, 5))
        if self.undetermined_directions:
            lines += [
                "",
                "not determined by this motion (std in multiples of the plausible size):",
            ]
            lines += [
                f"  +- {std:.2g}  {words}"
                for std, words in self.undetermined_directions[:_MAX_SHOWN]
            ]
            if more := len(self.undetermined_directions[_MAX_SHOWN:]):
                lines.append(f"  and {more} more directions")
            lines.append(self.remedy)
        return "\n".join(lines) + "\n"

    def to_csv(self, path: str | Path) -> None:
        """Write the base parameters as CSV: value, std, 95 % interval, description, mark, group.

        Raises:
            OutputError: The file cannot be written.
        """
        heads = ["parameter", "value", "std", "lower", "upper", "description", "mark", "group"]
        columns = [self.values, self.std, *self.confidence_interval().T, self.nominal]
        numbers = np.column_stack(columns).tolist()
        rows = zip(self.names, numbers, self.marks, self.base.groups, strict=True)
        write_csv(path, [heads, *([name, *map(repr, x), *words] for name, x, *words in rows)])
