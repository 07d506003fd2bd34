"""A folder in the place of another, so that at no instant it is half of each."""

import errno
import os
from pathlib import Path

from crane.common.leftovers import ASIDE, beside, hold

_HERE, _EXCHANGE = -100, 2  # AT_FDCWD and RENAME_EXCHANGE of Linux
_NOT_EMPTY = (errno.ENOTEMPTY, errno.EEXIST)
_CANNOT = (errno.ENOSYS, errno.EINVAL, errno.EOPNOTSUPP)  # an old kernel, a plain file system


def appeared(part: Path, place: Path) -> bool:
    """Move a folder to where nothing is, or an empty folder; whether that was so."""
    try:
        os.rename(part, place)
    except OSError as error:
        if error.errno in _NOT_EMPTY or place.is_dir():
            return False
        raise
    return True


def exchanged(part: Path, place: Path) -> None:
    """Put a folder in the place of another, which is then at `part`, or gone.

    Linux does that at once. Elsewhere the other is moved aside first: of a process that is killed
    between the two renames, `leftovers.clear` undoes the first.

    Raises:
        OSError: It cannot be; all is as it was.
    """
    if _at_once(part, place):
        return
    lock, aside = hold(place), beside(place, ASIDE)
    try:
        os.rename(place, aside)
        try:
            os.rename(part, place)
        except OSError:
            os.rename(aside, place)
            raise
        os.rename(aside, part)  # removed with it
    finally:
        if lock is not None:
            os.close(lock)


def _at_once(part: Path, place: Path) -> bool:
    import ctypes

    rename = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None) if _linux() else None
    if rename is None:
        return False
    if not rename(_HERE, os.fsencode(part), _HERE, os.fsencode(place), _EXCHANGE):
        return True
    number = ctypes.get_errno()
    if number in _CANNOT:
        return False
    raise OSError(number, os.strerror(number), str(place))


def _linux() -> bool:
    return os.uname().sysname == "Linux" if hasattr(os, "uname") else False
