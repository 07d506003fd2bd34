"""The loops that a description leaves open, put into a machine file."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from crane.common.errors import CraneError, CraneWarning, InputError, MechanismError
from crane.common.output import file_name, filling
from crane.common.packages import giving
from crane.description import MachineSpec
from crane.formats.adding.open_loops import Proposal, proposals
from crane.formats.adding.place import check_free, machine_file
from crane.formats.loading import load
from crane.formats.machine_file.read import read
from crane.formats.machine_file.write import Draft
from crane.machine import Machine


@dataclass(frozen=True)
class AddedLoops:
    """Loops that were taken over.

    Attributes:
        path: The machine file.
        loops: As they were proposed.
        active: Joints that drive the closed machine.
        freedom: Its degrees of freedom.
    """

    path: Path
    loops: tuple[Proposal, ...]
    active: tuple[str, ...]
    freedom: int

    def __str__(self) -> str:
        """A few lines."""
        lines = [str(proposal) for proposal in self.loops]
        driven = ", ".join(self.active)
        lines.append(f"{self.freedom} degrees of freedom, driven by {driven or 'nothing'}")
        return "\n".join([*lines, f"written to {self.path}"])


def add_loops(
    machine: str | Path,
    *,
    out: str | Path | None = None,
    force: bool = False,
    packages: Sequence[str | Path] = (),
    arguments: Mapping[str, object] | None = None,
) -> AddedLoops:
    """Close the loops that `crane check` proposes, and write the closed machine.

    Active joints and home are those that the file names; what it leaves open is chosen as for any
    machine and written down.

    Args:
        machine: As for `load`.
        out: The machine file to write, its URDFs go to a folder beside of the same name without
            suffix; NAME_closed.yaml in this folder if not given.
        force: Whether files that are there are replaced.
        packages: As for `load`.
        arguments: As for `load`.

    Returns:
        The loops, the active joints, and the file that was written.

    Raises:
        InputError: Nothing is left open.
        MechanismError: The machine does not close with them.
        OutputError: The files cannot be written, or are there already.
    """
    loaded, spec = _quietly(machine, packages, arguments)
    found = proposals(spec, loaded.model, loaded.home)
    if not found:
        raise InputError(
            f"'{loaded.name}' has no frames that look like ends of a loop and meet at home: give "
            'a home where they do (<group_state name="home">), or write loops in a machine file'
        )
    file = machine_file(out, f"{file_name(loaded.name)}_closed.yaml")
    draft = Draft(loaded, file.stem)
    check_free(draft, file, force)
    draft.data |= {
        "active": list(spec.active or ()), "free": list(spec.free), "home": dict(spec.home),
    }  # fmt: skip
    draft.data["loops"] += [_entry(proposal) for proposal in found]
    with filling(file.parent) as part:
        draft.write(part, file.name)
        closed = _closed(part / file.name, found)
        driven = closed.driven_joints
        draft.data |= {
            "active": [*(spec.active or driven)], "free": list(closed.free),
            "home": dict(zip(closed.joints, closed.home.tolist(), strict=True)),
        }  # fmt: skip
        draft.write(part, file.name)
    return AddedLoops(file, found, tuple(driven), closed.closure.degrees_of_freedom)


def _quietly(
    machine: str | Path,
    packages: Sequence[str | Path],
    arguments: Mapping[str, object] | None,
) -> tuple[Machine, MachineSpec]:
    """The open machine, whose loops are not worth a warning any more, and as it was read."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        loaded = load(machine, packages=packages, arguments=arguments)
        with giving(loaded.packages, loaded.arguments):
            return loaded, read(machine)


def _closed(path: Path, found: tuple[Proposal, ...]) -> Machine:
    try:
        return load(path)
    except CraneError as error:
        names = ", ".join(proposal.loop.name for proposal in found)
        raise MechanismError(
            f"the machine does not close with the proposed loops {names}: {error}", "loops"
        ) from None


def _entry(proposal: Proposal) -> dict[str, Any]:
    loop = proposal.loop
    return {
        "name": loop.name, "type": loop.type, "predecessor": loop.predecessor,
        "successor": loop.successor, "axis": list(loop.axis),
    }  # fmt: skip
