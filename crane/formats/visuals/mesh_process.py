"""A process that reads mesh files: whatever is in them can end this process, and nothing else.

Run by crane.formats.visuals.mesh_files, which sends it, as JSON, {"files": paths, "triangles": how
many they may have together}. Per file it writes a line of JSON, {"parts": [{"vertices": V,
"faces": F, "colour": [r, g, b, a] or null}, ...], "alone": whether nothing else was opened for it}
or {"wrong": "what"}, then the numbers of each part: V 3 float64, F 3 int64. Time and memory are
limited, because readers of a dozen formats believe the sizes that a damaged file declares.

It imports nothing of the package, which takes longer than most meshes.
"""

import json
import os
import sys
import warnings
from typing import Any, BinaryIO

MAX_MEMORY, MAX_SECONDS = 2 << 30, 20  # [bytes], [s] of computing per file
MAX_TRIANGLES = 4_000_000  # in all files; a page with as many has 300 MB
_MAX_REPEATED, _MAX_REPETITION_FACTOR = (
    100_000,
    10,
)  # triangles that a file may repeat its parts to: as many, or tenfold
_MESH_FORMATS = ("stl", "obj", "dae", "glb", "gltf", "ply", "off")


def main() -> None:
    """Read what is asked for."""
    import logging  # which whoever asks for it has no use for

    output = os.fdopen(os.dup(1), "wb")
    null_device = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null_device, 1)  # the output is ours alone
    os.dup2(null_device, 2)
    warnings.simplefilter("ignore")
    logging.disable()
    request = json.load(sys.stdin)
    files, remaining = request["files"], request["triangles"]
    # what trimesh does without when it reads, and takes longer to import than most meshes to read
    for name in ("networkx", "rtree", "scipy", "shapely"):
        sys.modules[name] = None  # type: ignore[assignment]
    try:
        import trimesh  # noqa: F401  before time is counted
    except ImportError as error:
        for _ in files:
            _send_answer(output, {"wrong": str(error)}, [])
        return
    for file in files:
        _limit_resources()
        try:
            header, arrays = _read_mesh(file, remaining)
            remaining -= sum(part["faces"] for part in header["parts"])
        except MemoryError:
            header, arrays = {"wrong": f"reading it takes more than {MAX_MEMORY >> 30} GB"}, []
        except Exception as error:  # whatever a reader raises for what is none of its format
            message = " ".join(str(error).split()) or type(error).__name__
            header, arrays = {"wrong": message[:80]}, []
        _send_answer(output, header, arrays)


def _limit_resources() -> None:
    """Time for one more file, and memory, where the system can limit them."""
    try:
        import resource
    except ImportError:
        return
    used = resource.getrusage(resource.RUSAGE_SELF)
    hard_limit = resource.getrlimit(resource.RLIMIT_CPU)[1]
    time_limit = int(used.ru_utime + used.ru_stime) + MAX_SECONDS
    resource.setrlimit(
        resource.RLIMIT_CPU,
        (time_limit if hard_limit < 0 else min(time_limit, hard_limit), hard_limit),
    )
    hard_limit = resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(
        resource.RLIMIT_AS,
        (MAX_MEMORY if hard_limit < 0 else min(MAX_MEMORY, hard_limit), hard_limit),
    )


def _send_answer(output: BinaryIO, header: dict[str, Any], arrays: list[Any]) -> None:
    output.write(json.dumps(header).encode() + b"\n")
    for array in arrays:
        output.write(array.tobytes())
    output.flush()


def _read_mesh(file: str, max_triangles: int) -> tuple[dict[str, Any], list[Any]]:
    """Triangles of a file, in the frame of its scene, if there are not too many."""
    import numpy as np
    import trimesh

    class Beside(trimesh.resolvers.FilePathResolver):
        """Opens materials, pictures and buffers, and notes that it did."""

        asked = False

        def get(self, name: str) -> bytes:
            Beside.asked = True
            return super().get(name)

    kind = file.rpartition(".")[2].lower()
    if kind not in _MESH_FORMATS:
        raise ValueError(f"no mesh ends in .{kind}, known: {', '.join(_MESH_FORMATS)}")
    # unmerged vertices keep the edges of the drawing sharp
    scene = trimesh.load_scene(file, resolver=Beside(file), process=False)
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
        first = np.cumsum([0, *(len(vertices) for vertices, _ in colour_parts)])
        vertices = np.concatenate([vertices for vertices, _ in colour_parts])
        faces = np.concatenate(
            [x + start for start, (_, x) in zip(first, colour_parts, strict=False)]
        )
        parts.append({"vertices": len(vertices), "faces": len(faces), "colour": colour})
        arrays += [vertices, faces]
    return {"parts": parts, "alone": not Beside.asked}, arrays


def _part_colour(part: Any) -> tuple[float, ...] | None:
    """Its own colour, if it has one that can be read."""
    try:
        if not part.visual.defined:
            return None
        material = getattr(part.visual, "material", part.visual)
        colour = tuple(min(max(float(x) / 255, 0.0), 1.0) for x in material.main_color)
    except MemoryError:
        raise
    except Exception:  # a texture that is damaged, a colour that is none
        return None
    return colour if len(colour) == 4 and all(x == x for x in colour) else None


if __name__ == "__main__":
    main()
