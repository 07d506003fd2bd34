"""Friction, springs, rotor inertias and drives of a MJCF file.

A fixed tendon or an actuator of one joint has the length L = c q, so a stiffness, damping or rotor
inertia s along L is c^2 s at the joint, and a friction s is |c| s. A tendon of several joints
couples them, which no force element of a machine does. The spring and damper of a tendon straight
from site to site are a force element between frames, or a rope if the spring is slack from 0 on. A
tendon over sites that an actuator drives has a joint for its length, see
`crane.formats.mjcf.actuator_cylinders`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from crane.description.force_elements import ForceElement, Friction, Rope
from crane.description.specification import Drive
from crane.formats.mjcf.actuator_cylinders import MjcfCylinders
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

    def add_along(
        self,
        joint: str,
        factor: float = 1.0,
        *,
        damping: float = 0.0,
        friction: float = 0.0,
        armature: float = 0.0,
        stiffness: float = 0.0,
        rest: float = 0.0,
    ) -> None:
        """Add effects along a length that is a factor times the coordinate of a joint."""
        square = factor * factor
        for values, value in (
            (self.viscous, square * damping),
            (self.coulomb, abs(factor) * friction),
            (self.rotor_inertias, square * armature),
        ):
            if value:
                values[joint] = values.get(joint, 0.0) + value
        if square * stiffness:
            self.springs.append(
                ForceElement(joint, stiffness=square * stiffness, rest=rest / factor)
            )

    @property
    def friction(self) -> dict[str, Friction]:
        """Friction laws by joint."""
        return {
            x: Friction(viscous=self.viscous.get(x, 0.0), coulomb=self.coulomb.get(x, 0.0))
            for x in dict.fromkeys((*self.viscous, *self.coulomb))
        }


def read_joint_effects(
    mjcf: MujocoFile,
    series_joints: Mapping[int, Sequence[str]],
    sites: Mapping[int, str],
    cylinders: MjcfCylinders,
) -> JointEffects:
    """Read the effects along single joints and between sites, and note what is left out.

    Args:
        mjcf: The file.
        series_joints: Names of the joints of the machine by joint of MuJoCo.
        sites: Name of the link by site.
        cylinders: Its cylinders.
    """
    model, effects = mjcf.model, JointEffects()
    for joint, names in series_joints.items():
        dof = int(model.jnt_dofadr[joint])
        dofs = range(dof, dof + len(names))
        damping, friction = model.dof_damping[dofs], model.dof_frictionloss[dofs]
        stiffness, armature = float(model.jnt_stiffness[joint]), float(model.dof_armature[dof])
        if len(names) == 1:
            effects.add_along(
                names[0],
                damping=float(damping[0]),
                friction=float(friction[0]),
                armature=armature,
                stiffness=stiffness,
                rest=float(model.qpos_spring[model.jnt_qposadr[joint]]),
            )
            continue
        translation_friction = friction[:-3].any()
        if translation_friction or stiffness:
            mjcf.note_unsupported_elements(
                "friction of free joints, stiffness of ball and free joints", "JOINT", [joint]
            )
        for i, name in enumerate(names):
            effects.add_along(
                name,
                damping=float(damping[i]),
                friction=0.0 if translation_friction else float(friction[i]),
                armature=armature,
            )
    for tendon in range(model.ntendon):
        _add_tendon_effects(mjcf, tendon, series_joints, sites, cylinders, effects)
    for actuator in range(len(model.actuator_trntype)):
        _add_actuator_effects(mjcf, actuator, series_joints, cylinders, effects)
    return effects


def _tendon_factors(
    mjcf: MujocoFile,
    tendon: int,
    series_joints: Mapping[int, Sequence[str]],
    cylinders: MjcfCylinders,
) -> dict[str, float] | None:
    """Return the factors of joints in the length of a tendon; None if no joints have it."""
    if tendon in cylinders.tendon_factors:
        return cylinders.tendon_factors[tendon]
    factors = fixed_tendon_factors(mjcf, tendon)
    if factors is None:
        return None
    return {series_joints[joint][0]: factor for joint, factor in factors.items()}


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


def _add_tendon_effects(
    mjcf: MujocoFile,
    tendon: int,
    series_joints: Mapping[int, Sequence[str]],
    sites: Mapping[int, str],
    cylinders: MjcfCylinders,
    effects: JointEffects,
) -> None:
    model, factors = mjcf.model, _tendon_factors(mjcf, tendon, series_joints, cylinders)
    stiffness, damping = float(model.tendon_stiffness[tendon]), float(model.tendon_damping[tendon])
    slack_length, taut_length = (float(x) for x in model.tendon_lengthspring[tendon])
    is_spring, supported = slack_length == taut_length, set[str]()
    ends = straight_tendon_sites(mjcf, tendon)
    is_rope = ends is not None and slack_length == 0
    if (is_spring or is_rope) and tendon not in nonzero_rows(model, "tendon_stiffnesspoly"):
        supported.add("stiffness")
    if tendon not in nonzero_rows(model, "tendon_dampingpoly"):
        supported.add("damping")
    stiffness *= "stiffness" in supported
    damping *= "damping" in supported
    links = None if ends is None else (sites[ends[0]], sites[ends[1]])
    if stiffness and links is not None and not is_spring:
        effects.ropes.append(Rope(links, length=taut_length, stiffness=stiffness))
        stiffness = 0.0
    if factors is not None and len(factors) == 1:
        supported |= {"friction", "armature"}
        ((joint, factor),) = factors.items()
        if tendon in cylinders.tendon_factors and not model.tendon_actfrclimited[tendon]:
            supported.add("limits")
        effects.add_along(
            joint,
            factor,
            damping=damping,
            friction=float(model.tendon_frictionloss[tendon]),
            armature=float(model.tendon_armature[tendon]),
            stiffness=stiffness,
            rest=slack_length - cylinders.tendon_offsets.get(tendon, 0.0),
        )
    if factors is None and links is not None and (stiffness or damping):
        rest = taut_length if stiffness else 0.0
        effects.springs.append(ForceElement("", stiffness, rest, damping, between=links))
    if links is None and (factors is None or len(factors) != 1):
        supported.clear()
    for feature, fields in _TENDON_FIELDS.items():
        if feature not in supported and any(
            tendon in nonzero_rows(model, name) for name in fields
        ):
            mjcf.note_unsupported_elements(f"{feature} of tendons", "TENDON", [tendon])


def _add_actuator_effects(
    mjcf: MujocoFile,
    actuator: int,
    series_joints: Mapping[int, Sequence[str]],
    cylinders: MjcfCylinders,
    effects: JointEffects,
) -> None:
    model = mjcf.model
    armature = float(model.actuator_armature[actuator])
    damping = float(model.actuator_damping[actuator])
    if not (armature or damping):
        return
    factors = _actuator_factors(mjcf, actuator, series_joints, cylinders)
    if len(factors) != 1:
        mjcf.note_unsupported_elements("armature and damping of actuators", "ACTUATOR", [actuator])
        return
    ((joint, ratio),) = factors.items()
    effects.add_along(joint, ratio, damping=damping, armature=armature)


def _actuator_factors(
    mjcf: MujocoFile,
    actuator: int,
    series_joints: Mapping[int, Sequence[str]],
    cylinders: MjcfCylinders,
) -> dict[str, float]:
    """Return the factors of joints in the length of an actuator, which are its moments.

    There are none if it acts on a joint of several degrees of freedom, or on what is left out.
    """
    kind, target = mjcf.transmission(actuator)
    gear = float(mjcf.model.actuator_gear[actuator, 0])
    factors: dict[str, float] = {}
    if kind == "TENDON":
        factors = _tendon_factors(mjcf, target, series_joints, cylinders) or {}
    elif kind == "JOINT" and len(series_joints[target]) == 1:
        factors = {series_joints[target][0]: 1.0}
    elif kind == "SLIDERCRANK" and actuator in cylinders.actuator_joints:
        factors = {cylinders.actuator_joints[actuator]: 1.0}
    return {joint: gear * factor for joint, factor in factors.items() if gear * factor}


def read_drives(
    mjcf: MujocoFile, series_joints: Mapping[int, Sequence[str]], cylinders: MjcfCylinders
) -> tuple[Drive, ...]:
    """Read what the actuators act along: joints, tendons, sliders, a part of a joint.

    The translations of a free joint are along axes of the world, as the forces of its actuators
    are; torques of ball and free joints are about axes of the child in both.

    Args:
        mjcf: The file.
        series_joints: Names of the joints of the machine by joint of MuJoCo.
        cylinders: Its cylinders.

    Returns:
        Each drive once, whatever the force law of its actuators, with the gear of the first.
    """
    found: dict[str, Drive] = {}
    for actuator in range(len(mjcf.model.actuator_trntype)):
        kind, target = mjcf.transmission(actuator)
        factors = _actuator_factors(mjcf, actuator, series_joints, cylinders)
        name = mjcf.name(*(("TENDON", target) if kind == "TENDON" else ("ACTUATOR", actuator)))
        if kind == "JOINT" and len(series_joints[target]) > 1:
            factors = _multi_freedom_factors(mjcf, actuator, series_joints[target])
        if kind == "JOINT" and len(factors) == 1:
            (name,) = factors
        if factors:
            found.setdefault(name, Drive(name, factors))
        else:
            mjcf.note_unsupported_elements(
                "actuators by sites, bodies, tendons around geoms and cranks that break",
                "ACTUATOR",
                [actuator],
            )
    return tuple(found.values())


def _multi_freedom_factors(
    mjcf: MujocoFile, actuator: int, joint_names: Sequence[str]
) -> dict[str, float]:
    """Return the factors of the parts of a ball or free joint."""
    gear = np.array(mjcf.model.actuator_gear[actuator])[: len(joint_names)]
    return {x: float(f) for x, f in zip(joint_names, gear, strict=True) if f}
