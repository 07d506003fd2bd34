"""Forces from outside as they are typed: `--load FRAME=FX,FY,FZ` or `--load FRAME=FILE`."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from crane.common.errors import InputError, suggest_names

if TYPE_CHECKING:
    from crane.common.samples import Array
    from crane.description.external_forces import Wrench

Load = Annotated[
    list[str] | None,
    typer.Option(
        "--load",
        metavar="FRAME=WRENCH",
        help="A force from outside: FX,FY,FZ in N, with MX,MY,MZ in N m if need be, or a CSV of "
        "columns time, force_x ... moment_z; FRAME@frame=... turns with the frame. May be "
        "repeated.",
    ),
]


def loads_of(words: Sequence[str] | None) -> "list[Wrench]":
    """What `--load` says.

    Raises:
        InputError: It is no wrench.
        RecordingError: Its file cannot be read.
    """
    return [_load(word) for word in words or ()]


def _load(word: str) -> "Wrench":
    from crane.description.external_forces import Wrench

    head, equals, text = word.partition("=")
    frame, _, axes = head.partition("@")
    what = f"--load {word!r}"
    if not equals or not frame or not text:
        raise InputError(f"{what} is no FRAME=WRENCH, give one such as tip=0,0,-1000")
    axes = axes or "world"
    if Path(text).suffix.lower() in (".csv", ".npz"):
        times, force, moment = _table(Path(text))
        return Wrench(frame, force, moment, times, axes)
    try:
        numbers = [float(x) for x in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (3, 6):
        raise InputError(f"{what}: give 3 or 6 numbers with commas, or a CSV file")
    return Wrench(frame, numbers[:3], numbers[3:] or (0.0, 0.0, 0.0), axes=axes)


def _table(path: Path) -> "tuple[Array, Array, Array]":
    """Times, forces, moments of a file."""
    import numpy as np

    from crane.description.external_forces import WRENCH_COMPONENTS
    from crane.recordings import table_reader

    table = table_reader.read_table(path)
    names = list(table.units)
    if "time" not in names:
        raise InputError(f"{path}: has no column 'time', add it")
    for name in names:
        if name != "time" and name not in WRENCH_COMPONENTS:
            raise InputError(
                f"{path}: '{name}' is no part of a wrench, "
                f"{suggest_names(WRENCH_COMPONENTS, name)}"
            )
    if len(names) < 2:
        raise InputError(f"{path}: has no force, add columns such as force_z")
    columns = dict(zip(names, table.values.T, strict=True))
    zero = np.zeros(len(table.values))
    every = np.stack([columns.get(part, zero) for part in WRENCH_COMPONENTS], axis=1)
    return columns["time"], every[:, :3], every[:, 3:]
