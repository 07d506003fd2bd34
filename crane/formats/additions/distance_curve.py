"""The distance of two attachment points over the range of a joint, and cylinders that fit it."""

import dataclasses
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from crane.common.errors import CraneError, CraneWarning, InputError
from crane.common.plausible_ranges import LONGEST
from crane.common.samples import Array
from crane.formats.additions.steel_cylinder import (
    AttachmentPoint,
    SteelCylinder,
    joints_between,
    lever_arm,
    vector_between,
)
from crane.machine.machine import Machine

_FINE_SAMPLES = 400  # over the range of the joint
_COARSE_SAMPLES = 24  # over the range of each candidate
_STANDSTILL_TOLERANCE = 1e-9  # relative change of length, or rate relative to the joint's
_CLOSING_RESOLUTION = 1e-7  # of the last closed configuration, relative to the step
_ROUNDING_TOLERANCE = 1e-15  # relative to a coordinate
_MIN_LEVER_ARM_SHARE = 0.02  # of the largest lever arm; below it is close to a dead centre

RangeSample = tuple[float, Array]  # coordinate and configuration (nq,)


@dataclass(frozen=True)
class DistanceCurve:
    """The distance of two attachment points over the range of one active joint, others at home.

    Attributes:
        machine: The machine.
        points: The two points.
        joint: The joint.
        values: (N,) coordinates of the joint at which the machine closes [m], [rad].
        configurations: (N, nq) configurations.
        length: (N,) distances of the points [m].
        home_index: Index of the home configuration.
        alternative_joints: Joints that a cylinder could drive instead.
    """

    machine: Machine
    points: Sequence[AttachmentPoint]
    joint: str
    values: Array
    configurations: Array
    length: Array
    home_index: int
    alternative_joints: tuple[str, ...] = ()

    @property
    def lever_arms(self) -> Array:
        """(N,) derivatives of the distance by the coordinate: lever arms [m], or ratios."""
        return np.array(
            [lever_arm(self.machine, self.points, q, self.joint) for q in self.configurations]
        )

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

        start = self.configurations[start_index]
        start_lever_arm = lever_arm(self.machine, self.points, start, self.joint)

        def is_driven_at(q: Array) -> bool:
            length = float(np.linalg.norm(vector_between(self.machine, self.points, q)))
            if not min_length - tolerance <= length <= max_length + tolerance:
                return False
            return lever_arm(self.machine, self.points, q, self.joint) * start_lever_arm > 0

        resolution = _ROUNDING_TOLERANCE * max(abs(self.values[0]), abs(self.values[-1]))
        samples = list(zip(self.values, self.configurations, strict=True))
        before, after = [samples[start_index]], [samples[start_index]]
        for half, step in ((before, -1), (after, 1)):
            k = start_index + step
            while 0 <= k < len(samples) and is_driven_at(samples[k][1]):
                half.append(samples[k])
                k += step
            if 0 <= k < len(samples):
                half.append(
                    last_closed_sample(
                        self.machine,
                        self.joint,
                        half[-1],
                        self.values[k],
                        resolution,
                        is_driven_at,
                    )
                )
        return start_index, DistanceCurve.from_samples(
            self.machine, self.points, self.joint, [*before[:0:-1], *after], len(before) - 1
        )

    @classmethod
    def from_samples(
        cls,
        machine: Machine,
        points: Sequence[AttachmentPoint],
        joint: str,
        samples: Sequence[RangeSample],
        home_index: int,
    ) -> "DistanceCurve":
        """Return the curve over some configurations, that at `home_index` being the home."""
        values, q = (np.array(part) for part in zip(*samples, strict=True))
        return cls(
            machine,
            points,
            joint,
            values,
            q,
            np.linalg.norm(vector_between(machine, points, q), axis=1),
            home_index,
        )


def distance_curve(machine: Machine, points: Sequence[AttachmentPoint]) -> DistanceCurve:
    """Return the curve over the active joint that a cylinder between two points replaces.

    Candidates are active joints between the two bodies, and revolute joints that move them through
    a linkage. Of several, the joint with the largest scaled change of the distance is chosen, as
    for the condition of the drives (see `crane.closure.active_joint_selection`).

    Raises:
        InputError: No joint changes the distance.
    """
    joints_in_path = [
        joint.name
        for joint in joints_between(machine.tree.parent_joints, points[0].link, points[1].link)
    ]
    if not joints_in_path:
        raise InputError(
            f"'{points[0]}' and '{points[1]}' are on one body, choose points of two that move "
            "against each other"
        )
    coordinate_scales = machine.closure.equations.motion_scales
    scaled_lever_arms: dict[str, float] = {}
    for joint in machine.active:
        coarse_curve = _scan_joint_range(machine, points, joint, _COARSE_SAMPLES)
        change = np.ptp(coarse_curve.length) / max(coarse_curve.length.max(), 1e-300)
        if len(coarse_curve.length) > 1 and change > _STANDSTILL_TOLERANCE:
            home = coarse_curve.configurations[coarse_curve.home_index]
            scaled_lever_arms[joint] = (
                abs(lever_arm(machine, points, home, joint))
                * coordinate_scales[machine.column(joint)]
            )
    if not scaled_lever_arms:
        raise InputError(
            f"no active joint changes the distance between '{points[0]}' and '{points[1]}' "
            f"(between them: {', '.join(joints_in_path)}), choose other points"
        )
    preferred = [x for x in scaled_lever_arms if x in joints_in_path or machine.unit(x) == "rad"]
    candidates = preferred or [*scaled_lever_arms]
    best = max(candidates, key=lambda joint: scaled_lever_arms[joint])
    return dataclasses.replace(
        _scan_joint_range(machine, points, best, _FINE_SAMPLES),
        alternative_joints=tuple(joint for joint in candidates if joint != best),
    )


def _scan_joint_range(
    machine: Machine, points: Sequence[AttachmentPoint], joint: str, count: int
) -> DistanceCurve:
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
        before, after = (
            _samples_outwards(machine, joint, (home, np.array(machine.home)), rest.tolist())
            for rest in (values[:home_index][::-1], values[home_index + 1 :])
        )
        samples, home_index = [*before[::-1], (home, np.array(machine.home)), *after], len(before)
    return DistanceCurve.from_samples(machine, points, joint, samples, home_index)


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


_RESOLUTION = 1e-6  # of the reachable part, relative to the stroke


def fit_to_joint_range(
    distances: DistanceCurve,
    cylinder: SteelCylinder,
    points: Sequence[AttachmentPoint],
    machine: Machine,
) -> tuple[int, DistanceCurve]:
    """Fit a cylinder to the range of a joint, with a warning if it does not drive all of it.

    Returns:
        Index of the home configuration, and the curve over the part that is reached.

    Raises:
        InputError: The cylinder fits nowhere, or the machine is not in metres.
    """
    length_limits = cylinder.retracted_length, cylinder.retracted_length + cylinder.stroke
    if distances.length.min() > LONGEST:
        raise InputError(
            f"'{points[0]}' and '{points[1]}' are {distances.length.min():.4g} m apart and "
            "more, farther than a machine is large: look at its units with crane check, "
            "lengths are metres"
        )
    length_text = f"{distances.length.min():.4g} to {distances.length.max():.4g} m"
    unit = machine.unit(distances.joint)
    range_text = f"{distances.values[0]:.4g} to {distances.values[-1]:.4g} {unit}"
    fit = distances.driven_part(*length_limits)
    if fit is None:
        fits = (distances.length >= length_limits[0]) & (distances.length <= length_limits[1])
        lever_arm_hint = "with a lever arm " if fits.any() else ""
        raise InputError(
            f"a cylinder of {length_limits[0]:.4g} to {length_limits[1]:.4g} m does not fit "
            f"{lever_arm_hint}between '{points[0]}' and '{points[1]}', {length_text} apart with "
            f"{distances.joint} at {range_text}: choose another stroke, dead length or eyes"
        )
    start_index, reached_distances = fit
    if any(reached_distances.values[k] != distances.values[k] for k in (0, -1)):
        index = machine.active.index(distances.joint)
        is_unlimited = bool(np.isinf([machine.lower[index], machine.upper[index]]).all())
        a, b = reached_distances.values[[0, -1]]
        dead_centres = [
            f"{reached_distances.values[k]:.4g}"
            for k in (0, -1)
            if reached_distances.values[k] != distances.values[k]
            and np.abs(reached_distances.length[k] - length_limits).min()
            > _RESOLUTION * cylinder.stroke
        ]
        dead_centre_text = (
            f", with a dead centre at {' and '.join(dead_centres)}" if dead_centres else ""
        )
        if dead_centres or not is_unlimited:  # the stroke limits a joint without limits
            warnings.warn(
                f"'{distances.joint}' moves from {range_text}, and a cylinder of "
                f"{length_limits[0]:.4g} to {length_limits[1]:.4g} m drives it from {a:.4g} to "
                f"{b:.4g}{dead_centre_text}: its eyes are {length_text} apart over all of it, "
                "choose stroke, dead length or eyes by that",
                CraneWarning,
                stacklevel=4,
            )
    return start_index, reached_distances


def warn_about_masses(machine: Machine, cylinder: SteelCylinder, joint: str) -> None:
    """Warn if all bodies that a joint moves are lighter than its cylinder."""
    model = machine.model
    cylinder_mass = cylinder.barrel_inertial.mass + cylinder.rod_inertial.mass
    rates = machine.closure.gamma(machine.home)[:, machine.active.index(joint)]
    moved_bodies = [
        i for i, x in enumerate(model.joints)
        if (np.abs(rates[x.idx_v : x.idx_v + x.nv]) > _STANDSTILL_TOLERANCE).any() and i
    ]  # fmt: skip
    bodies = {body for i in moved_bodies for body in model.subtrees[i]}
    mass = sum(model.inertias[body].mass for body in bodies)
    if mass < cylinder_mass:
        warnings.warn(
            f"the cylinder weighs {cylinder_mass:.4g} kg, and all that '{joint}' moves "
            f"{mass:.3g} kg: forces are little more than its own weight, give the bodies the "
            "masses of the real machine",
            CraneWarning,
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
        warnings.warn(
            f"the linkage does not close at {' and '.join(unreachable)} of the stroke of "
            f"'{name}', beyond its dead centre: choose another stroke, dead length or eyes",
            CraneWarning,
            stacklevel=4,
        )
