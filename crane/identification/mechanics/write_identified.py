"""Writing of identified machines: machine file and URDF files with identified parameters."""

import shutil
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from lxml import etree

from crane.common.atomic_output import replace_folder
from crane.common.errors import CraneError, CraneWarning, InputError, OutputError
from crane.common.samples import Array
from crane.common.unit_conversions import KeyPath
from crane.description.force_elements import Friction
from crane.description.kinematic_tree import inertia_problem
from crane.description.machine_parameters import GRAVITY_PREFIX
from crane.description.machine_schema import END_STOP, FORCE, GAS_SPRING, LOOP, ROPE
from crane.description.parameter_changes import lock_joints
from crane.description.specification import Chain, MachineSpec
from crane.dynamics.dynamics import Dynamics
from crane.formats.machine_file.machine_reader import read_machine_spec, read_plain_data
from crane.formats.machine_file.machine_writer import friction_data
from crane.formats.machine_file.yaml_text import format_yaml
from crane.formats.machine_loading import load
from crane.formats.parallel_robots import is_parallel_robot
from crane.identification.mechanics.base_parameters import random_samples
from crane.identification.mechanics.identification_result import Identification
from crane.identification.mechanics.identified_description import (
    FRICTION_PARAMETERS,
    divide_locked_bodies,
    friction_laws,
    joint_combinations,
    motor_chain,
    replace_inertials,
)
from crane.identification.mechanics.model_terms import BODY_PARAMETERS, FrictionTerm
from crane.machine.machine import Machine

_FEASIBLE_REMEDY = "give feasible=True"
_FORCE_TOLERANCE = 1e-9  # of the largest force, for the check of the written machine


def write_identified(identification: Identification, folder: str | Path) -> Path:
    """Write an identified machine as a machine file with a URDF file per sub-chain.

    `crane.load` reads it, with unlocked joints unless they are locked again:
    `crane.load(crane.identification.write_identified(identification, "identified"),
    lock=identification.described_machine.locked_joints)`.

    The parameters of a body are written to the link that its joint moves; inertials of links fixed
    to it are removed. Friction, rotor inertias and gas pressures are the identified ones, other
    passive forces those of the machine. Friction without a law in machine files is written as the
    nearest law at steady speeds, with a warning about the difference. A motor that turns several
    joints becomes a rotor with a coupling. Bodies of locked joints are divided among their links
    by the descriptions. Everything else is copied from the files of the machine; meshes are
    referred to by their paths. The written files are loaded and compared with the identification
    before they replace existing ones.

    Args:
        identification: Identification of all parameters, with a prior or feasibility constraints.
        folder: Target folder; it is created if necessary, and files of the same names are
            replaced.

    Returns:
        The machine file.

    Raises:
        InputError: The identified machine is not valid, only base parameters are known, the
            machine has another format or parameter changes, or a machine file cannot represent the
            terms of the model.
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
    check_rewritable(machine)
    if parameters is None or not identification.model.bodies:
        raise InputError("forces determine base parameters only: give prior or feasible=True")
    # warnings were reported when the machine was loaded
    with warnings.catch_warnings(action="ignore", category=CraneWarning):
        spec = read_machine_spec(machine.path)
        unlocked_machine = load(machine.path) if machine.locked_joints else machine
    bodies = divide_locked_bodies(machine, parameters, unlocked_machine)
    chains = spec.chains if spec.payload is None else (*spec.chains, spec.payload.chain)
    names = _file_names(chains)
    file = f"{machine.path.stem}.yaml"
    originals = {machine.path, *(chain.urdf for chain in chains)}
    for name in (file, *names.values()):
        if (target := (Path(folder) / name).resolve()) in originals:
            raise OutputError(
                f"{target}: is what '{machine.name}' was read from, choose another folder"
            )
    origin_text = (
        f"identified by {identification.method}{', feasible' if identification.feasible else ''}"
    )
    if undetermined_count := identification.marks.count("not determined"):
        origin_text += (
            f", {undetermined_count} of {len(identification.marks)} base parameters not determined"
        )
    laws, deviations = friction_laws(identification.model, parameters, identification.speeds)
    content, motor_urdfs = _machine_file_content(identification, spec, names, origin_text, laws)
    with replace_folder(folder) as part:
        for chain in spec.chains:
            tree = replace_inertials(chain.urdf, bodies, _fixed_links(spec), origin_text)
            text = etree.tostring(tree, encoding="utf-8", xml_declaration=True)
            (part / names[chain.name]).write_bytes(text.rstrip() + b"\n")
        if spec.payload is not None:
            payload_chain = spec.payload.chain
            shutil.copyfile(payload_chain.urdf, part / names[payload_chain.name])
        for name, text in motor_urdfs.items():
            (part / name).write_text(text, encoding="utf-8")
        (part / file).write_text(content, encoding="utf-8")
        _check_written_machine(identification, bodies, part / file, exact=not deviations)
    if deviations:
        worst = max(deviations, key=lambda name: deviations[name])
        unit = "N" if worst in machine.joints and machine.unit(worst) == "m" else "N m"
        text = (
            f"a machine file has no place for all of the friction of {', '.join(deviations)}: "
            "the nearest law at steady speeds is written, off by at most "
            f"{deviations[worst]:.3g} {unit} ({worst})"
        )
        warnings.warn(text, CraneWarning, stacklevel=3)
    return Path(folder) / file


def check_rewritable(machine: Machine) -> None:
    """Check that the files of a machine can be written with other parameters.

    Raises:
        InputError: The format is not supported, or the machine has parameter changes other than
            its gravity.
    """
    if any(chain.urdf.suffix.lower() != ".urdf" for chain in machine.chains) or (
        not (machine.path.suffix.lower() == ".urdf") and is_parallel_robot(machine.path)
    ):
        raise InputError(
            f"{machine.path.name}: an identified machine needs a machine file or URDF, make "
            f"one: crane convert {machine.command_line_arguments} FOLDER"
        )
    if not all(name.startswith(GRAVITY_PREFIX) for name in machine.parameter_changes):
        raise InputError(
            f"'{machine.name}' was loaded with parameter changes, identify it as its files "
            "describe it"
        )


def _infeasible_body(bodies: Mapping[str, Array]) -> str | None:
    """Text about the first infeasible body, None if all are feasible."""
    for link, body in bodies.items():
        if body[0] < 0:
            return f"link '{link}' has the negative mass {body[0]:.4g} kg"
        inertia = pin.Inertia.FromDynamicParameters(body)
        if problem := inertia_problem(float(inertia.mass), inertia.inertia):
            return f"link '{link}' has {problem.problem}"
    return None


def _file_names(chains: Sequence[Chain]) -> dict[str, str]:
    """File name of each chain; a number distinguishes equal names."""
    taken: dict[str, str] = {}
    for number, chain in enumerate(chains):
        name = chain.urdf.name
        taken[chain.name] = f"{number}_{name}" if name in taken.values() else name
    return taken


def _fixed_links(spec: MachineSpec) -> set[str]:
    """Links that are fixed to one that a joint moves."""
    parent_joints = {joint.child: joint for joint in spec.tree.joints.values()}
    found = set()
    for link in parent_joints:
        at = link
        while at in parent_joints and not parent_joints[at].is_movable:
            at = parent_joints[at].parent
        if at != link and at in parent_joints:
            found.add(link)
    return found


def _machine_file_content(
    result: Identification,
    spec: MachineSpec,
    names: Mapping[str, str],
    origin_text: str,
    laws: Mapping[str, Friction],
) -> tuple[str, dict[str, str]]:
    """Content of the machine file, and of URDF files of motors that turn several joints."""
    machine = result.described_machine
    if machine.path.suffix.lower() == ".urdf":
        data: dict[str, Any] = {"name": machine.name, "chains": [{"name": spec.chains[0].name}]}
        data["loops"] = [
            LOOP.values_of(loop) | {"axis": [float(x) for x in loop.axis]} for loop in spec.loops
        ]
        data["active"] = list(spec.active if spec.active is not None else machine.active)
        if machine.tip is not None:
            data["tip"] = machine.tip
    else:
        data = read_plain_data(machine.path)
    if machine.gravity != spec.gravity:
        data["gravity"] = list(machine.gravity)
    data["source"] = f"{origin_text}; else {machine.source or machine.path.name}"
    for chain in data["chains"]:
        chain["urdf"] = names[chain["name"]]
    if spec.payload is not None:
        data["payload"] = {"urdf": names[spec.payload.chain.name]}
    motor_urdfs = {}
    combinations = joint_combinations(result.model)
    for direction in combinations:
        chain, coupling, text = motor_chain(direction, spec.tree.root_link)
        data["chains"].append(chain)
        data["couplings"] = [*(data.get("couplings") or ()), coupling]
        motor_urdfs[chain["urdf"]] = text
    friction = {x: law for x, law in spec.friction.items() if x in machine.locked_joints}
    for joint in (*machine.joints, *(x.name for x in combinations)):
        if joint in laws or joint in spec.friction:  # without friction in the model it has none
            friction[joint] = laws.get(joint, Friction())
    data["friction"] = {joint: friction_data(law) for joint, law in friction.items()}
    rotors = {joint.name: joint.rotor_inertia for joint in spec.tree.moving_joints}
    rotors |= _parameters_of_kind(result, "rotor_inertia")
    for joint, value in rotors.items():
        if value < 0:
            raise InputError(f"'{joint}': rotor inertia is {value:g}, give feasible=True")
    data["rotor_inertia"] = {joint: value for joint, value in rotors.items() if value}
    scales = _parameters_of_kind(result, "gas_scale")
    moving = lock_joints(spec, machine.locked_joints) if machine.locked_joints else spec

    def elements_of(kind: str) -> list[Any]:
        """Elements of a kind, including those that locked joints removed."""
        kept = getattr(moving, kind)
        return [*getattr(machine, kind), *(x for x in getattr(spec, kind) if x not in kept)]

    data["forces"] = [FORCE.values_of(item) for item in elements_of("forces")]
    data["gas_springs"] = {
        item.joint: GAS_SPRING.values_of(item)
        | {"pressure": item.pressure * scales.get(item.joint, 1.0)}
        for item in elements_of("gas_springs")
    }
    data["ropes"] = [ROPE.values_of(item) for item in elements_of("ropes")]
    data["end_stops"] = {item.joint: END_STOP.values_of(item) for item in elements_of("end_stops")}
    for key in ("loops", "forces", "gas_springs", "ropes", "end_stops", "rotor_inertia"):
        if not data.get(key):
            data.pop(key, None)
    notes = _uncertainty_notes(result, data)
    return format_yaml(data, notes, spec.written_numbers), motor_urdfs


def _uncertainty_notes(result: Identification, data: Mapping[str, Any]) -> dict[KeyPath, str]:
    """Comments on the uncertainty of friction and rotor inertias that are base parameters."""
    found: dict[KeyPath, str] = {}
    half = 0.5 * np.diff(result.confidence_interval(), axis=1)[:, 0]
    for i, (name, group) in enumerate(zip(result.names, result.base.groups, strict=True)):
        owner, _, kind = name.rpartition(".")
        key_path = (kind, owner) if kind == "rotor_inertia" else ("friction", owner, kind)
        place: Any = data
        for key in key_path[:-1]:
            place = place.get(key, {})
        if group == name and np.isclose(
            place.get(key_path[-1], np.nan), result.values[i], rtol=1e-9
        ):
            mark = result.marks[i] and f", {result.marks[i]}"
            found[key_path] = f"identified ±{half[i]:.2g}, 95 %{mark}"
    return found


def _parameters_of_kind(result: Identification, kind: str) -> dict[str, float]:
    """Identified parameters of a kind by element."""
    assert result.parameters is not None
    named = zip(result.model.names, result.parameters.tolist(), strict=True)
    return {
        name.removesuffix(f".{kind}"): value for name, value in named if name.endswith(f".{kind}")
    }


def _check_written_machine(
    result: Identification, bodies: Mapping[str, Array], file: Path, exact: bool
) -> None:
    """Load the written machine and compare its forces with those of the identification.

    Args:
        result: The identification.
        bodies: Parameters (10,) by link.
        file: The machine file.
        exact: Whether friction is exact; otherwise it is excluded from the comparison.
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
    parameter_values, first = parameters.copy(), 0
    for term in model.terms:
        if isinstance(term, FrictionTerm) and not exact:
            parameter_values[first : first + len(term.names)] = 0.0
        first += len(term.names)
    expected_forces = model.regressor(at) @ parameter_values + model.known_forces(at)
    written_forces = Dynamics(written, backend="pinocchio").inverse(
        at.q_a, at.v_a, at.a_a, friction=exact
    )
    force_differences = np.abs(written_forces - expected_forces).max(axis=0)
    if force_differences.max() <= _FORCE_TOLERANCE * np.abs(expected_forces).max():
        return
    kinds = {*FRICTION_PARAMETERS, "gas_scale", "rotor_inertia", *BODY_PARAMETERS}
    others = [name for name in model.names if name.rpartition(".")[2] not in kinds]
    what = f"'{others[0]}'" if others else "friction over other velocities than the machine's"
    raise InputError(f"the model has {what}, for which a machine file has no place, leave it out")
