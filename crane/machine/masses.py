"""Bodies without mass or inertia: allowed where the others leave the mass matrix definite."""

import dataclasses
import warnings

import numpy as np
import pinocchio as pin

from crane.closure import Closure
from crane.common.errors import CraneWarning, DescriptionError
from crane.common.samples import Array
from crane.description import MachineSpec
from crane.description.findings import flag, is_strict
from crane.description.inertia import (
    InertiaProblem,
    inertia_problem,
    nearest_inertia,
    shown_inertia,
)
from crane.description.tree import Joint, Link
from crane.machine.assemble import assemble

_DEFINITE = 1e-12  # least eigenvalue of M_A with a diagonal of ones


def with_computable_inertias(
    spec: MachineSpec, model: pin.Model, closure: Closure
) -> tuple[MachineSpec, pin.Model]:
    """The description and its tree with inertias that dynamics can be computed with.

    Of those that are no body's for their form alone the file's numbers stay where they give the
    kinetic energy of every motion: a body's is 1/2 (m v^2 + w^T I w), positive wherever I has no
    negative principal moment, whatever the sum of the others. In place of one that has, and of
    all where a motion of the machine would move no mass, stand the nearest possible ones.
    """
    doubts: dict[str, tuple[Link, InertiaProblem]] = {}
    for link in spec.tree.links.values():
        body = link.inertial
        problem = inertia_problem(body.mass, body.matrix) if body and body.doubt else None
        if problem is not None:
            doubts[link.name] = link, problem
    if not doubts:
        return spec, model
    replaced = [link for link, problem in doubts.values() if problem.negative]
    spec, model = _with_nearest(spec, model, replaced)
    others = [link for link, problem in doubts.values() if not problem.negative]
    if others and has_mass(model) and len(_massless_motions(model, closure)):
        better = _with_nearest(spec, model, others)
        if not len(_massless_motions(better[1], closure)):
            (spec, model), replaced = better, [*replaced, *others]
    if not is_strict():  # then it has been told when it was read
        for link, problem in doubts.values():
            _warn_of_inertia(link, problem, link in replaced)
    return spec, model


def _with_nearest(
    spec: MachineSpec, model: pin.Model, links: list[Link]
) -> tuple[MachineSpec, pin.Model]:
    if not links:
        return spec, model
    made = []
    for link in links:
        assert link.inertial is not None
        tensor = nearest_inertia(link.inertial.matrix)[np.triu_indices(3)]
        body = dataclasses.replace(link.inertial, tensor=tuple(tensor.tolist()))
        made.append(dataclasses.replace(link, inertial=body))
    spec = dataclasses.replace(spec, tree=spec.tree.replacing(*made))
    return spec, assemble(spec)


def _warn_of_inertia(link: Link, problem: InertiaProblem, replaced: bool) -> None:
    assert link.inertial is not None
    nearest = shown_inertia(nearest_inertia(link.inertial.matrix))
    told = f"computed with the nearest possible, {nearest}: write it"
    if not replaced:
        told = f"computed with as it stands, the nearest possible is {nearest}"
    if not link.inertial.matrix.any():
        told = "taken as a point mass"
    text = f"{link.inertial.doubt}: link '{link.name}' has {problem.what}; {told}"
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

    def lacks(joint: Joint) -> bool:
        links, inertia = spec.tree.links, body(joint)
        if links[joint.child].between is not None or links[joint.child].refused:
            return False
        moments = np.linalg.eigvalsh(inertia.inertia)
        if links[joint.parent].between is not None:  # others of its series move the link as well
            return not inertia.mass > 0 or bool(moments[0] <= _DEFINITE * moments[2])
        if joint.kind == "prismatic":
            return not inertia.mass > 0
        arm = inertia.mass * float(np.sum(np.cross(inertia.lever, joint.axis) ** 2))
        own = float(joint.axis @ inertia.inertia @ joint.axis) + arm
        return own <= _DEFINITE * (arm + float(moments[2]))

    lacking = [joint for joint in spec.tree.moving if lacks(joint)]
    massless = [joint for joint in lacking if not body(joint).mass > 0]
    if not lacking:
        return
    if not has_mass(model):
        text = (
            "no link that moves has a mass: kinematics only, dynamics needs an <inertial> of each"
        )
        warnings.warn(f"{spec.path.name}: {text}", CraneWarning, stacklevel=3)
        return
    columns = [coordinates.column(joint.name) for joint in lacking]
    motions = _massless_motions(model, closure)
    for motion in motions:
        joint = lacking[int(np.abs(motion[columns]).argmax())]
        link = spec.tree.links[joint.child]
        lack = "no mass" if joint in massless else "no inertia against it"
        problem = f"joint '{joint.name}' moves link '{link.name}', which has {lack}"
        flag(DescriptionError(f"{link.where}: {problem}, give it an <inertial>"), harmless=True)
    without = [joint for joint in massless if not body(joint).inertia.any()]
    if without and not len(motions):
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


def _massless_motions(model: pin.Model, closure: Closure) -> Array:
    """Velocities (k, nv) of the motions at home that move no mass, none where M_A is definite."""
    gamma = closure.motion(closure.home, np.zeros(closure.degrees_of_freedom))[0]  # uncompiled
    coordinates = closure.equations.coordinates
    upper = np.triu(pin.crba(model, model.createData(), coordinates.configuration(closure.home)))
    mass: Array = gamma.T @ (upper + np.triu(upper, 1).T) @ gamma
    largest = np.sqrt(np.diag(mass))
    scale = 1 / np.where(largest > 0, largest, 1.0)
    values, vectors = np.linalg.eigh(mass * scale * scale[:, None])
    return np.asarray((gamma @ (scale[:, None] * vectors[:, values < _DEFINITE])).T)
