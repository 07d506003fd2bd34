"""Notes on what a MJCF file has that a machine does not have, or has otherwise.

The notes follow the fields of MuJoCo's `mjModel` that affect the motion and that a machine does
not have. Two are not noted: softness of constraints (solref, solimp), because loops close exactly,
and limits, because a run reports the limits that it passed.
"""

from typing import Any

import numpy as np

from crane.formats.mjcf.actuator_cylinders import MjcfCylinders
from crane.formats.mjcf.model_features import fixed_tendon_factors, straight_tendon_sites
from crane.formats.mjcf.mujoco_file import MujocoFile, nonzero_rows

_COUNTED_FEATURES = {"sensor": "nsensor", "camera": "ncam", "skin": "nskin", "plugin": "nplugin"}


def note_unsupported_features(mjcf: MujocoFile, cylinders: MjcfCylinders) -> None:
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
        if fixed_tendon_factors(mjcf, i) is None
        and straight_tendon_sites(mjcf, i) is None
        and i not in cylinders.tendon_factors
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
    excluded = {frozenset(divmod(int(x), 1 << 16)) for x in model.exclude_signature}
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
            frozenset((int(body[i]), int(body[j]))) not in excluded
            for j in np.flatnonzero(can_touch)
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
        found = [
            int(model.dof_jntid[i]) if attribute.startswith("dof") else i
            for i in nonzero_rows(model, attribute)
        ]
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
    is_nonstandard = model.actuator_gainprm[:, 0] != 1
    for attribute in (
        "actuator_gaintype", "actuator_biastype", "actuator_dyntype", "actuator_forcelimited",
        "actuator_ctrllimited", "actuator_actlimited", "actuator_dampingpoly", "actuator_delay",
    ):  # fmt: skip
        is_nonstandard[nonzero_rows(model, attribute)] = True
    if is_nonstandard.any():
        mjcf.note_difference(
            "drives take forces in N and N m, without gains, dynamics and limits of the actuators",
            *(mjcf.name("ACTUATOR", int(i)) for i in np.flatnonzero(is_nonstandard)),
        )
    if len(is_nonstandard) and "ACTUATION" in disabled:
        mjcf.note_difference(
            "the file switches its actuators off, what they act on is driven here"
        )
