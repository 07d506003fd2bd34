"""Search for files that other files refer to, and reading of files of limited size.

`package://PACKAGE/PATH`, `$(find PACKAGE)` and `model://MODEL/PATH` refer to a folder that only
the author's system knows. It is searched for, in this order, in the folders that the user gives,
in those above the referring file and beside its own package, and in the search paths of ROS and
Gazebo. A package is a folder whose package.xml (for a model: model.config) has its name, or,
without such a file, a folder of that name.
"""

import errno
import os
import re
import stat
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import islice
from pathlib import Path

from crane.common.errors import InputError

URDF_CONSTRAINT = "urdf_constraint"  # reads a URDF's <constraint> elements as loops
NEAREST_ASSEMBLY = "nearest_assembly"  # takes an assembly that is far from what the file says
OWN_ARGUMENTS = (URDF_CONSTRAINT, NEAREST_ASSEMBLY)  # that no file need have

_MANIFESTS = ("package.xml", "model.config")
_NAME_PATTERN = re.compile(rb"<name[^>]*>\s*([^<]*?)\s*</name>")
_MAX_DEPTH, _MAX_FOLDERS = 4, 2000  # levels below a given folder, and folders of a level
# Environment variables with folders, and the subfolder that contains the packages.
_SEARCH_VARIABLES = {
    "ROS_PACKAGE_PATH": "", "AMENT_PREFIX_PATH": "share", "CMAKE_PREFIX_PATH": "share",
    "GZ_SIM_RESOURCE_PATH": "", "IGN_GAZEBO_RESOURCE_PATH": "", "GAZEBO_MODEL_PATH": "",
    "SDF_PATH": "",
}  # fmt: skip


@dataclass(frozen=True)
class LoadOptions:
    """Options of the user for loading a file.

    Attributes:
        packages: Folders of packages, or folders that contain some.
        arguments: Values of the file's arguments by name.
        floating_root: Whether the root is a floating base.
        strict: Whether elements that are only formally wrong are errors, see `crane.load`.
        trust_xacro: Whether xacro files may run Python and read all files, see `crane.load`.
        gravity: (3,) acceleration of gravity [m/s2]; None for that of the file.
        found_packages: Packages that were searched for, by name and referring folder.
    """

    packages: tuple[str, ...] = ()
    arguments: Mapping[str, str] = field(default_factory=dict)
    floating_root: bool = False
    strict: bool = False
    trust_xacro: bool = False
    gravity: tuple[float, ...] | None = None
    found_packages: dict[tuple[str, Path], Path | None] = field(default_factory=dict, repr=False)


_load_options: ContextVar[LoadOptions | None] = ContextVar("given", default=None)


def load_options() -> LoadOptions:
    """The options for the files that are read now."""
    return _load_options.get() or LoadOptions()


@contextmanager
def use_load_options(
    packages: Sequence[str] = (),
    arguments: Mapping[str, object] | None = None,
    floating: bool = False,
    strict: bool = False,
    trust_xacro: bool | None = None,
    gravity: tuple[float, ...] | None = None,
) -> Iterator[LoadOptions]:
    """Context in which files are read with some options.

    Args:
        packages: Folders.
        arguments: Values by name; numbers and booleans are written as in XML.
        floating: Whether the root is a floating base.
        strict: Whether elements that are only formally wrong are errors, here and in nested
            contexts.
        trust_xacro: Whether xacro files may run Python; by default as in the context around.
        gravity: As for `crane.load`; by default as in the context around.
    """
    around = load_options()
    values = {
        str(name): str(value).lower() if isinstance(value, bool) else str(value)
        for name, value in (arguments or {}).items()
    }
    trust = around.trust_xacro if trust_xacro is None else trust_xacro
    gravity, is_strict = gravity or around.gravity, strict or around.strict
    options = LoadOptions(tuple(packages), values, floating, is_strict, trust, gravity)
    token = _load_options.set(options)
    try:
        yield options
    finally:
        _load_options.reset(token)


def own_argument(name: str) -> bool:
    """Whether one of the package's own arguments is true, see `OWN_ARGUMENTS`.

    Raises:
        InputError: It is neither true nor false.
    """
    value = load_options().arguments.get(name, "false").lower()
    if value not in ("true", "false"):
        raise InputError(f"the argument {name} is '{value}', give true or false")
    return value == "true"


def check_package_folders(packages: object) -> list[str]:
    """Check the folders of packages of a caller.

    Raises:
        InputError: Not a list, or a folder does not exist.
    """
    if isinstance(packages, str | Path) or not isinstance(packages, Sequence):
        raise InputError(f"packages is {packages!r}, give a list of folders such as ['src']")
    folders = [Path(str(folder)).resolve() for folder in packages]
    for folder in folders:
        if not folder.is_dir():
            raise InputError(f"packages: {folder} is no folder, check the path")
    return [str(folder) for folder in folders]


def check_argument_values(arguments: object) -> Mapping[str, object]:
    """Check the argument values of a caller.

    Raises:
        InputError: Not a mapping by name.
    """
    if not isinstance(arguments, Mapping | None):
        raise InputError(
            f"arguments is {arguments!r}, give values by name such as {{'name': 'value'}}"
        )
    return arguments or {}


def find_file(name: str, folder: Path) -> Path | None:
    """The file or folder that a name refers to, None if there is none.

    A name is a path relative to the folder of the referring file, or to one above.
    `package://NAME/` and `model://NAME/` begin in a package, see `find_package`; if that is
    unknown, the rest is a path, and so is that of other `SCHEME://PATH`. `package://FILE`, without
    a package, is FILE.

    Args:
        name: As written in the file.
        folder: Folder of that file.
    """
    scheme, separated, rest = name.partition("://")
    parts = [part for part in Path(rest if separated else name).parts if part != "/"]
    in_package = bool(separated) and scheme in ("package", "model") and bool(parts)
    try:
        package = find_package(parts[0], folder) if in_package else None
        if package is not None and package.joinpath(*parts[1:]).exists():
            return package.joinpath(*parts[1:])
        ends = [Path(rest if separated else name)]
        if in_package:  # also without the name of the package
            ends = [Path(*parts[1:]), Path(*parts)] if len(parts) > 1 else [Path(*parts)]
        places = (above / end for end in ends for above in (folder, *folder.absolute().parents))
        return next(filter(Path.is_file, places), None)
    except (OSError, ValueError):  # not a valid file name
        return None


def find_package(name: str, folder: Path) -> Path | None:
    """The folder of a package, None if it is not found.

    Args:
        name: Name of the package.
        folder: Folder of the referring file.
    """
    key, options = (name, folder.absolute()), load_options()
    if key not in options.found_packages:
        options.found_packages[key] = _search_package(name, folder.absolute(), options.packages)
    return options.found_packages[key]


def _search_package(name: str, folder: Path, packages: Sequence[str]) -> Path | None:
    for folder_given in packages:
        if (found := _search_below(name, Path(folder_given))) is not None:
            return found
    for above in (folder, *folder.parents):
        for place in (above, above / name):
            if _is_package(place, name):
                return place
    own_package = enclosing_package(folder)
    tops = [] if own_package is None else [own_package, own_package.parent]
    for variable, between in _SEARCH_VARIABLES.items():
        prefixes = filter(None, os.environ.get(variable, "").split(os.pathsep))
        tops += [Path(prefix) / between for prefix in prefixes]
    for top in tops:
        if (found := _search_below(name, top, 2)) is not None:
            return found
    same_named = (x for above in (folder, *folder.parents) for x in (above, above / name))
    return next((x for x in same_named if x.name == name and x.is_dir()), None)


def enclosing_package(folder: Path) -> Path | None:
    """The nearest folder with a manifest at or above a folder, None if there is none."""
    return next((above for above in (folder, *folder.parents) if _package_name(above)), None)


def _is_package(folder: Path, name: str) -> bool:
    name_in_manifest = _package_name(folder)
    return name_in_manifest == name or (
        folder.name == name and folder.is_dir() and not name_in_manifest
    )


def _search_below(name: str, top: Path, depth: int = _MAX_DEPTH) -> Path | None:
    """The package with a name in a folder, nearest first."""
    level = [top]
    for _ in range(depth + 1):
        if found := next((folder for folder in level if _is_package(folder, name)), None):
            return found
        inside = (Path(path) for folder in level for path in _subfolders(str(folder)))
        level = list(islice(inside, _MAX_FOLDERS))
    return None


def _subfolders(folder: str) -> list[str]:
    try:
        with os.scandir(folder) as inside:
            return sorted(x.path for x in inside if x.is_dir() and not x.name.startswith("."))
    except OSError:
        return []


def _package_name(folder: Path) -> str:
    for manifest in _MANIFESTS:
        file = folder / manifest
        try:
            changed = file.stat().st_mtime_ns
        except (OSError, ValueError):
            continue
        if name := _name_in_manifest(str(file), changed):
            return name if manifest == _MANIFESTS[0] else folder.name
    return ""


@lru_cache(maxsize=4096)
def _name_in_manifest(file: str, _: int) -> str:
    try:
        found = _NAME_PATTERN.search(Path(file).read_bytes()[:100_000])
    except OSError:
        return ""
    return found[1].decode("utf-8", "replace") if found else ""


def read_plain_file(path: Path, max_size: int) -> bytes:
    """Content of a plain file.

    Args:
        path: The file.
        max_size: Largest accepted size [bytes].

    Raises:
        OSError: It cannot be read, is a device or pipe, which need not end, or is too large.
    """
    if not stat.S_ISREG(mode := path.stat().st_mode) and not stat.S_ISDIR(mode):
        raise OSError(errno.EINVAL, "it is no plain file, copy it into one", str(path))
    with path.open("rb") as file:
        data = file.read(max_size + 1)
    if len(data) > max_size:
        size = max(os.path.getsize(path), len(data)) / 1e6
        raise OSError(errno.EFBIG, f"{size:.3g} MB, more than {max_size / 1e6:g}", str(path))
    return data
