"""Which motions without inertia a machine may have: idle ones of links that have a mass."""

import warnings
from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from crane.closure.closure import Closure
from crane.closure.loop_equations import frame_id
from crane.common.errors import CraneWarning, DescriptionError
from crane.common.samples import Array
from crane.description.findings import report_error
from crane.description.force_elements import AnyForceElement, element_name
from crane.description.kinematic_tree import Joint, Link
from crane.description.specification import MachineSpec
from crane.machine.massless_motions import (
    IdleMotion,
    describe_massless_motion,
    find_idle_motions,
    massless_motions_at,
    project_mass_matrix,
    select_held_coordinates,
)

_MOVES = 1e-7  # scaled velocity that counts, of a motion whose largest is 1


def judge_massless_motions(
    spec: MachineSpec, model: pin.Model, closure: Closure, candidates: Sequence[Joint]
) -> tuple[bool, tuple[int, ...]]:
    """Warn of idle motions, refuse other motions that move no inertia.

    A motion is idle if it moves no inertia in any configuration, a link that has a mass, no drive,
    and nothing that exerts a force: nothing depends on it then, see `Machine.held`.

    Args:
        spec: The machine.
        model: Its tree.
        closure: Its closure.
        candidates: Joints that move no inertia of their own link.

    Returns:
        Whether every motion moves an inertia, and the held coordinates, see `Machine.held`.

    Raises:
        DescriptionError: A motion moves no inertia in any configuration and is not idle.
    """
    motions = find_idle_motions(model, closure)
    held = select_held_coordinates(motions)
    at_home = massless_motions_at(model, closure, closure.home).shape[1]
    if at_home > len(held):
        _warn_about_home(spec, model, closure)
    names = closure.equations.coordinates.names
    candidates = candidates or [spec.tree.joints[name] for name in names]
    columns = [names.index(joint.name) for joint in candidates]
    idle: list[tuple[Joint, Link]] = []
    # one held coordinate moves in each
    q, basis = motions[-1] if held else IdleMotion(closure.home, np.eye(0))
    for motion in (basis @ np.linalg.inv(basis[list(held)])).T:
        v = closure.continuation.gamma(q) @ motion
        v = v / np.abs(v / closure.units).max()
        joint = candidates[int(np.abs(v[columns]).argmax())]
        link = spec.tree.links[joint.child]
        obstacle = _obstacle(spec, model, closure, q, v)
        if obstacle is None and len(held) < len(closure.active):
            idle.append((joint, link))
            continue
        massless = not link.inertial or not link.inertial.mass > 0
        missing = "no mass" if massless else "no inertia against it"
        problem = f"joint '{joint.name}' moves link '{link.name}', which has {missing}"
        report_error(
            DescriptionError(
                f"{link.source_location}: {problem}{obstacle or ''}, give it an <inertial>"
            ),
            harmless=True,
        )
    if idle:
        joint, link = idle[0]
        more = f" ({len(idle)} such)" if len(idle) > 1 else ""
        warnings.warn(
            f"{link.source_location}: link '{link.name}' has no inertia against joint "
            f"'{joint.name}'{more}: this motion is idle and is left out of the equations, give "
            "it an inertia if its speed counts",
            CraneWarning,
            stacklevel=4,
        )
    return not at_home, held if idle else ()


def _warn_about_home(spec: MachineSpec, model: pin.Model, closure: Closure) -> None:
    home, gamma = closure.home, closure.continuation.gamma(closure.home)
    mass = project_mass_matrix(model, closure, home, gamma)
    text = describe_massless_motion(model, closure, spec.tree, home, gamma, mass)
    warnings.warn(
        f"{spec.path.name}: the mass matrix is singular at home, {text}",
        CraneWarning,
        stacklevel=5,
    )


def _obstacle(
    spec: MachineSpec, model: pin.Model, closure: Closure, q: Array, v: Array
) -> str | None:
    """Why a motion with the velocities v (nv,) at q (nq,) cannot be idle; None if it can.

    Empty where no link that it moves has a mass.
    """
    coordinates = closure.equations.coordinates
    moving = {
        name
        for name, rate, unit in zip(coordinates.names, v, closure.units, strict=True)
        if abs(rate) > _MOVES * unit
    }
    data = model.createData()
    pin.forwardKinematics(model, data, coordinates.configuration(q), v)
    pairs = zip(model.inertias, data.v, strict=True)
    if not any(body.mass > 0 and np.abs(twist.vector).max() > _MOVES for body, twist in pairs):
        return ""
    if driven := moving & set(_driven_joints(spec)):
        return f", and '{min(driven)}' is driven"
    for name, friction in spec.friction.items():
        if name in moving and (friction.viscous or friction.root or friction.breakaway_force):
            return f", and friction of '{name}' acts on it"
    elements: tuple[AnyForceElement, ...] = (*spec.forces, *spec.gas_springs, *spec.ropes)
    for element in elements:
        ends = [
            pin.getFrameVelocity(model, data, frame_id(model, link), pin.LOCAL_WORLD_ALIGNED)
            for link in element.between or ()
        ]
        speed = max((float(np.linalg.norm(end.linear)) for end in ends), default=0.0)
        if element.joint in moving or speed > _MOVES * closure.characteristic_length:
            return f", and the {element_name(element)} acts on it"
    return None


def _driven_joints(spec: MachineSpec) -> Sequence[str]:
    """Joints that the file drives."""
    named = [joint for joint in spec.active or () if joint not in spec.free]
    motors = [joint for drive in spec.drives for joint in drive.factors]
    cylinders = spec.hydraulics.joints if spec.hydraulics else ()
    strong = [j.name for j in spec.tree.moving_joints if 0 < j.limits.effort < np.inf]
    return [*named, *motors, *spec.control, *cylinders, *strong]
