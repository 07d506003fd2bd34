"""Look up machines: bundled by name, example-robot-data by name, or by path."""

import shlex
import sys
from collections.abc import Mapping, Sequence
from functools import cache
from itertools import takewhile
from pathlib import Path
from string import ascii_letters

from crane.common.errors import DescriptionError, suggest_names
from crane.common.package_search import LoadOptions, load_options

# between a machine and its parameter changes, see `Machine.load_expression`
CHANGES_SEPARATOR = " with "
FOLDER_FILES = ("robot.yaml", "model.sdf")  # of example-parallel-robots and Gazebo
MACHINE_SUFFIXES = (".yaml", ".yml", ".urdf", ".xacro", ".sdf", ".world", ".xml", ".mjcf")


def bundled_machines() -> dict[str, Path]:
    """Return the machine files of the machines in the package by name."""
    return {path.stem: path for path in sorted(_model_folder().glob("*.yaml"))}


def machine_templates() -> dict[str, dict[str, Path]]:
    """Return the machine files that `crane new` copies: by machine, and by size from small on."""
    found = [
        (*path.stem.rpartition("_")[::2], path)
        for path in (_model_folder() / "templates").glob("*.yaml")
    ]
    templates: dict[str, dict[str, Path]] = {}
    for name, size, path in sorted(found, key=lambda x: float(x[1].rstrip(ascii_letters))):
        templates.setdefault(name, {})[size] = path
    return dict(sorted(templates.items()))


def _model_folder() -> Path:
    package = Path(__file__).resolve().parents[1]
    return package / "models" if (package / "models").is_dir() else package.parent / "models"


def machine_summary(path: Path) -> str:
    """Return the first sentence of the comment at the beginning of a machine file."""
    lines = takewhile(lambda line: line.startswith("#"), path.read_text("utf-8").splitlines())
    return " ".join(line.strip("# ") for line in lines).partition(". ")[0]


@cache
def example_root() -> Path | None:
    """Return the folder `robots` of example-robot-data, None if it is not installed."""
    from importlib.metadata import PackageNotFoundError, files  # slow to import

    try:
        package_files = files("example-robot-data") or []
    except PackageNotFoundError:  # conda installs it without Python metadata
        shared_folder = Path(sys.prefix, "share", "example-robot-data", "robots")
        return shared_folder if shared_folder.is_dir() else None
    for item in package_files:
        parts = item.parts
        if "robots" in parts:
            file_path = Path(str(item.locate())).resolve()
            return file_path.parents[len(parts) - 2 - parts.index("robots")]
    return None


@cache
def example_robots() -> dict[str, Path]:
    """Return the URDFs of example-robot-data by name."""
    root = example_root()
    if root is None:
        return {}
    return {path.stem: path for path in sorted(root.glob("**/*.urdf"))}


def without_changes(load_expression: str) -> str:
    """Return the machine name or file of a `Machine.load_expression`."""
    return load_expression.partition(CHANGES_SEPARATOR + "{")[0]


def command_line_arguments(
    name: str | Path,
    active: Sequence[str] | None = None,
    free: Sequence[str] | None = None,
    changes: Mapping[str, float] | None = None,
    lock: Mapping[str, float] | None = None,
    options: LoadOptions | None = None,
) -> str:
    """Return the command line arguments that load a machine: name and options.

    Args:
        name: As for `load`.
        active: Active joints, if chosen.
        free: Free joints, if chosen.
        changes: New values of parameters.
        lock: Coordinates of locked joints.
        options: Packages, arguments, gravity, and whether the root floats; the current load
            options if not given.
    """
    options = load_options() if options is None else options
    words = [str(name)]
    for option, values in {"--set": changes, "--lock": lock}.items():
        words += [x for key, value in (values or {}).items() for x in (option, f"{key}={value!r}")]
    for option, joints in {"--active": active, "--free": free}.items():
        words += [] if joints is None else [option, ",".join(joints)]
    words += ["--floating"] * options.floating_root + ["--trust-xacro"] * options.trust_xacro
    if options.gravity is not None:
        words += ["--gravity", ",".join(map(repr, options.gravity))]
    words += [x for folder in options.packages for x in ("--packages", folder)]
    words += [x for key, value in options.arguments.items() for x in ("--arg", f"{key}:={value}")]
    return shlex.join(words)


def find_machine_file(name: str | Path) -> Path:
    """Return the machine file or URDF of a name or path.

    Args:
        name: A bundled machine, a robot of example-robot-data, or a path that ends in .yaml, .yml,
            .urdf, .xacro, .sdf, .world, .xml or .mjcf, or of a folder with a robot.yaml or a
            model.sdf.

    Raises:
        DescriptionError: There is none.
    """
    if not isinstance(name, str | Path):
        raise DescriptionError(
            f"{type(name).__name__} names no machine, give a name or the path of a file"
        )
    path, text = Path(name), str(name)
    try:
        is_file, is_folder = path.is_file(), path.is_dir()
    except OSError as error:  # such as a name that is too long
        raise DescriptionError(
            f"{path}: cannot be read ({error.strerror}), check the path"
        ) from None
    folder_files = [path / name for name in FOLDER_FILES if is_folder and (path / name).is_file()]
    if folder_files:
        return folder_files[0].resolve()
    if path.suffix.lower() in MACHINE_SUFFIXES:
        if is_file:
            return path.resolve()
        problem = "is a folder, give a file" if is_folder else "no such file, check the path"
        raise DescriptionError(f"{path}: {problem}")
    machines = bundled_machines()
    if text in machines:
        return machines[text]
    robots = example_robots()
    if text in robots:
        return robots[text]
    if is_file or is_folder:
        raise DescriptionError(
            f"{path}: not a machine, give a machine file (.yaml), a URDF (.urdf, .xacro), an "
            "SDF (.sdf) or a MJCF (.xml)"
        )
    hint = suggest_names([*machines, *robots], text)
    if not hint.startswith("did you mean"):
        robots_hint = "; crane list --robots names more" if robots else ""
        hint = f"{suggest_names(machines)}{robots_hint}"
    raise DescriptionError(f"no machine and no file is named '{text}', {hint}")
