"""Cache of computed results, mainly machine code, as files in the user's cache folder.

The name of a file is a digest of everything that its content depends on. The file begins with a
digest of its own name and content, so that damaged or renamed files are not used. Machine code is
executed: a file is used only if this user or root owns it, and no other user can change it, its
folder, or a folder or link on the way to it. Elsewhere nothing is cached.
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
from crane.common.errors import OutputError, warn

MAX_CACHE_SIZE = 256 << 20  # [bytes]; the least recently used entries are removed
_CLEANUPS_PER_CACHE_SIZE = 16  # cleanups per `MAX_CACHE_SIZE` written bytes
_DIGEST_SIZE = 32  # bytes
_OTHERS_MAY_WRITE = stat.S_IWGRP | stat.S_IWOTH
_MAX_STEPS = 100  # folders and links on the way to the cache folder
_SAFE_FLAGS = os.O_NOFOLLOW | os.O_NONBLOCK  # nor wait for the other end of a pipe
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
    """Content of a cache entry; None if there is none, or it is damaged or not trusted."""
    path = cache_folder() / name
    try:
        if not _is_private(path.parent):
            return None
        with open(
            path, "rb", opener=lambda file, flags: os.open(file, flags | _SAFE_FLAGS)
        ) as file:
            if not _is_trusted_file(os.fstat(file.fileno())):
                return None
            data = file.read(MAX_CACHE_SIZE)
            with suppress(OSError):  # a read-only folder can be used
                os.utime(file.fileno())
    except OSError:
        return None
    content = data[_DIGEST_SIZE:]
    return content if _content_digest(name, content) == data[:_DIGEST_SIZE] else None


def write_entry(name: str, content: bytes) -> None:
    """Write a cache entry, if possible, in place of whatever has its name."""
    path = cache_folder() / name
    with suppress(OSError, OutputError):
        missing = [folder for folder in path.parents if not folder.exists()]
        for folder in reversed(missing):  # none that others may write, whatever the umask
            folder.mkdir(mode=0o700, exist_ok=True)
        if not _is_private(path.parent):
            return
        data = _content_digest(name, content) + content
        _make_room(path.parent, len(data))
        if os.path.lexists(path) and not stat.S_ISREG(path.lstat().st_mode):
            path.unlink()
        with replace_file(path) as part:
            part.chmod(0o600)
            part.write_bytes(data)


def _content_digest(name: str, content: bytes) -> bytes:
    return hashlib.sha256(f"{name} ".encode() + content).digest()


def _is_trusted_file(status: os.stat_result) -> bool:
    """Whether an open file is a plain one of bounded size, and nobody else can have written it."""
    is_plain = stat.S_ISREG(status.st_mode) and status.st_size <= MAX_CACHE_SIZE
    return is_plain and _is_own(status) and not status.st_mode & _OTHERS_MAY_WRITE


def _is_own(status: os.stat_result) -> bool:
    """Whether this user or root owns a file."""
    return status.st_uid in (0, os.getuid())


def _is_private(folder: Path) -> bool:
    """Whether no other user can change what is in a folder; warns if one can.

    Raises:
        OSError: The folder, or one on the way to it, does not exist or cannot be looked at.
    """
    place = _changeable_place(folder)
    if place is not None:
        warn(
            f"nothing is kept in {folder}, because other users can change {place}, and each "
            "command takes longer: take this right from them (chmod go-w), or set XDG_CACHE_HOME"
        )
    return place is None


def _changeable_place(folder: Path) -> str | None:
    """The first folder or link on the way to a folder that another user can change, if any.

    The way begins at the root: whoever can change a folder can put another one in the place of
    one in it. In a sticky folder such as /tmp everybody can change only what is theirs.
    """
    place, *names = folder.absolute().parts
    for _ in range(_MAX_STEPS):
        status = os.lstat(place)
        if stat.S_ISLNK(status.st_mode) and _is_own(status):
            target = Path(place).parent / os.readlink(place)
            place, *names = *target.parts, *names
            continue
        is_shared = status.st_mode & _OTHERS_MAY_WRITE
        if not _is_own(status) or (is_shared and not (names and status.st_mode & stat.S_ISVTX)):
            return place
        if not names:
            return None
        place = os.path.normpath(os.path.join(place, names.pop(0)))
    return place


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
            file_status = item.lstat()
            if stat.S_ISREG(file_status.st_mode):
                yield file_status.st_mtime, file_status.st_size, item
