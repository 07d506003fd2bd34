"""A load on a frame, and what was found of it."""

from dataclasses import dataclass

import numpy as np

from crane.common.errors import InputError
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array
from crane.common.units import format_table
from crane.dynamics import Dynamics
from crane.identification.mechanics.feasible_parameters import body_parameters, pseudo_inertia
from crane.identification.mechanics.force_comparison import ForceComparison
from crane.identification.mechanics.inertial_terms import BODY_PARAMETERS, inertial_regressor
from crane.identification.mechanics.model_term import MotionSamples
from crane.machine import Machine


class PayloadTerm:
    """A rigid body on a frame: its ten parameters about the frame's origin.

    Args:
        machine: The machine.
        frame: A link of it, which moves.
        parameter_count: How many of the ten: 4 without inertia, 1 for a point at the origin.
    """

    def __init__(self, machine: Machine, frame: str, parameter_count: int = 10):
        model_frame = machine.model.frames[machine.frame(frame)]
        if model_frame.parentJoint == 0:
            raise InputError(f"frame '{frame}' does not move, choose another")
        first = 10 * (model_frame.parentJoint - 1)
        A = model_frame.placement.homogeneous  # P about the joint is A P A^T
        self._frame_transform = body_parameters(A @ pseudo_inertia(np.eye(10)) @ A.T)[
            :parameter_count
        ].T
        self._body_columns = slice(first, first + 10)
        self._dynamics = Dynamics(machine)
        self.names = tuple(f"load.{key}" for key in BODY_PARAMETERS[:parameter_count])
        self.nominal, self.nonnegative = np.zeros(parameter_count), (False,) * parameter_count

    def columns(self, samples: MotionSamples) -> Array:
        """See `model.ModelTerm`."""
        return (
            inertial_regressor(self._dynamics, samples)[:, :, self._body_columns]
            @ self._frame_transform
        )


@dataclass(frozen=True, eq=False, repr=False)
class PayloadEstimate(OneLineRepr):
    """A load on a frame.

    Attributes:
        frame: A link of the machine.
        mass: [kg].
        com: (3,) centre of mass in the frame [m]; nan along axes that the motion does not tell.
            All nan where it was taken to be at the frame's origin, as nothing tells it.
        covariance: (4, 4) of mass and com, to first order; nan as `com`. The larger of what the
            noise makes and of what leaving out a tenth of the recording changes (jackknife).
        degrees_of_freedom: (4,) degrees of freedom behind each.
        directions: (k, 3) orthonormal directions of the frame along which the motion tells where
            the centre of mass is.
        friction_corrections: By drive, Coulomb friction that the machine's own lacks [N], [N m],
            of those that moved both ways.
        static_mass: Mass that the forces at rest tell with that centre of mass, and by how much
            friction may be in it [kg]; None where nothing rests, or the centre is not told.
        fit: What of the forces is not the machine's, and what the load explains.
    """

    frame: str
    mass: float
    com: Array
    covariance: Array
    degrees_of_freedom: Array
    directions: Array
    friction_corrections: dict[str, float]
    static_mass: tuple[float, float] | None
    fit: ForceComparison

    @property
    def std_mass(self) -> float:
        """Standard deviation of the mass [kg]."""
        return float(np.sqrt(self.covariance[0, 0]))

    @property
    def std_com(self) -> Array:
        """(3,) standard deviations of the centre of mass [m]."""
        return np.sqrt(np.diag(self.covariance)[1:])

    def interval(self, level: float = 0.95) -> Array:
        """(4, 2) ends of what covers mass and centre of mass with this probability each."""
        from scipy.stats import t

        half = t.ppf(0.5 + 0.5 * level, self.degrees_of_freedom) * np.sqrt(
            np.diag(self.covariance)
        )
        values = np.append(self.mass, self.com)
        return np.column_stack([values - half, values + half])

    @property
    def warning(self) -> str:
        """Why the mass should not be believed, "" where nothing is against it."""
        low, high = self.interval()[0].tolist()
        if self.static_mass is None:
            return ""
        mass, band = self.static_mass
        if low - band <= mass <= high + band:
            return ""
        return (
            f"the forces at rest say {mass:.4g} +- {band:.2g} kg (friction): the machine is not "
            "as described, identify it without the load first"
        )

    def to_text(self) -> str:
        """A table of mass and centre of mass."""
        rows = [["", "value", "std", "95 % interval", ""]]
        values, names = np.append(self.mass, self.com), ("mass", "com x", "com y", "com z")
        units = ("kg", "m", "m", "m")
        std = np.sqrt(np.diag(self.covariance))
        table = zip(names, units, values, std, self.interval(), strict=True)
        for name, unit, value, deviation, (low, high) in table:
            if np.isnan(value):
                rows.append([name, "-", "", "not told by this motion", ""])
                continue
            interval_text = f"{low:.5g} to {high:.5g} {unit}"
            rows.append([name, f"{value:.5g}", f"{deviation:.2g}", interval_text, ""])
        at = ", taken as a point there" if np.isnan(self.com).all() else ""
        lines = [f"load on {self.frame}{at}", *format_table(rows, (0, 3))]
        if self.interval()[0, 0] <= 0:
            lines.append("the mass may be zero: do not trust its centre")
        if self.static_mass is not None:
            lines.append(
                "mass by the forces at rest: {:.5g} +- {:.2g} kg".format(*self.static_mass)
            )
        if self.warning:
            lines.append(f"do not trust this: {self.warning}")
        lines.append(
            f"forces left unexplained: {100 * self.fit.overall_relative_error:.3g} % of the "
            f"load's share"
        )
        return "\n".join(lines) + "\n"
