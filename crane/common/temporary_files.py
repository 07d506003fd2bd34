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

PARTIAL_SUFFIX, REPLACED_SUFFIX = "part", "old"
_MAX_ATTEMPTS = 100
_TEMPORARY_PATTERN = re.compile(rf"\.[0-9a-f]{{8}}\.({PARTIAL_SUFFIX}|{REPLACED_SUFFIX})")


def temporary_name(target: Path, suffix: str) -> Path:
    """A new name for a temporary file or folder next to a place."""
    return target.with_name(f".{target.name}.{os.urandom(4).hex()}.{suffix}")


@contextmanager
def temporary_path(
    target: Path, is_folder: bool = False, parent: Path | None = None
) -> Iterator[Path]:
    """A new file or folder next to a place, locked, which is gone at the end if it is still there.

    Args:
        target: What it is written for.
        is_folder: Whether it is one.
        parent: The folder that it stands in, the place's own if not given.
    """
    part, lock = _create_temporary(target if parent is None else parent / target.name, is_folder)
    try:
        yield part
    finally:
        _remove(part)
        if lock is not None:
            os.close(lock)


def remove_leftovers(target: Path, parent: Path | None = None) -> None:
    """Remove what is left over of a place, or put it back there."""
    folder = target.parent if parent is None else parent
    try:
        found = [name for name in os.listdir(folder) if is_temporary(name, target)]
    except OSError:  # told by whoever writes there
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
        except OSError:  # another was here first
            pass
        finally:
            os.close(lock)


def is_temporary(name: str, target: Path) -> bool:
    """Whether a file or folder of this name is a temporary one of a place."""
    if not name.startswith(f".{target.name}."):  # nearly all
        return False
    return bool(_TEMPORARY_PATTERN.fullmatch(name[len(target.name) + 1 :]))


def wait_for_lock(path: Path) -> int | None:
    """Wait for the lock of a folder or file that is there; None where systems have none."""
    return _acquire_lock(path, wait=True)


def _create_temporary(target: Path, is_folder: bool) -> tuple[Path, int | None]:
    for _ in range(_MAX_ATTEMPTS):
        part = temporary_name(target, PARTIAL_SUFFIX)
        if is_folder:
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
    raise OSError(f"no temporary file could be made in {_MAX_ATTEMPTS} attempts")


def _acquire_lock(path: Path, wait: bool = False) -> int | None:
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
