"""Levers of the page on which a machine is driven: their inputs, and their directions."""

from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import numpy as np

from crane.common.errors import CraneError, InputError
from crane.common.samples import Array
from crane.control.valve_drive import ValveDrive
from crane.dynamics.dynamics import Dynamics
from crane.export.instance_program import InstanceProgram
from crane.machine.machine import Machine
from crane.motion.kinematics import Kinematics
from crane.motion.workspaces.workspace_section import find_slewing_joint
from crane.view.page.drive_hand import target_data

ROLES = ("slew", "boom", "stick", "tool")  # of levers, in their order from the ground
_ACCELERATIONS = {"m": 0.5, "rad": 1.5}  # by a full lever, of a drive of unknown effort
_BRAKING_TIME = 0.3  # in which a drive of a machine without valves stops by itself [s]
INTERVAL = 0.01  # of the recording, at whose ends the inputs are given [s]
_BRAKED_SHARE = 0.2  # of a speed, at most, in an interval
_MAX_INERTIA_RATIO = 100.0  # eigenvalue of M^-1 D, see `_braking_rate`
_NEAR_HOME = 0.2  # [rad], [characteristic lengths]
_STEP = 1e-5  # of a difference [m], [rad]


def lever_data(program: InstanceProgram) -> list[dict[str, Any]]:
    """Levers of a machine.

    A lever moves a target of a controller, or a spool, else the force of a drive. Its `role` and
    `sign` say where it is on the sticks, its `words` what it does in both directions: boom and
    stick along y, which is forwards, slew and tool along x, to the right. Forwards the boom goes
    down and the stick out, to the right the machine slews clockwise and the tool goes out.

    Raises:
        InputError: Nothing drives the machine.
    """
    levers = [{"name": x["name"], "joint": x["joint"]} for x in target_data(program)]
    if not levers:
        is_valve_drive = isinstance(program.control, ValveDrive)
        levers = list(_valves(program) if is_valve_drive else _forces(program))
    if not levers:
        raise InputError(
            f"nothing drives '{program.machine.name}', name active joints by --active"
        )
    for lever, (role, sign, words) in zip(levers, _roles(program.machine, levers), strict=True):
        lever |= {"role": role, "sign": sign, "words": words}
    return levers


def _valves(program: InstanceProgram) -> Iterator[dict[str, Any]]:
    first = program.layout.start_index("inputs")
    for i, (name, spool) in enumerate(program.control.circuit.hydraulics.spools.items()):
        yield {
            "name": name, "joint": spool.joint, "index": first + i, "neutral": spool.neutral,
            "full": spool.full, "overlap": spool.overlap,
        }  # fmt: skip


def _forces(program: InstanceProgram) -> Iterator[dict[str, Any]]:
    """Drives of a machine without valves: full force, and braking per velocity.

    Where there is no effort, a full lever carries the weight at home and accelerates.
    """
    machine, first = program.machine, program.layout.start_index("inputs")
    dynamics, home = Dynamics(machine, backend="pinocchio"), machine.home[machine.closure.active]
    weights, inertias = dynamics.gravity(home), np.diagonal(dynamics.mass_matrix(home))
    rate = _braking_rate(dynamics, home)
    limits = dict(zip(machine.joints, machine.model.effortLimit.tolist(), strict=False))
    for i, joint in enumerate(machine.driven_joints):
        column, effort = machine.active.index(joint), limits.get(joint, np.inf)
        inertia, is_assumed = float(inertias[column]), not 0.0 < effort < 1e9
        if is_assumed:
            force = inertia * _ACCELERATIONS[machine.unit(joint)]
            effort = float(2.0 * abs(weights[column]) + force)
        yield {
            "name": joint, "joint": joint, "index": first + i, "neutral": 0.0, "full": effort,
            "overlap": 0.0, "column": column, "braking": inertia * rate,
            "assumed": is_assumed,
        }  # fmt: skip


def _braking_rate(dynamics: Dynamics, home: Array) -> float:
    """Rate at which speeds are braked, by forces that are updated every `INTERVAL` [1/s].

    With D the diagonal of the mass matrix M at home, forces -rate D v stop every motion near home
    within some intervals: the largest eigenvalue of rate M^-1 D is well below 1 / interval. It is
    0 near configurations where inertias vanish.
    """
    inertias, fastest = np.diag(np.diagonal(dynamics.mass_matrix(home))), 1.0
    units = dynamics.machine.closure.units[dynamics.machine.closure.active]
    for shares in np.random.default_rng(1).uniform(-_NEAR_HOME, _NEAR_HOME, (8, len(home))):
        with suppress(CraneError, np.linalg.LinAlgError):
            mass = dynamics.mass_matrix(home + shares * units)
            values = np.linalg.eigvals(np.linalg.solve(mass, inertias)).real
            fastest = max(fastest, float(values.max()))
    if fastest > _MAX_INERTIA_RATIO:
        return 0.0
    return min(1.0 / _BRAKING_TIME, _BRAKED_SHARE / (fastest * INTERVAL))


def _roles(
    machine: Machine, levers: list[dict[str, Any]]
) -> Iterator[tuple[str, float, tuple[str, str]]]:
    """Role, sign and words of each lever; "" for those beside the sticks."""
    slewing = None if machine.tip is None else find_slewing_joint(machine, machine.tip)
    roles = list(ROLES) if slewing is None and len(levers) > 3 else list(ROLES[1:])
    for lever in levers:
        column = machine.active.index(lever["joint"])
        if slewing is not None and column == slewing[0]:
            yield "slew", -slewing[2], ("right", "left")
            continue
        role = roles.pop(0) if roles else ""
        out, up = _tip_motion(machine, column)
        sign, words = {
            "boom": (-np.sign(up), ("down", "up")), "stick": (np.sign(out), ("out", "in")),
            "tool": (np.sign(out), ("out", "in")),
        }.get(role, (0.0, ("+", "\u2212")))  # fmt: skip
        yield role, float(sign or 1.0), words if sign else ("+", "\u2212")


def _tip_motion(machine: Machine, column: int) -> tuple[float, float]:
    """Motion of the tip outwards and up by an active coordinate at home; 0 without a tip."""
    if machine.tip is None:
        return 0.0, 0.0
    home = machine.home[machine.closure.active]
    step = _STEP if home[column] + _STEP <= machine.upper[column] else -_STEP
    kinematics = Kinematics(machine)
    try:
        ahead = kinematics.position(home + step * np.eye(len(home))[column])
    except CraneError:  # at a dead centre, say
        return 0.0, 0.0
    tip: Array = kinematics.position(home)
    motion = (ahead - tip) / step
    up = machine.up_direction
    level = tip - (tip @ up) * up
    rates = np.array([motion @ level / (np.linalg.norm(level) or 1.0), motion @ up])
    rates[np.abs(rates) < 1e-6 * np.abs(motion).max(initial=1e-9)] = 0.0
    return float(rates[0]), float(rates[1])
