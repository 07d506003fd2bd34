"""The spanning tree and its closure, from a description."""

import copy
from collections.abc import Sequence

import numpy as np
import pinocchio as pin
from lxml import etree

from crane.closure import Closure, frame_id
from crane.description import LoopSpec, MachineSpec, inertia_problem
from crane.description.findings import kept, note
from crane.errors import DescriptionError, MechanismError, at
from crane.machine.axes import wrong_axis
from crane.samples import Array

_NO_LIMIT = 1e9  # stands for infinity in the text handed to Pinocchio
_DEEPEST = 2000  # links in a row; Pinocchio's reader needs stack for each and ends the process
_MOST = 1000  # joints that move; closing takes the cube of it


def active_joints(spec: MachineSpec, model: pin.Model) -> tuple[str, ...]:
    """The active joints: those named, or all that no coupling moves."""
    if spec.active is not None:
        return spec.active
    followers = {next(iter(coupling.factors)) for coupling in spec.couplings}
    return tuple(name for name in model.names[1:] if name not in followers)


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
                f"home of '{joint}' is {value:g}, outside of its limits {lower[column]:g} to "
                f"{upper[column]:g}, choose one within them"
            )
            note(DescriptionError(f"{spec.where[f'home {joint}']}: {problem}"))
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
    try:
        return _closure(spec, model, guess, loops)
    except MechanismError as error:
        if spec.active != () and (error.about == "active" or error.about.startswith("loop ")):

            def close(changed: MachineSpec, some: Sequence[LoopSpec]) -> object:
                tree = model if changed is spec else assemble(changed)
                return _closure(changed, tree, guess, some)

            if (suspect := wrong_axis(spec, model, loops, close)) is not None:
                raise suspect from None
        where = spec.where.get(error.about, spec.path.name)
        hint = ""
        if spec.active == () and spec.path.suffix.lower() == ".urdf":
            hint = ', and mark what you choose with independent="true"'
        raise MechanismError(at(where, error) + hint, error.about) from None


def _closure(
    spec: MachineSpec, model: pin.Model, guess: Array, loops: Sequence[LoopSpec]
) -> Closure:
    return Closure(model, loops, active_joints(spec, model), guess, spec.couplings)


def assemble(spec: MachineSpec) -> pin.Model:
    """Pinocchio's model of the merged chains.

    One text for all chains, because Pinocchio then adds the joints depth-first: joints appended
    chain by chain make its crba wrong without a word.

    Raises:
        DescriptionError: The tree is too large, or a body has no mass or an impossible inertia.
    """
    robot = copy.deepcopy(spec.tree)
    _check_size(spec, robot)
    for joint in robot.iter("joint"):
        if joint.get("type") == "continuous":
            joint.set("type", "revolute")  # Pinocchio's continuous joint has two coordinates
        if joint.get("type") != "fixed":
            limit = joint.find("limit")
            if limit is None:
                limit = etree.SubElement(joint, "limit")
            for key, sign in (("lower", "-"), ("upper", ""), ("effort", ""), ("velocity", "")):
                limit.set(key, limit.get(key, f"{sign}{_NO_LIMIT}"))
    try:
        model = pin.buildModelFromXML(etree.tostring(robot).decode())
    except (ValueError, RuntimeError) as error:
        reason = str(error).strip().splitlines()[0]
        raise DescriptionError(f"{spec.path.name}: cannot be assembled ({reason})") from None
    for limits in (
        model.lowerPositionLimit, model.upperPositionLimit, model.effortLimit, model.velocityLimit,
    ):  # fmt: skip
        endless = np.abs(limits) >= _NO_LIMIT
        limits[endless] = np.copysign(np.inf, limits[endless])
    model.name = spec.name
    _check_bodies(spec, model, robot)
    return model


def _check_size(spec: MachineSpec, robot: etree._Element) -> None:
    below: dict[str, list[str]] = {}
    children = set()
    moving = 0
    for joint in robot.iter("joint"):
        parent, child = (joint.find(end).get("link") for end in ("parent", "child"))
        below.setdefault(parent, []).append(child)
        children.add(child)
        moving += joint.get("type") != "fixed"
    if moving > _MOST:
        raise DescriptionError(
            f"{spec.path.name}: {moving} joints move, lock or leave out all but {_MOST}"
        )
    row, depth = [link for link in below if link not in children], 1
    while row := [child for link in row for child in below.get(link, ())]:
        depth += 1
        if depth > _DEEPEST:
            where = spec.where.get(f"link {row[0]}", spec.path.name)
            raise DescriptionError(
                f"{where}: link '{row[0]}' is the {depth}th in a row, join links to have at most "
                f"{_DEEPEST}"
            )


def _check_bodies(spec: MachineSpec, model: pin.Model, robot: etree._Element) -> None:
    links = list(robot.iter("link"))
    between = {link.get("name") for link in links if link.get("between")}
    refused = {link.get("name") for link in links if link.get("refused")}
    doubtful = {model.frames[frame_id(model, link)].parentJoint for link in refused}
    moved = {joint.get("name"): joint.find("child").get("link") for joint in robot.iter("joint")}
    for index in range(1, model.njoints):
        name = model.names[index]
        link = moved[name]
        if link not in between and index not in doubtful:
            with kept(harmless=True):
                _check_body(spec.where[f"link {link}"], name, link, model.inertias[index])


def _check_body(where: str, joint: str, link: str, inertia: pin.Inertia) -> None:
    if not inertia.mass > 0:
        raise DescriptionError(
            f"{where}: joint '{joint}' moves link '{link}', which has no mass, give it an "
            "<inertial>"
        )
    if problem := inertia_problem(inertia.mass, inertia.inertia):
        raise DescriptionError(f"{where}: link '{link}' with what is fixed to it has {problem}")
