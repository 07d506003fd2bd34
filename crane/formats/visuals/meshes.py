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

from crane.common import cache
from crane.common.packages import find_file
from crane.common.samples import Array
from crane.formats.visuals import mesh_process

_LARGEST = 200e6  # bytes of a file
_SMALL = 4 << 20  # bytes of a file, and of what it holds, that is kept
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
    of computing and 2 GB per file. Where it ends at a file, it begins anew after that, twice. What
    it says of small files is kept: it takes longer to start than to read a robot's meshes.
    """
    found: dict[Path, tuple[Part, ...] | str] = {}
    waiting: dict[Path, str | None] = {}  # and under which name to keep what is said
    for file in dict.fromkeys(files):
        size = file.stat().st_size
        if size > _LARGEST:
            found[file] = f"{size / 1e6:.0f} MB, more than {_LARGEST / 1e6:.0f}"
            continue
        name = _name(file) if size <= _SMALL else None
        kept = None if name is None else cache.read(name)
        if kept is None:
            waiting[file] = name
        else:
            found[file] = _told(kept)
    for _ in range(_ATTEMPTS):
        left = mesh_process.TRIANGLES - sum(map(_triangles, found.values()))
        answers = _ask(list(waiting), left) if waiting else []
        for (file, name), answer in zip(list(waiting.items()), answers, strict=False):
            found[file] = _told(answer)
            del waiting[file]
            alone = len(answer) <= _SMALL and _head(answer).get("alone")
            if name is not None and alone and name == _name(file):
                cache.write(name, answer)
    return found | dict.fromkeys(waiting, f"not tried after {_ATTEMPTS} that ended the reader")


def _name(file: Path) -> str:
    """Under which what is said of a file is kept: by the content, and by who reads it."""
    builds = [cache.build_of(package) for package in ("trimesh", "collada")]
    program = Path(mesh_process.__file__).read_bytes()
    return cache.named(
        repr((sys.version, builds, program, file.suffix, file.read_bytes())), "mesh"
    )


def _triangles(told: tuple[Part, ...] | str) -> int:
    return 0 if isinstance(told, str) else sum(len(part.faces) for part in told)


def _ask(files: list[Path], triangles: int) -> list[bytes]:
    """What the process says, of at least one file."""
    program = [sys.executable, "-P", mesh_process.__file__]  # its folder has an xml.py
    asked = {"files": [str(file.resolve()) for file in files], "triangles": triangles}
    alone = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}  # threads count as memory
    try:
        done = subprocess.run(
            program,
            input=json.dumps(asked).encode(),
            capture_output=True,
            env=alone,
            timeout=_PATIENCE * len(files),
        )
        said, status = done.stdout, done.returncode
    except subprocess.TimeoutExpired as late:
        said, status = late.stdout or b"", -signal.SIGTERM
    answers = list(_answers(said))
    if len(answers) < len(files):
        slow = status in (-signal.SIGTERM, -getattr(signal, "SIGXCPU", 0))
        reason = f"reading it takes more than {mesh_process.SECONDS} s" if slow else "damaged"
        answers.append(json.dumps({"wrong": reason}).encode() + b"\n")
    return answers


def _answers(said: bytes) -> Iterator[bytes]:
    """Whole answers of the process."""
    at = 0
    while (end := said.find(b"\n", at)) >= 0:
        parts = json.loads(said[at:end]).get("parts", ())
        end += 1 + sum(map(_bytes, parts))
        if end > len(said):
            break
        yield said[at:end]
        at = end


def _head(answer: bytes) -> dict[str, Any]:
    head: dict[str, Any] = json.loads(answer[: answer.index(b"\n")])
    return head


def _told(answer: bytes) -> tuple[Part, ...] | str:
    """The triangles of an answer, or what is wrong."""
    head = _head(answer)
    if "wrong" in head:
        return str(head["wrong"])
    return tuple(_parts(head["parts"], answer, answer.index(b"\n") + 1))


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
