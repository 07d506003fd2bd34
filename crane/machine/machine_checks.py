"""Checks of an assembled machine: masses and inertias, force elements between frames.

Massless bodies are allowed if the mass matrix is definite.
"""

import dataclasses
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np
import pinocchio as pin

from crane.closure.closure import Closure
from crane.closure.coordinates import Coordinates
from crane.closure.loop_equations import frame_id
from crane.common.errors import (
    CraneWarning,
    DescriptionError,
    InputError,
    SingularConfigurationError,
)
from crane.description.findings import is_strict, report_error
from crane.description.force_elements import AnyForceElement, GasSpring, element_name
from crane.description.kinematic_tree import (
    InertiaProblem,
    Joint,
    Link,
    format_inertia,
    inertia_problem,
    nearest_inertia,
)
from crane.description.specification import MachineSpec
from crane.machine.idle_motions import judge_massless_motions
from crane.machine.machine_assembly import assemble_tree
from crane.machine.massless_motions import MIN_INERTIA_SHARE, massless_motions_at


def replace_infeasible_inertias(
    spec: MachineSpec, model: pin.Model, closure: Closure
) -> tuple[MachineSpec, pin.Model]:
    """Replace infeasible inertias by ones that dynamics can be computed with.

    Inertias that are only formally infeasible are kept if they give every motion a positive
    kinetic energy: that of a body is 1/2 (m v^2 + w^T I w), positive if no principal moment is
    negative, whatever the triangle inequality says. Inertias with a negative moment, and all
    infeasible ones if some motion of the machine would have no kinetic energy, are replaced by the
    nearest feasible ones.
    """
    bodies = [
        (link, body)
        for link in spec.tree.links.values()
        if (body := link.inertial) and body.finding_location
    ]
    findings = [
        (link, problem)
        for link, body in bodies
        if (problem := inertia_problem(body.mass, body.inertia_matrix))
    ]
    if not findings:
        return spec, model
    replaced_links = [link for link, problem in findings if problem.is_negative]
    spec, model = _replace_by_nearest_feasible(spec, model, replaced_links)
    others = [link for link, problem in findings if not problem.is_negative]
    if others and has_mass(model) and _has_massless_motion(model, closure):
        improved = _replace_by_nearest_feasible(spec, model, others)
        if not _has_massless_motion(improved[1], closure):
            (spec, model), replaced_links = improved, [*replaced_links, *others]
    if not is_strict():  # otherwise reported while reading
        for link, problem in findings:
            _warn_about_inertia(link, problem, link in replaced_links)
    return spec, model


def _replace_by_nearest_feasible(
    spec: MachineSpec, model: pin.Model, links: list[Link]
) -> tuple[MachineSpec, pin.Model]:
    if not links:
        return spec, model
    made = []
    for link in links:
        assert link.inertial is not None
        tensor = nearest_inertia(link.inertial.inertia_matrix)[np.triu_indices(3)]
        made.append(
            dataclasses.replace(
                link, inertial=dataclasses.replace(link.inertial, tensor=tuple(tensor.tolist()))
            )
        )
    spec = dataclasses.replace(spec, tree=spec.tree.with_parts(*made))
    return spec, assemble_tree(spec)


def _warn_about_inertia(link: Link, problem: InertiaProblem, is_replaced: bool) -> None:
    assert link.inertial is not None
    nearest = format_inertia(nearest_inertia(link.inertial.inertia_matrix))
    remark = f"computed with the nearest possible, {nearest}: write it"
    if not is_replaced:
        remark = f"computed with as it stands, the nearest possible is {nearest}"
    if not link.inertial.inertia_matrix.any():
        remark = "taken as a point mass"
    warnings.warn(
        f"{link.inertial.finding_location}: link '{link.name}' has {problem.problem}; {remark}",
        CraneWarning,
        stacklevel=4,
    )


def check_masses(spec: MachineSpec, model: pin.Model, closure: Closure) -> tuple[int, ...]:
    """Warn of moving links without mass; refuse those that make the mass matrix singular.

    M_A = gamma^T M gamma at home is definite if each joint moves some inertia of its own link,
    S^T I S > 0, by induction from the ends of the tree; else `judge_massless_motions` decides. A
    machine without any mass has kinematics only, which `Dynamics` refuses, not the loading.

    Returns:
        Indices of held coordinates, see `Machine.held`.

    Raises:
        DescriptionError: Some motion of the machine moves no mass.
    """
    coordinates = closure.equations.coordinates

    def body(joint: Joint) -> pin.Inertia:
        return model.inertias[int(coordinates.joints[coordinates.column(joint.name)])]

    def lacks_inertia(joint: Joint) -> bool:
        links, inertia = spec.tree.links, body(joint)
        if (
            links[joint.child].composite_joint is not None
            or links[joint.child].has_refused_inertial
        ):
            return False
        moments = np.linalg.eigvalsh(inertia.inertia)
        extent = inertia.mass * closure.characteristic_length**2 + float(moments.sum())
        least = MIN_INERTIA_SHARE * extent
        if (
            links[joint.parent].composite_joint is not None
        ):  # other joints of its series move the link as well
            return not inertia.mass > 0 or bool(moments[0] <= least)
        if joint.kind == "prismatic":
            return not inertia.mass > 0
        arm = inertia.mass * float(np.sum(np.cross(inertia.lever, joint.axis) ** 2))
        return float(joint.axis @ inertia.inertia @ joint.axis) + arm <= least

    joints_without_inertia = [joint for joint in spec.tree.moving_joints if lacks_inertia(joint)]
    # the axes of a series may line up
    has_series = any(link.composite_joint is not None for link in spec.tree.links.values())
    if not joints_without_inertia and not has_series:
        return ()
    if not has_mass(model):
        text = (
            "no link that moves has a mass: kinematics only, dynamics needs an <inertial> of each"
        )
        warnings.warn(f"{spec.path.name}: {text}", CraneWarning, stacklevel=3)
        return ()
    massless_joints = [joint for joint in joints_without_inertia if not body(joint).mass > 0]
    try:
        is_regular, held = judge_massless_motions(spec, model, closure, joints_without_inertia)
    except SingularConfigurationError:  # home is no configuration to judge by
        return ()
    ignored_joints = [joint for joint in massless_joints if not body(joint).inertia.any()]
    if ignored_joints and is_regular:
        first = spec.tree.links[ignored_joints[0].child]
        count = f" ({len(ignored_joints)} such)" if len(ignored_joints) > 1 else ""
        warnings.warn(
            f"{first.source_location}: link '{first.name}', which joint "
            f"'{ignored_joints[0].name}' moves, has no "
            f"mass{count}, taken as massless",
            CraneWarning,
            stacklevel=3,
        )
    return held


def has_mass(model: pin.Model) -> bool:
    """Whether a body that moves has a mass or an inertia."""
    return any(body.mass > 0 or body.inertia.any() for body in list(model.inertias)[1:])


def _has_massless_motion(model: pin.Model, closure: Closure) -> bool:
    return massless_motions_at(model, closure, closure.home).shape[1] > 0


_COINCIDENT_TOLERANCE = 1e-9  # [m]


def check_frame_elements(spec: MachineSpec, closure: Closure) -> None:
    """Check that elements between frames have a direction at home and connect two bodies.

    Raises:
        DescriptionError: With file and line of the section.
    """
    for section in ("forces", "gas_springs", "ropes"):
        for problem in frame_element_problems(closure, getattr(spec, section)):
            place = spec.source_locations.get(section, spec.path.name)
            report_error(DescriptionError(f"{place}: {problem}"), harmless=True)


def check_force_elements(
    closure: Closure, elements: Sequence[AnyForceElement], find_frame: Callable[[str], int]
) -> None:
    """Check that the joints and frames of force elements exist and fit.

    Raises:
        InputError: They do not, or a joint has two gas springs.
    """
    gas_springs = [item.joint for item in elements if isinstance(item, GasSpring)]
    for item in elements:
        if item.between is None:
            closure.equations.coordinates.column(item.joint)
        for link in item.between or ():
            find_frame(link)
    for problem in frame_element_problems(closure, elements):
        raise InputError(problem)
    for joint in gas_springs:
        if gas_springs.count(joint) > 1:
            raise InputError(f"joint '{joint}' has two gas springs, keep one")


def check_limited(coordinates: Coordinates, joint: str, hint: str) -> None:
    """Check that a joint has limits.

    Raises:
        InputError: It has none.
    """
    column = coordinates.column(joint)
    if not np.isfinite([coordinates.lower[column], coordinates.upper[column]]).all():
        raise InputError(f"joint '{joint}' has no limits{hint}")


def frame_element_problems(closure: Closure, items: Iterable[AnyForceElement]) -> Iterator[str]:
    """Problems of elements between existing frames, as text.

    Where frames coincide, their distance has no direction. During a motion an element exerts no
    force there; at home it is refused, unless its law gives no force either: a slack rope, a
    spring of length zero.

    Args:
        closure: Closure of the machine.
        items: Its force elements, including those along joints.
    """
    model, data = closure.model, None
    for item in items:
        if item.between is None:
            continue
        if data is None:
            data = model.createData()
            pin.framesForwardKinematics(
                model, data, closure.equations.coordinates.configuration(closure.home)
            )
        one, two = (frame_id(model, link) for link in item.between)
        if model.frames[one].parentJoint == model.frames[two].parentJoint:
            yield f"the {element_name(item)} is within one body, choose frames of two"
            continue
        vector = data.oMf[two].translation - data.oMf[one].translation
        if item.requires_direction and np.linalg.norm(vector) < _COINCIDENT_TOLERANCE:
            yield (
                f"the {element_name(item)} has no direction, its frames meet at home: choose "
                "others or another home"
            )
