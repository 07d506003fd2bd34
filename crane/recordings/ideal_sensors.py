"""What ideal sensors say of a machine in motion."""

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from crane.common.samples import Array
from crane.description.sensors import INCLINATION_PREFIX, VELOCITY_SUFFIX
from crane.machine import Machine


def ideal_readings(machine: Machine, q: Array, v: Array, names: Sequence[str]) -> dict[str, Array]:
    """Coordinates, inclinations and their rates (N,) by name, in SI units.

    The inclination of a link is that of its x axis above the horizon, asin(x_z), its rate
    (w x x)_z / sqrt(1 - x_z^2).

    Args:
        machine: The machine.
        q: (N, nv) closed postures.
        v: (N, nv) velocities.
        names: X, X_velocity of joints; inclination_LINK, inclination_LINK_velocity.
    """
    found = {}
    for name in names:
        joint = name.removesuffix(VELOCITY_SUFFIX)
        if joint in machine.joints:
            found[name] = (q if joint == name else v)[:, machine.column(joint)]
    links = {
        name.removeprefix(INCLINATION_PREFIX).removesuffix(VELOCITY_SUFFIX)
        for name in names
        if name not in found
    }
    inclinations = _inclinations(machine, q, v, sorted(links)) if links else {}
    return found | {name: inclinations[name] for name in names if name not in found}


def _inclinations(machine: Machine, q: Array, v: Array, links: list[str]) -> dict[str, Array]:
    """Of links, and their rates, by the name of their column."""
    model, data = machine.model, machine.model.createData()
    frames = [machine.frame(link) for link in links]
    out = np.empty((2 * len(links), len(q)))
    axes = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    for i, (place, rate) in enumerate(zip(q, v, strict=True)):
        pin.forwardKinematics(model, data, machine.coordinates.configuration(place), rate)
        for k, frame in enumerate(frames):
            x = pin.updateFramePlacement(model, data, frame).rotation[:, 0]
            w = pin.getFrameVelocity(model, data, frame, axes).angular
            flat = max(float(np.hypot(x[0], x[1])), 1e-12)
            out[2 * k, i] = np.arctan2(x[2], flat)
            out[2 * k + 1, i] = (w[0] * x[1] - w[1] * x[0]) / flat
    names = [INCLINATION_PREFIX + link + end for link in links for end in ("", VELOCITY_SUFFIX)]
    return dict(zip(names, out, strict=True))
