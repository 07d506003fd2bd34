"""Mesh files: their paths and their triangles."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crane.common import file_cache
from crane.common.package_search import find_file
from crane.common.samples import Array
from crane.formats.visuals import mesh_process

_MAX_FILE_SIZE = 200e6  # bytes
_MAX_CACHED_SIZE = 4 << 20  # bytes of a cached file, and of its answer
_MAX_ATTEMPTS = 3
_TIMEOUT_PER_FILE = 10 * mesh_process.MAX_SECONDS  # [s], for systems without CPU limits


@dataclass(frozen=True, eq=False)
class MeshPart:
    """Triangles of one colour.

    Attributes:
        vertices: (V, 3) [units of the file].
        faces: (F, 3) indices of vertices.
        colour: Red, green, blue, opacity, 0 to 1; None if the file has none.
    """

    vertices: Array
    faces: np.ndarray
    colour: tuple[float, float, float, float] | None


def find_mesh_file(name: str, folder: Path) -> Path | None:
    """Return the file that a mesh is in, None if it does not exist.

    Args:
        name: As in `<mesh filename>`, see `find_file`.
        folder: Folder of the URDF.
    """
    found = find_file(name, folder)
    return found if found is not None and found.is_file() else None


def read_meshes(files: Iterable[Path]) -> dict[Path, tuple[MeshPart, ...] | str]:
    """Return the triangles of mesh files by path, or in a few words why a file cannot be read.

    Files may be damaged or declare sizes beyond all memory, so another process reads them, with 20
    s of computing and 2 GB for each file. If it crashes, it is restarted after the file that
    caused it, up to twice. Its results for small files are cached, because the process takes
    longer to start than to read the meshes of a robot.
    """
    found: dict[Path, tuple[MeshPart, ...] | str] = {}
    entry_names: dict[Path, str | None] = {}  # of the cache
    for file in dict.fromkeys(files):
        size = file.stat().st_size
        if size > _MAX_FILE_SIZE:
            found[file] = f"{size / 1e6:.0f} MB, more than {_MAX_FILE_SIZE / 1e6:.0f}"
            continue
        name = _cache_entry_name(file) if size <= _MAX_CACHED_SIZE else None
        cached = None if name is None else file_cache.read_entry(name)
        if cached is None:
            entry_names[file] = name
        else:
            found[file], _ = _parse_answer(cached)
    for _ in range(_MAX_ATTEMPTS):
        remaining_triangles = mesh_process.MAX_TRIANGLES - sum(
            len(part.faces)
            for parts in found.values()
            if not isinstance(parts, str)
            for part in parts
        )
        answers = _run_mesh_process(list(entry_names), remaining_triangles) if entry_names else []
        for (file, name), answer in zip(list(entry_names.items()), answers, strict=False):
            found[file], is_self_contained = _parse_answer(answer)
            del entry_names[file]
            is_small = len(answer) <= _MAX_CACHED_SIZE
            if name and is_small and is_self_contained and name == _cache_entry_name(file):
                file_cache.write_entry(name, answer)
    return found | dict.fromkeys(
        entry_names, f"not tried after {_MAX_ATTEMPTS} that ended the reader"
    )


def _cache_entry_name(file: Path) -> str:
    """Return the cache entry of a file, by its content and by the versions of the reader."""
    builds = [file_cache.package_build(package) for package in ("trimesh", "collada")]
    program = Path(mesh_process.__file__).read_bytes()
    return file_cache.entry_name(
        repr((sys.version, builds, program, file.suffix, file.read_bytes())), "mesh"
    )


def _run_mesh_process(files: list[Path], max_triangles: int) -> list[bytes]:
    """Return the answers of the process, at least one."""
    program = [sys.executable, "-P", mesh_process.__file__]  # without its folder in sys.path
    request = {"files": [str(file.resolve()) for file in files], "triangles": max_triangles}
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}  # threads count as memory
    try:
        completed = subprocess.run(
            program,
            input=json.dumps(request).encode(),
            capture_output=True,
            env=environment,
            timeout=_TIMEOUT_PER_FILE * len(files),
        )
        output, status = completed.stdout, completed.returncode
    except subprocess.TimeoutExpired as late:
        output, status = late.stdout or b"", -signal.SIGTERM
    answers, position = [], 0
    while (end := output.find(b"\n", position)) >= 0:  # complete answers
        parts = json.loads(output[position:end]).get("parts", ())
        end += 1 + sum(8 * 3 * (part["vertices"] + part["faces"]) for part in parts)
        if end > len(output):
            break
        answers.append(output[position:end])
        position = end
    if len(answers) < len(files):
        reason = "damaged"
        if status in (-signal.SIGTERM, -getattr(signal, "SIGXCPU", 0)):
            reason = f"reading it takes more than {mesh_process.MAX_SECONDS} s"
        answers.append(json.dumps({"wrong": reason}).encode() + b"\n")
    return answers


def _parse_answer(answer: bytes) -> tuple[tuple[MeshPart, ...] | str, bool]:
    """Return the triangles of an answer, or its error text, and whether no other file was read."""
    position = answer.index(b"\n") + 1
    header = json.loads(answer[:position])
    if "wrong" in header:
        return str(header["wrong"]), False
    parts = []
    for part in header["parts"]:
        v, f = 3 * part["vertices"], 3 * part["faces"]
        vertices = np.frombuffer(answer, np.float64, v, position).reshape(-1, 3)
        faces = np.frombuffer(answer, np.int64, f, position + 8 * v).reshape(-1, 3)
        parts.append(MeshPart(vertices, faces, part["colour"] and tuple(part["colour"])))
        position += 8 * (v + f)
    return tuple(parts), bool(header.get("alone"))
