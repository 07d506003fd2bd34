"""An identified machine as files: its URDFs and its machine file with other numbers."""

import dataclasses
import shutil
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from lxml import etree

from crane.common.errors import CraneError, CraneWarning, InputError, OutputError
from crane.common.output import staging
from crane.common.samples import Array
from crane.description import Chain, Friction, MachineSpec, locked
from crane.description.inertia import inertia_problem
from crane.dynamics import Dynamics
from crane.formats import load, read
from crane.formats.machine_file.read import plain_data
from crane.formats.machine_file.text import Way, yaml_text
from crane.formats.machine_file.write import friction_data
from crane.formats.parallel_robots import is_parallel_robot
from crane.identification.mechanics.base import random_samples
from crane.identification.mechanics.division import divided
from crane.identification.mechanics.inertias import PER_BODY
from crane.identification.mechanics.laws import Frictional, Written, laws
from crane.identification.mechanics.motors import combinations, motor_chain
from crane.identification.mechanics.result import Identification
from crane.identification.mechanics.urdf import changed_urdf
from crane.machine import Machine

_SAME = 1e-9  # of the largest force, by which the written machine may differ
_FRICTION = tuple(item.name for item in dataclasses.fields(Friction))


def write_identified(found: Identification, folder: str | Path) -> Path:
    """Write the identified machine: a machine file with a URDF per sub-chain beside it.

    `crane.load` gives it from there, with what was locked as all else:
    `crane.load(crane.write_identified(found, "identified"), lock=found.described.locks)`.

    Each body's parameters stand in the link that its joint moves, and the inertials of links
    fixed to it are removed. Friction, rotor inertias and pressures of gas are the identified
    ones, other passive forces the machine's. Friction that a machine file has no law for is
    written as the nearest law at steady speeds, with a warning that says how near. A motor
    that turns with several joints becomes a rotor that a coupling turns. What locked joints
    made one body is divided among its links as they are described. Everything else is as in
    the files that the machine was read from; what they draw is found where it is. The written
    files are loaded, and compared where the machine was locked, before they are put in place.

    Args:
        found: With all parameters, so of a prior or of a feasible estimate.
        folder: Created where there is none; files of the same names are replaced.

    Returns:
        The machine file.

    Raises:
        InputError: The identified machine cannot be, forces alone determined no more than base
            parameters, the machine comes from another format or is not as its files describe
            it, or a machine file cannot hold the model's terms.
        OutputError: The folder cannot be written, or holds what the machine was read from.
    """
    machine, parameters = found.described, found.parameters
    check_rewritable(machine)
    if parameters is None or not found.model.bodies:
        raise InputError("forces determine base parameters only: give prior or feasible=True")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)  # told when the machine was loaded
        spec = read(machine.path)
        whole = load(machine.path) if machine.locks else machine
    bodies = divided(machine, parameters, whole)
    names = _names(spec)
    file = f"{machine.path.stem}.yaml"
    originals = {machine.path, *(chain.urdf for chain in _files(spec))}
    for name in (file, *names.values()):
        if (place := (Path(folder) / name).resolve()) in originals:
            raise OutputError(
                f"{place}: is what '{machine.name}' was read from, choose another folder"
            )
    how = f"identified by {found.method}{', feasible' if found.feasible else ''}"
    if vague := found.marks.count("not determined"):
        how += f", {vague} of {len(found.marks)} base parameters not determined"
    written = laws(found.model, parameters, found.speeds)
    content, more = _content(found, spec, names, how, written)
    with staging(folder) as part:
        for chain in spec.chains:
            tree = changed_urdf(chain.urdf, bodies, _carried(spec), how)
            text = etree.tostring(tree, encoding="utf-8", xml_declaration=True)
            (part / names[chain.name]).write_bytes(text.rstrip() + b"\n")
        if spec.payload is not None:
            carried = spec.payload.chain
            shutil.copyfile(carried.urdf, part / names[carried.name])
        for name, text in more.items():
            (part / name).write_text(text, encoding="utf-8")
        (part / file).write_text(content, encoding="utf-8")
        _check(found, bodies, part / file, exact=not any(each.off for each in written.values()))
    _tell(machine, written)
    return Path(folder) / file


def check_rewritable(machine: Machine) -> None:
    """See that the files of a machine can be written again with other numbers in them.

    Raises:
        InputError: They cannot.
    """
    urdf = machine.path.suffix.lower() == ".urdf"
    if any(chain.urdf.suffix.lower() != ".urdf" for chain in machine.chains) or (
        not urdf and is_parallel_robot(machine.path)
    ):
        raise InputError(
            f"{machine.path.name}: an identified machine needs a machine file or URDF, make "
            f"one: crane convert {machine.command} FOLDER"
        )
    if machine.changes:
        raise InputError(
            f"'{machine.name}' was loaded with changed numbers, identify it as its files "
            "describe it"
        )


def _impossible(bodies: Mapping[str, Array]) -> str | None:
    """The first of the bodies that cannot exist, and why."""
    for link, body in bodies.items():
        if body[0] < 0:
            return f"link '{link}' has the negative mass {body[0]:.4g} kg"
        inertia = pin.Inertia.FromDynamicParameters(body)
        if problem := inertia_problem(float(inertia.mass), inertia.inertia):
            return f"link '{link}' has {problem.what}"
    return None


def _names(spec: MachineSpec) -> dict[str, str]:
    """File of each chain: the name it has, with a number where two are alike."""
    taken: dict[str, str] = {}
    for number, chain in enumerate(_files(spec)):
        name = chain.urdf.name
        taken[chain.name] = f"{number}_{name}" if name in taken.values() else name
    return taken


def _files(spec: MachineSpec) -> tuple[Chain, ...]:
    """The chains, and the payload that the machine file names."""
    return spec.chains if spec.payload is None else (*spec.chains, spec.payload.chain)


def _carried(spec: MachineSpec) -> set[str]:
    """Links that are fixed to one that a joint moves."""
    above = {joint.child: joint for joint in spec.tree.joints.values()}
    found = set()
    for link in above:
        at = link
        while at in above and not above[at].moves:
            at = above[at].parent
        if at != link and at in above:
            found.add(link)
    return found


def _content(
    result: Identification,
    spec: MachineSpec,
    names: Mapping[str, str],
    how: str,
    written: Mapping[str, Written],
) -> tuple[str, dict[str, str]]:
    """The machine file, and the URDFs of motors that turn with several joints, by name."""
    machine = result.described
    data: dict[str, Any]
    if machine.path.suffix.lower() == ".urdf":
        data = {"name": machine.name, "chains": [{"name": spec.chains[0].name}]}
        loops = [dataclasses.asdict(loop) for loop in spec.loops]
        data |= {"loops": [{k: v for k, v in loop.items() if k != "where"} for loop in loops]}
        for loop in data["loops"]:
            loop["axis"] = list(loop["axis"])
        data |= {"active": list(spec.active if spec.active is not None else machine.active)}
        if machine.tip is not None:
            data["tip"] = machine.tip
    else:
        data = plain_data(machine.path)
    data["source"] = f"{how}; else {machine.source or machine.path.name}"
    for chain in data["chains"]:
        chain["urdf"] = names[chain["name"]]
    if spec.payload is not None:
        data["payload"] = {"urdf": names[spec.payload.chain.name]}
    more = {}
    for direction in combinations(result.model):
        chain, coupling, text = motor_chain(direction, spec.tree.root)
        data["chains"].append(chain)
        data["couplings"] = [*(data.get("couplings") or ()), coupling]
        more[chain["urdf"]] = text
    data["friction"] = _friction(result, spec, written)
    data["rotor_inertia"] = _rotors(result, spec)
    scales = _values(result, "gas_scale")
    moving = locked(spec, machine.locks) if machine.locks else spec

    def of(kind: str) -> list[Any]:
        """The machine's elements of a kind, and those that its locks took."""
        kept = getattr(moving, kind)
        return [*getattr(machine, kind), *(x for x in getattr(spec, kind) if x not in kept)]

    data["forces"] = [_numbers(item) for item in of("forces")]
    data["gas_springs"] = {
        item.joint: _numbers(
            item, joint=None, pressure=item.pressure * scales.get(item.joint, 1.0)
        )
        for item in of("gas_springs")
    }
    data["ropes"] = [_numbers(item) for item in of("ropes")]
    data["end_stops"] = {item.joint: _numbers(item, joint=None) for item in of("end_stops")}
    for key in ("loops", "forces", "gas_springs", "ropes", "end_stops", "rotor_inertia"):
        if not data.get(key):
            data.pop(key, None)
    return yaml_text(data, _notes(result, data)), more


def _notes(result: Identification, data: Mapping[str, Any]) -> dict[Way, str]:
    """How well friction and rotor inertias are known that the recording tells by themselves."""
    found: dict[Way, str] = {}
    half = 0.5 * np.diff(result.interval(), axis=1)[:, 0]
    for i, (name, group) in enumerate(zip(result.names, result.base.groups, strict=True)):
        owner, _, kind = name.rpartition(".")
        way = (kind, owner) if kind == "rotor_inertia" else ("friction", owner, kind)
        place: Any = data
        for key in way[:-1]:
            place = place.get(key, {})
        if group == name and np.isclose(place.get(way[-1], np.nan), result.values[i], rtol=1e-9):
            mark = result.marks[i] and f", {result.marks[i]}"
            found[way] = f"identified ±{half[i]:.2g}, 95 %{mark}"
    return found


def _values(result: Identification, kind: str) -> dict[str, float]:
    """Identified parameters of a kind by what they are of."""
    assert result.parameters is not None
    named = zip(result.model.names, result.parameters.tolist(), strict=True)
    return {
        name.removesuffix(f".{kind}"): value for name, value in named if name.endswith(f".{kind}")
    }


def _rotors(result: Identification, spec: MachineSpec) -> dict[str, float]:
    """Rotor inertia by joint, the described one where none was identified."""
    described = {joint.name: joint.rotor_inertia for joint in spec.tree.moving}
    found = described | _values(result, "rotor_inertia")
    for joint, value in found.items():
        if value < 0:
            raise InputError(f"'{joint}': rotor inertia is {value:g}, give feasible=True")
    return {joint: value for joint, value in found.items() if value}


def _friction(
    result: Identification, spec: MachineSpec, written: Mapping[str, Written]
) -> dict[str, dict[str, Any]]:
    """Friction by joint; one that the model gives none has none, whatever its files say."""
    machine = result.described
    friction = {
        joint: friction_data(law) for joint, law in spec.friction.items() if joint in machine.locks
    }
    for joint in (*machine.joints, *(x.name for x in combinations(result.model))):
        if joint in written:
            friction[joint] = friction_data(written[joint].law)
        elif joint in spec.friction:
            friction[joint] = {"viscous": 0.0}
    return friction


def _tell(machine: Machine, written: Mapping[str, Written]) -> None:
    """Warn of friction that is not written as it was identified."""
    off = {name: each.off for name, each in written.items() if each.off}
    if off:
        worst = max(off, key=lambda name: off[name])
        unit = "N" if worst in machine.joints and machine.unit(worst) == "m" else "N m"
        text = (
            f"a machine file has no place for all of the friction of {', '.join(off)}: the "
            f"nearest law at steady speeds is written, off by at most {off[worst]:.3g} {unit} "
            f"({worst})"
        )
        warnings.warn(text, CraneWarning, stacklevel=4)


def _numbers(item: Any, **changed: Any) -> dict[str, Any]:
    """What of a dataclass is not as by default."""
    values = {
        field.name: changed.get(field.name, getattr(item, field.name))
        for field in dataclasses.fields(item)
        if field.name not in changed or changed[field.name] is not None
    }
    defaults = {field.name: field.default for field in dataclasses.fields(item)}
    return {key: value for key, value in values.items() if value != defaults[key]}


def _check(result: Identification, bodies: Mapping[str, Array], file: Path, exact: bool) -> None:
    """Load what was written and compare its forces with those of the parameters.

    Args:
        result: See above.
        bodies: Parameters (10,) by link.
        file: The machine file.
        exact: Whether friction is the identified one; where it is not, all else is compared.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CraneWarning)
            written = load(file, lock=dict(result.described.locks))
    except CraneError as error:
        # a body is no slip in a file, which is not there yet: not to be corrected by hand
        body = None if result.feasible else _impossible(bodies)
        why = f"{body}, give feasible=True" if body else error
        raise InputError(f"the identified machine cannot be: {why}") from None
    model, parameters = result.model, result.parameters
    assert parameters is not None
    at = random_samples(model, 20)
    counted, first = parameters.copy(), 0
    for term in model.terms:
        if isinstance(term, Frictional) and not exact:
            counted[first : first + len(term.names)] = 0.0
        first += len(term.names)
    wanted = model.regressor(at) @ counted + model.known(at)
    dynamics = Dynamics(written, backend="pinocchio")
    found = dynamics.inverse(at.q_a, at.v_a, at.a_a, friction=exact)
    off = np.abs(found - wanted).max(axis=0)
    if off.max() <= _SAME * np.abs(wanted).max():
        return
    kinds = {*_FRICTION, "gas_scale", "rotor_inertia", *PER_BODY}
    others = [name for name in model.names if name.rpartition(".")[2] not in kinds]
    what = f"'{others[0]}'" if others else "friction over other velocities than the machine's"
    raise InputError(f"the model has {what}, for which a machine file has no place, leave it out")
