"""Temporary files and folders beside a path, their removal, and the exchange of folders.

A process holds a lock on each of its temporary files for its lifetime. One without a lock is left
over: the next process that writes to the same path removes it. A folder that was moved aside for
an exchange is moved back if nothing is at its path.
"""

import errno
import fcntl
import os
import re
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

PARTIAL_SUFFIX, REPLACED_SUFFIX = "part", "old"
_MAX_ATTEMPTS = 100
_TEMPORARY_PATTERN = re.compile(rf"\.[0-9a-f]{{8}}\.({PARTIAL_SUFFIX}|{REPLACED_SUFFIX})")


def temporary_name(target: Path, suffix: str) -> Path:
    """A new name for a temporary file or folder next to a path."""
    return target.with_name(f".{target.name}.{os.urandom(4).hex()}.{suffix}")


@contextmanager
def temporary_path(
    target: Path, is_folder: bool = False, parent: Path | None = None
) -> Iterator[Path]:
    """Context of a new locked file or folder next to a path, which is removed at the end.

    Args:
        target: The path that it is written for.
        is_folder: Whether to create a folder.
        parent: Folder to create it in, that of the path if not given.
    """
    part, lock = _create_temporary(target if parent is None else parent / target.name, is_folder)
    try:
        yield part
    finally:
        _remove(part)
        os.close(lock)


def remove_leftovers(target: Path, parent: Path | None = None) -> None:
    """Remove temporary files that killed processes left beside a path, or move them back to it."""
    folder = target.parent if parent is None else parent
    try:
        found = [name for name in os.listdir(folder) if is_temporary(name, target)]
    except OSError:  # reported when writing
        return
    for leftover in (folder / x for x in found):
        lock = _acquire_lock(leftover)
        if lock is None:
            continue
        try:
            if leftover.name.endswith(REPLACED_SUFFIX) and not os.path.lexists(target):
                os.rename(leftover, target)
            else:
                _remove(leftover)
        except OSError:  # another process was faster
            pass
        finally:
            os.close(lock)


def is_temporary(name: str, target: Path) -> bool:
    """Whether a name is that of a temporary file or folder of a path."""
    if not name.startswith(f".{target.name}."):  # fast path
        return False
    return bool(_TEMPORARY_PATTERN.fullmatch(name[len(target.name) + 1 :]))


def _create_temporary(target: Path, is_folder: bool) -> tuple[Path, int]:
    for _ in range(_MAX_ATTEMPTS):
        part = temporary_name(target, PARTIAL_SUFFIX)
        if is_folder:
            part.mkdir()
        else:
            os.close(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
        try:
            lock = os.open(part, os.O_RDONLY)
        except FileNotFoundError:  # another process removed it before it was locked
            continue
        if try_lock(lock) and os.path.lexists(part):
            return part, lock
        os.close(lock)
    raise OSError(f"no temporary file could be made in {_MAX_ATTEMPTS} attempts")


def _acquire_lock(path: Path, wait: bool = False) -> int | None:
    """The lock of a file or folder; None if another process holds it, or without locks."""
    try:
        lock = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    except OSError:
        return None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except OSError:
        os.close(lock)
        return None
    return lock


def try_lock(file: int) -> bool:
    """Lock an open file as long as it is open; returns whether no other process has locked it.

    File systems without locks do not tell.
    """
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return not isinstance(error, BlockingIOError)
    return True


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # AT_FDCWD and RENAME_EXCHANGE of Linux
_NOT_EMPTY_ERRORS = (errno.ENOTEMPTY, errno.EEXIST)
_UNSUPPORTED_ERRORS = (
    errno.ENOSYS,
    errno.EINVAL,
    errno.EOPNOTSUPP,
)  # an old kernel, a plain file system


def move_to_free_path(source: Path, target: Path) -> bool:
    """Move a folder to a path that is free or an empty folder; returns whether it was."""
    try:
        os.rename(source, target)
    except OSError as error:
        if error.errno in _NOT_EMPTY_ERRORS or target.is_dir():
            return False
        raise
    return True


def exchange_folders(source: Path, target: Path) -> None:
    """Replace `target` by `source`; the old folder is then at `source`, or removed.

    Linux does this atomically. Elsewhere the old folder is moved aside first; if the process is
    killed between the two renames, `remove_leftovers` moves it back.

    Raises:
        OSError: The exchange failed; everything is unchanged.
    """
    if _exchange_atomically(source, target):
        return
    lock, aside = _acquire_lock(target, wait=True), temporary_name(target, REPLACED_SUFFIX)
    try:
        os.rename(target, aside)
        try:
            os.rename(source, target)
        except OSError:
            os.rename(aside, target)
            raise
        os.rename(aside, source)  # removed together with the temporary folder
    finally:
        if lock is not None:
            os.close(lock)


def _exchange_atomically(source: Path, target: Path) -> bool:
    import ctypes

    library = ctypes.CDLL(None, use_errno=True) if sys.platform == "linux" else None
    rename = getattr(library, "renameat2", None)
    if rename is None:
        return False
    if not rename(
        _AT_FDCWD, os.fsencode(source), _AT_FDCWD, os.fsencode(target), _RENAME_EXCHANGE
    ):
        return True
    number = ctypes.get_errno()
    if number in _UNSUPPORTED_ERRORS:
        return False
    raise OSError(number, os.strerror(number), str(target))
