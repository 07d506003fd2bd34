"""Identification of mass and centre of mass of a payload on a known machine."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NoReturn

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import InputError, RecordingError, check_name
from crane.common.progress import Progress, progress_reporter
from crane.common.samples import Array, as_sample, root_mean_square
from crane.common.threads import with_single_threaded_blas
from crane.dynamics.dynamics import Dynamics
from crane.identification.estimation.estimators import Estimate
from crane.identification.estimation.regressor import triangular_factor
from crane.identification.mechanics.base_parameters import BaseParameters
from crane.identification.mechanics.force_comparison import ForceComparison, check_forces
from crane.identification.mechanics.identification_model import IdentificationModel
from crane.identification.mechanics.identify import METHODS, build_equations, multi_pass_progress
from crane.identification.mechanics.model_terms import ModelTerm, friction_term
from crane.identification.mechanics.payload_estimate import (
    MIN_FRICTION_SHARE,
    PayloadEstimate,
    PayloadTerm,
    breakaway_force,
    low_passed_motion,
    static_cutoff,
    static_mass,
)
from crane.identification.mechanics.regression_equations import (
    RegressionEquations,
)
from crane.identification.mechanics.smoothed_motion import smoothed_motion
from crane.identification.signals.signal_processing import Motion
from crane.identification.signals.signal_quality import reject_unless_trusted
from crane.machine.machine import Machine
from crane.recordings.recording import Recording

_IDENTIFIABLE_TOLERANCE = 1e-6  # part of a direction outside of the identifiable ones
_SEGMENT_COUNT = 10  # segments of a recording in the jackknife
_MIN_RETURN_SHARE = 0.1  # least share of a drive's travel in the other direction
_MAX_INTERVAL_SHARE = 0.1  # largest half width of an interval, relative to the moving mass
_CENTRE_STEP = 0.01  # [m] step of derivatives by the centre of a point load


@with_single_threaded_blas
def identify_payload(
    machine: Machine,
    recording: Recording | Motion,
    frame: str | None = None,
    method: str = "wls",
    inertia: bool = True,
    trust: bool = False,
    progress: Progress | None = None,
    com: ArrayLike | None = None,
) -> PayloadEstimate:
    """Identify a payload from the forces that the machine alone does not explain.

    The equations are tau_A - (M_A a_A + bias + friction) = Y_b T phi + sum_j c_j sign(v_j), with
    the columns Y_b of the body that carries the frame, the ten parameters phi of the load about
    the frame, their change of frame T, and corrections c_j of the Coulomb friction of drive j,
    which depends on load, temperature and wear, and looks like weight if a drive moves in one
    direction only. The machine is otherwise taken as known; its errors show as different loads in
    parts of the recording, which widens the intervals (delete-one jackknife over ten segments).

    If this does not determine the mass, the load is taken as a point at `com`, or at the origin of
    the frame: one mass beside friction, with signals low-passed at ten times the frequency of the
    motion. The friction of a drive that moved in one direction only has a prior of the described
    friction, at least a hundredth of the drive force. A different mass by the forces at rest
    widens the interval.

    Args:
        machine: Identified machine without the load.
        recording: Recording of a motion with the load.
        frame: Frame that carries the load; default the tip.
        method: As for `identify`.
        inertia: Whether to estimate the inertia of the load about the frame, or neglect it.
        trust: As for `identify`.
        progress: Called with the finished share, 0 to 1.
        com: (3,) known centre of mass of the load in the frame [m]; estimated, where the motion
            determines it, if not given.

    Raises:
        InputError: The frame or method is unknown, the frame does not move, or `com` is no point.
        RecordingError: The recording is not suitable, does not determine the mass to within itself
            and a tenth of the machine's mass, or the mass is significantly negative.

    Source: Efron, Stein 1981, Annals of Statistics 9(3), the jackknife.
    """
    progress = progress_reporter(progress)
    check_name(method, METHODS, f"method '{method}' is unknown")
    if frame is None and machine.tip is None:
        raise InputError(f"'{machine.name}' has no tip, give the frame that holds the load")
    frame = frame or str(machine.tip)
    motion, progress = recording, multi_pass_progress(progress)
    if not isinstance(motion, Motion):
        motion = smoothed_motion(machine, motion, trust=trust, progress=progress)
    drive_moves = np.ptp(motion.v, axis=0) > 0
    names = [joint for joint, moved in zip(machine.active, drive_moves, strict=True) if moved]
    v = low_passed_motion(motion).v[:, drive_moves]
    travel = np.sort([np.maximum(v, 0).sum(axis=0), np.maximum(-v, 0).sum(axis=0)], axis=0)
    moves_one_way = travel[0] < _MIN_RETURN_SHARE * travel[1]
    one_way_drives = [x for x, one_way in zip(names, moves_one_way, strict=True) if one_way]
    centre = None if com is None else as_sample(com, 3, "the load's com")
    case = _PayloadCase(machine, frame, motion, method, names, one_way_drives, centre)
    first = case.estimate_body(inertia, trust, progress)
    if first is not None and not case.is_uncertain(first):
        low, high = first.confidence_interval()[0].tolist()
        _check_mass(first, trust)
        if low <= 0 <= high:  # not significant
            return first
        found = np.nan_to_num(first.com)
        held_mass = static_mass(machine, frame, motion, first.friction_corrections, found)
        return replace(first, static_mass=held_mass)
    point = case.estimate_point_mass(progress)
    if point is None or case.is_uncertain(point):
        held_mass = static_mass(machine, frame, motion, {}, case.point)
        _raise_unidentifiable(one_way_drives, first or point, held_mass)
    _check_mass(point, trust)
    return point


@dataclass(frozen=True)
class _PayloadCase:
    """Recording of a machine with a load.

    Attributes:
        machine: Machine without the load.
        frame: Frame that carries the load.
        motion: Recorded motion.
        method: Method of the estimate.
        moving_drives: Drives that moved.
        one_way_drives: Drives that moved in one direction only.
        com: (3,) known centre of mass in the frame [m], None if it is not known.
    """

    machine: Machine
    frame: str
    motion: Motion
    method: str
    moving_drives: Sequence[str]
    one_way_drives: Sequence[str]
    com: Array | None

    @property
    def point(self) -> Array:
        """Position (3,) of a point load in the frame [m]."""
        return np.zeros(3) if self.com is None else self.com

    def model(self, has_inertia: bool, com: Array | None) -> IdentificationModel:
        """Model of a load, see `PayloadTerm`, and of corrections of Coulomb friction."""
        dynamics = Dynamics(self.machine)

        bare_machine = self.machine.replace(
            friction={}, forces=(), gas_springs=(), ropes=(), end_stops=()
        )
        terms: list[ModelTerm] = [
            PayloadTerm(self.machine, self.frame, has_inertia, com),
            *(friction_term(bare_machine, x, ("coulomb",), 0.0) for x in self.moving_drives),
        ]
        return IdentificationModel(
            bare_machine, terms,
            lambda at: dynamics.evaluate_closed("inverse with friction", at.q, at.v_a, at.a_a),
        )  # fmt: skip

    def estimate_body(
        self, has_inertia: bool, trust: bool, progress: Progress
    ) -> PayloadEstimate | None:
        """Estimate a load with its moments; None if nothing determines its mass."""
        model = self.model(has_inertia, self.com)
        # the weight determines the load: smoothing of accelerations does not limit the bandwidth
        motion = replace(self.motion, passband=math.inf)
        equations, base = build_equations(model, [motion], progress=progress)
        (thinned,) = equations.thinned_motions()
        drive_indices = [self.machine.active.index(joint) for joint in self.moving_drives]
        q, v, a, tau = (
            x[:, drive_indices] for x in (thinned.q, thinned.v, thinned.a, thinned.tau)
        )
        drive_motion = Motion(thinned.time, q, v, a, tau)
        check_forces(
            drive_motion, equations.offset[:, drive_indices], self.moving_drives, trust=trust
        )
        columns = equations.column_selection(base)
        equations, estimate = equations.estimate(
            columns, METHODS[self.method], None, np.zeros(len(columns))
        )
        combinations, directions = _identifiable_moments(base, 4 if self.com is None else 1)
        if not combinations[:, 0].any():
            return None
        mass, *first = (combinations.T @ estimate.values).tolist()
        com = np.where(combinations[:, 1:].any(axis=0), np.array(first) / mass, np.nan)
        com = com if self.com is None else self.com
        derivatives = np.eye(4)  # of mass and com by mass and first moments
        derivatives[1:] /= mass
        derivatives[1:, 0] = -np.nan_to_num(com) / mass if self.com is None else 0.0
        derivatives = derivatives @ combinations.T
        covariance, freedom = _widen_covariance(equations, columns, estimate, derivatives)
        unknown = np.append(False, np.isnan(com))
        covariance[unknown] = covariance[:, unknown] = np.nan
        names = [base.names[i] for i in base.independent]
        corrections = {
            joint: float(estimate.values[names.index(f"{joint}.coulomb")])
            for joint in self.moving_drives
            if f"{joint}.coulomb" in names and joint not in self.one_way_drives
        }
        fit = self._force_comparison(equations, columns @ estimate.values)
        return PayloadEstimate(
            self.frame, mass, com, covariance, freedom, directions, corrections, None, fit,
            self.com is not None,
        )  # fmt: skip

    def estimate_point_mass(self, progress: Progress) -> PayloadEstimate | None:
        """Estimate a mass at a point; None if its weight loads no moving drive."""
        motion, model = low_passed_motion(self.motion), self.model(False, None)
        load = PayloadTerm(self.machine, self.frame, False, self.point)
        q = motion.q[:: max(1, len(motion.q) // 100)]
        at = IdentificationModel(self.machine, [load]).samples(q, 0 * q, 0 * q)
        drive_indices = [self.machine.active.index(joint) for joint in self.moving_drives]
        weight = np.abs(load.columns(at)[:, drive_indices, 0]).max(initial=0.0)
        length = self.machine.closure.characteristic_length
        if weight <= _IDENTIFIABLE_TOLERANCE * np.linalg.norm(self.machine.gravity) * length:
            return None
        try:
            equations, base = build_equations(
                model, [motion], static_cutoff(motion), progress=progress
            )
        except RecordingError:  # no row is far enough from standstill
            return None
        all_columns = equations.column_selection(base) @ base.grouping

        def columns_of(point: Array) -> Array:
            mass = all_columns[:, :4] @ np.append(1.0, point)
            return np.column_stack([mass, all_columns[:, 4:]])

        columns = columns_of(self.point)
        std = [math.inf]
        for joint in self.moving_drives:
            i = self.machine.active.index(joint)
            least = MIN_FRICTION_SHARE * root_mean_square(motion.tau[:, i])
            band = max(breakaway_force(self.machine, joint), least)
            std.append(band if joint in self.one_way_drives else math.inf)
        prior = np.zeros(len(std)), np.array(std)
        start = np.zeros(len(columns))
        gradient = np.zeros(3)
        for i, step in enumerate(_CENTRE_STEP * np.eye(3)):
            masses = [
                equations.estimate(columns_of(x), METHODS[self.method], prior, start)[1].values[0]
                for x in (self.point - step, self.point + step)
            ]
            gradient[i] = (masses[1] - masses[0]) / (2 * _CENTRE_STEP)
        equations, parameters = equations.estimate(columns, METHODS[self.method], prior, start)
        derivatives = np.zeros((4, len(std)))
        derivatives[0, 0] = 1.0
        covariance, freedom = _widen_covariance(
            equations, columns, parameters, derivatives, np.diag(1 / prior[1])
        )
        covariance[1:] = covariance[:, 1:] = np.nan if self.com is None else 0.0
        corrections = {
            joint: float(value)
            for joint, value in zip(self.moving_drives, parameters.values[1:], strict=True)
            if joint not in self.one_way_drives
        }
        estimate = PayloadEstimate(
            self.frame,
            float(parameters.values[0]),
            np.full(3, np.nan) if self.com is None else self.com,
            covariance,
            freedom,
            np.zeros((0, 3)),
            corrections,
            static_mass(self.machine, self.frame, self.motion, corrections, self.point),
            self._force_comparison(equations, columns @ parameters.values),
            self.com is not None,
            gradient,
        )
        if estimate.static_mass is not None:  # the difference of both estimates is an uncertainty
            covariance[0, 0] += (estimate.static_mass[0] - estimate.mass) ** 2
        return estimate

    def _force_comparison(self, equations: RegressionEquations, values: Array) -> ForceComparison:
        load_forces = equations.forces - equations.offset
        return ForceComparison(
            equations.time,
            load_forces,
            equations.modelled_forces(values),
            equations.is_moving,
            self.machine.active,
        )

    def is_uncertain(self, estimate: PayloadEstimate) -> bool:
        """Whether the interval exceeds the mass and a share of the machine's mass."""
        low, high = estimate.confidence_interval()[0].tolist()
        machine_mass = sum(inertia.mass for inertia in list(self.machine.model.inertias)[1:])
        return not high - low <= 2 * max(abs(estimate.mass), _MAX_INTERVAL_SHARE * machine_mass)


def _widen_covariance(
    equations: RegressionEquations,
    columns: Array,
    estimate: Estimate,
    derivatives: Array,
    prior_root: Array | None = None,
) -> tuple[Array, Array]:
    """Covariance (4, 4) and its degrees of freedom (4,), widened by a delete-one jackknife.

    Rows (k, s) of a prior about zero belong to all segments of the jackknife.
    """
    size = columns.shape[1]
    prior_rows = np.zeros((0, size)) if prior_root is None else prior_root
    prior_rows = np.column_stack([prior_rows, np.zeros(len(prior_rows))])
    T = np.zeros((len(columns) + 1, size + 1))
    T[:-1, :-1], T[-1, -1] = columns, 1.0
    parts = equations.segment_factors(_SEGMENT_COUNT) @ T / estimate.noise[:, None, None]
    found = []
    for i in range(_SEGMENT_COUNT):
        others = np.delete(parts, i, axis=0).reshape(-1, size + 1)
        R = triangular_factor(np.vstack([others, prior_rows]))
        found.append(np.linalg.lstsq(R[:-1, :-1], R[:-1, -1])[0])
    spread = (np.array(found) - np.mean(found, axis=0)) @ derivatives.T
    variances = (_SEGMENT_COUNT - 1) / _SEGMENT_COUNT * (spread**2).sum(axis=0)
    covariance = derivatives @ estimate.covariance @ derivatives.T
    inflation = variances / np.maximum(np.diag(covariance), np.finfo(float).tiny)
    scale = np.sqrt(np.maximum(inflation, 1.0))
    freedom = np.where(inflation > 1, _SEGMENT_COUNT - 1, estimate.degrees_of_freedom)
    return covariance * np.outer(scale, scale), freedom


def _check_mass(estimate: PayloadEstimate, trust: bool) -> None:
    """Reject a mass whose whole interval is negative.

    Raises:
        RecordingError: The recording is not trusted.
    """
    low, high = estimate.confidence_interval()[0].tolist()
    if high < 0:
        reject_unless_trusted(
            f"the mass comes out as {low:.3g} to {high:.3g} kg, and no load weighs less than "
            "nothing: look at signs and units of forces or pressures, and identify the machine "
            "without a load first",
            trust,
        )


def _raise_unidentifiable(
    one_way_drives: Sequence[str],
    estimate: PayloadEstimate | None,
    held_mass: tuple[float, float] | None,
) -> NoReturn:
    if estimate is None:
        raise RecordingError("this motion does not determine the mass, move all joints")
    low, high = estimate.confidence_interval()[0].tolist()
    text = f"this recording does not determine the mass ({low:.3g} to {high:.3g} kg): "
    if one_way_drives:
        names = ", ".join(f"'{joint}'" for joint in one_way_drives)
        text += f"{names} moved one way only, where friction looks like weight, record both ways"
    else:
        text += "its parts give different loads, identify the machine without a load first"
    if held_mass is not None:
        text += (
            f"; with its centre at '{estimate.frame}' the forces at rest hold "
            f"{held_mass[0]:.4g} +- {held_mass[1]:.2g} kg, by the described friction"
        )
    raise RecordingError(text)


def _identifiable_moments(base: BaseParameters, count: int) -> tuple[Array, Array]:
    """Mass and first moments as combinations (r, 4) of base parameters, zero if unidentifiable.

    Also returns the identifiable directions (k, 3) of first moments. A combination of parameters
    is identifiable if it is in the row space of K, orthogonal to the null space of K. Of mass and
    first moments, `count` are parameters.
    """
    K = base.grouping
    wanted = np.eye(K.shape[1])[:, :count]
    share = np.array(np.linalg.lstsq(K.T, wanted, rcond=None)[0])
    missing = np.abs(K.T @ share - wanted).max(axis=0)
    share[:, missing > _IDENTIFIABLE_TOLERANCE] = 0.0
    if count < 4:
        return np.pad(share, ((0, 0), (0, 4 - count))), np.zeros((0, 3))
    unseen = np.linalg.svd(K)[2][len(K) :]
    _, sizes, axes = np.linalg.svd(unseen[:, 1:4]) if len(unseen) else (0, np.zeros(3), np.eye(3))
    sizes = np.append(sizes, np.zeros(3 - len(sizes)))
    return share, axes[sizes <= _IDENTIFIABLE_TOLERANCE]
