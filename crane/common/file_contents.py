"""Files that end, of a size that can be read."""

import errno
import os
import stat
from pathlib import Path


def read_plain_file(path: Path, max_size: int) -> bytes:
    """What a plain file holds.

    Args:
        path: The file.
        max_size: Bytes that it may have.

    Raises:
        OSError: It cannot be read, is a device or pipe, which need not end, or is larger.
    """
    if not stat.S_ISREG(mode := path.stat().st_mode) and not stat.S_ISDIR(mode):
        raise OSError(errno.EINVAL, "it is no plain file, copy it into one", str(path))
    with path.open("rb") as file:
        data = file.read(max_size + 1)
    if len(data) > max_size:
        size = max(os.path.getsize(path), len(data)) / 1e6
        raise OSError(errno.EFBIG, f"{size:.3g} MB, more than {max_size / 1e6:g}", str(path))
    return data
