"""A cylinder put between two eyes of a machine: barrel and rod, closed by a loop."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crane.common.errors import CraneWarning, InputError
from crane.common.output import file_name, filling
from crane.formats.adding.eyes import eye_of, path_between
from crane.formats.adding.fitting import fitted, warn_of_masses, warn_of_strokes
from crane.formats.adding.hanging import hung
from crane.formats.adding.place import check_free, machine_file
from crane.formats.adding.replaced import driven_instead
from crane.formats.adding.span import Span, span_of
from crane.formats.adding.steel import SteelCylinder
from crane.formats.loading import load
from crane.formats.machine_file.write import Draft
from crane.machine import Machine

_PARTS = (
    "", "_base", "_barrel", "_cross", "_rod", "_eye", "_pin", "_pin_y", "_pin_z", "_attachment",
)  # fmt: skip


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
    start, reached = fitted(span, steel, eyes, loaded)
    way = [joint.name for joint in path_between(loaded, eyes[0].link, eyes[1].link)]
    shares = loaded.unit(span.joint) == "m" and span.joint not in way
    notes = _notes(span, start, shares) + hung(draft, loaded, name, eyes, steel, span.q[start])
    driven_instead(draft, loaded, name, None if shares else span.joint)
    check_free(draft, file, force)
    with filling(file.parent) as part:
        draft.write(part, file.name)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CraneWarning)
            closed = load(part / file.name)  # what does not load is not left behind
        warn_of_strokes(closed, name)
    warn_of_masses(loaded, steel, span.joint)
    return _added(file, name, loaded, steel, span, reached, shares, notes)


def _notes(span: Span, start: int, shares: bool) -> list[str]:
    """What was chosen: the joint that is driven, the posture to begin from."""
    notes = []
    if span.others and not shares:
        notes.append(
            f"{', '.join(span.others)} stay{'s' * (len(span.others) == 1)} driven: of them and "
            f"{span.joint} the cylinder drives {span.joint} best"
        )
    if start != span.home:
        notes.append(f"home: {span.joint} at {span.values[start]:.4g}, where the cylinder fits")
    return notes


def _added(
    file: Path,
    name: str,
    machine: Machine,
    steel: SteelCylinder,
    span: Span,
    reached: Span,
    shares: bool,
    notes: Sequence[str],
) -> AddedCylinder:
    """The result, from the postures that the cylinder reaches."""
    lever = np.abs(reached.lever)
    strokes = np.clip(reached.length[[0, -1]] - steel.retracted, 0, steel.stroke)
    return AddedCylinder(
        path=file,
        name=name,
        joint=span.joint,
        shares=shares,
        unit=machine.unit(span.joint),
        limits=(float(span.values[0]), float(span.values[-1])),
        covered=(float(reached.values[0]), float(reached.values[-1])),
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
