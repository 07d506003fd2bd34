"""A folder in the place of another, so that at no instant it is half of each."""

import errno
import os
from pathlib import Path

from crane.common.temporary_files import REPLACED_SUFFIX, temporary_name, wait_for_lock

_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # AT_FDCWD and RENAME_EXCHANGE of Linux
_NOT_EMPTY_ERRORS = (errno.ENOTEMPTY, errno.EEXIST)
_UNSUPPORTED_ERRORS = (
    errno.ENOSYS,
    errno.EINVAL,
    errno.EOPNOTSUPP,
)  # an old kernel, a plain file system


def move_to_free_path(source: Path, target: Path) -> bool:
    """Move a folder to where nothing is, or an empty folder; whether that was so."""
    try:
        os.rename(source, target)
    except OSError as error:
        if error.errno in _NOT_EMPTY_ERRORS or target.is_dir():
            return False
        raise
    return True


def exchange_folders(source: Path, target: Path) -> None:
    """Put a folder in the place of another, which is then at `source`, or gone.

    Linux does that at once. Elsewhere the other is moved aside first: of a process that is killed
    between the two renames, `leftovers.clear` undoes the first.

    Raises:
        OSError: It cannot be; all is as it was.
    """
    if _exchange_atomically(source, target):
        return
    lock, aside = wait_for_lock(target), temporary_name(target, REPLACED_SUFFIX)
    try:
        os.rename(target, aside)
        try:
            os.rename(source, target)
        except OSError:
            os.rename(aside, target)
            raise
        os.rename(aside, source)  # removed with it
    finally:
        if lock is not None:
            os.close(lock)


def _exchange_atomically(source: Path, target: Path) -> bool:
    import ctypes

    rename = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None) if _is_linux() else None
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


def _is_linux() -> bool:
    return os.uname().sysname == "Linux" if hasattr(os, "uname") else False
