"""Add the loops that a description leaves open to a machine file."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from crane.common.atomic_output import check_file_is_writable, fill_folder, portable_file_name
from crane.common.errors import CraneError, CraneWarning, InputError, MechanismError, OutputError
from crane.common.package_search import use_load_options
from crane.description.specification import MachineSpec
from crane.formats.additions.open_loop_search import LoopProposal, propose_loops
from crane.formats.machine_file.machine_reader import read_machine_spec
from crane.formats.machine_file.machine_writer import MachineDraft
from crane.formats.machine_loading import load
from crane.machine.machine import Machine


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
        target = file.parent / relative_path
        if target.exists() and not force:
            raise OutputError(f"{target}: exists already, choose another name or add --force")


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
        driven_text = ", ".join(self.active)
        lines.append(f"{self.mobility} degrees of freedom, driven by {driven_text or 'nothing'}")
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
    loaded, spec = _load_open_machine(machine, packages, arguments)
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
    draft.data["loops"] += [_loop_data(proposal) for proposal in proposed_loops]
    with fill_folder(file.parent) as output_folder:
        draft.write(output_folder, file.name)
        closed_machine = _load_closed_machine(output_folder / file.name, proposed_loops)
        driven_joints = closed_machine.driven_joints
        draft.data |= {
            "active": [*(spec.active or driven_joints)], "free": list(closed_machine.free),
            "home": dict(zip(closed_machine.joints, closed_machine.home.tolist(), strict=True)),
        }  # fmt: skip
        draft.write(output_folder, file.name)
    return AddedLoops(
        file, proposed_loops, tuple(driven_joints), closed_machine.closure.degrees_of_freedom
    )


def _load_open_machine(
    machine: str | Path,
    packages: Sequence[str | Path],
    arguments: Mapping[str, object] | None,
) -> tuple[Machine, MachineSpec]:
    """Load the open machine without warnings, and return it with its description."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        loaded = load(machine, packages=packages, arguments=arguments)
        with use_load_options(
            loaded.packages, loaded.arguments, trust_xacro=loaded.trusts_xacro
        ):
            return loaded, read_machine_spec(machine)


def _load_closed_machine(path: Path, proposed_loops: tuple[LoopProposal, ...]) -> Machine:
    try:
        return load(path)
    except CraneError as error:
        names = ", ".join(proposal.loop.name for proposal in proposed_loops)
        raise MechanismError(
            f"the machine does not close with the proposed loops {names}: {error}", "loops"
        ) from None


def _loop_data(proposal: LoopProposal) -> dict[str, Any]:
    loop = proposal.loop
    return {
        "name": loop.name, "type": loop.type, "predecessor": loop.predecessor,
        "successor": loop.successor, "axis": list(loop.axis),
    }  # fmt: skip
