"""Friction, springs, rotor inertias and drives of a MJCF file, and notes on what else it has.

A fixed tendon or an actuator of one joint has the length L = c q, so a stiffness, damping or rotor
inertia s along L is c^2 s at the joint, and a friction s is |c| s. A tendon of several joints
couples them, which no force element of a machine does. The spring and damper of a tendon straight
from site to site are a force element between frames, or a rope if the spring is slack from 0 on.

The notes follow the fields of MuJoCo's `mjModel` that affect the motion and that a machine does
not have. Two are not noted: softness of constraints (solref, solimp), because loops close exactly,
and limits, because a run reports the limits that it passed.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from crane.description.force_elements import ForceElement, Friction, Rope
from crane.description.specification import Drive
from crane.formats.mjcf.mujoco_file import MujocoFile, nonzero_rows

_STANDARD_GRAVITY = (0.0, 0.0, -9.81)
_COUNTED_FEATURES = {"sensor": "nsensor", "camera": "ncam", "skin": "nskin", "plugin": "nplugin"}
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
    mjcf: MujocoFile, series_joints: Mapping[int, Sequence[str]], sites: Mapping[int, str]
) -> JointEffects:
    """Read the effects along single joints and between sites, and note what is left out.

    Args:
        mjcf: The file.
        series_joints: Names of the joints of the machine by joint of MuJoCo.
        sites: Name of the link by site.
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
        if damping.any() or friction.any() or stiffness:
            mjcf.note_unsupported_elements(
                "damping, friction and stiffness of ball and free joints", "JOINT", [joint]
            )
        for name in names[:-3]:  # translations; see also `isotropic_rotor_inertia`
            effects.add_along(name, armature=armature)
    for tendon in range(model.ntendon):
        _add_tendon_effects(mjcf, tendon, series_joints, sites, effects)
    for actuator in range(len(model.actuator_trntype)):
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
    """Return the rotor inertia [kg m2] that a ball or free joint adds to its body, else 0.

    Rotors turn with the body against its parent, so they belong to the body if the parent is
    fixed.
    """
    model, dof = mjcf.model, int(mjcf.model.jnt_dofadr[joint])
    if (kind := mjcf.joint_type(joint)) not in ("BALL", "FREE"):
        return 0.0
    rotor = float(model.dof_armature[dof + 3 * (kind == "FREE")])
    if rotor and model.body_weldid[model.body_parentid[model.jnt_bodyid[joint]]]:
        mjcf.note_unsupported_elements(
            "armature of ball joints on moving bodies", "JOINT", [joint]
        )
        return 0.0
    return rotor


def _add_tendon_effects(
    mjcf: MujocoFile,
    tendon: int,
    series_joints: Mapping[int, Sequence[str]],
    sites: Mapping[int, str],
    effects: JointEffects,
) -> None:
    model, factors = mjcf.model, fixed_tendon_factors(mjcf, tendon)
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
    if ends is not None:
        links = sites[ends[0]], sites[ends[1]]
        if stiffness and not is_spring:
            effects.ropes.append(Rope(links, length=taut_length, stiffness=stiffness))
            stiffness = 0.0
        if stiffness or damping:
            rest = taut_length if stiffness else 0.0
            effects.springs.append(ForceElement("", stiffness, rest, damping, between=links))
    elif factors is not None and len(factors) == 1:
        supported |= {"friction", "armature"}
        ((joint, factor),) = factors.items()
        effects.add_along(
            series_joints[joint][0],
            factor,
            damping=damping,
            friction=float(model.tendon_frictionloss[tendon]),
            armature=float(model.tendon_armature[tendon]),
            stiffness=stiffness,
            rest=slack_length,
        )
    else:
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
    effects: JointEffects,
) -> None:
    model = mjcf.model
    armature = float(model.actuator_armature[actuator])
    damping = float(model.actuator_damping[actuator])
    if not (armature or damping):
        return
    kind, target = mjcf.transmission(actuator)
    factors = {target: 1.0} if kind == "JOINT" else {}
    if kind == "TENDON":
        factors = fixed_tendon_factors(mjcf, target) or {}
    if len(factors) != 1 or len(series_joints[next(iter(factors))]) != 1:
        mjcf.note_unsupported_elements("armature and damping of actuators", "ACTUATOR", [actuator])
        return
    ((joint, factor),) = factors.items()
    ratio = factor * float(model.actuator_gear[actuator, 0])
    effects.add_along(series_joints[joint][0], ratio, damping=damping, armature=armature)


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
            tendon = fixed_tendon_factors(mjcf, target) or {}
            name = mjcf.name("TENDON", target)
            factors = {series_joints[joint][0]: factor for joint, factor in tendon.items()}
        if kind == "JOINT" and len(series_joints[target]) > 1:
            used_joints = {joint for drive in found.values() for joint in drive.factors}
            factors = _multi_freedom_factors(mjcf, actuator, series_joints[target], used_joints)
        if kind == "JOINT" and len(series_joints[target]) == 1:
            factors = dict.fromkeys(series_joints[target], 1.0)
        if kind == "JOINT" and len(factors) == 1:
            (name,) = factors
            factors = {name: 1.0}
        if factors:
            found.setdefault(name, Drive(name, factors))
        else:
            mjcf.note_unsupported_elements(
                "actuators by sites, bodies and tendons in space", "ACTUATOR", [actuator]
            )
    return tuple(found.values())


def _multi_freedom_factors(
    mjcf: MujocoFile, actuator: int, joint_names: Sequence[str], used_joints: set[str]
) -> dict[str, float]:
    """Return the factors of the parts of a ball or free joint, normalized to length 1."""
    gear, translations = np.array(mjcf.model.actuator_gear[actuator]), joint_names[:-3]
    force_direction, axis = (gear[:3], gear[3:6]) if translations else (np.zeros(3), gear[:3])
    force_norm = float(np.linalg.norm(force_direction))
    if axis.any():
        mjcf.note_difference(
            "actuators about axes of ball and free joints drive their angles",
            mjcf.name("ACTUATOR", actuator),
        )
    if force_norm:
        forces = zip(translations, force_direction, strict=True)
        return {x: float(f) / force_norm for x, f in forces if f}
    nearest = [joint_names[-3:][i] for i in np.argsort(-np.abs(axis), kind="stable") if axis[i]]
    unused = [part for part in nearest if part not in used_joints]
    return {part: 1.0 for part in (unused or nearest)[:1]}


def note_unsupported_features(mjcf: MujocoFile) -> None:
    """Note all features that are left out or interpreted differently."""
    disabled = mjcf.disabled_features
    geoms = [] if "CONTACT" in disabled else colliding_geoms(mjcf.model, disabled)
    if geoms:
        bodies = mjcf.model.geom_bodyid
        # floors and walls first
        geoms.sort(key=lambda geom: mjcf.model.body_weldid[bodies[geom]] != 0)
        names = [
            mjcf.element_name("GEOM", x).strip() or f"one of {mjcf.name('BODY', int(bodies[x]))}"
            for x in geoms
        ]
        mjcf.note_unsupported(f"contacts of {len(geoms)} geom{'s' * (len(geoms) > 1)}", *names)
    _note_world(mjcf, disabled)
    _note_joints(mjcf, disabled)
    _note_actuators(mjcf, disabled)
    model = mjcf.model
    spatial_tendons = [
        i
        for i in range(model.ntendon)
        if fixed_tendon_factors(mjcf, i) is None and straight_tendon_sites(mjcf, i) is None
    ]
    mjcf.note_unsupported_elements(
        "tendons that are not straight from a site to one of another body",
        "TENDON",
        spatial_tendons,
    )
    for feature, attribute in _COUNTED_FEATURES.items():
        if count := int(getattr(model, attribute, 0)):
            mjcf.note_unsupported(f"{count} {feature}{'s' * (count > 1)}")


def _note_world(mjcf: MujocoFile, disabled: set[str]) -> None:
    model = mjcf.model
    gravity = np.zeros(3) if "GRAVITY" in disabled else model.opt.gravity
    if not np.allclose(gravity, _STANDARD_GRAVITY, rtol=0, atol=1e-9):
        given = " ".join(f"{x:g}" for x in gravity)
        mjcf.note_difference(f"gravity is {given} m/s2, a machine's is 0 0 -9.81")
    if np.any(model.body_gravcomp):
        mjcf.note_unsupported("gravity compensation")
    if model.opt.density or model.opt.viscosity:
        mjcf.note_unsupported("forces of the air")
    if model.nmocap:
        mocap_bodies = [mjcf.name("BODY", int(i)) for i in np.flatnonzero(model.body_mocapid >= 0)]
        mjcf.note_difference("what a program moves stands still (mocap)", *mocap_bodies)
    if (model.neq and "EQUALITY" in disabled) or "CONSTRAINT" in disabled:
        mjcf.note_difference("the file switches its constraints off, loops are closed here")


def colliding_geoms(model: Any, disabled: set[str]) -> list[int]:
    """Return the indices of geoms that can touch another geom by MuJoCo's rules.

    Two geoms can touch if a bit of the contype of one is in the conaffinity of the other, they
    move relative to each other, their bodies are not parent and child (unless one is fixed), and
    no exclude names them; or if a pair names them.

    Args:
        model: MuJoCo's model.
        disabled: As `MujocoFile.disabled_features`.
    """
    body_weld_ids = model.body_weldid
    parent_bodies = body_weld_ids[model.body_parentid[body_weld_ids]]  # of rigid bodies
    unique_geoms, unique_index = np.unique(
        np.column_stack([model.geom_bodyid, model.geom_contype, model.geom_conaffinity]).reshape(
            -1, 3
        ),
        axis=0,
        return_inverse=True,
    )
    body, contype, conaffinity = unique_geoms.T
    rigid_bodies = body_weld_ids[body]
    excluded = {divmod(int(x), 1 << 16) for x in model.exclude_signature}
    excluded |= {(two, one) for one, two in excluded}
    is_touching = np.zeros(len(unique_geoms), dtype=bool)
    for i in range(len(unique_geoms)):
        can_touch = ((contype[i] & conaffinity) | (contype & conaffinity[i])) != 0
        can_touch &= rigid_bodies != rigid_bodies[i]
        if "FILTERPARENT" not in disabled:
            are_parent_and_child = (parent_bodies[rigid_bodies] == rigid_bodies[i]) | (
                rigid_bodies == parent_bodies[rigid_bodies[i]]
            )
            can_touch &= ~(are_parent_and_child & (rigid_bodies != 0) & (rigid_bodies[i] != 0))
        is_touching[i] = any(
            (int(body[i]), int(body[j])) not in excluded for j in np.flatnonzero(can_touch)
        )
    found = is_touching[np.ravel(unique_index)]
    found[np.concatenate([model.pair_geom1, model.pair_geom2]).astype(int)] = True
    return np.flatnonzero(found).tolist()


def _note_joints(mjcf: MujocoFile, disabled: set[str]) -> None:
    model = mjcf.model
    for attribute, feature in (
        ("dof_dampingpoly", "nonlinear damping of joints"),
        ("jnt_stiffnesspoly", "nonlinear stiffness of joints"),
        ("jnt_springyield", "yielding of springs"),
        ("jnt_actfrclimited", "limits of the force on joints (actuatorfrcrange)"),
    ):
        of_dofs = attribute.startswith("dof")
        found = [int(model.dof_jntid[i]) if of_dofs else i for i in nonzero_rows(model, attribute)]
        mjcf.note_unsupported_elements(feature, "JOINT", found)
    for switch, fields in (
        ("SPRING", ("jnt_stiffness", "tendon_stiffness")),
        ("DAMPER", ("dof_damping", "tendon_damping")),
        ("FRICTIONLOSS", ("dof_frictionloss", "tendon_frictionloss")),
    ):
        passive = switch in disabled or ("PASSIVE" in disabled and switch != "FRICTIONLOSS")
        if passive and any(np.any(getattr(model, attribute)) for attribute in fields):
            mjcf.note_difference(
                f"the file switches off what it calls {switch.lower()}, it acts here"
            )
    limited = [] if "LIMIT" in disabled else nonzero_rows(model, "jnt_limited")
    ball_joints = [i for i in limited if mjcf.joint_type(i) == "BALL"]
    mjcf.note_unsupported_elements("limits of the angle of ball joints", "JOINT", ball_joints)


def _note_actuators(mjcf: MujocoFile, disabled: set[str]) -> None:
    """Note actuators other than motors, whose force [N], [N m] is not their control signal."""
    model = mjcf.model
    is_nonstandard = (model.actuator_gainprm[:, 0] != 1) | (
        np.abs(np.linalg.norm(model.actuator_gear, axis=1) - 1) > 1e-9
    )
    for attribute in (
        "actuator_gaintype", "actuator_biastype", "actuator_dyntype", "actuator_forcelimited",
        "actuator_ctrllimited", "actuator_actlimited", "actuator_dampingpoly", "actuator_delay",
    ):  # fmt: skip
        is_nonstandard[nonzero_rows(model, attribute)] = True
    if is_nonstandard.any():
        mjcf.note_difference(
            "drives take forces in N and N m, without gains, gears, dynamics and limits of the "
            "actuators",
            *(mjcf.name("ACTUATOR", int(i)) for i in np.flatnonzero(is_nonstandard)),
        )
    if len(is_nonstandard) and "ACTUATION" in disabled:
        mjcf.note_difference(
            "the file switches its actuators off, what they act on is driven here"
        )
