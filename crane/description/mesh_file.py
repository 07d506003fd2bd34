"""Which file the name of a mesh stands for."""

from pathlib import Path


def mesh_file(name: str, folder: Path) -> Path | None:
    """The file that a mesh's name stands for, None if there is none.

    A name is a path from the URDF's folder or from one above it. Of `package://PACKAGE/PATH` it is
    PATH, and where that is not there PACKAGE/PATH, as packages that lie side by side have it; of
    other `SCHEME://PATH` it is PATH. `package://FILE`, which names no package, is FILE.

    Args:
        name: As `<mesh filename>` has it.
        folder: Of the URDF.
    """
    scheme, separated, rest = name.partition("://")
    path = Path(rest if separated else name)
    ends = [path]
    if separated and scheme == "package":
        parts = [part for part in path.parts if part != "/"]
        ends = [Path(*parts[1:]), Path(*parts)] if len(parts) > 1 else [Path(*parts)]
    for end in ends:
        for above in (folder, *folder.absolute().parents):
            try:
                if (above / end).is_file():
                    return above / end
            except OSError:  # a name that cannot be a file's
                return None
    return None
