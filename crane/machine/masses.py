"""Bodies without mass: allowed where the others leave the machine's mass matrix definite."""

import warnings
from collections.abc import Iterator

import numpy as np
import pinocchio as pin

from crane.closure import Closure
from crane.common.errors import CraneWarning, DescriptionError
from crane.common.samples import Array
from crane.description import MachineSpec
from crane.description.findings import flag
from crane.description.tree import Joint

_DEFINITE = 1e-12  # least eigenvalue of M_A with a diagonal of ones


def check_masses(spec: MachineSpec, model: pin.Model, closure: Closure) -> None:
    """Warn of moving links without mass; refuse those that make the mass matrix singular.

    M_A = gamma^T M gamma at home. A machine without any mass is one of kinematics alone, which
    `Dynamics` refuses, not the loading.

    Raises:
        DescriptionError: A motion of the machine moves no mass.
    """
    coordinates = closure.equations.coordinates

    def body(joint: Joint) -> pin.Inertia:
        return model.inertias[int(coordinates.joints[coordinates.column(joint.name)])]

    def massless(joint: Joint) -> bool:
        link = spec.tree.links[joint.child]
        return link.between is None and not link.refused and not body(joint).mass > 0

    without = [joint for joint in spec.tree.moving if massless(joint)]
    if not without:
        return
    if not has_mass(model):
        text = (
            "no link that moves has a mass: kinematics only, dynamics needs an <inertial> of each"
        )
        warnings.warn(f"{spec.path.name}: {text}", CraneWarning, stacklevel=3)
        return
    stuck = list(_weightless(model, closure, without))
    for joint in stuck:
        link = spec.tree.links[joint.child]
        problem = f"joint '{joint.name}' moves link '{link.name}', which has no mass"
        flag(DescriptionError(f"{link.where}: {problem}, give it an <inertial>"), harmless=True)
    without = [joint for joint in without if not body(joint).inertia.any()]
    if without and not stuck:
        first = spec.tree.links[without[0].child]
        count = f" ({len(without)} such)" if len(without) > 1 else ""
        warnings.warn(
            f"{first.where}: link '{first.name}', which joint '{without[0].name}' moves, has no "
            f"mass{count}, taken as massless",
            CraneWarning,
            stacklevel=3,
        )


def has_mass(model: pin.Model) -> bool:
    """Whether a body that moves has a mass or an inertia."""
    return any(body.mass > 0 or body.inertia.any() for body in list(model.inertias)[1:])


def _weightless(model: pin.Model, closure: Closure, without: list[Joint]) -> Iterator[Joint]:
    """The massless joints that move most in each motion of the machine that moves no mass."""
    gamma = closure.motion(closure.home, np.zeros(closure.degrees_of_freedom))[0]  # uncompiled
    coordinates = closure.equations.coordinates
    upper = np.triu(pin.crba(model, model.createData(), coordinates.configuration(closure.home)))
    mass: Array = gamma.T @ (upper + np.triu(upper, 1).T) @ gamma
    largest = np.sqrt(np.diag(mass))
    scale = 1 / np.where(largest > 0, largest, 1.0)
    values, vectors = np.linalg.eigh(mass * scale * scale[:, None])
    columns = [coordinates.column(joint.name) for joint in without]
    for vector in vectors.T[values < _DEFINITE]:
        moved = np.abs(gamma[columns] @ (scale * vector))
        yield without[int(moved.argmax())]
