"""Files and folders are written whole or not at all."""

import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from crane.common.errors import OutputError


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """A temporary path to write to, which takes the place of `path` at the end.

    The temporary file stands in the same folder and is removed when the block raises; whatever
    was at `path` before then stays as it was.

    Raises:
        OutputError: The folder does not exist, nothing can be written there, or something other
            than a plain file is in the way.
    """
    path = Path(path)
    _check_place(path)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield part
        os.replace(part, path)
    except OSError as error:
        raise _unwritable(path, error) from error
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def staging(folder: str | Path) -> Iterator[Path]:
    """A temporary folder to write to, whose files go into `folder` at the end.

    The temporary folder stands in `folder`, or where that does not exist in the nearest folder
    above it that does, and is removed when the block raises. At the end `folder` is created, and
    files of the same names in it are replaced; others stay.

    Raises:
        OutputError: Nothing can be written there, or a folder is where a file is to go, or a file
            where a folder is to go.
    """
    target = Path(os.path.realpath(folder))
    _check_writable(target)
    part = _existing(target) / f".{target.name}.{os.getpid()}.part"
    try:
        part.mkdir()
        yield part
        _move_all(part, target)
    except OutputError as error:  # told of the place that the user knows
        raise OutputError(str(error).replace(str(part), str(folder))) from error
    except OSError as error:
        raise _unwritable(Path(folder), error) from error
    finally:
        shutil.rmtree(part, ignore_errors=True)


def check_file(path: Path) -> None:
    """See that a file can be written, before it is computed.

    Raises:
        OutputError: The folder does not exist or may not be written to, or something other than a
            plain file is in the way.
    """
    _check_place(path)
    _check_writable(path.parent)


def check_folder(folder: Path) -> None:
    """See that a folder can be made or filled, before its files are computed.

    Raises:
        OutputError: A file is in the way, or the nearest folder may not be written to.
    """
    _check_writable(folder)


def file_name(text: str) -> str:
    """A name for a file that every system takes, as near to a text as possible."""
    return re.sub(r"[^\w.-]+", "_", text).strip("._")[:60] or "unnamed"


def _check_place(path: Path) -> None:
    try:
        if path.is_dir():
            raise OutputError(f"{path}: is a folder, give the name of a file")
        if path.exists() and not path.is_file():
            raise OutputError(f"{path}: is no plain file, give another name")
        if not path.parent.is_dir():
            raise OutputError(f"{path}: there is no folder {path.parent}, create it first")
    except OSError as error:  # a name longer than any file's, a folder that may not be entered
        raise _unwritable(path, error) from None


def _check_writable(folder: Path) -> None:
    try:
        existing = _existing(folder)
        is_folder = existing.is_dir()
    except OSError as error:
        raise _unwritable(folder, error) from None
    if not is_folder:
        what = "is a file" if existing == folder else f"{existing} is a file"
        raise OutputError(f"{folder}: {what}, give the name of a folder")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise OutputError(
            f"{folder}: the folder {existing} may not be written to, choose another place"
        )


def _existing(path: Path) -> Path:
    """The path itself, or the nearest one above it that exists."""
    while not path.exists() and path != path.parent:
        path = path.parent
    return path


def _move_all(source: Path, target: Path) -> None:
    """Move all files from one folder into another, the same names replaced."""
    if not target.exists():
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(source, target)
        return
    files = [path.relative_to(source) for path in sorted(source.rglob("*")) if path.is_file()]
    for file in files:  # what is in the way is found before anything is moved
        _check_writable((target / file).parent)
        if (target / file).is_dir():
            raise OutputError(f"{target / file}: is a folder, remove it or choose another place")
    for file in files:
        (target / file).parent.mkdir(parents=True, exist_ok=True)
        os.replace(source / file, target / file)


def _unwritable(path: Path, error: OSError) -> OutputError:
    reason = error.strerror or str(error)
    return OutputError(f"{path}: cannot be written ({reason}), choose another place")
