"""What is kept between runs, machine code above all: found once, it is read from a folder.

A file each, in the user's cache, named by a digest of all that its content depends on. It begins
with a digest of its own name and the rest, so that one that is damaged or belongs elsewhere is
made anew. Where the folder cannot be written or belongs to someone else, nothing is kept.
"""

import hashlib
import os
import stat
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

from platformdirs import user_cache_path

from crane.common.errors import OutputError
from crane.common.output import replacing

MOST = 256 << 20  # bytes in the folder; what was used least lately makes room
_PARTS = 16  # of these, after each of which the folder is looked through again
_DIGEST = 32  # bytes
_left: dict[Path, int] = {}  # bytes that this process may write before it looks again


def folder() -> Path:
    """Where things are kept."""
    return user_cache_path("crane", appauthor=False) / "objects"


def named(depends: str, kind: str = "code") -> str:
    """The name of a file whose content depends on this alone."""
    return f"{hashlib.sha256(depends.encode()).hexdigest()}.{kind}"


def object_code(depends: str, make: Callable[[], bytes]) -> bytes:
    """Machine code from the folder, or else made and put there.

    Args:
        depends: All that it depends on.
        make: Makes it.
    """
    name = named(depends)
    found = read(name)
    if found is None:
        found = make()
        write(name, found)
    return found


def build_of(package: str) -> tuple[int, int] | None:
    """What differs between builds of a package, which need not be imported; None if not here."""
    spec = find_spec(package)
    if spec is None or spec.origin is None:
        return None
    about = os.stat(spec.origin)
    return about.st_mtime_ns, about.st_size


def read(name: str) -> bytes | None:
    """What is kept under a name; None where nothing is that was written whole under this name."""
    file = folder() / name
    try:
        if not _own(file.parent):
            return None
        data = file.read_bytes()
    except OSError:
        return None
    with suppress(OSError):  # a folder that may only be read serves as well
        os.utime(file)
    code = data[_DIGEST:]
    return code if _digest(name, code) == data[:_DIGEST] else None


def write(name: str, code: bytes) -> None:
    """Keep something under a name, if possible."""
    file = folder() / name
    with suppress(OSError, OutputError):
        file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not _own(file.parent):
            return
        data = _digest(name, code) + code
        _make_room(file.parent, len(data))
        with replacing(file) as part:
            part.write_bytes(data)


def _digest(name: str, code: bytes) -> bytes:
    return hashlib.sha256(f"{name} ".encode() + code).digest()


def _own(place: Path) -> bool:
    """Whether nobody else can put code there, as far as the system tells."""
    if not hasattr(os, "getuid"):
        return True
    about = place.stat()
    return about.st_uid == os.getuid() and not about.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def _make_room(place: Path, size: int) -> None:
    """Remove what was used least lately until there is room for so many bytes.

    Looking at thousands of files takes longer than compiling a small program, so that room is made
    for many programs at once. Other processes may fill the same room meanwhile.
    """
    left = _left.get(place, 0)
    if left < size:
        left = max(size, MOST // _PARTS)
        files = sorted(_files(place))
        total = left + sum(length for _, length, _ in files)
        for _, length, item in files:
            if total <= MOST:
                break
            item.unlink(missing_ok=True)
            total -= length
    _left[place] = left - size


def _files(place: Path) -> Iterator[tuple[float, int, Path]]:
    """When used last, length, and path of what is there, also of what a killed process left."""
    for item in place.iterdir():
        with suppress(FileNotFoundError):  # another process made room
            about = item.stat()
            if stat.S_ISREG(about.st_mode):
                yield about.st_mtime, about.st_size, item
