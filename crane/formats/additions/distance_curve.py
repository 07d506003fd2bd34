"""The distance of two attachment points over the range of a joint, and cylinders that fit it."""

from collections.abc import Callable, Sequence

import numpy as np

from crane.common.errors import CraneError, InputError, warn
from crane.common.plausible_ranges import LONGEST
from crane.common.samples import Array
from crane.formats.additions.cylinder_addition import AttachmentPair
from crane.formats.steel_cylinder import SteelCylinder
from crane.machine.machine import Machine

_FINE_SAMPLES = 400  # over the range of the joint
_COARSE_SAMPLES = 24  # over the range of each candidate
_STANDSTILL_TOLERANCE = 1e-9  # relative change of length, or rate relative to the joint's
_CLOSING_RESOLUTION = 1e-7  # of the last closed configuration, relative to the step
_ROUNDING_TOLERANCE = 1e-15  # relative to a coordinate
_MIN_LEVER_ARM_SHARE = 0.02  # of the largest lever arm; below it is close to a dead centre
_RESOLUTION = 1e-6  # of the reachable part, relative to the stroke

RangeSample = tuple[float, Array]  # coordinate and configuration (nq,)


class DistanceCurve:
    """The distance of two attachment points over the range of one active joint, others at home.

    Args:
        points: The two points.
        joint: The joint.
        samples: Coordinates at which the machine closes [m], [rad], and configurations (nq,).
        home_index: Index of the home configuration.

    Attributes:
        points: The two points.
        joint: The joint.
        samples: As given.
        values: (N,) their coordinates [m], [rad].
        length: (N,) distances of the points [m].
        home_index: As given.
        alternative_joints: Joints that a cylinder could drive instead.
    """

    def __init__(
        self, points: AttachmentPair, joint: str, samples: Sequence[RangeSample], home_index: int
    ):
        self.points, self.joint, self.samples = points, joint, samples
        self.home_index = home_index
        self.values = np.array([value for value, _ in samples])
        self.length = np.linalg.norm([points.vector(q) for _, q in samples], axis=1)
        self.alternative_joints: tuple[str, ...] = ()

    def driven_part(
        self, min_length: float, max_length: float
    ) -> "tuple[int, DistanceCurve] | None":
        """Return the part of the range over which a cylinder drives the joint.

        Args:
            min_length: Length of the cylinder with the rod retracted [m].
            max_length: Length with the rod extended [m].

        Returns:
            Index of the start: home, or the nearest configuration at which the cylinder fits with
            a lever arm; and the curve from there to the ends of the stroke or to dead centres,
            whose positions are refined. None if the cylinder fits nowhere.
        """
        tolerance = 1e-9 * max_length
        fits = (self.length >= min_length - tolerance) & (self.length <= max_length + tolerance)
        rates = np.abs(np.gradient(self.length, self.values))
        is_drivable = fits & (rates > _MIN_LEVER_ARM_SHARE * rates.max())
        if not is_drivable.any():
            return None
        start_index = int(
            min(np.flatnonzero(is_drivable), key=lambda k: abs(int(k) - self.home_index))
        )
        start = self.samples[start_index]
        start_lever_arm = self.points.lever_arm(start[1], self.joint)

        def is_driven_at(q: Array) -> bool:
            length = float(np.linalg.norm(self.points.vector(q)))
            if not min_length - tolerance <= length <= max_length + tolerance:
                return False
            return self.points.lever_arm(q, self.joint) * start_lever_arm > 0

        resolution = _ROUNDING_TOLERANCE * max(abs(self.values[0]), abs(self.values[-1]))
        before, after = [start], [start]
        for half, step in ((before, -1), (after, 1)):
            k = start_index + step
            while 0 <= k < len(self.samples) and is_driven_at(self.samples[k][1]):
                half.append(self.samples[k])
                k += step
            if 0 <= k < len(self.samples):
                machine, end = self.points.machine, self.samples[k][0]
                half.append(
                    last_closed_sample(
                        machine, self.joint, half[-1], end, resolution, is_driven_at
                    )
                )
        return start_index, DistanceCurve(
            self.points, self.joint, [*before[:0:-1], *after], len(before) - 1
        )

    def fit_cylinder(self, cylinder: SteelCylinder) -> "tuple[int, DistanceCurve]":
        """Fit a cylinder to the range, with a warning if it does not drive all of it.

        Returns:
            Index of the home configuration, and the curve over the part that is reached.

        Raises:
            InputError: The cylinder fits nowhere, or the machine is not in metres.
        """
        length_limits = cylinder.retracted_length, cylinder.retracted_length + cylinder.stroke
        machine, (barrel, rod) = self.points.machine, self.points.points
        if self.length.min() > LONGEST:
            raise InputError(
                f"'{barrel}' and '{rod}' are {self.length.min():.4g} m apart and more, farther "
                "than a machine is large: look at its units with crane check, lengths are metres"
            )
        length_text = f"{self.length.min():.4g} to {self.length.max():.4g} m"
        unit = machine.unit(self.joint)
        range_text = f"{self.values[0]:.4g} to {self.values[-1]:.4g} {unit}"
        fit = self.driven_part(*length_limits)
        if fit is None:
            fits = (self.length >= length_limits[0]) & (self.length <= length_limits[1])
            lever_arm_hint = "with a lever arm " if fits.any() else ""
            raise InputError(
                f"a cylinder of {length_limits[0]:.4g} to {length_limits[1]:.4g} m does not fit "
                f"{lever_arm_hint}between '{barrel}' and '{rod}', {length_text} apart with "
                f"{self.joint} at {range_text}: choose another stroke, dead length or eyes"
            )
        _, reached = fit
        ends = [k for k in (0, -1) if reached.values[k] != self.values[k]]
        index = machine.active.index(self.joint)
        is_unlimited = bool(np.isinf([machine.lower[index], machine.upper[index]]).all())
        dead_centres = [
            f"{reached.values[k]:.4g}"
            for k in ends
            if np.abs(reached.length[k] - length_limits).min() > _RESOLUTION * cylinder.stroke
        ]
        dead_centre_text = (
            f", with a dead centre at {' and '.join(dead_centres)}" if dead_centres else ""
        )
        if dead_centres or (ends and not is_unlimited):  # the stroke limits one without limits
            warn(
                f"'{self.joint}' moves from {range_text}, and a cylinder of "
                f"{length_limits[0]:.4g} to {length_limits[1]:.4g} m drives it from "
                f"{reached.values[0]:.4g} to {reached.values[-1]:.4g}{dead_centre_text}: its eyes "
                f"are {length_text} apart over all of it, choose stroke, dead length or eyes by "
                "that",
                stacklevel=4,
            )
        return fit


def distance_curve(points: AttachmentPair) -> DistanceCurve:
    """Return the curve over the active joint that a cylinder between two points replaces.

    Candidates are active joints between the two bodies, and revolute joints that move them through
    a linkage. Of several, the joint with the largest scaled change of the distance is chosen, as
    for the condition of the drives (see `crane.closure.active_joint_selection`).

    Raises:
        InputError: No joint changes the distance.
    """
    machine, (barrel, rod) = points.machine, points.points
    joints_in_path = [joint.name for joint in points.joints]
    if not joints_in_path:
        raise InputError(
            f"'{barrel}' and '{rod}' are on one body, choose points of two that move against each "
            "other"
        )
    coordinate_scales = machine.closure.equations.motion_scales
    scaled_lever_arms: dict[str, float] = {}
    for joint in machine.active:
        coarse_curve = _scan_joint_range(points, joint, _COARSE_SAMPLES)
        change = np.ptp(coarse_curve.length) / max(coarse_curve.length.max(), 1e-300)
        if len(coarse_curve.length) > 1 and change > _STANDSTILL_TOLERANCE:
            _, home = coarse_curve.samples[coarse_curve.home_index]
            scaled_lever_arms[joint] = (
                abs(points.lever_arm(home, joint)) * coordinate_scales[machine.column(joint)]
            )
    if not scaled_lever_arms:
        raise InputError(
            f"no active joint changes the distance between '{barrel}' and '{rod}' (between them: "
            f"{', '.join(joints_in_path)}), choose other points"
        )
    preferred = [x for x in scaled_lever_arms if x in joints_in_path or machine.unit(x) == "rad"]
    candidates = preferred or [*scaled_lever_arms]
    best = max(candidates, key=lambda joint: scaled_lever_arms[joint])
    curve = _scan_joint_range(points, best, _FINE_SAMPLES)
    curve.alternative_joints = tuple(joint for joint in candidates if joint != best)
    return curve


def _scan_joint_range(points: AttachmentPair, joint: str, count: int) -> DistanceCurve:
    machine = points.machine
    column, index = machine.column(joint), machine.active.index(joint)
    home = float(machine.home[column])
    default_range = (
        np.pi if machine.unit(joint) == "rad" else float(machine.coordinates.units[column])
    )
    lower, upper = (float(limits[index]) for limits in (machine.lower, machine.upper))
    lower = lower if np.isfinite(lower) else min(home, upper) - default_range
    upper = upper if np.isfinite(upper) else max(home, lower) + default_range
    values = np.linspace(lower, upper, count + 1)
    home_index = int(np.argmin(np.abs(values - home)))
    values[home_index] = home  # replaces the nearest value, so the values remain sorted
    targets = np.tile(machine.home[machine.closure.active], (len(values), 1))
    targets[:, index] = values
    try:
        samples = list(zip(values, machine.closure.solve(targets), strict=True))
    except CraneError:  # part of the range cannot be closed
        home_sample = home, np.array(machine.home)
        before, after = (
            _samples_outwards(machine, joint, home_sample, rest.tolist())
            for rest in (values[:home_index][::-1], values[home_index + 1 :])
        )
        samples, home_index = [*before[::-1], home_sample, *after], len(before)
    return DistanceCurve(points, joint, samples, home_index)


def _samples_outwards(
    machine: Machine, joint: str, sample: RangeSample, values: Sequence[float]
) -> list[RangeSample]:
    found: list[RangeSample] = []
    for value in values:
        configuration = _solve_at(machine, joint, value, sample[1])
        if configuration is None:
            resolution = _CLOSING_RESOLUTION * abs(value - sample[0])
            return [*found, last_closed_sample(machine, joint, sample, value, resolution)]
        sample = value, configuration
        found.append(sample)
    return found


def last_closed_sample(
    machine: Machine,
    joint: str,
    sample: RangeSample,
    limit: float,
    resolution: float,
    condition: Callable[[Array], bool] = lambda q: True,
) -> RangeSample:
    """Return the last configuration towards a limit that closes and satisfies a condition.

    It is found by bisection to a resolution.
    """
    value, q = sample
    while abs(limit - value) > resolution:
        middle = (value + limit) / 2
        configuration = _solve_at(machine, joint, middle, q)
        if configuration is not None and condition(configuration):
            value, q = middle, configuration
        else:
            limit = middle
    return value, q


def _solve_at(machine: Machine, joint: str, value: float, guess: Array) -> Array | None:
    """Return the configuration with a joint at a coordinate, None if it does not close."""
    target = machine.home[machine.closure.active]
    target[machine.active.index(joint)] = value
    try:
        return machine.closure.solve(target, guess)
    except CraneError:
        return None


def warn_about_masses(machine: Machine, cylinder: SteelCylinder, joint: str) -> None:
    """Warn if all bodies that a joint moves are lighter than its cylinder."""
    model = machine.model
    cylinder_mass = cylinder.barrel_inertia.mass + cylinder.rod_inertia.mass
    rates = machine.closure.gamma(machine.home)[:, machine.active.index(joint)]
    moved_bodies = [
        i for i, x in enumerate(model.joints)
        if (np.abs(rates[x.idx_v : x.idx_v + x.nv]) > _STANDSTILL_TOLERANCE).any() and i
    ]  # fmt: skip
    bodies = {body for i in moved_bodies for body in model.subtrees[i]}
    mass = sum(model.inertias[body].mass for body in bodies)
    if mass < cylinder_mass:
        warn(
            f"the cylinder weighs {cylinder_mass:.4g} kg, and all that '{joint}' moves "
            f"{mass:.3g} kg: forces are little more than its own weight, give the bodies the "
            "masses of the real machine",
            stacklevel=4,
        )


def warn_about_strokes(machine: Machine, name: str) -> None:
    """Warn of strokes at which the linkage does not close."""
    if name not in machine.active:  # it shares the load of another drive
        return
    index, home = machine.active.index(name), machine.home
    tolerance, unreachable = _RESOLUTION * machine.upper[index], []
    for end in (float(machine.lower[index]), float(machine.upper[index])):
        last_stroke, _ = last_closed_sample(
            machine, name, (float(home[machine.column(name)]), home), end, tolerance
        )
        if abs(end - last_stroke) > tolerance:
            unreachable.append(f"{min(last_stroke, end):.4g} to {max(last_stroke, end):.4g} m")
    if unreachable:
        warn(
            f"the linkage does not close at {' and '.join(unreachable)} of the stroke of "
            f"'{name}', beyond its dead centre: choose another stroke, dead length or eyes",
            stacklevel=4,
        )
