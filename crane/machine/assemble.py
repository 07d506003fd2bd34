"""The spanning tree and its closure, from a description."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
import pinocchio as pin

from crane.closure import Closure, frame_id
from crane.closure.equations import LoopEquations
from crane.common.errors import DescriptionError, MechanismError, at
from crane.common.samples import Array
from crane.description import LoopSpec, MachineSpec, inertia_problem
from crane.description.findings import flag, recoverable
from crane.description.rigid import inertia, se3
from crane.description.tree import Joint, Link
from crane.machine.axes import wrong_axis
from crane.machine.drives import active_joints, completed, warn_of_completion

_MOST = 1000  # joints that move; closing takes the cube of it
_SAME = 1e-12  # difference of two directions that is none, as Pinocchio has it
_ALIGNED = (
    (pin.JointModelRX, pin.JointModelPX),
    (pin.JointModelRY, pin.JointModelPY),
    (pin.JointModelRZ, pin.JointModelPZ),
)


def home_guess(spec: MachineSpec, model: pin.Model) -> Array:
    """(nq,) coordinates under `home`, of other joints zero or the limit nearest to it.

    Raises:
        DescriptionError: An active joint is at home outside of its limits.
    """
    active = active_joints(spec, model)
    lower, upper = model.lowerPositionLimit, model.upperPositionLimit
    guess = np.clip(np.zeros(model.nq), lower, upper)
    for joint, value in spec.home.items():
        column = model.joints[model.getJointId(joint)].idx_q
        if joint in active and not lower[column] <= value <= upper[column]:
            problem = (
                f"home of '{joint}' is {value:g}, outside of its limits "
                f"{spec.tree.joints[joint].limits}, choose one within them"
            )
            flag(DescriptionError(f"{spec.where[f'home {joint}']}: {problem}"))
        guess[column] = value
    return guess


def closed(
    spec: MachineSpec, model: pin.Model, guess: Array, loops: Sequence[LoopSpec] | None = None
) -> Closure:
    """The closure of a tree.

    Args:
        spec: The machine as read.
        model: Its tree.
        guess: (nq,) home posture to start from.
        loops: Loops to close, if not all.

    Raises:
        MechanismError: The parts do not make a machine that can be driven; with file and line.
    """
    loops = spec.loops if loops is None else loops
    # while findings are collected, joints that close rings are no part of the tree
    there = tuple(x for x in spec.couplings if all(map(model.existJointName, x.factors)))
    spec = dataclasses.replace(spec, couplings=there)
    names = active_joints(spec, model)
    try:
        return Closure(model, loops, names, guess, there)
    except MechanismError as refused:
        error = refused

    def close(changed: MachineSpec, some: Sequence[LoopSpec]) -> object:
        tree = model if changed.tree is spec.tree else assemble(changed)
        return Closure(tree, some, names, guess, there)

    if names and (error.about == "active" or error.about.startswith("loop ")):
        suspect = wrong_axis(spec, model, loops, close)
        if suspect is not None:
            raise suspect
    if error.about == "active" and error.posture is not None:
        closure = _completed(spec, model, loops, error.posture)
        if closure is not None:
            return closure
    raise MechanismError(at(spec.where.get(error.about, spec.path.name), error), error.about)


def _completed(
    spec: MachineSpec, model: pin.Model, loops: Sequence[LoopSpec], posture: Array
) -> Closure | None:
    """The closure with active joints chosen as the file leaves it, None where that is none."""
    equations = LoopEquations(model, loops, spec.couplings)
    choice = completed(spec, model, equations, posture)
    if choice is None:
        return None
    names, text = choice
    try:
        closure = Closure(model, loops, names, posture, spec.couplings)
    except MechanismError:
        return None
    warn_of_completion(spec, text)
    return closure


def assemble(spec: MachineSpec) -> pin.Model:
    """Pinocchio's model of the tree.

    Joints are added depth-first, because joints appended chain by chain make Pinocchio's crba
    wrong without a word; those on one link in the order of their names, as Pinocchio's reader of
    URDF adds them.

    Raises:
        DescriptionError: The tree is too large, or a body has an impossible inertia.
    """
    tree, below = spec.tree, spec.tree.below()
    if (moving := len(tree.moving)) > _MOST:
        raise DescriptionError(
            f"{spec.path.name}: {moving} joints move, lock or leave out all but {_MOST}"
        )
    model = pin.Model()
    model.name = spec.name
    root = tree.root
    frame = pin.Frame(
        root, 0, 0, pin.SE3.Identity(), pin.FrameType.BODY, inertia(tree.links[root].inertial)
    )
    frames = {root: model.addFrame(frame)}
    waiting = _last_first(below, root)
    while waiting:
        joint = waiting.pop()
        mass = inertia(tree.links[joint.child].inertial)
        try:
            frames[joint.child] = _add(model, frames[joint.parent], joint, mass)
        except (ValueError, RuntimeError) as error:  # it has its own words for names
            reason = str(error).strip().splitlines()[0]
            raise DescriptionError(f"{joint.where}: cannot be assembled ({reason})") from None
        waiting += _last_first(below, joint.child)
    _check_bodies(spec, model)
    return model


def _last_first(below: Mapping[str, list[Joint]], link: str) -> list[Joint]:
    return sorted(below.get(link, ()), key=lambda joint: joint.name, reverse=True)


def _add(model: pin.Model, parent: int, joint: Joint, mass: pin.Inertia) -> int:
    """Add a joint and the link that it moves; the frame of the link.

    Args:
        model: Where to.
        parent: Frame of the link that the joint stands on.
        joint: The joint.
        mass: Inertia of the link that it moves.
    """
    above = model.frames[parent]
    moved_by, place = above.parentJoint, above.placement * se3(joint.xyz, joint.rpy)
    if not joint.moves:
        fixed = pin.FrameType.FIXED_JOINT
        frame = model.addFrame(pin.Frame(joint.name, moved_by, parent, place, fixed, mass))
        return int(model.addBodyFrame(joint.child, moved_by, place, frame))
    limits = (
        np.array([getattr(joint.limits, key)]) for key in ("effort", "velocity", "lower", "upper")
    )
    index = model.addJoint(moved_by, _kind(joint), place, joint.name, *limits)
    frame = model.addJointFrame(index, parent)
    model.appendBodyToJoint(index, mass, pin.SE3.Identity())
    return int(model.addBodyFrame(joint.child, index, pin.SE3.Identity(), frame))


def _kind(joint: Joint) -> pin.JointModel:
    """Pinocchio's joint, one for each direction of the frame's axes: they are faster."""
    turns, axis = joint.kind == "revolute", np.array(joint.axis)
    for direction, kinds in zip(np.eye(3), _ALIGNED, strict=True):
        if np.linalg.norm(axis - direction) < _SAME:
            return kinds[0]() if turns else kinds[1]()
    kind = pin.JointModelRevoluteUnaligned if turns else pin.JointModelPrismaticUnaligned
    return kind(axis)


def _check_bodies(spec: MachineSpec, model: pin.Model) -> None:
    links = spec.tree.links
    doubtful = {
        model.frames[frame_id(model, link.name)].parentJoint
        for link in links.values()
        if link.refused
    }
    for index in range(1, model.njoints):
        joint = spec.tree.joints[model.names[index]]
        link = links[joint.child]
        if link.between is not None or index in doubtful:
            continue
        with recoverable(harmless=True):
            _check_body(link, model.inertias[index])


def _check_body(link: Link, inertia: pin.Inertia) -> None:
    if problem := inertia_problem(inertia.mass, inertia.inertia):
        raise DescriptionError(
            f"{link.where}: link '{link.name}' with what is fixed to it has {problem}"
        )
