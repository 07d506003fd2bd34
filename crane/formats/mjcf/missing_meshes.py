"""Compile a MJCF file whose meshes and textures are missing without them.

A machine needs them only where MuJoCo computes the mass of a body from a mesh. A moving body that
has other mass is then lighter, which is noted; one without any other mass is an error.
"""

import math
import re
from typing import Any

_MISSING_FILE_PATTERN = re.compile(r"opening file '([^']*)'")
_ELEMENT_PATTERN = re.compile(r"Element name '([^']*)'")
_IMAGE_COLLECTIONS = ("materials", "textures", "skins")
_DRAWN_COLLECTIONS = ("geoms", "sites", "tendons")  # with materials
_AUTOMATIC_INERTIA = 2  # value of inertiafromgeom: for bodies without an <inertial>


class MassMissingError(Exception):
    """A moving body has no mass except that of a missing mesh.

    Args:
        body: Name of the body.
        mesh: File of the mesh.
    """

    def __init__(self, body: str, mesh: str):
        super().__init__(body, mesh)
        self.body, self.mesh = body, mesh


def missing_file(text: str) -> str:
    """Return the file that MuJoCo could not open according to its message, else ""."""
    found = _MISSING_FILE_PATTERN.search(text)
    return found[1] if found else ""


def compile_without_missing_files(
    mujoco: Any, path: str, first_missing: str
) -> tuple[Any, list[str], dict[str, str]]:
    """Compile a file without its missing meshes, and without materials and textures.

    Args:
        mujoco: The package.
        path: The MJCF file.
        first_missing: A missing file.

    Returns:
        Model, names of the missing files, and by name of each body that lost mass one of them.

    Raises:
        MassMissingError: A moving body has no mass without one of the files.
        Exception: The error of MuJoCo; a ValueError if nothing can be removed.
    """
    spec = mujoco.MjSpec.from_file(path)
    if not hasattr(spec, "delete"):
        raise ValueError(f"there is no file '{first_missing}'")
    for item in (x for kind in _DRAWN_COLLECTIONS for x in getattr(spec, kind)):
        item.material = ""
    for kind in _IMAGE_COLLECTIONS:
        for item in list(getattr(spec, kind)):
            spec.delete(item)
    for i, body in enumerate(spec.bodies):
        body.name = body.name or f"body{i}"
    moving = _moving_bodies(spec)
    files, lighter_bodies, name = [first_missing], dict[str, str](), first_missing
    while True:
        is_removed = _remove_shapes(spec, name, moving, lighter_bodies)
        try:
            return spec.compile(), files, lighter_bodies
        except ValueError as error:
            before, name = name, missing_file(str(error))
            element = _ELEMENT_PATTERN.search(str(error))
            if not name and element and element[1] in lighter_bodies:
                raise MassMissingError(element[1], lighter_bodies[element[1]]) from None
            if not name or (not is_removed and before != first_missing):
                raise
            files.append(name)


def _remove_shapes(
    spec: Any, name: str, moving_bodies: set[str], lighter_bodies: dict[str, str]
) -> bool:
    """Remove the meshes and height fields of a file with their geoms.

    Args:
        spec: The `MjSpec`.
        name: Name of the file.
        moving_bodies: As `_moving_bodies` returns them.
        lighter_bodies: Receives the bodies that lose mass, with the file.

    Returns:
        Whether there were any.
    """
    meshes = [x for x in spec.meshes if x.file and name.endswith(x.file)]
    fields = [x for x in spec.hfields if x.file and name.endswith(x.file)]
    shapes = {x.name for x in (*meshes, *fields)}
    for geom in list(spec.geoms):
        if shapes & {geom.meshname, geom.hfieldname}:
            if _contributes_mass(spec, geom, moving_bodies):
                lighter_bodies.setdefault(geom.parent.name, name)
            spec.delete(geom)
    for item in (*meshes, *fields):
        spec.delete(item)
    return bool(shapes)


def _moving_bodies(spec: Any) -> set[str]:
    """Return the names of bodies that can move, without a compiled model."""
    found = set[str]()
    for body in spec.bodies:  # parents before children
        if body.parent is not None and (len(body.joints) or body.parent.name in found):
            found.add(body.name)
    return found


def _contributes_mass(spec: Any, geom: Any, moving_bodies: set[str]) -> bool:
    """Whether a geom contributes to the mass of a moving body."""
    settings, body = spec.compiler, geom.parent
    inertia_mode = int(settings.inertiafromgeom)
    if not inertia_mode or (inertia_mode == _AUTOMATIC_INERTIA and body.explicitinertial):
        return False
    lowest, highest = settings.inertiagrouprange
    if not lowest <= geom.group <= highest:
        return False
    if geom.mass == 0 or (math.isnan(geom.mass) and geom.density == 0):
        return False
    return body.name in moving_bodies
