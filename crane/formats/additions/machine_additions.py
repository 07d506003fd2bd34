"""Add a hydraulic cylinder, or the loops that a description leaves open, to a machine file."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crane.common.atomic_output import check_file_is_writable, fill_folder, portable_file_name
from crane.common.errors import (
    CraneError,
    InputError,
    MechanismError,
    ignore_warnings,
    warn,
)
from crane.common.package_search import use_load_options
from crane.formats.additions.cylinder_addition import (
    AttachmentPair,
    add_barrel_and_rod,
    parse_attachment_point,
)
from crane.formats.additions.distance_curve import (
    DistanceCurve,
    distance_curve,
    warn_about_masses,
    warn_about_strokes,
)
from crane.formats.additions.open_loop_search import LoopProposal, propose_loops
from crane.formats.machine_file.machine_reader import read_machine_spec
from crane.formats.machine_file.machine_writer import MachineDraft, loop_data
from crane.formats.machine_loading import load
from crane.formats.steel_cylinder import SteelCylinder
from crane.machine.machine import Machine

_NAME_SUFFIXES = (
    "", "_base", "_barrel", "_cross", "_rod", "_eye", "_pin", "_pin_y", "_pin_z", "_attachment",
)  # fmt: skip


@dataclass(frozen=True)
class AddedCylinder:
    """A cylinder that was added to a machine.

    Attributes:
        path: The machine file.
        name: Name of the cylinder and of its active joint, the stroke.
        joint: The joint that it drives.
        shares_load: Whether the previous drive of the joint remains and shares the load.
        unit: Unit of the joint's coordinate.
        limits: Limits of the joint, or the examined range of a joint without limits.
        driven_range: Part of the limits that the stroke reaches.
        length_range: (2,) least and largest distance of the attachment points over `limits` [m].
        stroke_range: (2,) of the cylinder at both ends of `driven_range` [m].
        lever_arm_range: (2,) least and largest lever arm over `driven_range` [m]; a ratio for a
            prismatic joint.
        masses: Masses of barrel and rod [kg].
        notes: Assumptions that were made.
    """

    path: Path
    name: str
    joint: str
    shares_load: bool
    unit: str
    limits: tuple[float, float]
    driven_range: tuple[float, float]
    length_range: tuple[float, float]
    stroke_range: tuple[float, float]
    lever_arm_range: tuple[float, float]
    masses: tuple[float, float]
    notes: tuple[str, ...]

    def __str__(self) -> str:
        """Return a few lines about the cylinder."""
        verb_phrase = "shares the load on" if self.shares_load else "drives"
        lever_arm_name = "lever arm" if self.unit == "rad" else "ratio"
        return "\n".join(
            [
                f"{self.name} {verb_phrase} {self.joint} from {self.driven_range[0]:.4g} to "
                f"{self.driven_range[1]:.4g} {self.unit}, with {self.stroke_range[0]:.4g} to "
                f"{self.stroke_range[1]:.4g} m of its stroke, {lever_arm_name} "
                f"{self.lever_arm_range[0]:.3g} to {self.lever_arm_range[1]:.3g}"
                f"{' m' * (self.unit == 'rad')}",
                f"barrel {self.masses[0]:.4g} kg, rod {self.masses[1]:.4g} kg of steel, "
                "without oil",
                *self.notes,
                f"written to {self.path}",
            ]
        )


def add_cylinder(
    machine: str | Path,
    between: Sequence[str],
    bore: float,
    rod: float,
    stroke: float,
    *,
    name: str = "cylinder",
    dead_length: float | None = None,
    out: str | Path | None = None,
    force: bool = False,
) -> AddedCylinder:
    """Add a cylinder between two points of a machine, and write the closed machine.

    The stroke becomes an active joint in place of the joint that it determines. If the joints
    between the two bodies move in one plane that contains the attachment points, the barrel has a
    revolute joint about the normal and the rod is closed by a revolute loop. Otherwise the barrel
    has a universal joint and the rod is closed by a spherical loop, so that the rod does not spin.

    Args:
        machine: As for `load`.
        between: Attachment points of barrel and rod: LINK, or LINK:x,y,z with metres in the link's
            frame.
        bore: Diameter of the piston [m].
        rod: Diameter of the rod [m].
        stroke: [m].
        name: Name of the cylinder: of its stroke, chain and loop, and prefix of its links.
        dead_length: Length between the pins with the rod retracted [m]; stroke plus four bores if
            not given.
        out: The machine file to write; its URDFs go to a folder of the same name without suffix;
            MACHINE_NAME.yaml in the working folder if not given.
        force: Whether to replace existing files.

    Returns:
        The added cylinder; `path` is the machine file, for `load`.

    Raises:
        InputError: A dimension is invalid, a point is unknown, or the cylinder does not fit.
        OutputError: The files cannot be written, or exist already.
    """
    cylinder = SteelCylinder.from_dimensions(bore, rod, stroke, dead_length)
    if isinstance(between, str) or len(between) != 2:
        raise InputError(f"between is {between!r}, give the two eyes, of barrel and rod")
    if not name or name != name.strip() or not name.isprintable():
        raise InputError(f"the cylinder's name is {name!r}, give a word")
    loaded = load(machine)
    file = machine_file_path(out, f"{portable_file_name(f'{loaded.name}_{name}')}.yaml")
    barrel, rod_eye = (parse_attachment_point(loaded, text) for text in between)
    points = AttachmentPair(loaded, (barrel, rod_eye))
    draft = MachineDraft(loaded, file.stem)
    _check_names_are_free(loaded, name)
    distances = distance_curve(points)
    start_index, reached_distances = distances.fit_cylinder(cylinder)
    shares_load = loaded.unit(distances.joint) == "m" and distances.joint not in [
        joint.name for joint in points.joints
    ]
    notes = _choice_notes(distances, start_index, shares_load)
    notes += add_barrel_and_rod(draft, name, points, cylinder, distances.samples[start_index][1])
    _replace_drive(draft, loaded, name, None if shares_load else distances.joint)
    check_files_are_new(draft, file, force)
    with fill_folder(file.parent) as output_folder:
        draft.write(output_folder, file.name)
        with ignore_warnings():
            closed = load(output_folder / file.name)  # a file that does not load is not kept
        warn_about_strokes(closed, name)
    warn_about_masses(loaded, cylinder, distances.joint)
    lever_arms = [abs(points.lever_arm(q, distances.joint)) for _, q in reached_distances.samples]
    strokes = np.clip(
        reached_distances.length[[0, -1]] - cylinder.retracted_length, 0, cylinder.stroke
    )
    return AddedCylinder(
        path=file,
        name=name,
        joint=distances.joint,
        shares_load=shares_load,
        unit=loaded.unit(distances.joint),
        limits=(float(distances.values[0]), float(distances.values[-1])),
        driven_range=(float(reached_distances.values[0]), float(reached_distances.values[-1])),
        length_range=(float(distances.length.min()), float(distances.length.max())),
        stroke_range=(float(strokes[0]), float(strokes[1])),
        lever_arm_range=(min(lever_arms), max(lever_arms)),
        masses=(cylinder.barrel_inertia.mass, cylinder.rod_inertia.mass),
        notes=tuple(notes),
    )


def _choice_notes(distances: DistanceCurve, start_index: int, shares_load: bool) -> list[str]:
    notes = []
    if distances.alternative_joints and not shares_load:
        notes.append(
            f"{', '.join(distances.alternative_joints)} "
            f"stay{'s' * (len(distances.alternative_joints) == 1)} driven: of them and "
            f"{distances.joint} the cylinder drives {distances.joint} best"
        )
    if start_index != distances.home_index:
        notes.append(
            f"home: {distances.joint} at {distances.values[start_index]:.4g}, where the "
            "cylinder fits"
        )
    return notes


def _replace_drive(draft: MachineDraft, machine: Machine, name: str, joint: str | None) -> None:
    """Make a cylinder a drive in place of a joint, and remove sections of that joint."""
    active = draft.data["active"]
    if joint in active:
        active[active.index(joint)] = name
    else:
        active.append(name)
    draft.data["free"] = [other for other in draft.data.get("free") or () if other != joint]
    removed = []
    if draft.data.pop("control", None):
        removed.append("gains")
    all_tasks = draft.data.get("tasks") or {}
    tasks = {key: task for key, task in all_tasks.items() if "tip" in task}
    if len(tasks) < len(all_tasks):
        draft.data["tasks"] = tasks
        removed.append("tasks of active joints")
    cylinders = (draft.data.get("hydraulics") or {}).get("cylinders", {})
    if joint in cylinders:
        for section in draft.data["hydraulics"].values():
            section.pop(joint, None)
        removed.append(f"the hydraulics of {joint}")
        if not cylinders:
            del draft.data["hydraulics"]
    if removed:
        warn(
            f"{machine.name}: {', '.join(removed)} belonged to the active joints as they were, "
            "left out: write those of the new ones",
            stacklevel=4,
        )


def _check_names_are_free(machine: Machine, name: str) -> None:
    used_names = {*machine.tree.links, *machine.tree.joints, *machine.closure.equations.names}
    used_names |= {chain.name for chain in machine.chains}
    for suffix in _NAME_SUFFIXES:
        if name + suffix in used_names:
            raise InputError(
                f"'{name}{suffix}' is a part of '{machine.name}' already, give the cylinder "
                "another name with --name"
            )


def machine_file_path(out: str | Path | None, default: str) -> Path:
    """Return the machine file to write.

    Raises:
        InputError: The path has another suffix.
        OutputError: It cannot be written.
    """
    file = Path(default if out is None else out)
    if file.suffix.lower() not in (".yaml", ".yml"):
        raise InputError(f"{file}: a machine file is written, let its name end in .yaml")
    check_file_is_writable(file)
    return file


def check_files_are_new(draft: MachineDraft, file: Path, force: bool) -> None:
    """Raise if a file exists that would be replaced without `force`.

    Raises:
        OutputError: A file exists already.
    """
    for relative_path in draft.file_paths(file.name):
        check_file_is_writable(file.parent / relative_path, force)


@dataclass(frozen=True)
class AddedLoops:
    """Loops that were added to a machine.

    Attributes:
        path: The machine file.
        loops: The loops as proposed.
        active: Joints that drive the closed machine.
        mobility: Degrees of freedom of the closed machine.
    """

    path: Path
    loops: tuple[LoopProposal, ...]
    active: tuple[str, ...]
    mobility: int

    def __str__(self) -> str:
        """Return a few lines about the loops."""
        lines = [str(proposal) for proposal in self.loops]
        driven_text = ", ".join(self.active) or "nothing"
        lines.append(f"{self.mobility} degrees of freedom, driven by {driven_text}")
        return "\n".join([*lines, f"written to {self.path}"])


def add_loops(
    machine: str | Path,
    *,
    out: str | Path | None = None,
    force: bool = False,
    packages: Sequence[str | Path] = (),
    arguments: Mapping[str, object] | None = None,
) -> AddedLoops:
    """Add the loops that `crane check` proposes, and write the closed machine.

    Active joints and home are those of the file; missing ones are chosen as for any machine and
    written to the file.

    Args:
        machine: As for `load`.
        out: The machine file to write; its URDFs go to a folder of the same name without suffix;
            NAME_closed.yaml in the working folder if not given.
        force: Whether to replace existing files.
        packages: As for `load`.
        arguments: As for `load`.

    Returns:
        The loops, the active joints, and the file that was written.

    Raises:
        InputError: The machine has no open loops.
        MechanismError: The machine does not close with them.
        OutputError: The files cannot be written, or exist already.
    """
    with ignore_warnings():
        loaded = load(machine, packages=packages, arguments=arguments)
        with use_load_options(loaded.packages, loaded.arguments, trust_xacro=loaded.trusts_xacro):
            spec = read_machine_spec(machine)
    proposed_loops = propose_loops(spec, loaded.model, loaded.home)
    if not proposed_loops:
        raise InputError(
            f"'{loaded.name}' has no frames that look like ends of a loop and meet at home: give "
            'a home where they do (<group_state name="home">), or write loops in a machine file'
        )
    file = machine_file_path(out, f"{portable_file_name(loaded.name)}_closed.yaml")
    draft = MachineDraft(loaded, file.stem)
    check_files_are_new(draft, file, force)
    draft.data |= {
        "active": list(spec.active or ()), "free": list(spec.free), "home": dict(spec.home),
    }  # fmt: skip
    draft.data["loops"] += [loop_data(proposal.loop) for proposal in proposed_loops]
    with fill_folder(file.parent) as output_folder:
        draft.write(output_folder, file.name)
        try:
            closed_machine = load(output_folder / file.name)
        except CraneError as error:
            names = ", ".join(proposal.loop.name for proposal in proposed_loops)
            raise MechanismError(
                f"the machine does not close with the proposed loops {names}: {error}", "loops"
            ) from None
        driven_joints = closed_machine.driven_joints
        draft.data |= {
            "active": [*(spec.active or driven_joints)], "free": list(closed_machine.free),
            "home": dict(zip(closed_machine.joints, closed_machine.home.tolist(), strict=True)),
        }  # fmt: skip
        draft.write(output_folder, file.name)
    return AddedLoops(
        file, proposed_loops, tuple(driven_joints), closed_machine.closure.degrees_of_freedom
    )
