"""Friction, springs, rotor inertias and drives of a MJCF file.

A fixed tendon or an actuator of one joint has the length L = c q, so a stiffness, damping or rotor
inertia s along L is c^2 s at the joint, and a friction s is |c| s. A tendon of several joints
couples them, which no force element of a machine does. The spring and damper of a tendon straight
from site to site are a force element between frames, or a rope if the spring is slack from 0 on.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from crane.description.force_elements import ForceElement, Friction, Rope
from crane.description.specification import Drive
from crane.formats.mjcf.mujoco_file import MujocoFile, nonzero_rows

_TENDON_FIELDS = {  # fields of tendons by the feature that they define
    "stiffness": ("tendon_stiffness", "tendon_stiffnesspoly"),
    "damping": ("tendon_damping", "tendon_dampingpoly"),
    "friction": ("tendon_frictionloss",),
    "armature": ("tendon_armature",),
    "limits": ("tendon_limited", "tendon_actfrclimited"),
}


@dataclass
class JointEffects:
    """Friction, force elements and rotor inertias of a file.

    Attributes:
        viscous: Viscous friction by joint [N s/m], [N m s/rad].
        coulomb: Coulomb friction by joint [N], [N m].
        springs: Force elements along joints and between frames.
        ropes: Ropes between frames.
        rotor_inertias: Rotor inertias by joint [kg], [kg m2].
    """

    viscous: dict[str, float] = field(default_factory=dict)
    coulomb: dict[str, float] = field(default_factory=dict)
    springs: list[ForceElement] = field(default_factory=list)
    ropes: list[Rope] = field(default_factory=list)
    rotor_inertias: dict[str, float] = field(default_factory=dict)

    @property
    def friction(self) -> dict[str, Friction]:
        """Friction laws by joint."""
        joints = dict.fromkeys((*self.viscous, *self.coulomb))
        return {
            x: Friction(viscous=self.viscous.get(x, 0.0), coulomb=self.coulomb.get(x, 0.0))
            for x in joints
        }


def read_joint_effects(
    mjcf: MujocoFile, series_joints: Mapping[int, Sequence[str]], sites: Mapping[int, str]
) -> JointEffects:
    """Read the effects along single joints and between sites, and note what is left out.

    Args:
        mjcf: The file.
        series_joints: Names of the joints of the machine by joint of MuJoCo.
        sites: Name of the link by site.
    """
    effects = JointEffects()
    for joint, names in series_joints.items():
        if len(names) > 1:
            _add_multi_freedom_effects(mjcf, joint, names, effects)
        else:
            _add_joint_effects(mjcf.model, joint, names[0], effects)
    for tendon in range(mjcf.model.ntendon):
        _add_tendon_effects(mjcf, tendon, series_joints, sites, effects)
    for actuator in range(len(mjcf.model.actuator_trntype)):
        _add_actuator_effects(mjcf, actuator, series_joints, effects)
    return effects


def fixed_tendon_factors(mjcf: MujocoFile, tendon: int) -> dict[int, float] | None:
    """Return the factors of a fixed tendon by joint of MuJoCo, None for a spatial tendon."""
    model = mjcf.model
    found: dict[int, float] = {}
    start = model.tendon_adr[tendon]
    for wrap in range(start, start + model.tendon_num[tendon]):
        if mjcf.enumeration_name("Wrap", model.wrap_type[wrap]) != "JOINT":
            return None
        joint = int(model.wrap_objid[wrap])
        found[joint] = found.get(joint, 0.0) + float(model.wrap_prm[wrap])
    return {joint: factor for joint, factor in found.items() if factor}


def straight_tendon_sites(mjcf: MujocoFile, tendon: int) -> tuple[int, int] | None:
    """Return the sites of a straight tendon between two bodies, None for other tendons."""
    model, start = mjcf.model, mjcf.model.tendon_adr[tendon]
    wraps = range(start, start + model.tendon_num[tendon])
    sites = [int(model.wrap_objid[i]) for i in wraps]
    if [mjcf.enumeration_name("Wrap", model.wrap_type[i]) for i in wraps] != ["SITE"] * 2:
        return None
    first_body, second_body = (int(model.body_weldid[model.site_bodyid[site]]) for site in sites)
    return None if first_body == second_body else (sites[0], sites[1])


def isotropic_rotor_inertia(mjcf: MujocoFile, joint: int) -> float:
    """Return the rotor inertia [kg m2] that a ball or free joint adds to its body, isotropic.

    Rotors turn with the body against its parent, so they belong to the body if the parent is
    fixed.
    """
    model, dof = mjcf.model, int(mjcf.model.jnt_dofadr[joint])
    rotor = float(model.dof_armature[dof + 3 * (mjcf.joint_type(joint) == "FREE")])
    if rotor and model.body_weldid[model.body_parentid[model.jnt_bodyid[joint]]]:
        feature = "armature of ball joints on moving bodies"
        mjcf.note_unsupported_elements(feature, "JOINT", [joint])
        return 0.0
    return rotor


def _add_value(values: dict[str, float], joint: str, value: float) -> None:
    if value:
        values[joint] = values.get(joint, 0.0) + value


def _field_value(model: Any, field: str, index: int) -> float:
    """Return a value of a field, 0 if this version of MuJoCo lacks the field."""
    values = getattr(model, field, None)
    return 0.0 if values is None else float(values[index])


def _add_joint_effects(model: Any, joint: int, name: str, effects: JointEffects) -> None:
    dof = int(model.jnt_dofadr[joint])
    _add_value(effects.viscous, name, float(model.dof_damping[dof]))
    _add_value(effects.coulomb, name, float(model.dof_frictionloss[dof]))
    _add_value(effects.rotor_inertias, name, float(model.dof_armature[dof]))
    if stiffness := float(model.jnt_stiffness[joint]):
        rest = float(model.qpos_spring[model.jnt_qposadr[joint]])
        effects.springs.append(ForceElement(name, stiffness=stiffness, rest=rest))


def _add_multi_freedom_effects(
    mjcf: MujocoFile, joint: int, names: Sequence[str], effects: JointEffects
) -> None:
    model, dof = mjcf.model, int(mjcf.model.jnt_dofadr[joint])
    joint_dofs = range(dof, dof + len(names))
    if model.dof_damping[joint_dofs].any() or model.dof_frictionloss[joint_dofs].any() or (
        model.jnt_stiffness[joint]
    ):  # fmt: skip
        feature = "damping, friction and stiffness of ball and free joints"
        mjcf.note_unsupported_elements(feature, "JOINT", [joint])
    for name in names[:-3]:  # translations of a free joint; see also `isotropic_rotor_inertia`
        _add_value(effects.rotor_inertias, name, float(model.dof_armature[dof]))


def _add_tendon_effects(
    mjcf: MujocoFile,
    tendon: int,
    series_joints: Mapping[int, Sequence[str]],
    sites: Mapping[int, str],
    effects: JointEffects,
) -> None:
    factors = fixed_tendon_factors(mjcf, tendon)
    supported: set[str] = set()
    if factors is not None and len(factors) == 1:
        ((joint, factor),) = factors.items()
        (name,) = series_joints[joint]
        supported = _add_joint_tendon(name, factor, mjcf.model, tendon, effects)
    elif ends := straight_tendon_sites(mjcf, tendon):
        links = sites[ends[0]], sites[ends[1]]
        supported = _add_straight_tendon(links, mjcf.model, tendon, effects)
    for feature, fields in _TENDON_FIELDS.items():
        if feature not in supported and any(
            tendon in nonzero_rows(mjcf.model, name) for name in fields
        ):
            mjcf.note_unsupported_elements(f"{feature} of tendons", "TENDON", [tendon])


def _add_joint_tendon(
    joint: str, factor: float, model: Any, tendon: int, effects: JointEffects
) -> set[str]:
    """Add the effects of a fixed tendon of one joint, and return the features it represents."""
    supported = {"friction", "armature"}
    square = factor * factor
    slack_length, taut_length = (float(x) for x in model.tendon_lengthspring[tendon])
    if slack_length == taut_length and tendon not in nonzero_rows(model, "tendon_stiffnesspoly"):
        supported.add("stiffness")
        if stiffness := square * float(model.tendon_stiffness[tendon]):
            effects.springs.append(
                ForceElement(joint, stiffness=stiffness, rest=slack_length / factor)
            )
    if tendon not in nonzero_rows(model, "tendon_dampingpoly"):
        supported.add("damping")
        _add_value(effects.viscous, joint, square * float(model.tendon_damping[tendon]))
    _add_value(effects.coulomb, joint, abs(factor) * float(model.tendon_frictionloss[tendon]))
    armature = _field_value(model, "tendon_armature", tendon)
    _add_value(effects.rotor_inertias, joint, square * armature)
    return supported


def _add_straight_tendon(
    links: tuple[str, str], model: Any, tendon: int, effects: JointEffects
) -> set[str]:
    """Add the spring and damper of a straight tendon, and return the features they represent."""
    supported: set[str] = set()
    stiffness = damping = rest = 0.0
    lower, upper = (float(x) for x in model.tendon_lengthspring[tendon])
    if tendon not in nonzero_rows(model, "tendon_stiffnesspoly") and (
        lower == upper or lower == 0
    ):
        supported.add("stiffness")
        spring_stiffness = float(model.tendon_stiffness[tendon])
        if lower == upper:
            stiffness, rest = spring_stiffness, upper
        elif spring_stiffness:
            effects.ropes.append(Rope(links, length=upper, stiffness=spring_stiffness))
    if tendon not in nonzero_rows(model, "tendon_dampingpoly"):
        supported.add("damping")
        damping = float(model.tendon_damping[tendon])
    if stiffness or damping:
        rest = rest if stiffness else 0.0
        effects.springs.append(ForceElement("", stiffness, rest, damping, between=links))
    return supported


def _add_actuator_effects(
    mjcf: MujocoFile,
    actuator: int,
    series_joints: Mapping[int, Sequence[str]],
    effects: JointEffects,
) -> None:
    model = mjcf.model
    armature = _field_value(model, "actuator_armature", actuator)
    damping = _field_value(model, "actuator_damping", actuator)
    if not (armature or damping):
        return
    kind, target = mjcf.transmission(actuator)
    factors = {target: 1.0} if kind == "JOINT" else {}
    if kind == "TENDON":
        factors = fixed_tendon_factors(mjcf, target) or {}
    if len(factors) != 1 or len(series_joints[next(iter(factors))]) != 1:
        feature = "armature and damping of actuators"
        mjcf.note_unsupported_elements(feature, "ACTUATOR", [actuator])
        return
    ((joint, c),) = factors.items()
    squared_ratio = (c * float(model.actuator_gear[actuator, 0])) ** 2
    _add_value(effects.viscous, series_joints[joint][0], squared_ratio * damping)
    _add_value(effects.rotor_inertias, series_joints[joint][0], squared_ratio * armature)


def read_drives(mjcf: MujocoFile, series_joints: Mapping[int, Sequence[str]]) -> tuple[Drive, ...]:
    """Read what the actuators act along: a hinge or slide, a fixed tendon, a part of a joint.

    The translations of a free joint are along axes of the world, as the forces of its actuators
    are. A torque about an axis of a ball or free joint drives the Cardan angle about that axis.

    Args:
        mjcf: The file.
        series_joints: Names of the joints of the machine by joint of MuJoCo.

    Returns:
        Each drive once, whatever the force law of its actuators.
    """
    found: dict[str, Drive] = {}
    for actuator in range(len(mjcf.model.actuator_trntype)):
        kind, target = mjcf.transmission(actuator)
        factors: Mapping[str, float] = {}
        name = mjcf.name("ACTUATOR", actuator)
        if kind == "TENDON":
            tendon = fixed_tendon_factors(mjcf, target)
            name = mjcf.name("TENDON", target)
            factors = {series_joints[joint][0]: factor for joint, factor in (tendon or {}).items()}
        elif kind == "JOINT":
            factors = dict.fromkeys(series_joints[target], 1.0)
            if len(factors) > 1:
                used_joints = {joint for drive in found.values() for joint in drive.factors}
                factors = _multi_freedom_factors(mjcf, actuator, [*factors], used_joints)
            if len(factors) == 1:
                (name,) = factors
                factors = {name: 1.0}
        if factors:
            found.setdefault(name, Drive(name, factors))
        else:
            feature = "actuators by sites, bodies and tendons in space"
            mjcf.note_unsupported_elements(feature, "ACTUATOR", [actuator])
    return tuple(found.values())


def _multi_freedom_factors(
    mjcf: MujocoFile, actuator: int, joint_names: Sequence[str], used_joints: set[str]
) -> dict[str, float]:
    """Return the factors of the parts of a ball or free joint, normalized to length 1."""
    gear = np.array(mjcf.model.actuator_gear[actuator])
    prismatic_joints, revolute_joints = joint_names[:-3], joint_names[-3:]
    force_direction, axis = (gear[:3], gear[3:6]) if prismatic_joints else (np.zeros(3), gear[:3])
    force_norm = float(np.linalg.norm(force_direction))
    if axis.any():
        mjcf.note_difference(
            "actuators about axes of ball and free joints drive their angles",
            mjcf.name("ACTUATOR", actuator),
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
