"""The order of imports and the names of modules."""

import ast
import inspect
import re
from functools import cache
from pathlib import Path

from package_source import PACKAGE, nodes

# A room may import those before it. Within a room, modules may not form a circle either.
ORDER = [
    "common", "codegen", "hydraulics", "description", "closure", "machine", "formats",
    "recordings", "dynamics", "motion", "ratings", "control", "simulation", "identification",
    "studies", "export", "view", "cli",
]  # fmt: skip


def module_of(path: Path) -> str:
    """Dotted name, of a folder's `__init__.py` that of the folder."""
    return ".".join(("crane", *path.relative_to(PACKAGE).with_suffix("").parts)).removesuffix(
        ".__init__"
    )


def room(module: str) -> str:
    return module.split(".")[1]


@cache
def imports(path: Path) -> tuple[str, ...]:
    """Modules of the package that a file imports when it is imported, not for types only."""
    return tuple(_imports(path))


def _imports(path):
    skipped = {
        id(inner)
        for node in nodes(path)
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)
        for inner in ast.walk(node)
    }
    for node in nodes(path):
        if id(node) in skipped:
            continue
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("crane."):
            for name in node.names:  # a module of a folder, or a name of a module
                inner = PACKAGE.joinpath(*node.module.split(".")[1:], f"{name.name}.py")
                yield f"{node.module}.{name.name}" if inner.exists() else node.module
        elif isinstance(node, ast.Import):
            yield from (name.name for name in node.names if name.name.startswith("crane."))


def files():
    return [path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py"]


def test_every_file_is_in_a_room():
    assert {path.relative_to(PACKAGE).parts[0] for path in files()} == set(ORDER)


def test_imports_run_downwards():
    upwards = []
    for path in files():
        here = room(module_of(path))
        for module in imports(path):
            if room(module) != here and ORDER.index(room(module)) > ORDER.index(here):
                upwards.append(f"{module_of(path)} imports {module}")
    assert not upwards


def test_no_circles_within_a_room():
    graph = {}
    for path in files():
        name = module_of(path)
        graph[name] = {m for m in imports(path) if room(m) == room(name) and m != name}
    while graph:
        free = [name for name, needs in graph.items() if not needs & graph.keys()]
        assert free, f"circle among {sorted(graph)}"
        for name in free:
            del graph[name]


def test_no_module_hides_a_name_of_the_package():
    """Importing crane.x puts the module in the place of a function crane.x."""
    import crane

    names = {name for name in crane.__all__ if not inspect.ismodule(getattr(crane, name))}
    assert not set(ORDER) & names


def test_no_module_hides_a_name_of_its_folder():
    """An `__init__.py` exports no name that one of its modules has."""
    hidden = []
    for path in PACKAGE.rglob("__init__.py*"):
        modules = {other.stem for other in path.parent.glob("*.py")}
        modules |= {other.name for other in path.parent.iterdir() if other.is_dir()}
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module:  # not `from . import closure`
                hidden += [
                    f"{path.parent.name}: {n.name}" for n in node.names if n.name in modules
                ]
    assert not hidden


def test_files_that_ci_names_exist():
    root = PACKAGE.parent
    named = re.findall(r"\btests/\w+\.py\b", (root / ".ci" / "run").read_text())
    assert named and all((root / path).is_file() for path in named), named
