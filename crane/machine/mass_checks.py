"""Bodies without mass or inertia: allowed where the others leave the mass matrix definite."""

import dataclasses
import warnings

import numpy as np
import pinocchio as pin

from crane.closure import Closure
from crane.common.errors import CraneWarning, DescriptionError
from crane.common.samples import Array
from crane.description import MachineSpec
from crane.description.findings import is_strict, report_error
from crane.description.inertia_feasibility import (
    InertiaProblem,
    format_inertia,
    inertia_problem,
    nearest_inertia,
)
from crane.description.kinematic_tree import Joint, Link
from crane.machine.machine_assembly import assemble_tree

_DEFINITE_TOLERANCE = 1e-12  # least eigenvalue of M_A with a diagonal of ones


def replace_infeasible_inertias(
    spec: MachineSpec, model: pin.Model, closure: Closure
) -> tuple[MachineSpec, pin.Model]:
    """The description and its tree with inertias that dynamics can be computed with.

    Of those that are no body's for their form alone the file's numbers stay where they give the
    kinetic energy of every motion: a body's is 1/2 (m v^2 + w^T I w), positive wherever I has no
    negative principal moment, whatever the sum of the others. In place of one that has, and of
    all where a motion of the machine would move no mass, stand the nearest possible ones.
    """
    findings: dict[str, tuple[Link, InertiaProblem]] = {}
    for link in spec.tree.links.values():
        body = link.inertial
        problem = (
            inertia_problem(body.mass, body.inertia_matrix)
            if body and body.finding_location
            else None
        )
        if problem is not None:
            findings[link.name] = link, problem
    if not findings:
        return spec, model
    replaced_links = [link for link, problem in findings.values() if problem.is_negative]
    spec, model = _replace_by_nearest_feasible(spec, model, replaced_links)
    others = [link for link, problem in findings.values() if not problem.is_negative]
    if others and has_mass(model) and len(_massless_motions(model, closure)):
        improved = _replace_by_nearest_feasible(spec, model, others)
        if not len(_massless_motions(improved[1], closure)):
            (spec, model), replaced_links = improved, [*replaced_links, *others]
    if not is_strict():  # then it has been told when it was read
        for link, problem in findings.values():
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
        body = dataclasses.replace(link.inertial, tensor=tuple(tensor.tolist()))
        made.append(dataclasses.replace(link, inertial=body))
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
    text = f"{link.inertial.finding_location}: link '{link.name}' has {problem.problem}; {remark}"
    warnings.warn(text, CraneWarning, stacklevel=4)


def check_masses(spec: MachineSpec, model: pin.Model, closure: Closure) -> None:
    """Warn of moving links without mass; refuse those that make the mass matrix singular.

    M_A = gamma^T M gamma at home. It is definite, as M is, where each joint moves some inertia of
    its own link, S^T I S > 0: then so does it with those that hang on it, from the ends of the
    tree on. A machine without any mass is one of kinematics alone, which `Dynamics` refuses, not
    the loading.

    Raises:
        DescriptionError: A motion of the machine moves no mass.
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
        if (
            links[joint.parent].composite_joint is not None
        ):  # others of its series move the link as well
            return not inertia.mass > 0 or bool(moments[0] <= _DEFINITE_TOLERANCE * moments[2])
        if joint.kind == "prismatic":
            return not inertia.mass > 0
        arm = inertia.mass * float(np.sum(np.cross(inertia.lever, joint.axis) ** 2))
        own = float(joint.axis @ inertia.inertia @ joint.axis) + arm
        return own <= _DEFINITE_TOLERANCE * (arm + float(moments[2]))

    joints_without_inertia = [joint for joint in spec.tree.moving_joints if lacks_inertia(joint)]
    massless_joints = [joint for joint in joints_without_inertia if not body(joint).mass > 0]
    if not joints_without_inertia:
        return
    if not has_mass(model):
        text = (
            "no link that moves has a mass: kinematics only, dynamics needs an <inertial> of each"
        )
        warnings.warn(f"{spec.path.name}: {text}", CraneWarning, stacklevel=3)
        return
    columns = [coordinates.column(joint.name) for joint in joints_without_inertia]
    motions = _massless_motions(model, closure)
    for motion in motions:
        joint = joints_without_inertia[int(np.abs(motion[columns]).argmax())]
        link = spec.tree.links[joint.child]
        missing = "no mass" if joint in massless_joints else "no inertia against it"
        problem = f"joint '{joint.name}' moves link '{link.name}', which has {missing}"
        report_error(
            DescriptionError(f"{link.source_location}: {problem}, give it an <inertial>"),
            harmless=True,
        )
    ignored_joints = [joint for joint in massless_joints if not body(joint).inertia.any()]
    if ignored_joints and not len(motions):
        first = spec.tree.links[ignored_joints[0].child]
        count = f" ({len(ignored_joints)} such)" if len(ignored_joints) > 1 else ""
        warnings.warn(
            f"{first.source_location}: link '{first.name}', which joint "
            f"'{ignored_joints[0].name}' moves, has no "
            f"mass{count}, taken as massless",
            CraneWarning,
            stacklevel=3,
        )


def has_mass(model: pin.Model) -> bool:
    """Whether a body that moves has a mass or an inertia."""
    return any(body.mass > 0 or body.inertia.any() for body in list(model.inertias)[1:])


def _massless_motions(model: pin.Model, closure: Closure) -> Array:
    """Velocities (k, nv) of the motions at home that move no mass, none where M_A is definite."""
    gamma = closure.gamma_velocity_drift(closure.home, np.zeros(closure.degrees_of_freedom))[
        0
    ]  # uncompiled
    coordinates = closure.equations.coordinates
    upper = np.triu(pin.crba(model, model.createData(), coordinates.configuration(closure.home)))
    mass: Array = gamma.T @ (upper + np.triu(upper, 1).T) @ gamma
    largest = np.sqrt(np.diag(mass))
    scale = 1 / np.where(largest > 0, largest, 1.0)
    values, vectors = np.linalg.eigh(mass * scale * scale[:, None])
    return np.asarray((gamma @ (scale[:, None] * vectors[:, values < _DEFINITE_TOLERANCE])).T)
