"""Where a machine that something was added to is written."""

from pathlib import Path

from crane.common.atomic_output import check_file_is_writable
from crane.common.errors import InputError, OutputError
from crane.formats.machine_file.machine_writer import MachineDraft


def machine_file_path(out: str | Path | None, default: str) -> Path:
    """The machine file to write.

    Raises:
        InputError: It has another suffix.
        OutputError: It cannot be written.
    """
    file = Path(default if out is None else out)
    if file.suffix.lower() not in (".yaml", ".yml"):
        raise InputError(f"{file}: a machine file is written, let its name end in .yaml")
    check_file_is_writable(file)
    return file


def check_files_are_new(draft: MachineDraft, file: Path, force: bool) -> None:
    """See that no file is replaced that should not be.

    Raises:
        OutputError: One is there already.
    """
    for relative_path in draft.file_paths(file.name):
        target = file.parent / relative_path
        if target.exists() and not force:
            raise OutputError(f"{target}: exists already, choose another name or add --force")
