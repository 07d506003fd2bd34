"""Assembly of the spanning tree and the closure from a description."""

import dataclasses
import warnings
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import pinocchio as pin

from crane.closure.closure import Closure
from crane.closure.constraint_structure import ActiveJointError, OpenLoopError
from crane.closure.coordinates import Coordinates
from crane.closure.loop_equations import LoopEquations, frame_id
from crane.common.errors import CraneWarning, DescriptionError, MechanismError, prefix_location
from crane.common.samples import Array
from crane.description.findings import error_recovery, is_strict, report_error
from crane.description.kinematic_tree import Joint, Link, Tree, inertia_problem
from crane.description.pinocchio_conversion import inertia_from_inertial, se3_from_xyz_rpy
from crane.description.rotation_vectors import ROTATION_COUNT, composite_joints
from crane.description.specification import LoopSpec, MachineSpec
from crane.machine.axis_diagnosis import find_wrong_axis
from crane.machine.drive_selection import (
    complete_active_joints,
    select_free_joints,
    specified_active_joints,
)

_MAX_MOVING_JOINTS = 1000  # closing takes time in proportion to its cube
_DIRECTION_TOLERANCE = 1e-12  # difference of equal directions, as in Pinocchio
_AXIS_ALIGNED_JOINTS = (
    (pin.JointModelRX, pin.JointModelPX),
    (pin.JointModelRY, pin.JointModelPY),
    (pin.JointModelRZ, pin.JointModelPZ),
)


def home_initial_guess(spec: MachineSpec, model: pin.Model) -> Array:
    """(nq,) coordinates under `home`; for other joints zero, or the limit nearest to zero.

    Raises:
        DescriptionError: The home coordinate of an active joint is outside of its limits.
    """
    active = specified_active_joints(spec, model)
    coordinates = Coordinates(model)
    lower, upper = coordinates.lower, coordinates.upper
    initial_guess = np.clip(np.zeros(model.nv), lower, upper)
    for joint, value in spec.home.items():
        column = coordinates.column(joint)
        if joint in active and not lower[column] <= value <= upper[column]:
            problem = (
                f"home of '{joint}' is {value:g}, outside of its limits "
                f"{spec.tree.joints[joint].limits}, choose one within them"
            )
            report_error(DescriptionError(f"{spec.source_locations[f'home {joint}']}: {problem}"))
        initial_guess[column] = value
    return initial_guess


def build_closure(
    spec: MachineSpec,
    model: pin.Model,
    initial_guess: Array,
    loops: Sequence[LoopSpec] | None = None,
) -> Closure:
    """Build the closure of a tree.

    Args:
        spec: The machine as read.
        model: Its tree.
        initial_guess: (nq,) initial guess of home.
        loops: Loops to close, if not all.

    Raises:
        OpenLoopError: A loop does not close; with file and line.
        MechanismError: The parts do not form a machine that can be driven; with file and line.
    """
    loops = spec.loops if loops is None else loops
    # while findings are collected, joints that close loops are missing in the tree
    known_names = set(Coordinates(model).names)
    present_couplings = tuple(x for x in spec.couplings if known_names.issuperset(x.joints))
    spec = dataclasses.replace(spec, couplings=present_couplings)
    names = specified_active_joints(spec, model)
    try:
        return _create_closure(spec, model, names, initial_guess, loops)
    except MechanismError as refused:
        error = refused

    def close(changed: MachineSpec, some: Sequence[LoopSpec]) -> object:
        return Closure(
            model if changed.tree is spec.tree else assemble_tree(changed),
            some,
            names,
            initial_guess,
            present_couplings,
        )

    if names and (error.subject == "active" or error.subject.startswith("loop ")):
        axis_error = find_wrong_axis(spec, model, loops, close)
        if axis_error is not None:
            raise axis_error
    if isinstance(error, ActiveJointError) and error.configuration is not None:
        closure = _closure_with_completed_joints(spec, model, initial_guess, loops, error)
        if closure is not None:
            return closure
    text = prefix_location(spec.source_locations.get(error.subject, spec.path.name), error)
    if isinstance(error, OpenLoopError):
        raise OpenLoopError(text, error.subject, error.reason)
    raise MechanismError(text, error.subject)


def _create_closure(
    spec: MachineSpec,
    model: pin.Model,
    names: Sequence[str],
    initial_guess: Array,
    loops: Sequence[LoopSpec],
) -> Closure:
    """The closure; joints whose home the file does not specify may move in the home search."""
    return Closure(
        model,
        loops,
        names,
        initial_guess,
        spec.couplings,
        spec.home,
        set(select_free_joints(spec, names)) - spec.home.keys(),
    )


def _closure_with_completed_joints(
    spec: MachineSpec,
    model: pin.Model,
    initial_guess: Array,
    loops: Sequence[LoopSpec],
    active_joint_error: ActiveJointError,
) -> Closure | None:
    """The closure with completed active joints, None if there is no selection."""
    equations = LoopEquations(model, loops, spec.couplings)
    choice = complete_active_joints(spec, equations, active_joint_error.jacobian)
    if choice is None:
        return None
    names, text = choice
    try:
        closure = _create_closure(spec, model, names, initial_guess, loops)
    except MechanismError:
        try:
            closure = Closure(
                model, loops, names, active_joint_error.configuration, spec.couplings
            )
        except MechanismError:
            return None
    if closure.home_search is not None:  # home is far from where they were selected
        improved = complete_active_joints(
            spec,
            equations,
            equations.evaluate(closure.home)[1][closure.structure.independent_rows],
        )
        if improved is not None and improved[0] != names:
            text = improved[1]
            closure = _closure_by_other_joints(closure, improved[0])
    where = spec.source_locations.get("active", spec.path.name)
    warnings.warn(f"{where}: {text}; name them as active and free", CraneWarning, stacklevel=3)
    return closure


def _closure_by_other_joints(closure: Closure, names: Sequence[str]) -> Closure:
    """The same closure with other active joints."""
    equations = closure.equations
    try:
        other = Closure(closure.model, equations.loops, names, closure.home, equations.couplings)
    except MechanismError:
        return closure
    other.home_search, other.initial_guess, other.specified_columns = (
        closure.home_search,
        closure.initial_guess,
        closure.specified_columns,
    )
    return other


def assemble_tree(spec: MachineSpec) -> pin.Model:
    """Pinocchio's model of the tree.

    Joints are added depth-first, because Pinocchio's crba is silently wrong for joints appended
    chain by chain; joints on one link are added by name, as Pinocchio's URDF reader does.

    Raises:
        DescriptionError: The tree is too large, or a body has an infeasible inertia.
    """
    tree, joints_by_parent = spec.tree, spec.tree.joints_by_parent()
    if (moving := len(tree.moving_joints)) > _MAX_MOVING_JOINTS:
        raise DescriptionError(
            f"{spec.path.name}: {moving} joints move, lock or leave out all but "
            f"{_MAX_MOVING_JOINTS}"
        )
    model = pin.Model()
    model.name = spec.name
    model.gravity.linear = np.array(spec.gravity)
    root = tree.root_link
    frame = pin.Frame(
        root,
        0,
        0,
        pin.SE3.Identity(),
        pin.FrameType.BODY,
        inertia_from_inertial(tree.links[root].inertial),
    )
    frames = {root: model.addFrame(frame)}
    composite = {series[0]: (name, series) for name, series in composite_joints(spec).items()}
    pending = _joints_in_reverse_order(joints_by_parent, root)
    while pending:
        joint = pending.pop()
        if joint.name in composite:
            pending += _joints_in_reverse_order(
                joints_by_parent,
                _add_composite_joint(model, frames, *composite[joint.name], tree),
            )
            continue
        mass = inertia_from_inertial(tree.links[joint.child].inertial)
        try:
            frames[joint.child] = _add_joint(model, frames[joint.parent], joint, mass)
        except (ValueError, RuntimeError) as error:  # Pinocchio refuses some names
            reason = str(error).strip().splitlines()[0]
            raise DescriptionError(
                f"{joint.source_location}: cannot be assembled ({reason})"
            ) from None
        pending += _joints_in_reverse_order(joints_by_parent, joint.child)
    model.armature = np.array(
        [tree.joints[name].rotor_inertia for name in Coordinates(model).names]
    )
    _check_body_inertias(spec, model)
    return model


def _joints_in_reverse_order(
    joints_by_parent: Mapping[str, list[Joint]], link: str
) -> list[Joint]:
    return sorted(joints_by_parent.get(link, ()), key=lambda joint: joint.name, reverse=True)


def _add_joint(model: pin.Model, parent: int, joint: Joint, mass: pin.Inertia) -> int:
    """Add a joint and the link that it moves; returns the frame of the link.

    Args:
        model: Model to extend.
        parent: Frame of the joint's parent link.
        joint: The joint.
        mass: Inertia of the link that it moves.
    """
    parent_frame = model.frames[parent]
    parent_joint, placement = (
        parent_frame.parentJoint,
        parent_frame.placement * se3_from_xyz_rpy(joint.xyz, joint.rpy),
    )
    if not joint.is_movable:
        frame = model.addFrame(
            pin.Frame(joint.name, parent_joint, parent, placement, pin.FrameType.FIXED_JOINT, mass)
        )
        return int(model.addBodyFrame(joint.child, parent_joint, placement, frame))
    limits = (
        np.array([getattr(joint.limits, key)]) for key in ("effort", "velocity", "lower", "upper")
    )
    index = model.addJoint(
        parent_joint, _pinocchio_joint_model(joint), placement, joint.name, *limits
    )
    frame = model.addJointFrame(index, parent)
    model.appendBodyToJoint(index, mass, pin.SE3.Identity())
    return int(model.addBodyFrame(joint.child, index, pin.SE3.Identity(), frame))


def _add_composite_joint(
    model: pin.Model, frames: dict[str, int], name: str, series: Sequence[str], tree: Tree
) -> str:
    """Add a spherical or free-flyer joint for a series; returns the link that it moves."""
    joints = [tree.joints[part] for part in series]
    parent_frame = model.frames[frames[joints[0].parent]]
    placement = parent_frame.placement * se3_from_xyz_rpy(joints[0].xyz, joints[0].rpy)
    kind = pin.JointModelFreeFlyer if len(series) > ROTATION_COUNT else pin.JointModelSpherical
    index = model.addJoint(parent_frame.parentJoint, kind(), placement, name)
    for limits in (model.effortLimit, model.velocityLimit):
        limits[model.joints[index].idx_v :] = np.inf  # Pinocchio's default is the largest number
    model.addJointFrame(index, frames[joints[0].parent])
    last = joints[-1].child
    model.appendBodyToJoint(
        index, inertia_from_inertial(tree.links[last].inertial), pin.SE3.Identity()
    )
    for joint in joints:
        frames[joint.child] = int(model.addBodyFrame(joint.child, index, pin.SE3.Identity(), -1))
    return last


def _pinocchio_joint_model(joint: Joint) -> pin.JointModel:
    """Pinocchio's joint model; axis-aligned models are faster."""
    is_revolute, axis = joint.kind == "revolute", np.array(joint.axis)
    for direction, kinds in zip(np.eye(3), _AXIS_ALIGNED_JOINTS, strict=True):
        if np.linalg.norm(axis - direction) < _DIRECTION_TOLERANCE:
            return kinds[0]() if is_revolute else kinds[1]()
    kind = pin.JointModelRevoluteUnaligned if is_revolute else pin.JointModelPrismaticUnaligned
    return kind(axis)


def _check_body_inertias(spec: MachineSpec, model: pin.Model) -> None:
    links = spec.tree.links

    def parent_joints(some: Iterable[Link]) -> set[int]:
        return {model.frames[frame_id(model, link.name)].parentJoint for link in some}

    refused_joints = parent_joints(link for link in links.values() if link.has_refused_inertial)
    joints_with_findings = parent_joints(
        link for link in links.values() if _has_inertia_finding(link)
    )
    composite = composite_joints(spec)
    for index in range(1, model.njoints):
        name = model.names[index]
        link = links[spec.tree.joints[composite[name][-1] if name in composite else name].child]
        if link.composite_joint is not None or index in refused_joints:
            continue
        problem = inertia_problem(model.inertias[index].mass, model.inertias[index].inertia)
        # formal problems that were already reported are accepted
        is_accepted = index in joints_with_findings and (
            _has_inertia_finding(link) or not is_strict()
        )
        if problem is None or (is_accepted and problem.is_formal):
            continue
        with error_recovery(harmless=True):
            text = f"link '{link.name}' with what is fixed to it has {problem}"
            raise DescriptionError(f"{link.source_location}: {text}")


def _has_inertia_finding(link: Link) -> bool:
    return link.inertial is not None and bool(link.inertial.finding_location)
