"""Cache of computed results, mainly machine code, as files in the user's cache folder.

The name of a file is a digest of everything that its content depends on. The file begins with a
digest of its own name and content, so that damaged or renamed files are not used. Nothing is
cached where the folder cannot be written or belongs to another user.
"""

import hashlib
import os
import stat
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

from platformdirs import user_cache_path

from crane.common.atomic_output import replace_file
from crane.common.errors import OutputError

MAX_CACHE_SIZE = 256 << 20  # [bytes]; the least recently used entries are removed
_CLEANUPS_PER_CACHE_SIZE = 16  # cleanups per `MAX_CACHE_SIZE` written bytes
_DIGEST_SIZE = 32  # bytes
_remaining_bytes: dict[Path, int] = {}  # [bytes] that may be written before the next cleanup


def cache_folder() -> Path:
    """Path of the cache folder."""
    return user_cache_path("crane", appauthor=False) / "objects"


def entry_name(dependencies: str, kind: str = "code") -> str:
    """The name of a cache entry whose content depends on `dependencies` only."""
    return f"{hashlib.sha256(dependencies.encode()).hexdigest()}.{kind}"


def cached_object_code(dependencies: str, compile_code: Callable[[], bytes]) -> bytes:
    """Machine code from the cache, or else compiled and cached.

    Args:
        dependencies: Everything that it depends on.
        compile_code: Compiles it.
    """
    name = entry_name(dependencies)
    found = read_entry(name)
    if found is None:
        found = compile_code()
        write_entry(name, found)
    return found


def package_build(package: str) -> tuple[int, int] | None:
    """Time and size of a package's file, which differ between builds; None if it is not installed.

    The package is not imported.
    """
    spec = find_spec(package)
    if spec is None or spec.origin is None:
        return None
    file_status = os.stat(spec.origin)
    return file_status.st_mtime_ns, file_status.st_size


def read_entry(name: str) -> bytes | None:
    """Content of a cache entry; None if it does not exist or is damaged."""
    file = cache_folder() / name
    try:
        if not _is_private(file.parent):
            return None
        data = file.read_bytes()
    except OSError:
        return None
    with suppress(OSError):  # a read-only folder can be used
        os.utime(file)
    code = data[_DIGEST_SIZE:]
    return code if _content_digest(name, code) == data[:_DIGEST_SIZE] else None


def write_entry(name: str, content: bytes) -> None:
    """Write a cache entry, if possible."""
    file = cache_folder() / name
    with suppress(OSError, OutputError):
        file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not _is_private(file.parent):
            return
        data = _content_digest(name, content) + content
        _make_room(file.parent, len(data))
        with replace_file(file) as part:
            part.write_bytes(data)


def _content_digest(name: str, content: bytes) -> bytes:
    return hashlib.sha256(f"{name} ".encode() + content).digest()


def _is_private(place: Path) -> bool:
    """Whether no other user can write to a folder, as far as the system reports."""
    if not hasattr(os, "getuid"):
        return True
    file_status = place.stat()
    return file_status.st_uid == os.getuid() and not file_status.st_mode & (
        stat.S_IWGRP | stat.S_IWOTH
    )


def _make_room(place: Path, size: int) -> None:
    """Remove the least recently used entries until there is room for `size` bytes.

    Listing thousands of files takes longer than compiling a small program, so that room is made
    for many entries at once. Other processes may fill the same room meanwhile.
    """
    remaining = _remaining_bytes.get(place, 0)
    if remaining < size:
        remaining = max(size, MAX_CACHE_SIZE // _CLEANUPS_PER_CACHE_SIZE)
        files = sorted(_cache_files(place))
        total = remaining + sum(length for _, length, _ in files)
        for _, length, item in files:
            if total <= MAX_CACHE_SIZE:
                break
            item.unlink(missing_ok=True)
            total -= length
    _remaining_bytes[place] = remaining - size


def _cache_files(place: Path) -> Iterator[tuple[float, int, Path]]:
    """Time of last use, size and path of all files in the cache folder."""
    for item in place.iterdir():
        with suppress(FileNotFoundError):  # another process made room
            file_status = item.stat()
            if stat.S_ISREG(file_status.st_mode):
                yield file_status.st_mtime, file_status.st_size, item
