"""Actuators of MJCF as drives: whatever law makes its force, along what it acts."""

from collections.abc import Mapping, Sequence

import numpy as np

from crane.description.spec import Drive
from crane.formats.mjcf.acting import fixed_tendon
from crane.formats.mjcf.file import MujocoFile

_AXES = np.eye(3)


def read_drives(mjcf: MujocoFile, parts: Mapping[int, Sequence[str]]) -> tuple[Drive, ...]:
    """What the actuators act along, each once: a hinge or slide, a fixed tendon, parts of a joint.

    Of a free joint an actuator pushes along an axis of the world, which its slides are. About an
    axis of a ball or free joint it drives the angle that turns about that axis at rest.

    Args:
        mjcf: The file.
        parts: Joints that each joint of MuJoCo became.
    """
    found: dict[str, Drive] = {}
    for actuator in range(len(mjcf.model.actuator_trntype)):
        kind, target = mjcf.transmission(actuator)
        factors: Mapping[str, float] = {}
        name = mjcf.actuator(actuator)
        if kind == "TENDON":
            tendon = fixed_tendon(mjcf, target)
            name = mjcf.tendon(target)
            factors = {parts[joint][0]: factor for joint, factor in (tendon or {}).items()}
        elif kind == "JOINT" and len(parts[target]) == 1:
            (name,) = parts[target]
            factors = {name: 1.0}
        elif kind == "JOINT":
            taken = [joint for drive in found.values() for joint in drive.factors]
            factors = _several(mjcf, actuator, parts[target], taken)
            if len(factors) == 1:
                (name,) = factors
                factors = {name: 1.0}
        if factors:
            found.setdefault(name, Drive(name, factors))
        else:
            mjcf.lose("actuators by sites, bodies and tendons in space", mjcf.actuator(actuator))
    return tuple(found.values())


def _several(
    mjcf: MujocoFile, actuator: int, parts: Sequence[str], taken: Sequence[str]
) -> dict[str, float]:
    """Factors of the parts of a ball or free joint, of size 1 together."""
    gear = np.array(mjcf.model.actuator_gear[actuator])
    slides, turns = parts[:-3], parts[-3:]
    push, axis = (gear[:3], gear[3:6]) if slides else (np.zeros(3), gear[:3])
    size = float(np.linalg.norm(push))
    if axis.any():
        mjcf.differ(
            "actuators about axes of ball and free joints drive their angles",
            mjcf.actuator(actuator),
        )
    if size:
        return {x: float(f) / size for x, f in zip(slides, push, strict=True) if f}
    nearest = [turns[i] for i in np.argsort(-np.abs(axis), kind="stable") if axis[i]]
    untaken = [part for part in nearest if part not in taken]
    return {part: 1.0 for part in (untaken or nearest)[:1]}
