"""Files and folders are written whole or not at all; folders that are not there are made."""

import os
import re
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from crane.common import temporary_files
from crane.common.errors import OutputError
from crane.common.folder_exchange import exchange_folders, move_to_free_path


@contextmanager
def replace_file(path: str | Path) -> Iterator[Path]:
    """A temporary path to write to, which takes the place of `path` at the end.

    The temporary file stands in the same folder, or where there is none in the nearest folder
    above it, and is removed when the block raises; whatever was at `path` before then stays as it
    was.

    Raises:
        OutputError: Nothing can be written there, or something other than a plain file is in the
            way.
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
        raise _cannot_be_written_error(path, error) from error


@contextmanager
def replace_folder(
    folder: str | Path, overwrite: bool = True, stale: Iterable[str] = ()
) -> Iterator[Path]:
    """A temporary folder to write to, which takes the place of `folder` at the end.

    It stands beside `folder`, or where that does not exist in the nearest folder above it that
    does, and is removed when the block raises. Whatever else is in `folder` stays there: of its
    files there are links in the new folder. Whoever looks, at any instant, and whoever finds it
    after a kill, sees what was there or what was written, and never some of both.

    There is no place beside the current folder and those above it, where a disk is mounted, or in
    a folder that may not be written to, and some file systems have no links: such a folder is
    filled file by file, as by `fill_folder`.

    Args:
        folder: Created where there is none.
        overwrite: Whether files of the same names are replaced; if not, `folder` has to be new or
            empty, at the end, too.
        stale: Patterns of paths in `folder`, of files that do not stay.

    Raises:
        OutputError: Nothing can be written there, a folder is where a file is to go, or a file
            where a folder is to go, or `folder` was filled meanwhile.
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
        except OSError:  # no links here, or another user's folder
            _move_files(output_folder, target, stale)


@contextmanager
def fill_folder(folder: str | Path, stale: Iterable[str] = ()) -> Iterator[Path]:
    """A temporary folder to write to, whose files go one by one into `folder` at the end.

    For a folder that is the user's place rather than a result. The temporary folder stands in it,
    or where there is none in the nearest folder above it, and is removed when the block raises.

    Args:
        folder: Created where there is none; files of the same names are replaced, others stay.
        stale: Patterns of paths in `folder`, of files that do not stay.

    Raises:
        OutputError: Nothing can be written there, or a folder is where a file is to go, or a file
            where a folder is to go.
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
    """A temporary folder for a place, and the one in it that is written to.

    Raises:
        OutputError: One that is raised in the block, told of the folder that the user knows, or
            nothing can be written.
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
        raise _cannot_be_written_error(Path(folder), error) from error


def check_file_is_writable(path: Path, overwrite: bool = True) -> None:
    """See that a file can be written, before it is computed.

    Raises:
        OutputError: Its folder can be neither written to nor made, something other than a plain
            file is in the way, or the file exists and `overwrite` is False.
    """
    try:
        if path.is_dir():
            raise OutputError(f"{path}: is a folder, give the name of a file")
        if path.exists() and not path.is_file():
            raise OutputError(f"{path}: is no plain file, give another name")
    except OSError as error:  # a name longer than any file's, a folder that may not be entered
        raise _cannot_be_written_error(path, error) from None
    _check_writable(path.parent)
    if path.exists() and not overwrite:
        raise OutputError(f"{path}: exists already, choose another name or add --force")


def check_folder_is_writable(folder: Path, overwrite: bool = True) -> None:
    """See that a folder can be made or filled, before its files are computed.

    What killed processes left over of it is removed.

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
    """A name for a file that every system takes, as near to a text as possible."""
    return re.sub(r"[^\w.-]+", "_", text).strip("._")[:60] or "unnamed"


def _check_writable(folder: Path) -> None:
    try:
        existing = _nearest_existing(folder)
        is_folder = existing.is_dir()
    except OSError as error:
        raise _cannot_be_written_error(folder, error) from None
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
    """Whether a folder can be put in the place of this one."""
    if not os.access(_first_missing(target).parent, os.W_OK | os.X_OK):
        return False
    try:
        current = Path(os.path.realpath(os.getcwd()))
    except OSError:  # it is gone
        return not os.path.ismount(target)
    return not (current.is_relative_to(target) or os.path.ismount(target))


def _check_free(target: Path, folder: str | Path) -> None:
    """Raise if a folder holds something besides what is being written to it."""
    if any(not temporary_files.is_temporary(name, target) for name in os.listdir(target)):
        raise OutputError(
            f"{folder}: is there now, another program has filled it meanwhile, choose another "
            "folder or add --force"
        )


def _match_patterns(target: Path, patterns: Iterable[str]) -> set[Path]:
    """Files that patterns name."""
    return {x for pattern in patterns for x in target.glob(pattern) if not x.is_dir()}


def _link_other_files(old: Path, new: Path, stale: set[Path]) -> None:
    """Link into a new folder what of an old one is not in it, and not stale."""
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
            else:  # all of it was stale
                there.rmdir()
        else:
            os.link(here, there, follow_symlinks=False)
    shutil.copymode(old, new)


def _move_files(source: Path, target: Path, patterns: Iterable[str]) -> None:
    """Move all files from one folder into another, the same names replaced, then remove others."""
    if not target.exists():
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(source, target)
        return
    files = [path.relative_to(source) for path in sorted(source.rglob("*")) if path.is_file()]
    stale = _match_patterns(target, patterns) - {target / file for file in files}
    for file in files:  # what is in the way is found before anything is moved
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


def _cannot_be_written_error(path: Path, error: OSError) -> OutputError:
    reason = error.strerror or str(error)
    return OutputError(f"{path}: cannot be written ({reason}), choose another place")
