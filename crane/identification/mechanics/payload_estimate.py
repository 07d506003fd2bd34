"""A payload on a frame: model term, estimate, and mass from the forces at rest."""

from dataclasses import dataclass, replace

import numpy as np

from crane.common.errors import InputError
from crane.common.samples import Array, true_runs
from crane.common.units import format_table
from crane.dynamics.dynamics import Dynamics
from crane.identification.estimation.estimators import EstimatedValues
from crane.identification.mechanics.feasible_parameters import body_parameters, pseudo_inertia
from crane.identification.mechanics.force_comparison import ForceComparison
from crane.identification.mechanics.identification_model import IdentificationModel
from crane.identification.mechanics.model_terms import (
    BODY_PARAMETERS,
    MotionSamples,
    inertial_regressor,
)
from crane.identification.signals.signal_processing import Motion, low_pass
from crane.identification.signals.signal_quality import spectral_edge_frequency
from crane.machine.machine import Machine

_REST_SPEED_SHARE = 0.05  # of a joint's largest velocity, below which it is at rest
_MIN_REST_DURATION = 0.25  # [s], least duration of rest
MIN_FRICTION_SHARE = 0.01  # least uncertainty at rest by friction and sensors, per drive force
_CUTOFF_FACTOR = 10.0  # cutoff of static forces, times the frequency of the motion
_MIN_PERIODS = 5.0  # periods of the cutoff in a recording


class PayloadTerm:
    """Term of a rigid body on a frame: its parameters about the origin of the frame.

    With a known centre of mass these are its mass and its inertia about the centre.

    Args:
        machine: The machine.
        frame: Name of a moving link.
        has_inertia: Whether the inertia is among the parameters.
        com: (3,) centre of mass in the frame [m], None if the first moments are parameters.
    """

    def __init__(
        self, machine: Machine, frame: str, has_inertia: bool = True, com: Array | None = None
    ):
        model_frame = machine.model.frames[machine.frame(frame)]
        if model_frame.parentJoint == 0:
            raise InputError(f"frame '{frame}' does not move, choose another")
        first = 10 * (model_frame.parentJoint - 1)
        A = model_frame.placement.homogeneous  # the pseudo-inertia about the joint is A P A^T
        if com is not None:
            A[:3, 3] += A[:3, :3] @ com
        kept = np.r_[0 : 4 if com is None else 1, 4 : 10 if has_inertia else 4]
        self._frame_transform = body_parameters(A @ pseudo_inertia(np.eye(10)) @ A.T)[kept].T
        self._body_columns = slice(first, first + 10)
        self._dynamics = Dynamics(machine)
        self.names = tuple(f"load.{BODY_PARAMETERS[i]}" for i in kept)
        self.nominal, self.nonnegative = np.zeros(len(kept)), (False,) * len(kept)

    def columns(self, samples: MotionSamples) -> Array:
        """See `model.ModelTerm`."""
        return (
            inertial_regressor(self._dynamics, samples)[:, :, self._body_columns]
            @ self._frame_transform
        )


@dataclass(frozen=True, eq=False, repr=False)
class PayloadEstimate(EstimatedValues):
    """Estimated payload on a frame.

    Attributes:
        frame: Name of the link.
        mass: Mass [kg].
        com: (3,) centre of mass in the frame [m], as given or estimated; nan along axes that the
            motion does not determine, all nan if the load was taken as a point at the origin.
        covariance: (4, 4) covariance of mass and com to first order, the larger of that by noise
            and that by the jackknife; nan as for `com`.
        degrees_of_freedom: (4,) degrees of freedom of each variance.
        directions: (k, 3) orthonormal directions of the frame in which the motion determines the
            centre of mass.
        friction_corrections: Corrections of Coulomb friction [N], [N m] by drive that moved in
            both directions.
        static_mass: Mass by the forces at rest for this centre of mass, and its uncertainty by
            friction [kg]; None without rest.
        fit: Forces beyond those of the machine, measured and by the load.
        is_com_given: Whether the centre of mass was given.
        mass_gradient: (3,) derivatives of the mass by the centre of a load that was taken as a
            point [kg/m], None otherwise.
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
    is_com_given: bool = False
    mass_gradient: Array | None = None

    @property
    def values(self) -> Array:  # type: ignore[override]
        """Mass and centre of mass (4,)."""
        return np.append(self.mass, self.com)

    @property
    def warning(self) -> str:
        """Warning if the forces at rest contradict the mass, else ""."""
        low, high = self.confidence_interval()[0].tolist()
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
        """Table of mass and centre of mass."""
        rows = [["", "value", "std", "95 % interval", ""]]
        names, units = ("mass", "com x", "com y", "com z"), ("kg", "m", "m", "m")
        table = zip(names, units, self.values, self.std, self.confidence_interval(), strict=True)
        for name, unit, value, deviation, (low, high) in table:
            if np.isnan(value):
                rows.append([name, "-", "", "not determined by this motion", ""])
                continue
            if self.is_com_given and name != "mass":
                rows.append([name, f"{value:.5g}", "", "given", ""])
                continue
            interval = f"{low:.5g} to {high:.5g} {unit}"
            rows.append([name, f"{value:.5g}", f"{deviation:.2g}", interval, ""])
        point = ", modelled as a point mass" if self.mass_gradient is not None else ""
        at = " at this frame" if point and not self.is_com_given else ""
        lines = [f"load on {self.frame}{point}{at}", *format_table(rows, (0, 3))]
        if at and self.mass_gradient is not None:
            changes = ", ".join(f"{0.1 * x:+.2g}" for x in self.mass_gradient)
            lines.append(
                f"per 0.1 m of its centre along x, y, z the mass changes by {changes} kg: give "
                "the centre (--centre X,Y,Z)"
            )
        if self.confidence_interval()[0, 0] <= 0:
            lines.append("the mass may be zero: do not trust its centre")
        if self.static_mass is not None:
            lines.append(
                "mass by the forces at rest: {:.5g} +- {:.2g} kg".format(*self.static_mass)
            )
        if self.warning:
            lines.append(f"do not trust this: {self.warning}")
        lines.append(
            f"residual forces: {100 * self.fit.overall_relative_error:.3g} % of the load's share"
        )
        return "\n".join(lines) + "\n"


def low_passed_motion(motion: Motion) -> Motion:
    """Motion with velocities and accelerations filtered at `static_cutoff`."""
    cutoff, step = static_cutoff(motion), float(motion.time[1] - motion.time[0])
    if 4 * cutoff >= 1 / step:
        return motion
    v, a = (low_pass(motion.time, x, cutoff) for x in (motion.v, motion.a))
    return replace(motion, v=v, a=a)


def static_cutoff(motion: Motion) -> float:
    """Cutoff [Hz] below which forces are weights and friction."""
    step, duration = float(motion.time[1] - motion.time[0]), float(np.ptp(motion.time))
    wanted = max(_CUTOFF_FACTOR * spectral_edge_frequency(motion.q, step), _MIN_PERIODS / duration)
    return min(wanted, 0.24 / step)


def static_mass(
    machine: Machine,
    frame: str,
    motion: Motion,
    friction_corrections: dict[str, float],
    com: Array,
) -> tuple[float, float] | None:
    """Mass by the forces at rest and its uncertainty by friction; None without rest.

    Each drive is weighted by its friction, described and corrected, as a standard deviation.
    """
    step = float(motion.time[1] - motion.time[0])
    v = low_passed_motion(motion).v
    is_resting = (np.abs(v) <= _REST_SPEED_SHARE * np.abs(v).max(axis=0)).all(axis=1)
    runs = [
        (i, j) for i, j in true_runs(is_resting).tolist() if (j - i) * step >= _MIN_REST_DURATION
    ]
    if not runs:
        return None
    q = np.array([motion.q[i:j].mean(axis=0) for i, j in runs])
    tau = np.array([motion.tau[i:j].mean(axis=0) for i, j in runs])
    zero = np.zeros_like(q)
    tau = tau - Dynamics(machine).inverse(q, zero, zero)
    load = PayloadTerm(machine, frame, has_inertia=False)
    at = IdentificationModel(machine, [load]).samples(q, zero, zero)
    unit_forces = load.columns(at) @ np.append(1.0, com)
    friction_forces = np.array([breakaway_force(machine, joint) for joint in machine.active])
    friction_forces += [abs(friction_corrections.get(joint, 0.0)) for joint in machine.active]
    friction_forces = np.maximum(
        friction_forces, MIN_FRICTION_SHARE * np.sqrt(np.mean(motion.tau**2, axis=0))
    )
    information = ((unit_forces / friction_forces) ** 2).sum()
    if not information > 0:
        return None
    mass = float((unit_forces * tau / friction_forces**2).sum() / information)
    # drives that disagree by more than their friction widen the uncertainty
    misfit = float((((tau - unit_forces * mass) / friction_forces) ** 2).sum()) / max(
        unit_forces.size - 1, 1
    )
    return mass, float(np.sqrt(max(misfit, 1.0) * len(runs) / information))


def breakaway_force(machine: Machine, joint: str) -> float:
    """Largest friction of a joint at rest [N], [N m]."""
    law = machine.friction.get(joint)
    return 0.0 if law is None else law.coulomb + law.stiction + abs(law.coulomb_offset)
