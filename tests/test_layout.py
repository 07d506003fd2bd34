"""Imports run one way through the package."""

import ast
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "crane"

# A module may import those before it. Within a room, modules may not form a circle either.
ORDER = [
    "errors", "samples", "units", "output", "npz", "timeseries", "codegen", "description",
    "closure", "machine", "check", "formats", "dynamics", "kinematics", "workspaces", "hydraulics",
    "paths", "control", "integration", "recording", "logs", "measured", "summary", "simulation",
    "replays", "batch", "studies", "rig", "identification", "view", "live", "runs", "demo", "cli",
]  # fmt: skip


def room(module: str) -> str:
    return module.split(".")[1]


def imports(path: Path):
    """Modules of the package that a file imports when it is imported, not for types only."""
    tree = ast.parse(path.read_text())
    skipped = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)
        for inner in ast.walk(node)
    }
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("crane."):
            yield node.module
        elif isinstance(node, ast.Import):
            yield from (name.name for name in node.names if name.name.startswith("crane."))


def files():
    return [path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py"]


def test_every_file_has_a_room():
    rooms = {path.relative_to(PACKAGE).parts[0].removesuffix(".py") for path in files()}
    assert rooms == set(ORDER)


def test_imports_run_downwards():
    upwards = []
    for path in files():
        here = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        for module in imports(path):
            if room(module) != here and ORDER.index(room(module)) > ORDER.index(here):
                upwards.append(f"{path.name} imports {module}")
    assert not upwards


def test_no_circles_within_a_room():
    graph = {}
    for path in files():
        relative = path.relative_to(PACKAGE)
        if len(relative.parts) == 2 and relative.name != "__init__.py":
            name = f"crane.{relative.parts[0]}.{relative.stem}"
            graph[name] = {m for m in imports(path) if m.count(".") == 2 and room(m) == room(name)}
    while graph:
        free = [name for name, needs in graph.items() if not needs & graph.keys()]
        assert free, f"circle among {sorted(graph)}"
        for name in free:
            del graph[name]


def test_no_module_hides_a_name_of_the_package():
    """Importing crane.x puts the module in the place of a function crane.x."""
    import crane

    modules = {path.relative_to(PACKAGE).parts[0].removesuffix(".py") for path in files()}
    assert not modules & set(crane.__all__)
