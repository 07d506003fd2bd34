"""Mesh files: where they are, and their triangles."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from crane.common.packages import find_file
from crane.common.samples import Array
from crane.formats.visuals import mesh_process

_LARGEST = 200e6  # bytes of a file
_ATTEMPTS = 3
_PATIENCE = 10 * mesh_process.SECONDS  # [s] per file, for systems that do not limit computing


@dataclass(frozen=True, eq=False)
class Part:
    """Triangles of one colour.

    Attributes:
        vertices: (V, 3) [units of the file].
        faces: (F, 3) numbers of vertices.
        colour: Red, green, blue, opacity, 0 to 1; None where the file has none.
    """

    vertices: Array
    faces: np.ndarray
    colour: tuple[float, float, float, float] | None


def mesh_file(name: str, folder: Path) -> Path | None:
    """The file that a mesh's name stands for, None if there is none, see `find_file`.

    Args:
        name: As `<mesh filename>` has it.
        folder: Of the URDF.
    """
    found = find_file(name, folder)
    return found if found is not None and found.is_file() else None


def read_meshes(files: Iterable[Path]) -> dict[Path, tuple[Part, ...] | str]:
    """Triangles of mesh files by their paths, or what is wrong with a file, in a few words.

    Files may be damaged, or declare sizes beyond all memory: another process reads them, with 20 s
    of computing and 2 GB per file. Where it ends at a file, it begins anew after that, twice.
    """
    found: dict[Path, tuple[Part, ...] | str] = {}
    waiting = []
    for file in dict.fromkeys(files):
        size = file.stat().st_size
        if size > _LARGEST:
            found[file] = f"{size / 1e6:.0f} MB, more than {_LARGEST / 1e6:.0f}"
        else:
            waiting.append(file)
    for _ in range(_ATTEMPTS):
        told = _ask(waiting) if waiting else []
        found |= dict(zip(waiting, told, strict=False))
        waiting = waiting[len(told) :]
    return found | dict.fromkeys(waiting, f"not tried after {_ATTEMPTS} that ended the reader")


def _ask(files: list[Path]) -> list[tuple[Part, ...] | str]:
    """What the process says, of at least one file."""
    program = [sys.executable, "-P", mesh_process.__file__]  # its folder has an xml.py
    wanted = json.dumps([str(file.resolve()) for file in files]).encode()
    alone = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}  # threads count as memory
    try:
        done = subprocess.run(
            program, input=wanted, capture_output=True, env=alone, timeout=_PATIENCE * len(files)
        )
        said, status = done.stdout, done.returncode
    except subprocess.TimeoutExpired as late:
        said, status = late.stdout or b"", -signal.SIGTERM
    told = _parsed(said)
    if len(told) < len(files):
        slow = status in (-signal.SIGTERM, -getattr(signal, "SIGXCPU", 0))
        reason = f"reading it takes more than {mesh_process.SECONDS} s" if slow else "damaged"
        told.append(reason)
    return told


def _parsed(said: bytes) -> list[tuple[Part, ...] | str]:
    """Whole answers of the process."""
    told: list[tuple[Part, ...] | str] = []
    at = 0
    while (end := said.find(b"\n", at)) >= 0:
        head = json.loads(said[at:end])
        at = end + 1
        if "wrong" in head:
            told.append(head["wrong"])
            continue
        size = sum(_bytes(part) for part in head["parts"])
        if at + size > len(said):
            break
        told.append(tuple(_parts(head["parts"], said, at)))
        at += size
    return told


def _bytes(part: dict[str, Any]) -> int:
    """How many bytes the triangles of a part take."""
    return 8 * 3 * int(part["vertices"] + part["faces"])


def _parts(heads: list[dict[str, Any]], said: bytes, at: int) -> Iterator[Part]:
    """The parts that stand one after the other in an answer from a byte on."""
    for part in heads:
        v, f = 3 * part["vertices"], 3 * part["faces"]
        vertices = np.frombuffer(said, np.float64, v, at).reshape(-1, 3)
        faces = np.frombuffer(said, np.int64, f, at + 8 * v).reshape(-1, 3)
        yield Part(vertices, faces, part["colour"] and tuple(part["colour"]))
        at += _bytes(part)
