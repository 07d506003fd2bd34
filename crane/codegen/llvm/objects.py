"""Machine code kept between runs: what was compiled once is read from a folder of the user's.

A file per program, named by a digest of all that its code depends on. It begins with a digest of
the rest, so that a damaged one is compiled anew. Where the folder cannot be written or belongs to
someone else, nothing is kept.
"""

import hashlib
import os
import stat
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from platformdirs import user_cache_path

from crane.common.errors import OutputError
from crane.common.output import replacing

MOST = 256 << 20  # bytes in the folder; what was used least lately makes room
_DIGEST = 32  # bytes


def folder() -> Path:
    """Where machine code is kept."""
    return user_cache_path("crane", appauthor=False) / "objects"


def object_code(depends: str, make: Callable[[], bytes]) -> bytes:
    """Machine code from the folder, or else made and put there.

    Args:
        depends: All that it depends on.
        make: Makes it.
    """
    file = folder() / f"{hashlib.sha256(depends.encode()).hexdigest()}.o"
    found = _read(file)
    if found is None:
        found = make()
        with suppress(OSError, OutputError):
            _write(file, found)
    return found


def _read(file: Path) -> bytes | None:
    try:
        if not _own(file.parent):
            return None
        data = file.read_bytes()
        os.utime(file)
    except OSError:
        return None
    code = data[_DIGEST:]
    return code if hashlib.sha256(code).digest() == data[:_DIGEST] else None


def _write(file: Path, code: bytes) -> None:
    file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not _own(file.parent):
        return
    _make_room(file.parent, len(code))
    with replacing(file) as part:
        part.write_bytes(hashlib.sha256(code).digest() + code)


def _own(place: Path) -> bool:
    """Whether nobody else can put code there, as far as the system tells."""
    if not hasattr(os, "getuid"):
        return True
    about = place.stat()
    return about.st_uid == os.getuid() and not about.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def _make_room(place: Path, size: int) -> None:
    """Remove what was used least lately until there is room for so many bytes."""
    files = [(item.stat(), item) for item in place.iterdir()]
    total = size + sum(about.st_size for about, _ in files)
    for about, item in sorted(files, key=lambda pair: pair[0].st_mtime):
        if total <= MOST:
            return
        item.unlink(missing_ok=True)
        total -= about.st_size
