"""A MJCF file whose meshes and pictures are not there, compiled without them.

They are drawn and touched, which a machine does not do. Where the mass of a body comes from one
as well, it is missing: told where the body is a part of one that has some, else refused.
"""

import math
import re
from typing import Any

_MISSING_FILE_PATTERN = re.compile(r"opening file '([^']*)'")
_ELEMENT_PATTERN = re.compile(r"Element name '([^']*)'")
_IMAGE_COLLECTIONS = ("materials", "textures", "skins")
_DRAWN_COLLECTIONS = ("geoms", "sites", "tendons")  # with materials
_AUTOMATIC_INERTIA = 2  # of inertiafromgeom: where a body has no <inertial>


class MassMissingError(Exception):
    """A body that moves has no mass but that of a mesh that is not there.

    Args:
        body: Its name.
        mesh: The mesh's file.
    """

    def __init__(self, body: str, mesh: str):
        super().__init__(body, mesh)
        self.body, self.mesh = body, mesh


def missing_file(text: str) -> str:
    """The file that MuJoCo could not open, by its words; empty where that is not what they say."""
    found = _MISSING_FILE_PATTERN.search(text)
    return found[1] if found else ""


def compile_without_missing_files(
    mujoco: Any, path: str, first_missing: str
) -> tuple[Any, list[str], dict[str, str]]:
    """The compiled model without the meshes that are not there, and pictures.

    Args:
        mujoco: The package.
        path: The MJCF file.
        first_missing: A file that is not there.

    Returns:
        Model, names of the files, and of bodies whose mass lacks that of one of them.

    Raises:
        MassMissingError: A body that moves has no mass without one of them.
        Exception: Whatever MuJoCo raises; a ValueError where nothing can be taken out.
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
    """Take out the meshes and height fields of a file with their shapes; whether there are any.

    Args:
        spec: What is compiled.
        name: Of the file.
        moving_bodies: See `_moving_bodies`.
        lighter_bodies: Gets the bodies that lose mass, with the file.
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
    """Bodies that can move; MuJoCo cannot be asked any more where it has failed to compile."""
    found = set[str]()
    for body in spec.bodies:  # parents before children
        if body.parent is not None and (len(body.joints) or body.parent.name in found):
            found.add(body.name)
    return found


def _contributes_mass(spec: Any, geom: Any, moving_bodies: set[str]) -> bool:
    """Whether a shape gives mass to a body that can move."""
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
