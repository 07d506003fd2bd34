"""Actuators of MJCF as drives: whatever law makes its force, along what it acts."""

from collections.abc import Mapping, Sequence

import numpy as np

from crane.description.specification import Drive
from crane.formats.mjcf.joint_effects import fixed_tendon_factors
from crane.formats.mjcf.mujoco_file import MujocoFile

_AXES = np.eye(3)


def read_drives(mjcf: MujocoFile, series_joints: Mapping[int, Sequence[str]]) -> tuple[Drive, ...]:
    """What the actuators act along, each once: a hinge or slide, a fixed tendon, parts of a joint.

    Of a free joint an actuator pushes along an axis of the world, which its slides are. About an
    axis of a ball or free joint it drives the angle that turns about that axis at rest.

    Args:
        mjcf: The file.
        series_joints: Joints that each joint of MuJoCo became.
    """
    found: dict[str, Drive] = {}
    for actuator in range(len(mjcf.model.actuator_trntype)):
        kind, target = mjcf.transmission(actuator)
        factors: Mapping[str, float] = {}
        name = mjcf.actuator_name(actuator)
        if kind == "TENDON":
            tendon = fixed_tendon_factors(mjcf, target)
            name = mjcf.tendon_name(target)
            factors = {series_joints[joint][0]: factor for joint, factor in (tendon or {}).items()}
        elif kind == "JOINT" and len(series_joints[target]) == 1:
            (name,) = series_joints[target]
            factors = {name: 1.0}
        elif kind == "JOINT":
            used_joints = [joint for drive in found.values() for joint in drive.factors]
            factors = _multi_freedom_factors(mjcf, actuator, series_joints[target], used_joints)
            if len(factors) == 1:
                (name,) = factors
                factors = {name: 1.0}
        if factors:
            found.setdefault(name, Drive(name, factors))
        else:
            mjcf.note_unsupported(
                "actuators by sites, bodies and tendons in space", mjcf.actuator_name(actuator)
            )
    return tuple(found.values())


def _multi_freedom_factors(
    mjcf: MujocoFile, actuator: int, joint_names: Sequence[str], used_joints: Sequence[str]
) -> dict[str, float]:
    """Factors of the parts of a ball or free joint, of size 1 together."""
    gear = np.array(mjcf.model.actuator_gear[actuator])
    prismatic_joints, revolute_joints = joint_names[:-3], joint_names[-3:]
    force_direction, axis = (gear[:3], gear[3:6]) if prismatic_joints else (np.zeros(3), gear[:3])
    force_norm = float(np.linalg.norm(force_direction))
    if axis.any():
        mjcf.note_difference(
            "actuators about axes of ball and free joints drive their angles",
            mjcf.actuator_name(actuator),
        )
    if force_norm:
        return {
            x: float(f) / force_norm
            for x, f in zip(prismatic_joints, force_direction, strict=True)
            if f
        }
    nearest = [revolute_joints[i] for i in np.argsort(-np.abs(axis), kind="stable") if axis[i]]
    unused = [part for part in nearest if part not in used_joints]
    return {part: 1.0 for part in (unused or nearest)[:1]}
