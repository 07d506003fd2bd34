"""What MuJoCo would compute with and a machine does not have: told, a line for each kind.

The list follows the fields of MuJoCo's mjModel that act on the motion. Softness of constraints
(solref, solimp) is not told: loops close exactly here, whatever it says.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from crane.formats.mjcf.file import MujocoFile

_GRAVITY = (0.0, 0.0, -9.81)
_SHOWN = 6  # names in a line
_TWISTS = ("BALL", "FREE")


def warn_of_the_rest(mjcf: MujocoFile, joints: Sequence[str]) -> None:
    """Warn of all that is left out.

    Args:
        mjcf: The file.
        joints: Names of the joints, by their numbers.
    """
    off = mjcf.switched_off
    _warn_world(mjcf, off)
    if "CONTACT" not in off:
        _warn_contacts(mjcf, off)
    _warn_joints(mjcf, joints, off)
    _warn_tendons(mjcf)
    _warn_actuators(mjcf, off)
    if mjcf.model.nplugin:
        mjcf.warn("plugins are left out")


def listed(names: Iterable[str]) -> str:
    """Names, the first of many."""
    names = list(dict.fromkeys(names))
    more = [f"{len(names) - _SHOWN} more"] if len(names) > _SHOWN else []
    return ", ".join(names[:_SHOWN] + more)


def _warn_world(mjcf: MujocoFile, off: set[str]) -> None:
    model, warn = mjcf.model, mjcf.warn
    gravity = np.zeros(3) if "GRAVITY" in off else model.opt.gravity
    if not np.allclose(gravity, _GRAVITY, rtol=0, atol=1e-9):
        given = " ".join(f"{x:g}" for x in gravity)
        warn(f"gravity is {given} m/s2, a machine's is 0 0 -9.81")
    if np.any(model.body_gravcomp):
        warn("gravity compensation is left out, write constant forces")
    if model.opt.density or model.opt.viscosity:
        warn("forces of the air are left out")
    if model.nmocap:
        moved = [mjcf.body(body) for body in np.flatnonzero(model.body_mocapid >= 0).tolist()]
        warn(f"{listed(moved)} stand still, which a program moves in MuJoCo (mocap)")
    if (model.neq and "EQUALITY" in off) or "CONSTRAINT" in off:
        warn("the file switches its constraints off, loops are closed here")


def _warn_contacts(mjcf: MujocoFile, off: set[str]) -> None:
    geoms = touching(mjcf.model, off)
    if not geoms:
        return
    on = mjcf.model.geom_bodyid
    geoms.sort(key=lambda geom: mjcf.model.body_weldid[on[geom]] != 0)  # floors and walls first
    names = [mjcf.name("GEOM", x).strip() or f"one of {mjcf.body(int(on[x]))}" for x in geoms]
    count = f"{len(geoms)} geom{'s' * (len(geoms) > 1)}"
    mjcf.warn(
        f"contacts of {count} ({listed(names)}) are left out, nothing stops the machine there"
    )


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


def _warn_joints(mjcf: MujocoFile, joints: Sequence[str], off: set[str]) -> None:
    model, warn = mjcf.model, mjcf.warn
    kinds = [mjcf.kind("Joint", kind) for kind in model.jnt_type]
    armature: dict[str, str] = {}
    for dof in np.flatnonzero(model.dof_armature):
        joint = model.dof_jntid[dof]
        linear = kinds[joint] == "SLIDE" or (
            kinds[joint] == "FREE" and dof < model.jnt_dofadr[joint] + 3
        )
        unit = "kg" if linear else "kg m2"
        armature.setdefault(joints[joint], f"{model.dof_armature[dof]:g} {unit}")
    if armature:
        values = listed(f"{name} ({value})" for name, value in armature.items())
        warn(f"armature of {values} is left out, a machine has none")
    if names := [joints[model.dof_jntid[dof]] for dof in _rows(model, "dof_dampingpoly")]:
        warn(f"nonlinear damping of {listed(names)} is left out, a machine has none")
    if names := [joints[i] for i in _rows(model, "jnt_stiffnesspoly")]:
        warn(f"nonlinear stiffness of {listed(names)} is left out, write gas_springs or forces")
    if names := [joints[i] for i in _rows(model, "jnt_springyield")]:
        warn(f"springs of {listed(names)} that yield are left out, a machine's do not")
    if names := [joints[i] for i in _rows(model, "jnt_actfrclimited")]:
        warn(f"limits of the force of {listed(names)} (actuatorfrcrange) are left out")
    for switch, fields in (
        ("SPRING", ("jnt_stiffness",)), ("DAMPER", ("dof_damping",)),
        ("FRICTIONLOSS", ("dof_frictionloss",)),
    ):  # fmt: skip
        passive = switch in off or ("PASSIVE" in off and switch != "FRICTIONLOSS")
        if passive and any(np.any(getattr(model, field)) for field in fields):
            warn(f"the file switches off what it calls {switch.lower()}, it acts here")
    limited = [] if "LIMIT" in off else _rows(model, "jnt_limited")
    if names := [joints[i] for i in limited if kinds[i] not in _TWISTS]:
        warn(
            f"the limits of {listed(names)} stop nothing here, as they do in MuJoCo: write "
            "end_stops in a machine file"
        )
    if names := [joints[i] for i in limited if kinds[i] in _TWISTS]:
        warn(f"the limit of the angle of {listed(names)} is left out")


def _warn_tendons(mjcf: MujocoFile) -> None:
    model = mjcf.model
    acting = {
        "stiffness": ("tendon_stiffness", "tendon_stiffnesspoly"),
        "damping": ("tendon_damping", "tendon_dampingpoly"),
        "friction": ("tendon_frictionloss",),
        "armature": ("tendon_armature",),
        "limits": ("tendon_limited",),
    }
    whats, tendons = [], set()
    for what, fields in acting.items():
        rows = {int(row) for field in fields for row in _rows(model, field)}
        whats += [what] if rows else []
        tendons |= rows
    if whats:
        names = [mjcf.name("TENDON", i).strip() or f"tendon{i + 1}" for i in sorted(tendons)]
        mjcf.warn(f"{', '.join(whats)} of tendons ({listed(names)}) are left out")


def _warn_actuators(mjcf: MujocoFile, off: set[str]) -> None:
    """Those that are no motors: their force is not what they are told, in N or N m."""
    model = mjcf.model
    count = len(model.actuator_trntype)
    odd = set()
    for field in (
        "actuator_gaintype", "actuator_biastype", "actuator_dyntype", "actuator_forcelimited",
        "actuator_ctrllimited", "actuator_actlimited", "actuator_armature", "actuator_damping",
        "actuator_dampingpoly", "actuator_delay",
    ):  # fmt: skip
        odd.update(_rows(model, field))
    for field in ("actuator_gainprm", "actuator_gear"):
        odd.update(i for i in range(count) if getattr(model, field)[i, 0] != 1)
    names = [mjcf.name("ACTUATOR", i).strip() or f"actuator{i + 1}" for i in sorted(odd)]
    if names:
        mjcf.warn(
            f"gains, gears, dynamics and limits of the actuators {listed(names)} are left out, "
            "active joints take forces in N and N m"
        )
    if count and "ACTUATION" in off:
        mjcf.warn("the file switches its actuators off, the joints they act on are active here")


def _rows(model: Any, field: str) -> list[int]:
    """Rows of a field in which a number is not zero; newer versions have more than older ones."""
    values = getattr(model, field, None)
    if values is None or not np.size(values):
        return []
    return np.flatnonzero(np.any(np.reshape(values, (len(values), -1)), axis=1)).tolist()
