"""A process that reads mesh files, so that a damaged file can crash only this process.

`crane.formats.visuals.urdf_shapes` runs it and sends a JSON object {"files": paths, "triangles":
largest number in all files}. For each file the process writes a line of JSON, {"parts":
[{"faces": F, "colour": [r, g, b, a] or null}, ...], "alone": whether no other file was opened for
it} or {"wrong": "message"}, then vertices and faces of each part in the format of `numpy.save`.
Time and memory are limited, because mesh readers trust the sizes that a damaged file declares.

It imports nothing of the package, which would take longer than reading most meshes.
"""

import contextlib
import io
import json
import os
import resource
import sys
import warnings
from typing import Any

MAX_MEMORY, MAX_SECONDS = 2 << 30, 20  # [bytes], [s] of computing per file
MAX_TRIANGLES = 4_000_000  # in all files; a page with as many has 300 MB
# triangles of instances of the same geometry: so many, or so many times the geometry
_MAX_REPEATED, _MAX_REPETITION_FACTOR = 100_000, 10
_MESH_FORMATS = ("stl", "obj", "dae", "glb", "gltf", "ply", "off")


def main() -> None:
    """Read the files of the request."""
    import logging  # not needed by modules that only use the constants

    output = os.fdopen(os.dup(1), "wb")
    null_device = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null_device, 1)  # libraries cannot write into the output
    os.dup2(null_device, 2)
    warnings.simplefilter("ignore")
    logging.disable()
    request = json.load(sys.stdin)
    files, remaining = request["files"], request["triangles"]
    # trimesh does not need these to read, and importing them takes longer than most meshes
    for name in ("networkx", "rtree", "scipy", "shapely"):
        sys.modules[name] = None  # type: ignore[assignment]
    import numpy as np

    with contextlib.suppress(ImportError):  # `_read_mesh` raises it again
        import trimesh  # noqa: F401  before time is counted
    for file in files:
        limit_resources()
        try:
            header, arrays = _read_mesh(file, remaining)
            remaining -= sum(part["faces"] for part in header["parts"])
        except MemoryError:
            header, arrays = {"wrong": f"reading it takes more than {MAX_MEMORY >> 30} GB"}, []
        except Exception as error:  # readers raise anything for malformed files
            message = " ".join(str(error).split()) or type(error).__name__
            header, arrays = {"wrong": message[:80]}, []
        answer = io.BytesIO()  # numpy cannot write arrays into a pipe
        answer.write(json.dumps(header).encode() + b"\n")
        for array in arrays:
            np.save(answer, array)
        output.write(answer.getbuffer())
        output.flush()


def limit_resources() -> None:
    """Limit time for one more file, and memory."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    time_limit = int(used.ru_utime + used.ru_stime) + MAX_SECONDS
    for kind, limit in ((resource.RLIMIT_CPU, time_limit), (resource.RLIMIT_AS, MAX_MEMORY)):
        hard_limit = resource.getrlimit(kind)[1]
        resource.setrlimit(kind, (limit if hard_limit < 0 else min(limit, hard_limit), hard_limit))


def _read_mesh(file: str, max_triangles: int) -> tuple[dict[str, Any], list[Any]]:
    """Return the triangles of a file in the frame of its scene."""
    import numpy as np
    import trimesh

    class SiblingFileResolver(trimesh.resolvers.FilePathResolver):
        """Opens materials, textures and buffers, and records that it did."""

        asked = False

        def get(self, name: str) -> bytes:
            SiblingFileResolver.asked = True
            return super().get(name)

    kind = file.rpartition(".")[2].lower()
    if kind not in _MESH_FORMATS:
        raise ValueError(f"no mesh ends in .{kind}, known: {', '.join(_MESH_FORMATS)}")
    # unmerged vertices keep the edges of the drawing sharp
    scene = trimesh.load_scene(file, resolver=SiblingFileResolver(file), process=False)
    unique_triangles = sum(len(getattr(part, "faces", ())) for part in scene.geometry.values())
    max_repeated = max(_MAX_REPEATED, _MAX_REPETITION_FACTOR * unique_triangles)
    by_colour: dict[tuple[float, ...] | None, list[tuple[Any, Any]]] = {}
    count = 0
    for node in scene.graph.nodes_geometry:
        placement, name = scene.graph[node]
        part = scene.geometry[name]
        if not isinstance(part, trimesh.Trimesh) or not len(part.faces):
            continue
        count += len(part.faces)
        if count > max_repeated:
            raise ValueError(
                f"it repeats its {unique_triangles} triangles to more than {max_repeated}"
            )
        if count > max_triangles:
            raise ValueError(f"with it there are more than {MAX_TRIANGLES} triangles to draw")
        vertices = trimesh.transform_points(np.asarray(part.vertices, np.float64), placement)
        faces = np.asarray(part.faces, np.int64)
        if not (vertices.ndim == faces.ndim == 2 and vertices.shape[1] == faces.shape[1] == 3):
            raise ValueError("no triangles in space")
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise ValueError("a triangle of vertices that are not there")
        if not np.isfinite(vertices).all():
            raise ValueError("coordinates that are not finite")
        by_colour.setdefault(_part_colour(part), []).append((vertices, faces))
    if not by_colour:
        raise ValueError("no triangles in it")
    parts: list[dict[str, Any]] = []
    arrays: list[Any] = []
    for colour, colour_parts in by_colour.items():
        joined = trimesh.util.append_faces(*zip(*colour_parts, strict=True))
        parts.append({"faces": len(joined[1]), "colour": colour})
        arrays += joined
    return {"parts": parts, "alone": not SiblingFileResolver.asked}, arrays


def _part_colour(part: Any) -> tuple[float, ...] | None:
    """Return the colour of a part, None if it has no readable one."""
    try:
        material = getattr(part.visual, "material", part.visual)
        components = material.main_color if part.visual.defined else ()
        colour = tuple(min(max(float(x) / 255, 0.0), 1.0) for x in components)
    except MemoryError:
        raise
    except Exception:  # such as a damaged texture
        return None
    return colour if len(colour) == 4 and all(x == x for x in colour) else None


if __name__ == "__main__":
    main()
