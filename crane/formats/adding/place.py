"""Where a machine that something was added to is written."""

from pathlib import Path

from crane.common.errors import InputError, OutputError
from crane.common.output import check_file
from crane.formats.machine_file.write import Draft


def machine_file(out: str | Path | None, otherwise: str) -> Path:
    """The machine file to write.

    Raises:
        InputError: It has another suffix.
        OutputError: It cannot be written.
    """
    file = Path(otherwise if out is None else out)
    if file.suffix.lower() not in (".yaml", ".yml"):
        raise InputError(f"{file}: a machine file is written, let its name end in .yaml")
    check_file(file)
    return file


def check_free(draft: Draft, file: Path, force: bool) -> None:
    """See that no file is replaced that should not be.

    Raises:
        OutputError: One is there already.
    """
    for other in draft.files(file.name):
        place = file.parent / other
        if place.exists() and not force:
            raise OutputError(f"{place}: exists already, choose another name or add --force")
