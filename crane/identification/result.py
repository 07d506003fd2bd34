"""What an identification found, and how well it predicts."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from crane.identification.base import Base
from crane.identification.estimators import Estimate
from crane.identification.model import Model
from crane.machine import Machine
from crane.samples import Array, Brief


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(Brief):
    """Measured and modelled forces of one recording, both through the same filter.

    Attributes:
        time: (M,) [s].
        measured: (M, n) [N], [N m].
        modelled: (M, n).
        moving: (M, n) which rows count: those away from zero velocity.
        joints: Names (n,).
    """

    time: Array
    measured: Array
    modelled: Array
    moving: np.ndarray
    joints: tuple[str, ...]

    @property
    def residuals(self) -> Array:
        """(M, n) measured less modelled."""
        return self.measured - self.modelled

    def _rms(self, values: Array) -> Array:
        count = np.maximum(self.moving.sum(axis=0), 1)
        return np.sqrt((np.where(self.moving, values, 0.0) ** 2).sum(axis=0) / count)

    @property
    def rmse(self) -> Array:
        """(n,) root mean square of the residuals [N], [N m]."""
        return self._rms(self.residuals)

    @property
    def relative(self) -> Array:
        """(n,) the same over the root mean square of the measured force."""
        size = self._rms(self.measured)
        return np.divide(self.rmse, size, out=np.full_like(size, np.nan), where=size > 0)

    @property
    def percentage_error(self) -> Array:
        """(n,) equation (9) of the reduced-scale forwarder paper [%]: 100 relative^2."""
        return 100 * self.relative**2

    @property
    def stacked(self) -> float:
        """Norm of all residuals over that of all measured forces."""
        kept = self.moving
        return float(np.linalg.norm(self.residuals[kept]) / np.linalg.norm(self.measured[kept]))


@dataclass(frozen=True, eq=False)
class Identification:
    """Parameters of a machine from a recording.

    Attributes:
        model: What was identified.
        base: Base parameters that the recording tells.
        values: (r,) their values.
        covariance: (r, r).
        parameters: (p,) values of all parameters, where a prior or feasibility asked for them;
            else None: forces determine the base parameters only.
        estimate: Of the estimator, with noise and condition numbers.
        method: Name of the estimator.
        feasible: Whether every body of `parameters` can exist.
        training: On the recording it was identified from.
        validation: On another one, if there was one.
    """

    model: Model
    base: Base
    values: Array
    covariance: Array
    parameters: Array | None
    estimate: Estimate
    method: str
    feasible: bool
    training: Comparison
    validation: Comparison | None = None

    def __repr__(self) -> str:
        """What was identified, how, and how well it predicts."""
        kind = "feasible, " if self.feasible else ""
        judged = "" if self.validation is None else f", validation {self.validation.stacked:.3%}"
        return (
            f"Identification of '{self.machine.name}': {len(self.values)} base parameters, "
            f"{kind}{self.method}, error {self.training.stacked:.3%}{judged}"
        )

    @property
    def names(self) -> tuple[str, ...]:
        """(r,) first parameter of each group."""
        return tuple(self.base.names[i] for i in self.base.independent)

    @property
    def std(self) -> Array:
        """(r,) standard deviations."""
        return np.sqrt(np.diag(self.covariance))

    def interval(self, level: float = 0.95) -> Array:
        """(r, 2) ends of what covers the truth with this probability."""
        from scipy.stats import t

        half = t.ppf(0.5 + 0.5 * level, self.estimate.freedom) * self.std
        return np.column_stack([self.values - half, self.values + half])

    @cached_property
    def nominal(self) -> Array:
        """(r,) what the machine's description says."""
        return self.base.values(self.model.nominal)

    def predict(self, q_a: ArrayLike, v_a: ArrayLike, a_a: ArrayLike) -> Array:
        """Forces of a motion by the identified parameters.

        Args:
            q_a: (N, n) [m], [rad].
            v_a: (N, n).
            a_a: (N, n).

        Returns:
            (N, n) [N], [N m].
        """
        at = self.model.samples(q_a, v_a, a_a)
        W = self.model.regressor(at)[:, :, self.base.independent]
        return W @ self.values + self.model.known(at)

    @property
    def machine(self) -> Machine:
        """The machine that was identified."""
        return self.model.machine

    def to_text(self) -> str:
        """Tables of the fit and of the parameters."""
        lines = [
            f"{self.machine.name}: {self.base.rank} base parameters of {len(self.base.names)}, "
            f"{self.method}{', feasible' if self.feasible else ''}; condition number "
            f"{self.estimate.condition:.3g}, columns scaled {self.estimate.scaled_condition:.3g}",
            "",
        ]
        head = f"{'force':<16}{'RMS error':>12}{'relative':>10}{'PE (9)':>9}"
        for title, fit in (("training", self.training), ("validation", self.validation)):
            if fit is None:
                continue
            lines += [f"{title}, moving rows", head]
            for i, joint in enumerate(fit.joints):
                unit = "N" if self.machine.unit(joint) == "m" else "N m"
                lines.append(
                    f"{joint:<16}{fit.rmse[i]:>9.4g} {unit:<3}{100 * fit.relative[i]:>8.2f} %"
                    f"{fit.percentage_error[i]:>7.3f} %"
                )
            lines += [f"all, stacked{'':>19}{100 * fit.stacked:>8.2f} %", ""]
        head = f"{'parameter':<28}{'value':>13}{'std':>12}{'rel. std':>10}{'description':>14}"
        lines.append(head)
        for name, value, std, before in zip(
            self.names, self.values, self.std, self.nominal, strict=True
        ):
            share = f"{100 * std / abs(value):.1f} %" if value else "-"
            lines.append(f"{name:<28}{value:>13.6g}{std:>12.2g}{share:>10}{before:>14.6g}")
        return "\n".join(lines) + "\n"
