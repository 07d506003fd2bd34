"""What acts in a MJCF: friction, springs, rotors of joints, tendons and actuators.

A fixed tendon or an actuator of one joint has the length L = c q, so a spring, damper or rotor of
the size s along L counts c^2 s at the joint, and friction |c| s. Several joints of one tendon are
bound by it, which no element of a machine does. The spring and damper of a tendon straight from
site to site are a force element between them, or a rope where the spring is slack from 0 on.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from crane.description.specification import ForceElement, Friction, Rope
from crane.formats.mjcf.mujoco_file import MujocoFile, nonzero_rows

_TENDON_FIELDS = {  # fields of tendons, by the words that tell of them
    "stiffness": ("tendon_stiffness", "tendon_stiffnesspoly"),
    "damping": ("tendon_damping", "tendon_dampingpoly"),
    "friction": ("tendon_frictionloss",),
    "armature": ("tendon_armature",),
    "limits": ("tendon_limited", "tendon_actfrclimited"),
}


@dataclass
class JointEffects:
    """What acts along joints, by their names, and between frames.

    Attributes:
        viscous: [N s/m], [N m s/rad].
        coulomb: [N], [N m].
        springs: Force elements.
        ropes: Ropes.
        rotor_inertias: Rotor inertias [kg], [kg m2].
    """

    viscous: dict[str, float] = field(default_factory=dict)
    coulomb: dict[str, float] = field(default_factory=dict)
    springs: list[ForceElement] = field(default_factory=list)
    ropes: list[Rope] = field(default_factory=list)
    rotor_inertias: dict[str, float] = field(default_factory=dict)

    @property
    def friction(self) -> dict[str, Friction]:
        """Laws by joint."""
        joints = dict.fromkeys((*self.viscous, *self.coulomb))
        return {
            x: Friction(viscous=self.viscous.get(x, 0.0), coulomb=self.coulomb.get(x, 0.0))
            for x in joints
        }


def read_joint_effects(
    mjcf: MujocoFile, series_joints: Mapping[int, Sequence[str]], sites: Mapping[int, str]
) -> JointEffects:
    """All that acts along single joints and between sites; the rest is noted as left out.

    Args:
        mjcf: The file.
        series_joints: Joints that each joint of MuJoCo became.
        sites: Link of each site.
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
    """Factors by joint of MuJoCo; None for a tendon in space."""
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
    """The sites of a tendon straight from one to another, on two bodies; None for others."""
    model, start = mjcf.model, mjcf.model.tendon_adr[tendon]
    wraps = range(start, start + model.tendon_num[tendon])
    sites = [int(model.wrap_objid[i]) for i in wraps]
    if [mjcf.enumeration_name("Wrap", model.wrap_type[i]) for i in wraps] != ["SITE"] * 2:
        return None
    first_body, second_body = (int(model.body_weldid[model.site_bodyid[site]]) for site in sites)
    return None if first_body == second_body else (sites[0], sites[1])


def isotropic_rotor_inertia(mjcf: MujocoFile, joint: int) -> float:
    """Inertia [kg m2] that the rotors of a ball or free joint add to its body about every axis.

    They turn with it against its parent, so they are a part of it where that stands still.
    """
    model, dof = mjcf.model, int(mjcf.model.jnt_dofadr[joint])
    free = mjcf.enumeration_name("Joint", model.jnt_type[joint]) == "FREE"
    rotor = float(model.dof_armature[dof + 3 * free])
    if rotor and model.body_weldid[model.body_parentid[model.jnt_bodyid[joint]]]:
        mjcf.note_unsupported("armature of ball joints on moving bodies", mjcf.joint_name(joint))
        return 0.0
    return rotor


def _add_value(values: dict[str, float], joint: str, value: float) -> None:
    if value:
        values[joint] = values.get(joint, 0.0) + value


def _field_value(model: Any, field: str, index: int) -> float:
    """A number of a field; older versions have fewer fields."""
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
        mjcf.note_unsupported(
            "damping, friction and stiffness of ball and free joints", mjcf.joint_name(joint)
        )
    for name in names[:-3]:  # of a free joint the slides; the rest is the body's, see `isotropic`
        _add_value(effects.rotor_inertias, name, float(model.dof_armature[dof]))


def _add_tendon_effects(
    mjcf: MujocoFile,
    tendon: int,
    series_joints: Mapping[int, Sequence[str]],
    sites: Mapping[int, str],
    effects: JointEffects,
) -> None:
    model, factors = mjcf.model, fixed_tendon_factors(mjcf, tendon)
    unsupported = [
        what
        for what, fields in _TENDON_FIELDS.items()
        if any(tendon in nonzero_rows(model, name) for name in fields)
    ]
    if factors is not None and len(factors) == 1:
        ((joint, c),) = factors.items()
        (name,) = series_joints[joint]
        slack_length, taut_length = (float(x) for x in model.tendon_lengthspring[tendon])
        if slack_length == taut_length and tendon not in nonzero_rows(
            model, "tendon_stiffnesspoly"
        ):
            if stiffness := c * c * float(model.tendon_stiffness[tendon]):
                effects.springs.append(
                    ForceElement(name, stiffness=stiffness, rest=slack_length / c)
                )
            unsupported = [what for what in unsupported if what != "stiffness"]
        if tendon not in nonzero_rows(model, "tendon_dampingpoly"):
            _add_value(effects.viscous, name, c * c * float(model.tendon_damping[tendon]))
            unsupported = [what for what in unsupported if what != "damping"]
        _add_value(effects.coulomb, name, abs(c) * float(model.tendon_frictionloss[tendon]))
        _add_value(
            effects.rotor_inertias, name, c * c * _field_value(model, "tendon_armature", tendon)
        )
        unsupported = [what for what in unsupported if what not in ("friction", "armature")]
    elif ends := straight_tendon_sites(mjcf, tendon):
        supported = _add_straight_tendon((sites[ends[0]], sites[ends[1]]), mjcf, tendon, effects)
        unsupported = [what for what in unsupported if what not in supported]
    for what in unsupported:
        mjcf.note_unsupported(f"{what} of tendons", mjcf.tendon_name(tendon))


def _add_straight_tendon(
    links: tuple[str, str], mjcf: MujocoFile, tendon: int, effects: JointEffects
) -> list[str]:
    """Add the spring and damper of a tendon between two sites; which of both it is."""
    model, supported = mjcf.model, []
    stiffness = damping = rest = 0.0
    lower, upper = (float(x) for x in model.tendon_lengthspring[tendon])
    if tendon not in nonzero_rows(model, "tendon_stiffnesspoly") and (
        lower == upper or lower == 0
    ):
        supported.append("stiffness")
        spring_stiffness = float(model.tendon_stiffness[tendon])
        if lower == upper:
            stiffness, rest = spring_stiffness, upper
        elif spring_stiffness:
            effects.ropes.append(Rope(links, length=upper, stiffness=spring_stiffness))
    if tendon not in nonzero_rows(model, "tendon_dampingpoly"):
        supported.append("damping")
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
        mjcf.note_unsupported("armature and damping of actuators", mjcf.actuator_name(actuator))
        return
    ((joint, c),) = factors.items()
    squared_ratio = (c * float(model.actuator_gear[actuator, 0])) ** 2
    _add_value(effects.viscous, series_joints[joint][0], squared_ratio * damping)
    _add_value(effects.rotor_inertias, series_joints[joint][0], squared_ratio * armature)
