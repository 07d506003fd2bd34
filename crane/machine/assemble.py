"""The spanning tree and its closure, from a description."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import pinocchio as pin

from crane.closure import Closure, frame_id
from crane.closure.coordinates import Coordinates
from crane.closure.equations import LoopEquations
from crane.closure.structure import ActiveError, OpenLoopError
from crane.common.errors import DescriptionError, MechanismError, at
from crane.common.samples import Array
from crane.description import LoopSpec, MachineSpec, inertia_problem
from crane.description.findings import flag, is_strict, recoverable
from crane.description.floating import flyers
from crane.description.rigid import inertia, se3
from crane.description.tree import Joint, Link, Tree
from crane.machine.axes import wrong_axis
from crane.machine.drives import active_joints, completed, free_joints, warn_of_completion

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
    coordinates = Coordinates(model)
    lower, upper = coordinates.lower, coordinates.upper
    guess = np.clip(np.zeros(model.nv), lower, upper)
    for joint, value in spec.home.items():
        column = coordinates.column(joint)
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
        OpenLoopError: A loop does not close; with file and line.
        MechanismError: The parts do not make a machine that can be driven; likewise.
    """
    loops = spec.loops if loops is None else loops
    # while findings are collected, joints that close rings are no part of the tree
    known_names = set(Coordinates(model).names)
    there = tuple(x for x in spec.couplings if known_names >= x.factors.keys())
    spec = dataclasses.replace(spec, couplings=there)
    names = active_joints(spec, model)
    try:
        return _closure(spec, model, names, guess, loops)
    except MechanismError as refused:
        error = refused

    def close(changed: MachineSpec, some: Sequence[LoopSpec]) -> object:
        tree = model if changed.tree is spec.tree else assemble(changed)
        return Closure(tree, some, names, guess, there)

    if names and (error.about == "active" or error.about.startswith("loop ")):
        suspect = wrong_axis(spec, model, loops, close)
        if suspect is not None:
            raise suspect
    if isinstance(error, ActiveError) and error.posture is not None:
        closure = _completed(spec, model, guess, loops, error)
        if closure is not None:
            return closure
    text = at(spec.where.get(error.about, spec.path.name), error)
    if isinstance(error, OpenLoopError):
        raise OpenLoopError(text, error.about, error.reason)
    raise MechanismError(text, error.about)


def _closure(
    spec: MachineSpec,
    model: pin.Model,
    names: Sequence[str],
    guess: Array,
    loops: Sequence[LoopSpec],
) -> Closure:
    """The closure, its home sought where the file does not say it."""
    loose = set(free_joints(spec, names)) - spec.home.keys()
    return Closure(model, loops, names, guess, spec.couplings, spec.home, loose)


def _completed(
    spec: MachineSpec,
    model: pin.Model,
    guess: Array,
    loops: Sequence[LoopSpec],
    found: ActiveError,
) -> Closure | None:
    """The closure with active joints chosen as the file leaves it, None where that is none."""
    equations = LoopEquations(model, loops, spec.couplings)
    choice = completed(spec, model, equations, found.jacobian)
    if choice is None:
        return None
    names, text = choice
    try:
        closure = _closure(spec, model, names, guess, loops)
    except MechanismError:
        try:
            closure = Closure(model, loops, names, found.posture, spec.couplings)
        except MechanismError:
            return None
    if closure.sought is not None:  # far from where they were chosen
        jacobian = equations.evaluate(closure.home)[1][closure.structure.rows]
        better = completed(spec, model, equations, jacobian)
        if better is not None and better[0] != names:
            text = better[1]
            closure = _moved(closure, better[0])
    warn_of_completion(spec, text)
    return closure


def _moved(closure: Closure, names: Sequence[str]) -> Closure:
    """The same closure by other independent coordinates."""
    equations = closure.equations
    try:
        other = Closure(closure.model, equations.loops, names, closure.home, equations.couplings)
    except MechanismError:
        return closure
    other.sought, other.guess, other.said = closure.sought, closure.guess, closure.said
    return other


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
    afloat = {series[0]: (name, series) for name, series in flyers(spec).items()}
    waiting = _last_first(below, root)
    while waiting:
        joint = waiting.pop()
        if joint.name in afloat:
            last = _float(model, frames, *afloat[joint.name], tree)
            waiting += _last_first(below, last)
            continue
        mass = inertia(tree.links[joint.child].inertial)
        try:
            frames[joint.child] = _add(model, frames[joint.parent], joint, mass)
        except (ValueError, RuntimeError) as error:  # it has its own words for names
            reason = str(error).strip().splitlines()[0]
            raise DescriptionError(f"{joint.where}: cannot be assembled ({reason})") from None
        waiting += _last_first(below, joint.child)
    model.armature = np.array(
        [tree.joints[name].rotor_inertia for name in Coordinates(model).names]
    )
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


def _float(
    model: pin.Model, frames: dict[str, int], name: str, series: Sequence[str], tree: Tree
) -> str:
    """Add a free-flyer in place of a series of six joints; the link that it moves."""
    joints = [tree.joints[part] for part in series]
    above = model.frames[frames[joints[0].parent]]
    place = above.placement * se3(joints[0].xyz, joints[0].rpy)
    index = model.addJoint(above.parentJoint, pin.JointModelFreeFlyer(), place, name)
    model.addJointFrame(index, frames[joints[0].parent])
    last = joints[-1].child
    mass = inertia(tree.links[last].inertial)
    model.appendBodyToJoint(index, mass, pin.SE3.Identity())
    for joint in joints:
        frames[joint.child] = int(model.addBodyFrame(joint.child, index, pin.SE3.Identity(), -1))
    return last


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

    def bodies(some: Iterable[Link]) -> set[int]:
        return {model.frames[frame_id(model, link.name)].parentJoint for link in some}

    refused = bodies(link for link in links.values() if link.refused)
    doubtful = bodies(link for link in links.values() if _is_doubtful(link))
    floating = flyers(spec)
    for index in range(1, model.njoints):
        name = model.names[index]
        joint = spec.tree.joints[floating[name][-1] if name in floating else name]
        link = links[joint.child]
        if link.between is not None or index in refused:
            continue
        with recoverable(harmless=True):
            _check_body(link, model.inertias[index], index in doubtful)


def _is_doubtful(link: Link) -> bool:
    return link.inertial is not None and bool(link.inertial.doubt)


def _check_body(link: Link, inertia: pin.Inertia, doubtful: bool) -> None:
    """Refuse a body that cannot be; of doubtful parts only where their form is no excuse."""
    problem = inertia_problem(inertia.mass, inertia.inertia)
    excused = doubtful and (_is_doubtful(link) or not is_strict())
    if problem is not None and not (excused and problem.formal):
        raise DescriptionError(
            f"{link.where}: link '{link.name}' with what is fixed to it has {problem}"
        )
