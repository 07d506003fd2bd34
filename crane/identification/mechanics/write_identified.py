"""Writing of identified machines: friction laws, divided bodies, machine file and URDF files."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pinocchio as pin

from crane.common.errors import CraneError, CraneWarning, InputError
from crane.common.samples import Array
from crane.description.force_elements import Friction
from crane.description.kinematic_tree import (
    Inertial,
    Joint,
    Link,
    inertia_problem,
    with_rotor_inertias,
)
from crane.description.parameter_changes import lock_joints
from crane.description.pinocchio_conversion import inertial_from_inertia
from crane.dynamics.dynamics import Dynamics
from crane.formats.machine_file.machine_writer import MachineDraft, friction_data
from crane.formats.machine_loading import MachineVariants, load
from crane.formats.xml_file import add_joint, add_link
from crane.identification.mechanics.base_parameters import random_samples
from crane.identification.mechanics.feasible_parameters import (
    body_parameters,
    pseudo_inertia,
    thicken_body,
)
from crane.identification.mechanics.identification_model import IdentificationModel
from crane.identification.mechanics.identification_result import Identification
from crane.identification.mechanics.model_terms import (
    BODY_PARAMETERS,
    DirectionalTerm,
    ForceDirection,
    FrictionTerm,
    body_names,
)
from crane.machine.machine import Machine

T = TypeVar("T")
_FEASIBLE_REMEDY = "give feasible=True"
_FORCE_TOLERANCE = 1e-9  # of the largest force, for the check of the written machine
FRICTION_PARAMETERS = frozenset(item.name for item in fields(Friction))
_FLATNESS_TOLERANCE = 1e-6  # smallest eigenvalue of the scaled pseudo-inertia of a flat body


def write_identified(identification: Identification, folder: str | Path) -> Path:
    """Write an identified machine as a machine file with a URDF file per sub-chain.

    `crane.load` reads it, with unlocked joints unless they are locked again:
    `crane.load(crane.identification.write_identified(identification, "identified"),
    lock=identification.described_machine.locked_joints)`.

    The parameters of a body are written to the link that its joint moves; inertials of links fixed
    to it are removed. Friction, rotor inertias and gas pressures are the identified ones, all else
    is that of the machine, see `write_machine`. The written machine predicts as the parameters do:
    `Dynamics.inverse` with friction and the step of a motion is `Identification.predict`. A motor
    that turns several joints becomes a rotor with a coupling. Bodies of locked joints are divided
    among their links by the descriptions. The written files are loaded and compared with the
    identification before they replace existing ones.

    Args:
        identification: Identification of all parameters, with a prior or feasibility constraints.
        folder: Target folder; it is created if necessary, and files of the same names are
            replaced.

    Returns:
        The machine file.

    Raises:
        InputError: The identified machine is not valid, only base parameters are known, or a
            machine file cannot represent the terms of the model.
        OutputError: The folder cannot be written, or contains the files of the machine.
    """
    try:
        return _write_identified(identification, folder)
    except InputError as error:
        text = str(error)
        if not text.endswith(_FEASIBLE_REMEDY) or not identification.delay_text:
            raise
        # feasible parameters would hide what the delay does to them
        problem = text.removesuffix(f", {_FEASIBLE_REMEDY}")
        raise InputError(f"{problem}: {identification.delay_text}, take that out first") from None


def _write_identified(identification: Identification, folder: str | Path) -> Path:
    machine, parameters = identification.described_machine, identification.parameters
    if parameters is None or not identification.model.bodies:
        raise InputError("forces determine base parameters only: give prior or feasible=True")
    # warnings were reported when the machine was loaded
    with warnings.catch_warnings(action="ignore", category=CraneWarning):
        unlocked_machine = _unlocked_machine(machine) if machine.locked_joints else machine
    bodies = divide_locked_bodies(machine, parameters, unlocked_machine)
    laws = friction_laws(identification.model, parameters)
    draft = _identified_draft(identification, unlocked_machine, bodies, laws)
    return draft.write_folder(
        folder, check=partial(_check_written_machine, identification, bodies)
    )


def _unlocked_machine(machine: Machine) -> Machine:
    """The machine without locked joints; force elements that were replaced since stay replaced."""
    variants = MachineVariants(replace(machine, locked_joints={}))
    locked_spec = lock_joints(variants.spec, machine.locked_joints)
    elements: dict[str, Any] = {}
    for kind in ("forces", "gas_springs", "ropes", "end_stops"):
        kept = getattr(locked_spec, kind)
        removed = (x for x in getattr(variants.spec, kind) if x not in kept)
        elements[kind] = (*getattr(machine, kind), *removed)
    return variants.machine({}).replace(**elements)


def _identified_draft(
    result: Identification,
    unlocked_machine: Machine,
    bodies: Mapping[str, Array],
    laws: Mapping[str, Friction],
) -> MachineDraft:
    """The identified machine, with notes on the uncertainty of its friction and rotor inertias."""
    tree, described = unlocked_machine.tree, result.described_machine
    rotors = _parameters_of_kind(result, "rotor_inertia")
    for joint, value in rotors.items():
        if value < 0:
            raise InputError(f"'{joint}': rotor inertia is {value:g}, give feasible=True")
    inertials: dict[str, Inertial | None] = {
        link: None
        for link, first in tree.bodies_by_link().items()
        if link != first != tree.root_link
    }
    for link, body in bodies.items():
        inertials[link] = inertial_from_inertia(pin.Inertia.FromDynamicParameters(body))
    tree = tree.with_parts(*(replace(tree.links[x], inertial=y) for x, y in inertials.items()))
    motors = joint_combinations(result.model)
    directions = [motor.name for motor in motors]
    friction = {x: y for x, y in unlocked_machine.friction.items() if x in described.locked_joints}
    scales = _parameters_of_kind(result, "gas_scale")
    draft = MachineDraft(
        replace(
            unlocked_machine,
            source=f"{_origin_text(result)}; else {described.source or described.path.name}",
            tree=with_rotor_inertias(tree, _without(rotors, directions)),
            friction=friction | _without(laws, directions),
            gas_springs=tuple(
                replace(x, pressure=x.pressure * scales.get(x.joint, 1.0))
                for x in unlocked_machine.gas_springs
            ),
        )
    )
    for motor in motors:
        law, inertia = laws.get(motor.name, Friction()), rotors.get(motor.name, 0.0)
        add_motor(draft, motor, tree.root_link, law, inertia)
    draft.add_notes(_uncertainty_notes(result, laws, rotors))
    return draft


def _without(values: Mapping[str, T], names: Sequence[str]) -> dict[str, T]:
    return {name: value for name, value in values.items() if name not in names}


def _origin_text(result: Identification) -> str:
    text = f"identified by {result.method}{', feasible' if result.feasible else ''}"
    if undetermined_count := result.marks.count("not determined"):
        text += f", {undetermined_count} of {len(result.marks)} base parameters not determined"
    return text


def _infeasible_body(bodies: Mapping[str, Array]) -> str | None:
    """Text about the first infeasible body, None if all are feasible."""
    for link, body in bodies.items():
        if body[0] < 0:
            return f"link '{link}' has the negative mass {body[0]:.4g} kg"
        inertia = pin.Inertia.FromDynamicParameters(body)
        if problem := inertia_problem(float(inertia.mass), inertia.inertia):
            return f"link '{link}' has {problem.problem}"
    return None


def _uncertainty_notes(
    result: Identification, laws: Mapping[str, Friction], rotors: Mapping[str, float]
) -> dict[str, str]:
    """Comments on the uncertainty of friction and rotor inertias that are base parameters."""
    found: dict[str, str] = {}
    half = 0.5 * np.diff(result.confidence_interval(), axis=1)[:, 0]
    for i, (name, group) in enumerate(zip(result.names, result.base.groups, strict=True)):
        owner, _, kind = name.rpartition(".")
        is_rotor = kind == "rotor_inertia"
        written = rotors[owner] if is_rotor else getattr(laws.get(owner), kind, np.nan)
        if group == name and np.isclose(written, result.values[i], rtol=1e-9):
            mark = result.marks[i] and f", {result.marks[i]}"
            key = name if is_rotor else f"friction.{name}"
            found[key] = f"identified ±{half[i]:.2g}, 95 %{mark}"
    return found


def _parameters_of_kind(result: Identification, kind: str) -> dict[str, float]:
    """Identified parameters of a kind by element."""
    assert result.parameters is not None
    named = zip(result.model.names, result.parameters.tolist(), strict=True)
    return {
        name.removesuffix(f".{kind}"): value for name, value in named if name.endswith(f".{kind}")
    }


def _check_written_machine(
    result: Identification, bodies: Mapping[str, Array], file: Path
) -> None:
    """Load the written machine and compare its forces with those of the identification.

    Args:
        result: The identification.
        bodies: Parameters (10,) by link.
        file: The machine file.
    """
    try:
        with warnings.catch_warnings(action="ignore", category=CraneWarning):
            written = load(file, lock=dict(result.described_machine.locked_joints))
    except CraneError as error:
        # an infeasible body is no error of the file that a user could correct
        body = None if result.feasible else _infeasible_body(bodies)
        why = f"{body}, give feasible=True" if body else error
        raise InputError(f"the identified machine is not valid: {why}") from None
    model, parameters = result.model, result.parameters
    assert parameters is not None
    at = random_samples(model, 20)
    expected_forces = model.regressor(at) @ parameters + model.known_forces(at)
    written_forces = Dynamics(written, backend="pinocchio").inverse(
        at.q_a, at.v_a, at.a_a, friction=True, step=at.step
    )
    force_differences = np.abs(written_forces - expected_forces).max(axis=0)
    if force_differences.max() <= _FORCE_TOLERANCE * np.abs(expected_forces).max():
        return
    kinds = {*FRICTION_PARAMETERS, "gas_scale", "rotor_inertia", *BODY_PARAMETERS}
    others = [name for name in model.names if name.rpartition(".")[2] not in kinds]
    what = f"'{others[0]}'" if others else "friction over other velocities than the machine's"
    raise InputError(f"the model has {what}, for which a machine file has no place, leave it out")


def friction_laws(model: IdentificationModel, parameters: Array) -> dict[str, Friction]:
    """Friction law of each direction with friction terms in the model.

    Args:
        model: The model.
        parameters: All parameters (p,).

    Raises:
        InputError: Identified friction is negative, or no law has a term.
    """
    values = dict(zip(model.names, parameters.tolist(), strict=True))
    numbers_by_direction: dict[str, dict[str, float]] = {}
    for term in model.terms:
        if isinstance(term, FrictionTerm):
            name = term.direction.name
            found = {each.removeprefix(f"{name}."): values[each] for each in term.names}
            if unknown := found.keys() - FRICTION_PARAMETERS:
                raise InputError(
                    f"the model has '{name}.{min(unknown)}', for which a machine file has no "
                    "place, leave it out"
                )
            numbers_by_direction.setdefault(name, {}).update(found, **term.law_constants)
    laws = dict[str, Friction]()
    for name, numbers in numbers_by_direction.items():
        try:
            laws[name] = Friction(**numbers)
        except InputError as error:
            raise InputError(f"'{name}': {error}, {_FEASIBLE_REMEDY}") from None
    return laws


def divide_locked_bodies(
    machine: Machine, parameters: Array, unlocked_machine: Machine
) -> dict[str, Array]:
    """Divide the parameters of bodies with locked joints among their links, (10,) each.

    For a body with the pseudo-inertia P (`pseudo_inertia`) that consists of links with the
    descriptions D_k, whose sum is D, link k gets

        P_k = T D_k T^T,   T = L L_D^-1,   P = L L^T,  D = L_D L_D^T,

    all in the frame of the body's joint: the sum of the links is P, each link is feasible if its
    description is, and P = D gives the descriptions. Rods and plates without thickness are
    thickened. Links that locks fix to the ground are unchanged.

    Args:
        machine: Machine with locked joints.
        parameters: (10 nb,) parameters of its bodies.
        unlocked_machine: The machine without locked joints.

    Raises:
        InputError: A body is not feasible.
    """
    names = body_names(unlocked_machine)
    described = Dynamics(unlocked_machine).parameters[: 10 * len(names)].reshape(-1, 10)
    links_by_body: dict[int, list[tuple[str, Array, Array]]] = {}
    out = {}
    for name, body in zip(names, described, strict=True):
        frame = machine.model.frames[machine.frame(name)]
        A = frame.placement.homogeneous  # the pseudo-inertia about the body's joint is A P A^T
        if frame.parentJoint == 0:
            out[name] = body
            continue
        P = pseudo_inertia(body)
        units = np.sqrt(np.maximum(np.diag(P), np.finfo(float).tiny))
        if np.linalg.eigvalsh(P / np.outer(units, units))[0] <= _FLATNESS_TOLERANCE:
            P = pseudo_inertia(thicken_body(body))
        links_by_body.setdefault(frame.parentJoint - 1, []).append((name, A, P))
    for i, links in links_by_body.items():
        body = parameters[10 * i : 10 * i + 10]
        if len(links) == 1:
            out[links[0][0]] = body
            continue
        try:
            L = np.linalg.cholesky(pseudo_inertia(body))
            D = np.linalg.cholesky(sum(A @ P @ A.T for _, A, P in links))
        except np.linalg.LinAlgError:
            listed = ", ".join(f"'{name}'" for name, *_ in links)
            raise InputError(
                f"the body of the locked links {listed} is not feasible, give feasible=True"
            ) from None
        T = L @ np.linalg.inv(D)
        for name, A, P in links:
            link_transform = np.linalg.inv(A) @ T @ A
            out[name] = body_parameters(link_transform @ P @ link_transform.T)
    return out


def joint_combinations(model: IdentificationModel) -> list[ForceDirection]:
    """Directions of a model that combine several active joints."""
    directions = [term.direction for term in model.terms if isinstance(term, DirectionalTerm)]
    return list({x.name: x for x in directions if x.factors}.values())


def add_motor(
    draft: MachineDraft, direction: ForceDirection, parent: str, law: Friction, inertia: float
) -> None:
    """Add the rotor of a motor that turns several joints, and its coupling with them.

    Its joint has the name of the direction and carries rotor inertia and friction. Its angle is
    that of the motor on the joints' side. Its link has a mass of 1 mg, as bodies need a mass.
    """
    name, zero = direction.name, (0.0, 0.0, 0.0)
    rotor = Inertial(1e-6, zero, zero, (1e-12, 0.0, 0.0, 1e-12, 0.0, 1e-12))
    robot = draft.urdf_of_link(parent)
    add_link(robot, Link(f"{name}_rotor", "", rotor))
    add_joint(robot, Joint(name, "revolute", parent, f"{name}_rotor", "", axis=(0.0, 0.0, 1.0)))
    turned = {joint: -factor for joint, factor in (direction.factors or {}).items()}
    draft.data["couplings"].append({"name": name, "joints": {name: 1.0} | turned})
    draft.data["friction"][name] = friction_data(law)
    draft.data["rotor_inertia"][name] = inertia
