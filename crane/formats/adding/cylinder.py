"""A cylinder put between two eyes of a machine: barrel and rod, closed by a loop."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin
from lxml import etree

from crane.common.errors import CraneError, CraneWarning, InputError, OutputError
from crane.common.output import check_file, file_name, staging
from crane.common.samples import Array
from crane.description.rigid import placement, vector
from crane.description.tree import Joint, Limits, Link
from crane.formats.adding.eyes import Eye, apart, eye_of, path_between
from crane.formats.adding.span import Span, span_of
from crane.formats.adding.steel import SteelCylinder
from crane.formats.loading import load
from crane.formats.machine_file.write import Draft
from crane.formats.parts import add_joint, add_link
from crane.machine import Machine

_PARALLEL = 1e-9  # sine of an angle that is none: what is less exact gets a universal joint
_RESOLVED = 1e-4  # of the stroke, to which its reachable part is told
_PARTS = (
    "", "_base", "_barrel", "_cross", "_rod", "_eye", "_pin", "_pin_y", "_pin_z", "_attachment",
)  # fmt: skip
_X, _Y, _Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class AddedCylinder:
    """What was added, and what it does.

    Attributes:
        path: The machine file.
        name: Of the cylinder and its active joint, the stroke.
        joint: The joint that it drives.
        shares: Whether it shares the load with what drove the joint before, else in its place.
        unit: Of the joint.
        limits: Of the joint, or what was looked at where it has none.
        covered: Part of them that the stroke reaches.
        length: (2,) least and largest distance of the eyes over `limits` [m].
        strokes: (2,) of the cylinder at both ends of `covered` [m].
        lever: (2,) least and largest lever arm over `covered` [m], of a slide a ratio.
        masses: Of barrel and rod [kg].
        notes: What was assumed.
    """

    path: Path
    name: str
    joint: str
    shares: bool
    unit: str
    limits: tuple[float, float]
    covered: tuple[float, float]
    length: tuple[float, float]
    strokes: tuple[float, float]
    lever: tuple[float, float]
    masses: tuple[float, float]
    notes: tuple[str, ...]

    def __str__(self) -> str:
        """A few lines."""
        place = "shares the load on" if self.shares else "drives"
        arm = "lever arm" if self.unit == "rad" else "ratio"
        lines = [
            f"{self.name} {place} {self.joint} from {self.covered[0]:.4g} to "
            f"{self.covered[1]:.4g} {self.unit}, with {self.strokes[0]:.4g} to "
            f"{self.strokes[1]:.4g} m of its stroke, {arm} {self.lever[0]:.3g} to "
            f"{self.lever[1]:.3g}{' m' * (self.unit == 'rad')}",
            f"barrel {self.masses[0]:.4g} kg, rod {self.masses[1]:.4g} kg of steel, without oil",
            *self.notes,
            f"written to {self.path}",
        ]
        return "\n".join(lines)


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
    """Put a cylinder between two points of a machine, and write the closed machine.

    The stroke becomes an active joint in place of the joint that it determines. Where the joints
    between the two bodies move in one plane and the eyes lie in it, the barrel turns about an axis
    normal to it and the rod's eye is a revolute loop; else the barrel has a universal joint and
    the rod's eye a spherical one, so that the rod does not spin.

    Args:
        machine: As for `load`.
        between: Eyes of barrel and rod: LINK, or LINK:x,y,z with metres in the link's frame.
        bore: Diameter of the piston [m].
        rod: Diameter of the rod [m].
        stroke: [m].
        name: Of the cylinder: its stroke, chain and loop; its links have it in front.
        dead_length: Pin to pin with the rod in [m]; stroke and four bores if not given.
        out: The machine file to write, its URDFs go to a folder beside of the same name without
            suffix; MACHINE_NAME.yaml in this folder if not given.
        force: Whether files that are there are replaced.

    Returns:
        What was added; `path` is the machine file, for `load`.

    Raises:
        InputError: The cylinder is none, its eyes are not there, or it does not fit between them.
        OutputError: The files cannot be written, or are there already.
    """
    steel = SteelCylinder.of(bore, rod, stroke, dead_length)
    if isinstance(between, str) or len(between) != 2:
        raise InputError(f"between is {between!r}, give the two eyes, of barrel and rod")
    if not name or name != name.strip() or not name.isprintable():
        raise InputError(f"the cylinder's name is {name!r}, give a word")
    loaded = load(machine)
    file = machine_file(out, f"{file_name(f'{loaded.name}_{name}')}.yaml")
    eyes = [eye_of(loaded, text) for text in between]
    draft = Draft(loaded, file.stem)
    _check_names(loaded, name)
    span = span_of(loaded, eyes)
    start, reached = _fitted(span, steel, eyes, loaded)
    shares = loaded.unit(span.joint) == "m" and span.joint not in [
        joint.name for joint in path_between(loaded, eyes[0].link, eyes[1].link)
    ]
    notes = []
    if span.others and not shares:
        notes.append(
            f"{', '.join(span.others)} stay{'s' * (len(span.others) == 1)} driven: of them and "
            f"{span.joint} the cylinder drives {span.joint} best"
        )
    if start != span.home:
        notes.append(f"home: {span.joint} at {span.values[start]:.4g}, where the cylinder fits")
    notes += _assembled(draft, loaded, name, eyes, steel, span.q[start])
    _drive(draft, loaded, name, None if shares else span.joint)
    check_free(draft, file, force)
    with staging(file.parent) as part:
        draft.write(part, file.name)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CraneWarning)
            closed = load(part / file.name)  # what does not load is not left behind
        _warn_of_strokes(closed, name)
    lever = np.abs(span.lever[reached])
    first, last = reached[0], reached[-1]
    strokes = np.clip(span.length[[first, last]] - steel.retracted, 0, steel.stroke)
    return AddedCylinder(
        path=file,
        name=name,
        joint=span.joint,
        shares=shares,
        unit=loaded.unit(span.joint),
        limits=(float(span.values[0]), float(span.values[-1])),
        covered=(float(span.values[first]), float(span.values[last])),
        length=(float(span.length.min()), float(span.length.max())),
        strokes=(float(strokes[0]), float(strokes[1])),
        lever=(float(lever.min()), float(lever.max())),
        masses=(steel.barrel.mass, steel.piston_rod.mass),
        notes=tuple(notes),
    )


def _check_names(machine: Machine, name: str) -> None:
    taken = {*machine.tree.links, *machine.tree.joints}
    taken |= {chain.name for chain in machine.chains}
    taken |= set(machine.closure.equations.names)
    for part in _PARTS:
        if name + part in taken:
            raise InputError(
                f"'{name}{part}' is a part of '{machine.name}' already, give the cylinder another "
                "name with --name"
            )


def _fitted(
    span: Span, steel: SteelCylinder, eyes: Sequence[Eye], machine: Machine
) -> tuple[int, range]:
    """Index of the home posture and range of those reached, told where that is not all.

    Raises:
        InputError: There are none.
    """
    ends = steel.retracted, steel.retracted + steel.stroke
    lengths = f"{span.length.min():.4g} to {span.length.max():.4g} m"
    unit = machine.unit(span.joint)
    values = f"{span.values[0]:.4g} to {span.values[-1]:.4g} {unit}"
    found = span.driven(*ends)
    if found is None:
        fits = (span.length >= ends[0]) & (span.length <= ends[1])
        idle = "with a lever arm " if fits.any() else ""
        raise InputError(
            f"a cylinder of {ends[0]:.4g} to {ends[1]:.4g} m does not fit {idle}between "
            f"'{eyes[0]}' and '{eyes[1]}', {lengths} apart with {span.joint} at {values}: choose "
            "another stroke, dead length or eyes"
        )
    start, reached = found
    if len(reached) < len(span.values):
        a, b = span.values[reached[0]], span.values[reached[-1]]
        inside = (span.length >= ends[0]) & (span.length <= ends[1])
        beyond = [k for k in (reached[0] - 1, reached[-1] + 1) if 0 <= k < len(inside)]
        dead = [f"{span.values[k]:.4g}" for k in beyond if inside[k]]
        what = f", with a dead centre at {' and '.join(dead)}" if dead else ""
        warnings.warn(
            f"'{span.joint}' moves from {values}, and a cylinder of {ends[0]:.4g} to "
            f"{ends[1]:.4g} m drives it from {a:.4g} to {b:.4g}{what}: its eyes are {lengths} "
            "apart over all of it, choose stroke, dead length or eyes by that",
            CraneWarning,
            stacklevel=4,
        )
    return start, reached


def _warn_of_strokes(machine: Machine, name: str) -> None:
    """Warn of strokes that the linkage does not let the cylinder have."""
    if name not in machine.active:  # it shares the load: others say how far they go
        return
    index, home = machine.active.index(name), machine.home[machine.closure.active]

    def closes(stroke: float) -> bool:
        target = home.copy()
        target[index] = stroke
        try:
            machine.closure.solve(target)
        except CraneError:
            return False
        return True

    lost = []
    for end in (float(machine.lower[index]), float(machine.upper[index])):
        good, bad = float(home[index]), end
        if closes(end):
            continue
        while abs(bad - good) > _RESOLVED * machine.upper[index]:
            middle = (good + bad) / 2
            good, bad = (middle, bad) if closes(middle) else (good, middle)
        lost.append(f"{min(good, end):.4g} to {max(good, end):.4g} m")
    if lost:
        warnings.warn(
            f"the linkage does not close at {' and '.join(lost)} of the stroke of '{name}', "
            "beyond its dead centre: choose another stroke, dead length or eyes",
            CraneWarning,
            stacklevel=4,
        )


def _assembled(
    draft: Draft,
    machine: Machine,
    name: str,
    eyes: Sequence[Eye],
    steel: SteelCylinder,
    q: Array,
) -> list[str]:
    """Barrel and rod as a chain, the loop that closes it, and the home posture q (nq,)."""
    notes = []
    way = apart(machine, eyes, q)
    normal = _normal(machine, eyes, q, way)
    planar = normal is not None and bool(abs(way @ normal) <= steel.bore)
    if normal is not None and planar:
        offset = float(way @ normal)
        if abs(offset) > 1e-6:
            notes.append(f"the rod's eye moved {1e3 * abs(offset):.4g} mm along its pin, into the "
                         "plane of the barrel's")  # fmt: skip
        way = way - offset * normal
    length = float(np.linalg.norm(way))
    along = way / length
    if normal is None or abs(along @ normal) > 0.9:
        normal = np.eye(3)[np.abs(along).argmin()]
    across = normal - (normal @ along) * along
    across /= np.linalg.norm(across)
    turn = np.column_stack([along, across, np.cross(along, across)])
    barrel, rod = (eye.place(machine, q) for eye in eyes)
    mount = pin.SE3(turn, barrel.translation)
    seat = pin.SE3(turn, barrel.translation + way)
    base = pin.SE3(np.eye(3), np.array(eyes[0].point)) * barrel.actInv(mount)
    eye = pin.SE3(np.eye(3), np.array(eyes[1].point)) * rod.actInv(seat)
    _put_eye(draft.robot_of(eyes[1].link), name, eyes[1].link, eye)
    draft.add_chain(name, _chain(name, steel, base, planar), {"parent": eyes[0].link})
    draft.data["loops"].append(
        {
            "name": name,
            "type": "revolute" if planar else "spherical",
            "predecessor": f"{name}_rod",
            "successor": f"{name}_eye",
            "axis": list(_Y),
        }
    )
    home = dict(zip(machine.joints, q.tolist(), strict=True))
    pins = [f"{name}_pin"] if planar else [f"{name}_pin_y", f"{name}_pin_z"]
    draft.data["home"] = home | dict.fromkeys(pins, 0.0) | {name: length - steel.retracted}
    return notes


def _normal(machine: Machine, eyes: Sequence[Eye], q: Array, way: Array) -> Array | None:
    """(3,) normal of the plane in which two bodies move against each other, None for space."""
    data = machine.model.createData()
    jacobian = pin.computeJointJacobians(machine.model, data, q).reshape(6, -1)
    turning, sliding = [], []
    for joint in path_between(machine, eyes[0].link, eyes[1].link):
        column = jacobian[:, machine.column(joint.name)]
        if joint.kind == "revolute":
            turning.append(column[3:])
        else:
            sliding.append(column[:3])
    if turning:
        normal = turning[0]
    else:
        crosses = [np.cross(way, axis) for axis in sliding]
        normal = max(crosses, key=lambda cross: float(np.linalg.norm(cross)))
        if np.linalg.norm(normal) < _PARALLEL * np.linalg.norm(way):
            normal = np.cross(way, np.eye(3)[np.abs(way).argmin()])
        normal = normal / np.linalg.norm(normal)
    off = [float(np.linalg.norm(np.cross(axis, normal))) for axis in turning]
    off += [abs(float(axis @ normal)) for axis in sliding]
    return None if max(off) > _PARALLEL else np.asarray(normal)


def _put_eye(robot: etree._Element, name: str, link: str, place: pin.SE3) -> None:
    """A frame of a link for the rod's eye."""
    xyz, rpy = placement(place)
    add_link(robot, Link(f"{name}_eye", ""))
    add_joint(robot, Joint(f"{name}_eye", "fixed", link, f"{name}_eye", "", xyz, rpy))


def _chain(name: str, steel: SteelCylinder, base: pin.SE3, planar: bool) -> etree._Element:
    """The URDF of barrel and rod; x points from the barrel's eye to the rod's, y is a pin."""
    robot = etree.Element("robot", name=name)
    barrel, cross, rod = (f"{name}_{part}" for part in ("barrel", "cross", "rod"))
    xyz, rpy = placement(base)
    links = [Link(f"{name}_base", "")]
    if planar:
        pins = [Joint(f"{name}_pin", "revolute", links[0].name, barrel, "", xyz, rpy, _Y)]
    else:
        links.append(Link(cross, "", between=f"{name}_pin"))
        pins = [
            Joint(f"{name}_pin_y", "revolute", links[0].name, cross, "", xyz, rpy, _Y),
            Joint(f"{name}_pin_z", "revolute", cross, barrel, "", axis=_Z),
        ]
    links += [Link(barrel, "", steel.barrel), Link(rod, "", steel.piston_rod)]
    limits = Limits(0.0, steel.stroke, steel.effort)
    at = vector(np.array([steel.retracted, 0, 0]))
    slide = Joint(name, "prismatic", barrel, rod, "", at, axis=_X, limits=limits)
    for link in links:
        add_link(robot, link)
    steel.draw(*(element for element in robot.findall("link")[-2:]))
    for joint in (*pins, slide):
        add_joint(robot, joint)
    return robot


def _drive(draft: Draft, machine: Machine, name: str, joint: str | None) -> None:
    """Name the cylinder as driven, in place of a joint, and drop what belonged to that joint."""
    active, free = draft.data["active"], draft.data["free"]
    if joint in active:
        active[active.index(joint)] = name
    else:
        active.append(name)
    draft.data["free"] = [other for other in free if other != joint]
    lost = []
    if draft.data["control"]:
        draft.data["control"] = {}
        lost.append("gains")
    tasks = {key: task for key, task in draft.data["tasks"].items() if "tip" in task}
    if len(tasks) < len(draft.data["tasks"]):
        draft.data["tasks"] = tasks
        lost.append("tasks of active joints")
    cylinders = draft.data.get("hydraulics", {}).get("cylinders", {})
    if joint in cylinders:
        for section in draft.data["hydraulics"].values():
            section.pop(joint, None)
        lost.append(f"the hydraulics of {joint}")
        if not cylinders:
            del draft.data["hydraulics"]
    if lost:
        warnings.warn(
            f"{machine.name}: {', '.join(lost)} belonged to the active joints as they were, left "
            "out: write those of the new ones",
            CraneWarning,
            stacklevel=4,
        )
