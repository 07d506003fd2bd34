"""What MuJoCo would compute with and a machine does not have: noted, to be told in one line.

The list follows the fields of MuJoCo's mjModel that act on the motion. Softness of constraints
(solref, solimp) is not told: loops close exactly here, whatever it says. Limits are not either: a
run says which it passed.
"""

from typing import Any

import numpy as np

from crane.formats.mjcf.acting import fixed_tendon, straight
from crane.formats.mjcf.file import MujocoFile, rows

_GRAVITY = (0.0, 0.0, -9.81)
_SEEN = {"sensor": "nsensor", "camera": "ncam", "skin": "nskin", "plugin": "nplugin"}


def note_the_rest(mjcf: MujocoFile) -> None:
    """Note all that is left out, or taken otherwise."""
    off = mjcf.switched_off
    if "CONTACT" not in off:
        _note_contacts(mjcf, off)
    _note_world(mjcf, off)
    _note_joints(mjcf, off)
    _note_actuators(mjcf, off)
    model = mjcf.model
    spatial = [
        i
        for i in range(model.ntendon)
        if fixed_tendon(mjcf, i) is None and straight(mjcf, i) is None
    ]
    if spatial:
        mjcf.lose(
            "tendons that are not straight from a site to one of another body",
            *map(mjcf.tendon, spatial),
        )
    for what, field in _SEEN.items():
        if count := int(getattr(model, field, 0)):
            mjcf.lose(f"{count} {what}{'s' * (count > 1)}")


def _note_world(mjcf: MujocoFile, off: set[str]) -> None:
    model = mjcf.model
    gravity = np.zeros(3) if "GRAVITY" in off else model.opt.gravity
    if not np.allclose(gravity, _GRAVITY, rtol=0, atol=1e-9):
        given = " ".join(f"{x:g}" for x in gravity)
        mjcf.differ(f"gravity is {given} m/s2, a machine's is 0 0 -9.81")
    if np.any(model.body_gravcomp):
        mjcf.lose("gravity compensation")
    if model.opt.density or model.opt.viscosity:
        mjcf.lose("forces of the air")
    if model.nmocap:
        moved = [mjcf.body(body) for body in np.flatnonzero(model.body_mocapid >= 0).tolist()]
        mjcf.differ("what a program moves stands still (mocap)", *moved)
    if (model.neq and "EQUALITY" in off) or "CONSTRAINT" in off:
        mjcf.differ("the file switches its constraints off, loops are closed here")


def _note_contacts(mjcf: MujocoFile, off: set[str]) -> None:
    geoms = touching(mjcf.model, off)
    if not geoms:
        return
    on = mjcf.model.geom_bodyid
    geoms.sort(key=lambda geom: mjcf.model.body_weldid[on[geom]] != 0)  # floors and walls first
    names = [mjcf.name("GEOM", x).strip() or f"one of {mjcf.body(int(on[x]))}" for x in geoms]
    count = f"{len(geoms)} geom{'s' * (len(geoms) > 1)}"
    mjcf.lose(f"contacts of {count}", *names)


def touching(model: Any, off: set[str]) -> list[int]:
    """Numbers of the geoms that can touch another one, as MuJoCo decides on it.

    Two geoms can, if a bit of the contype of one is in the conaffinity of the other, they move
    against each other, their bodies are not parent and child (unless one stands still), and no
    exclude names them; or if a pair names them.

    Args:
        model: MuJoCo's model.
        off: What is switched off, of `MujocoFile.switched_off`.
    """
    weld = model.body_weldid
    above = weld[model.body_parentid[weld]]  # of the body that each is a part of
    kinds, kind = np.unique(
        np.column_stack([model.geom_bodyid, model.geom_contype, model.geom_conaffinity]).reshape(
            -1, 3
        ),
        axis=0,
        return_inverse=True,
    )
    body, contype, conaffinity = kinds.T
    part = weld[body]
    excluded = {divmod(int(x), 1 << 16) for x in model.exclude_signature}
    excluded |= {(two, one) for one, two in excluded}
    touches = np.zeros(len(kinds), dtype=bool)
    filtered = "FILTERPARENT" not in off
    for i in range(len(kinds)):
        can = ((contype[i] & conaffinity) | (contype & conaffinity[i])) != 0
        can &= part != part[i]
        if filtered:
            near = (above[part] == part[i]) | (part == above[part[i]])
            can &= ~(near & (part != 0) & (part[i] != 0))
        others = np.flatnonzero(can)
        if excluded:
            others = np.array(
                [j for j in others if (int(body[i]), int(body[j])) not in excluded], dtype=int
            )
        touches[i] = len(others) > 0
    found = touches[np.ravel(kind)]
    found[np.concatenate([model.pair_geom1, model.pair_geom2]).astype(int)] = True
    return np.flatnonzero(found).tolist()


def _note_joints(mjcf: MujocoFile, off: set[str]) -> None:
    model = mjcf.model
    for field, what in (
        ("dof_dampingpoly", "nonlinear damping of joints"),
        ("jnt_stiffnesspoly", "nonlinear stiffness of joints"),
        ("jnt_springyield", "yielding of springs"),
        ("jnt_actfrclimited", "limits of the force on joints (actuatorfrcrange)"),
    ):
        of_dofs = field.startswith("dof")
        found = [int(model.dof_jntid[i]) if of_dofs else i for i in rows(model, field)]
        if found:
            mjcf.lose(what, *map(mjcf.joint, found))
    for switch, fields in (
        ("SPRING", ("jnt_stiffness", "tendon_stiffness")),
        ("DAMPER", ("dof_damping", "tendon_damping")),
        ("FRICTIONLOSS", ("dof_frictionloss", "tendon_frictionloss")),
    ):
        passive = switch in off or ("PASSIVE" in off and switch != "FRICTIONLOSS")
        if passive and any(np.any(getattr(model, field)) for field in fields):
            mjcf.differ(f"the file switches off what it calls {switch.lower()}, it acts here")
    limited = [] if "LIMIT" in off else rows(model, "jnt_limited")
    balls = [i for i in limited if mjcf.kind("Joint", model.jnt_type[i]) == "BALL"]
    if balls:
        mjcf.lose("limits of the angle of ball joints", *map(mjcf.joint, balls))


def _note_actuators(mjcf: MujocoFile, off: set[str]) -> None:
    """Those that are no motors: their force is not what they are told, in N or N m."""
    model = mjcf.model
    count = len(model.actuator_trntype)
    odd = set()
    for field in (
        "actuator_gaintype", "actuator_biastype", "actuator_dyntype", "actuator_forcelimited",
        "actuator_ctrllimited", "actuator_actlimited", "actuator_dampingpoly", "actuator_delay",
    ):  # fmt: skip
        odd.update(rows(model, field))
    odd.update(i for i in range(count) if model.actuator_gainprm[i, 0] != 1)
    odd.update(i for i in range(count) if abs(np.linalg.norm(model.actuator_gear[i]) - 1) > 1e-9)
    if odd:
        mjcf.differ(
            "drives take forces in N and N m, without gains, gears, dynamics and limits of the "
            "actuators",
            *map(mjcf.actuator, sorted(odd)),
        )
    if count and "ACTUATION" in off:
        mjcf.differ("the file switches its actuators off, what they act on is driven here")
