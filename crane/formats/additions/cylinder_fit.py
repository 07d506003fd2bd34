"""Which part of a joint's range and of its own stroke a cylinder can be used over."""

import warnings
from collections.abc import Sequence

import numpy as np

from crane.common.errors import CraneWarning, InputError
from crane.common.plausible_ranges import LONGEST
from crane.formats.additions.attachment_points import AttachmentPoint
from crane.formats.additions.distance_curve import DistanceCurve, last_closed_sample
from crane.formats.additions.steel_cylinder import SteelCylinder
from crane.machine import Machine

_STANDSTILL_TOLERANCE = 1e-9  # rate against the joint's, below which something does not move
_RESOLUTION = 1e-6  # of the stroke, to which its reachable part is told


def fit_to_joint_range(
    distances: DistanceCurve,
    cylinder: SteelCylinder,
    points: Sequence[AttachmentPoint],
    machine: Machine,
) -> tuple[int, DistanceCurve]:
    """Index of the home posture and the part that is reached, told where that is not all.

    Raises:
        InputError: There is none, or the machine is not in metres.
    """
    length_limits = cylinder.retracted_length, cylinder.retracted_length + cylinder.stroke
    if distances.length.min() > LONGEST:
        raise InputError(
            f"'{points[0]}' and '{points[1]}' are {distances.length.min():.4g} m apart and "
            f"more, farther "
            f"than a machine is large: look at its units with crane check, lengths are metres"
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
            f"{lever_arm_hint}between "
            f"'{points[0]}' and '{points[1]}', {length_text} apart with {distances.joint} at "
            f"{range_text}: choose "
            "another stroke, dead length or eyes"
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
        if dead_centres or not is_unlimited:  # else its range is what the stroke makes of it
            warnings.warn(
                f"'{distances.joint}' moves from {range_text}, and a cylinder of "
                f"{length_limits[0]:.4g} to "
                f"{length_limits[1]:.4g} m drives it from {a:.4g} to {b:.4g}{dead_centre_text}: "
                f"its eyes are {length_text} "
                "apart over all of it, choose stroke, dead length or eyes by that",
                CraneWarning,
                stacklevel=4,
            )
    return start_index, reached_distances


def warn_about_masses(machine: Machine, cylinder: SteelCylinder, joint: str) -> None:
    """Warn where all that a joint moves is lighter than its cylinder, as placeholders are."""
    model, cylinder_mass = (
        machine.model,
        cylinder.barrel_inertial.mass + cylinder.rod_inertial.mass,
    )
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
            f"{mass:.3g} kg: "
            "forces are little more than its own weight, give the bodies the masses of the real "
            "machine",
            CraneWarning,
            stacklevel=4,
        )


def warn_about_strokes(machine: Machine, name: str) -> None:
    """Warn of strokes that the linkage does not let the cylinder have."""
    if name not in machine.active:  # it shares the load: others say how far they go
        return
    index, home = machine.active.index(name), machine.home
    tolerance, unreachable = _RESOLUTION * machine.upper[index], []
    for end in (float(machine.lower[index]), float(machine.upper[index])):
        start = float(home[machine.column(name)]), home
        last_stroke, _ = last_closed_sample(machine, name, start, end, tolerance)
        if abs(end - last_stroke) > tolerance:
            unreachable.append(f"{min(last_stroke, end):.4g} to {max(last_stroke, end):.4g} m")
    if unreachable:
        warnings.warn(
            f"the linkage does not close at {' and '.join(unreachable)} of the stroke of "
            f"'{name}', "
            "beyond its dead centre: choose another stroke, dead length or eyes",
            CraneWarning,
            stacklevel=4,
        )
