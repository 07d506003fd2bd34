"""What acts in a MJCF: friction, springs, rotors of joints, tendons and actuators.

A fixed tendon or an actuator of one joint has the length L = c q, so a spring, damper or rotor of
the size s along L counts c^2 s at the joint, and friction |c| s. Several joints of one tendon are
bound by it, which no element of a machine does. The spring and damper of a tendon straight from
site to site are a force element between them, or a rope where the spring is slack from 0 on.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from crane.description.spec import ForceElement, Friction, Rope
from crane.formats.mjcf.file import MujocoFile, rows

_ALONG = {  # fields of tendons, by the words that tell of them
    "stiffness": ("tendon_stiffness", "tendon_stiffnesspoly"),
    "damping": ("tendon_damping", "tendon_dampingpoly"),
    "friction": ("tendon_frictionloss",),
    "armature": ("tendon_armature",),
    "limits": ("tendon_limited", "tendon_actfrclimited"),
}


@dataclass
class Acting:
    """What acts along joints, by their names, and between frames.

    Attributes:
        viscous: [N s/m], [N m s/rad].
        coulomb: [N], [N m].
        springs: Force elements.
        ropes: Ropes.
        rotors: Rotor inertias [kg], [kg m2].
    """

    viscous: dict[str, float] = field(default_factory=dict)
    coulomb: dict[str, float] = field(default_factory=dict)
    springs: list[ForceElement] = field(default_factory=list)
    ropes: list[Rope] = field(default_factory=list)
    rotors: dict[str, float] = field(default_factory=dict)

    @property
    def friction(self) -> dict[str, Friction]:
        """Laws by joint."""
        joints = dict.fromkeys((*self.viscous, *self.coulomb))
        return {
            x: Friction(viscous=self.viscous.get(x, 0.0), coulomb=self.coulomb.get(x, 0.0))
            for x in joints
        }


def read_acting(
    mjcf: MujocoFile, parts: Mapping[int, Sequence[str]], sites: Mapping[int, str]
) -> Acting:
    """All that acts along single joints and between sites; the rest is noted as left out.

    Args:
        mjcf: The file.
        parts: Joints that each joint of MuJoCo became.
        sites: Link of each site.
    """
    found = Acting()
    for joint, names in parts.items():
        if len(names) > 1:
            _of_several(mjcf, joint, names, found)
        else:
            _of_joint(mjcf.model, joint, names[0], found)
    for tendon in range(mjcf.model.ntendon):
        _of_tendon(mjcf, tendon, parts, sites, found)
    for actuator in range(len(mjcf.model.actuator_trntype)):
        _of_actuator(mjcf, actuator, parts, found)
    return found


def fixed_tendon(mjcf: MujocoFile, tendon: int) -> dict[int, float] | None:
    """Factors by joint of MuJoCo; None for a tendon in space."""
    model = mjcf.model
    found: dict[int, float] = {}
    start = model.tendon_adr[tendon]
    for wrap in range(start, start + model.tendon_num[tendon]):
        if mjcf.kind("Wrap", model.wrap_type[wrap]) != "JOINT":
            return None
        joint = int(model.wrap_objid[wrap])
        found[joint] = found.get(joint, 0.0) + float(model.wrap_prm[wrap])
    return {joint: factor for joint, factor in found.items() if factor}


def straight(mjcf: MujocoFile, tendon: int) -> tuple[int, int] | None:
    """The sites of a tendon straight from one to another, on two bodies; None for others."""
    model, start = mjcf.model, mjcf.model.tendon_adr[tendon]
    wraps = range(start, start + model.tendon_num[tendon])
    sites = [int(model.wrap_objid[i]) for i in wraps]
    if [mjcf.kind("Wrap", model.wrap_type[i]) for i in wraps] != ["SITE"] * 2:
        return None
    one, two = (int(model.body_weldid[model.site_bodyid[site]]) for site in sites)
    return None if one == two else (sites[0], sites[1])


def isotropic(mjcf: MujocoFile, joint: int) -> float:
    """Inertia [kg m2] that the rotors of a ball or free joint add to its body about every axis.

    They turn with it against its parent, so they are a part of it where that stands still.
    """
    model, dof = mjcf.model, int(mjcf.model.jnt_dofadr[joint])
    free = mjcf.kind("Joint", model.jnt_type[joint]) == "FREE"
    rotor = float(model.dof_armature[dof + 3 * free])
    if rotor and model.body_weldid[model.body_parentid[model.jnt_bodyid[joint]]]:
        mjcf.lose("armature of ball joints on moving bodies", mjcf.joint(joint))
        return 0.0
    return rotor


def _add(values: dict[str, float], joint: str, value: float) -> None:
    if value:
        values[joint] = values.get(joint, 0.0) + value


def _value(model: Any, field: str, index: int) -> float:
    """A number of a field; older versions have fewer fields."""
    values = getattr(model, field, None)
    return 0.0 if values is None else float(values[index])


def _of_joint(model: Any, joint: int, name: str, found: Acting) -> None:
    dof = int(model.jnt_dofadr[joint])
    _add(found.viscous, name, float(model.dof_damping[dof]))
    _add(found.coulomb, name, float(model.dof_frictionloss[dof]))
    _add(found.rotors, name, float(model.dof_armature[dof]))
    if stiffness := float(model.jnt_stiffness[joint]):
        rest = float(model.qpos_spring[model.jnt_qposadr[joint]])
        found.springs.append(ForceElement(name, stiffness=stiffness, rest=rest))


def _of_several(mjcf: MujocoFile, joint: int, names: Sequence[str], found: Acting) -> None:
    model, dof = mjcf.model, int(mjcf.model.jnt_dofadr[joint])
    own = range(dof, dof + len(names))
    if model.dof_damping[own].any() or model.dof_frictionloss[own].any() or (
        model.jnt_stiffness[joint]
    ):  # fmt: skip
        mjcf.lose("damping, friction and stiffness of ball and free joints", mjcf.joint(joint))
    for name in names[:-3]:  # of a free joint the slides; the rest is the body's, see `isotropic`
        _add(found.rotors, name, float(model.dof_armature[dof]))


def _of_tendon(
    mjcf: MujocoFile,
    tendon: int,
    parts: Mapping[int, Sequence[str]],
    sites: Mapping[int, str],
    found: Acting,
) -> None:
    model, factors = mjcf.model, fixed_tendon(mjcf, tendon)
    lost = [
        what
        for what, fields in _ALONG.items()
        if any(tendon in rows(model, name) for name in fields)
    ]
    if factors is not None and len(factors) == 1:
        ((joint, c),) = factors.items()
        (name,) = parts[joint]
        slack, tight = (float(x) for x in model.tendon_lengthspring[tendon])
        if slack == tight and tendon not in rows(model, "tendon_stiffnesspoly"):
            if stiffness := c * c * float(model.tendon_stiffness[tendon]):
                found.springs.append(ForceElement(name, stiffness=stiffness, rest=slack / c))
            lost = [what for what in lost if what != "stiffness"]
        if tendon not in rows(model, "tendon_dampingpoly"):
            _add(found.viscous, name, c * c * float(model.tendon_damping[tendon]))
            lost = [what for what in lost if what != "damping"]
        _add(found.coulomb, name, abs(c) * float(model.tendon_frictionloss[tendon]))
        _add(found.rotors, name, c * c * _value(model, "tendon_armature", tendon))
        lost = [what for what in lost if what not in ("friction", "armature")]
    elif ends := straight(mjcf, tendon):
        acting = _between((sites[ends[0]], sites[ends[1]]), mjcf, tendon, found)
        lost = [what for what in lost if what not in acting]
    for what in lost:
        mjcf.lose(f"{what} of tendons", mjcf.tendon(tendon))


def _between(links: tuple[str, str], mjcf: MujocoFile, tendon: int, found: Acting) -> list[str]:
    """Add the spring and damper of a tendon between two sites; which of both it is."""
    model, acting = mjcf.model, []
    stiffness = damping = rest = 0.0
    lower, upper = (float(x) for x in model.tendon_lengthspring[tendon])
    if tendon not in rows(model, "tendon_stiffnesspoly") and (lower == upper or lower == 0):
        acting.append("stiffness")
        size = float(model.tendon_stiffness[tendon])
        if lower == upper:
            stiffness, rest = size, upper
        elif size:
            found.ropes.append(Rope(links, length=upper, stiffness=size))
    if tendon not in rows(model, "tendon_dampingpoly"):
        acting.append("damping")
        damping = float(model.tendon_damping[tendon])
    if stiffness or damping:
        rest = rest if stiffness else 0.0
        found.springs.append(ForceElement("", stiffness, rest, damping, between=links))
    return acting


def _of_actuator(
    mjcf: MujocoFile, actuator: int, parts: Mapping[int, Sequence[str]], found: Acting
) -> None:
    model = mjcf.model
    armature = _value(model, "actuator_armature", actuator)
    damping = _value(model, "actuator_damping", actuator)
    if not (armature or damping):
        return
    kind, target = mjcf.transmission(actuator)
    factors = {target: 1.0} if kind == "JOINT" else {}
    if kind == "TENDON":
        factors = fixed_tendon(mjcf, target) or {}
    if len(factors) != 1 or len(parts[next(iter(factors))]) != 1:
        mjcf.lose("armature and damping of actuators", mjcf.actuator(actuator))
        return
    ((joint, c),) = factors.items()
    share = (c * float(model.actuator_gear[actuator, 0])) ** 2
    _add(found.viscous, parts[joint][0], share * damping)
    _add(found.rotors, parts[joint][0], share * armature)
