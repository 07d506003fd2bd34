"""An axis that keeps a linkage from moving in its plane, which shows as other errors."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
import pinocchio as pin

from crane.closure.equations import LoopEquations, frame_id
from crane.common.errors import CraneError, MechanismError
from crane.common.samples import Array
from crane.description import LoopSpec, MachineSpec

_PARALLEL = 1e-6  # sine of an angle that counts as none
_TURNING = ("revolute", "cylindrical", "planar")  # loops whose axis is normal to their plane


def wrong_axis(
    spec: MachineSpec,
    model: pin.Model,
    loops: Sequence[LoopSpec],
    close: Callable[[MachineSpec, Sequence[LoopSpec]], object],
) -> MechanismError | None:
    """The error about an axis, if there is one with which the machine closes once it is turned.

    In a plane all axes of a ring that turn are parallel, and all that slide are at right angles
    to them. Where that holds for all joints of a ring and its loop but one, that one is turned
    and the machine closed anew.

    Args:
        spec: The machine as read.
        model: Its tree.
        loops: Its loops.
        close: Assembles and closes a machine with some loops, or raises.
    """
    equations = LoopEquations(model, loops, spec.couplings)
    data = model.createData()
    # at zero a wrong axis has turned nothing out of the plane yet
    coordinates = equations.coordinates
    at = coordinates.configuration(np.zeros(model.nv))
    jacobian = pin.computeJointJacobians(model, data, at).reshape(6, -1)
    sliding, names = coordinates.slides, coordinates.names
    for index, loop in enumerate(loops):
        if loop.type not in (*_TURNING, "prismatic"):
            continue
        ring = [int(i) for i in np.flatnonzero(equations.sign[index])]
        axes = [[jacobian[:3, i] if sliding[i] else jacobian[3:, i]] for i in ring]
        axes.append([
            (data.oMi[joint].rotation @ place.rotation)[:, 2]
            for joint, place in equations.frames[2 * index : 2 * index + 2]
        ])  # fmt: skip
        turns = [not sliding[i] for i in ring] + [loop.type in _TURNING]
        labels = [*(names[i] for i in ring), f"loop {loop.name}"]
        for odd, normal in _odd_ones(axes, turns):
            column = ring[odd] if odd < len(ring) else None
            if column is not None and not model.existJointName(names[column]):
                continue  # of a body that floats, which has no axes
            frame = _frame_of(model, data, loop if column is None else names[column])
            turned = _turned(frame.T @ axes[odd][0], frame.T @ normal, turns[odd])
            changed, some = spec, list(loops)
            if column is None:
                some[index] = dataclasses.replace(loop, axis=turned)
            else:
                changed = _with_axis(spec, names[column], turned)
            try:
                close(changed, some)
            except CraneError:
                continue
            others = [x for k, x in enumerate(labels) if k != odd and turns[k]]
            return _error(spec, labels[odd], axes[odd][0], normal, turned, turns[odd], others)
    return None


def _frame_of(model: pin.Model, data: pin.Data, of: LoopSpec | str) -> Array:
    """Axes (3, 3) of the frame that the axis of a loop is written in, or of a joint's."""
    if isinstance(of, LoopSpec):
        link = model.frames[frame_id(model, of.predecessor)]
        frame: Array = data.oMi[link.parentJoint].rotation @ link.placement.rotation
    else:
        joint = model.getJointId(of)
        above = data.oMi[model.parents[joint]].rotation
        frame = above @ model.jointPlacements[joint].rotation
    return frame


def _odd_ones(axes: list[list[Array]], turns: list[bool]) -> list[tuple[int, Array]]:
    """Those whose axes do not fit where all others move in one plane, and its normal.

    Args:
        axes: Directions (3,) of each joint, of a loop in both its frames.
        turns: Whether each turns about its axis, else slides along it.
    """

    def fits(k: int, normal: Array) -> bool:
        off = [np.linalg.norm(np.cross(a, normal)) if turns[k] else a @ normal for a in axes[k]]
        return bool(np.abs(off).max() < _PARALLEL)

    found = []
    for odd in range(len(axes)):
        turning = [k for k in range(len(axes)) if turns[k] and k != odd]
        if len(turning) < 2:
            continue
        normal = axes[turning[0]][0]
        rest = [k for k in range(len(axes)) if k != odd]
        if not fits(odd, normal) and all(fits(k, normal) for k in rest):
            found.append((odd, normal))
    return found


def _turned(axis: Array, normal: Array, turns: bool) -> tuple[float, float, float]:
    """The direction nearest to an axis that fits a plane, both in the frame it is written in."""
    right = normal * (np.sign(axis @ normal) or 1.0) if turns else axis - normal * (axis @ normal)
    if np.linalg.norm(right) < _PARALLEL:  # a slide out of the plane may mean any in it
        right = np.cross(np.eye(3)[np.abs(normal).argmin()], normal)
    right = right / np.linalg.norm(right)
    right = np.where(np.abs(right) < 1e-9, 0.0, right)
    if turns and abs(axis @ normal) < _PARALLEL and right[np.abs(right).argmax()] < 0:
        right = -right
    x, y, z = (float(value) + 0.0 for value in right)
    return x, y, z


def _with_axis(spec: MachineSpec, name: str, axis: tuple[float, float, float]) -> MachineSpec:
    joint = dataclasses.replace(spec.tree.joints[name], axis=axis)
    return dataclasses.replace(spec, tree=spec.tree.replacing(joint))


def _error(
    spec: MachineSpec,
    label: str,
    axis: Array,
    normal: Array,
    turned: tuple[float, float, float],
    turns: bool,
    others: list[str],
) -> MechanismError:
    share = abs(float(axis @ normal))
    angle = np.degrees(np.arccos(min(1.0, share)) if turns else np.arcsin(min(1.0, share)))
    is_loop = label.startswith("loop ")
    what = f"loop '{label.removeprefix('loop ')}'" if is_loop else f"joint '{label}'"
    place = spec.where.get(label, spec.path.name) if is_loop else spec.tree.joints[label].where
    numbers = [f"{value:.6g}" for value in turned]
    in_xml = not is_loop or spec.path.suffix.lower() != ".yaml"
    right = f'<axis xyz="{" ".join(numbers)}"/>' if in_xml else f"axis: [{', '.join(numbers)}]"
    against = "those of" if turns else "the plane that is normal to"
    return MechanismError(
        f"{place}: {what}: its axis is {angle:.3g} degrees off {against} its neighbours "
        f"{', '.join(others)}, so that it cannot move with them: turn it to {right}",
        label if is_loop else f"joint {label}",
    )
