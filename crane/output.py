"""Files are written whole or not at all."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from crane.errors import OutputError


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """A temporary path to write to, which takes the place of `path` at the end.

    The temporary file stands in the same folder and is removed when the block raises; whatever
    was at `path` before then stays as it was.

    Raises:
        OutputError: The folder does not exist, or nothing can be written there.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise OutputError(f"{path}: there is no folder {path.parent}, create it first")
    if path.is_dir():
        raise OutputError(f"{path}: is a folder, give the name of a file")
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield part
        os.replace(part, path)
    except OSError as error:
        reason = error.strerror or str(error)
        raise OutputError(f"{path}: cannot be written ({reason}), choose another place") from error
    finally:
        part.unlink(missing_ok=True)
