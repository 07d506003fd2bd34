"""Atomic output: files and folders are written completely or not at all.

Missing folders are created.
"""

import csv
import os
import re
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from crane.common import temporary_files
from crane.common.errors import OutputError
from crane.common.temporary_files import exchange_folders, move_to_free_path


@contextmanager
def replace_file(path: str | Path) -> Iterator[Path]:
    """Context of a temporary path that replaces `path` at the end.

    The temporary file is in the same folder, or in the nearest existing folder above. It is
    removed when the block raises, and `path` is then unchanged.

    Raises:
        OutputError: Nothing can be written there, or `path` is not a plain file.
    """
    path = Path(path)
    check_file_is_writable(path)
    folder = _nearest_existing(path.parent)
    try:
        temporary_files.remove_leftovers(path, folder)
        with temporary_files.temporary_path(path, parent=folder) as temporary_file:
            yield temporary_file
            path.parent.mkdir(parents=True, exist_ok=True)
            os.replace(temporary_file, path)
    except OSError as error:
        raise writing_error(path, error) from error


def write_csv(
    path: str | Path, rows: Iterable[Iterable[object]], notes: Iterable[str] = ()
) -> None:
    """Write rows of cells as CSV, below notes as comments.

    Raises:
        OutputError: See `replace_file`.
    """
    with (
        replace_file(path) as part,
        part.open("w", newline="", encoding="utf-8", errors="surrogateescape") as file,
    ):
        file.writelines(f"# {note}\n" for note in notes)
        csv.writer(file, lineterminator="\n").writerows(rows)


@contextmanager
def replace_folder(
    folder: str | Path, overwrite: bool = True, stale: Iterable[str] = ()
) -> Iterator[Path]:
    """Context of a temporary folder that replaces `folder` at the end.

    It is beside `folder`, or in the nearest existing folder above, and is removed when the block
    raises. Other files in `folder` are kept: the new folder has links to them. At any instant,
    also after a kill, `folder` has either its old or its new content.

    Some folders cannot be replaced: the current folder and those above it, mount points, folders
    without write permission, and those on file systems without links. They are filled file by
    file, as by `fill_folder`.

    Args:
        folder: Created if it does not exist.
        overwrite: Whether files of the same names are replaced; if not, `folder` must be new or
            empty, also at the end.
        stale: Patterns of paths in `folder`, of files to remove.

    Raises:
        OutputError: Nothing can be written there, a file would replace a folder or a folder a
            file, or `folder` was filled meanwhile.
    """
    target = Path(os.path.realpath(folder))
    _check_writable(target)
    if not _can_be_moved(target):
        with fill_folder(folder, stale) as output_folder:
            yield output_folder
            if not overwrite:
                _check_free(target, folder)
        return
    first_missing = _first_missing(target)
    with _temporary_output_folder(
        folder, first_missing, subfolder=target.relative_to(first_missing)
    ) as (temporary_folder, output_folder):
        yield output_folder
        if move_to_free_path(temporary_folder, first_missing):
            return
        target.parent.mkdir(parents=True, exist_ok=True)
        if output_folder != temporary_folder and move_to_free_path(output_folder, target):
            return
        if not overwrite:
            _check_free(target, folder)
        try:
            _link_other_files(target, output_folder, _match_patterns(target, stale))
            exchange_folders(output_folder, target)
        except OSError:  # no links on this file system, or another user's folder
            _move_files(output_folder, target, stale)


@contextmanager
def fill_folder(folder: str | Path, stale: Iterable[str] = ()) -> Iterator[Path]:
    """Context of a temporary folder whose files are moved one by one into `folder` at the end.

    For folders of the user rather than results. The temporary folder is in `folder`, or in the
    nearest existing folder above, and is removed when the block raises.

    Args:
        folder: Created if it does not exist; files of the same names are replaced, others kept.
        stale: Patterns of paths in `folder`, of files to remove.

    Raises:
        OutputError: Nothing can be written there, or a file would replace a folder or a folder a
            file.
    """
    target = Path(os.path.realpath(folder))
    _check_writable(target)
    with _temporary_output_folder(folder, target, parent=_nearest_existing(target)) as (
        _,
        output_folder,
    ):
        yield output_folder
        _move_files(output_folder, target, stale)


@contextmanager
def _temporary_output_folder(
    folder: str | Path, target: Path, parent: Path | None = None, subfolder: Path = Path()
) -> Iterator[tuple[Path, Path]]:
    """A temporary folder, and the subfolder in it that is written to.

    Raises:
        OutputError: Raised in the block, with the path that the user knows; or nothing can be
            written.
    """
    try:
        temporary_files.remove_leftovers(target, parent)
        with temporary_files.temporary_path(
            target, is_folder=True, parent=parent
        ) as temporary_folder:
            (output_folder := temporary_folder / subfolder).mkdir(parents=True, exist_ok=True)
            try:
                yield temporary_folder, output_folder
            except OutputError as error:
                raise OutputError(str(error).replace(str(output_folder), str(folder))) from error
    except OSError as error:
        raise writing_error(Path(folder), error) from error


def check_file_is_writable(path: Path, overwrite: bool = True) -> None:
    """Check that a file can be written, before it is computed.

    Raises:
        OutputError: Its folder can be neither written to nor made, something other than a plain
            file is in the way, or the file exists and `overwrite` is False.
    """
    try:
        if path.is_dir():
            raise OutputError(f"{path}: is a folder, give the name of a file")
        if path.exists() and not path.is_file():
            raise OutputError(f"{path}: is no plain file, give another name")
    except OSError as error:  # a name that is too long, or a folder without permission
        raise writing_error(path, error) from None
    _check_writable(path.parent)
    if path.exists() and not overwrite:
        raise OutputError(f"{path}: exists already, choose another name or add --force")


def check_folder_is_writable(folder: Path, overwrite: bool = True) -> None:
    """Check that a folder can be made or filled, before its files are computed.

    Removes what killed processes left there.

    Raises:
        OutputError: A file is in the way, the nearest folder may not be written to, or the folder
            holds something and `overwrite` is False.
    """
    _check_writable(folder)
    target = Path(os.path.realpath(folder))
    temporary_files.remove_leftovers(_first_missing(target))
    temporary_files.remove_leftovers(target, _nearest_existing(target))
    if overwrite or not folder.is_dir():
        return
    try:
        is_empty = not any(folder.iterdir())
    except OSError as error:
        reason = error.strerror or str(error)
        raise OutputError(f"{folder}: cannot be read ({reason}), choose another") from None
    if not is_empty:
        raise OutputError(f"{folder}: is not empty, choose another folder or add --force")


def portable_file_name(text: str) -> str:
    """A file name that is valid on every system, as similar to a text as possible."""
    return re.sub(r"[^\w.-]+", "_", text).strip("._")[:60] or "unnamed"


def _check_writable(folder: Path) -> None:
    try:
        existing = _nearest_existing(folder)
        is_folder = existing.is_dir()
    except OSError as error:
        raise writing_error(folder, error) from None
    if not is_folder:
        what = "is a file" if existing == folder else f"{existing} is a file"
        raise OutputError(f"{folder}: {what}, give the name of a folder")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise OutputError(
            f"{folder}: the folder {existing} may not be written to, choose another place"
        )


def _nearest_existing(path: Path) -> Path:
    """The path itself, or the nearest one above it that exists."""
    while not path.exists() and path != path.parent:
        path = path.parent
    return path


def _first_missing(path: Path) -> Path:
    """The path itself, or the highest one above it that does not exist."""
    while not path.parent.exists() and path != path.parent:
        path = path.parent
    return path


def _can_be_moved(target: Path) -> bool:
    """Whether a folder can be replaced by renaming."""
    if not os.access(_first_missing(target).parent, os.W_OK | os.X_OK):
        return False
    try:
        current = Path(os.path.realpath(os.getcwd()))
    except OSError:  # the current folder was removed
        return not os.path.ismount(target)
    return not (current.is_relative_to(target) or os.path.ismount(target))


def _check_free(target: Path, folder: str | Path) -> None:
    if any(not temporary_files.is_temporary(name, target) for name in os.listdir(target)):
        raise OutputError(
            f"{folder}: is there now, another program has filled it meanwhile, choose another "
            "folder or add --force"
        )


def _match_patterns(target: Path, patterns: Iterable[str]) -> set[Path]:
    return {x for pattern in patterns for x in target.glob(pattern) if not x.is_dir()}


def _link_other_files(old: Path, new: Path, stale: set[Path]) -> None:
    """Link files of an old folder into a new one, except stale and existing ones."""
    for entry in os.scandir(old):
        here, there = old / entry.name, new / entry.name
        is_folder = entry.is_dir(follow_symlinks=False)
        if here in stale:
            continue
        if os.path.lexists(there):
            if there.is_dir() and not is_folder:
                raise OutputError(f"{here}: is a file, give the name of a folder")
            if is_folder and not there.is_dir():
                raise _folder_in_the_way_error(here)
            if is_folder:
                _link_other_files(here, there, stale)
        elif is_folder:
            there.mkdir()
            _link_other_files(here, there, stale)
            if any(there.iterdir()) or not any(here.iterdir()):
                shutil.copystat(here, there)
            else:  # all files in it were stale
                there.rmdir()
        else:
            os.link(here, there, follow_symlinks=False)
    shutil.copymode(old, new)


def _move_files(source: Path, target: Path, patterns: Iterable[str]) -> None:
    """Move all files from one folder into another, then remove stale files."""
    if not target.exists():
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(source, target)
        return
    files = [path.relative_to(source) for path in sorted(source.rglob("*")) if path.is_file()]
    stale = _match_patterns(target, patterns) - {target / file for file in files}
    for file in files:  # check everything before moving anything
        _check_writable((target / file).parent)
        if (target / file).is_dir():
            raise _folder_in_the_way_error(target / file)
    for file in files:
        (target / file).parent.mkdir(parents=True, exist_ok=True)
        os.replace(source / file, target / file)
    for path in stale:
        path.unlink(missing_ok=True)
        if path.parent != target and not any(path.parent.iterdir()):
            path.parent.rmdir()


def _folder_in_the_way_error(path: Path) -> OutputError:
    return OutputError(f"{path}: is a folder, remove it or choose another place")


def writing_error(path: Path, error: OSError) -> OutputError:
    """An error of the system about a path as one of the package."""
    reason = error.strerror or str(error)
    return OutputError(f"{path}: cannot be written ({reason}), choose another place")
