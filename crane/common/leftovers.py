"""Temporary files and folders beside a place, and those that killed processes left there.

A process holds a lock on each of its own for as long as it lives. One without a lock is left over:
the next that writes to the same place removes it. What stood at a place and was moved aside, to
make room, goes back if nothing has taken the place.
"""

import contextlib
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

try:
    import fcntl
except ImportError:  # no Unix: nothing is known to be left over
    fcntl = None  # type: ignore[assignment]

PART, ASIDE = "part", "old"
_ATTEMPTS = 100
_MARK = re.compile(rf"\.[0-9a-f]{{8}}\.({PART}|{ASIDE})")


def beside(place: Path, kind: str) -> Path:
    """A new name for a temporary file or folder next to a place."""
    return place.with_name(f".{place.name}.{os.urandom(4).hex()}.{kind}")


@contextmanager
def temporary(place: Path, folder: bool = False, within: Path | None = None) -> Iterator[Path]:
    """A new file or folder next to a place, locked, which is gone at the end if it is still there.

    Args:
        place: What it is written for.
        folder: Whether it is one.
        within: The folder that it stands in, the place's own if not given.
    """
    part, lock = _made(place if within is None else within / place.name, folder)
    try:
        yield part
    finally:
        _remove(part)
        if lock is not None:
            os.close(lock)


def clear(place: Path, within: Path | None = None) -> None:
    """Remove what is left over of a place, or put it back there."""
    folder = place.parent if within is None else within
    try:
        found = [name for name in os.listdir(folder) if is_temporary(name, place)]
    except OSError:  # told by whoever writes there
        return
    for left in (folder / x for x in found):
        lock = _locked(left)
        if lock is None:
            continue
        try:
            if left.name.endswith(ASIDE) and not os.path.lexists(place):
                os.rename(left, place)
            else:
                _remove(left)
        except OSError:  # another was here first
            pass
        finally:
            os.close(lock)


def is_temporary(name: str, place: Path) -> bool:
    """Whether a file or folder of this name is a temporary one of a place."""
    if not name.startswith(f".{place.name}."):  # nearly all
        return False
    return bool(_MARK.fullmatch(name[len(place.name) + 1 :]))


def hold(path: Path) -> int | None:
    """Wait for the lock of a folder or file that is there; None where systems have none."""
    return _locked(path, wait=True)


def _made(place: Path, folder: bool) -> tuple[Path, int | None]:
    for _ in range(_ATTEMPTS):
        part = beside(place, PART)
        if folder:
            part.mkdir()
        else:
            os.close(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
        if fcntl is None:
            return part, None
        try:
            lock = os.open(part, os.O_RDONLY)
        except FileNotFoundError:  # taken for left over before it was locked
            continue
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.lexists(part):
                return part, lock
        except BlockingIOError:
            pass
        except OSError:  # a file system without locks
            os.close(lock)
            return part, None
        os.close(lock)
    raise OSError(f"no temporary file could be made in {_ATTEMPTS} attempts")


def _locked(path: Path, wait: bool = False) -> int | None:
    """The lock of a file or folder; None if another process holds it, or there are none."""
    if fcntl is None:
        return None
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


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(FileNotFoundError):
            path.unlink()
