"""Diagnosis of joint axes that keep a planar linkage from moving."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
import pinocchio as pin

from crane.closure.loop_equations import LoopEquations, frame_id
from crane.common.errors import CraneError, MechanismError
from crane.common.samples import Array
from crane.description.specification import LoopSpec, MachineSpec

_PARALLEL_TOLERANCE = 1e-6  # sine of an angle that counts as zero
_REVOLUTE_LOOP_TYPES = (
    "revolute",
    "cylindrical",
    "planar",
)  # loop types whose axis is normal to the plane


def find_wrong_axis(
    spec: MachineSpec,
    model: pin.Model,
    loops: Sequence[LoopSpec],
    close_loops: Callable[[MachineSpec, Sequence[LoopSpec]], object],
) -> MechanismError | None:
    """Find a wrong axis: one with which the machine closes after correction.

    In a planar linkage all revolute axes of a loop are parallel, and prismatic ones perpendicular
    to them. Where this holds for all joints of a loop but one, the axis of that one is corrected
    and the machine closed again.

    Args:
        spec: The machine as read.
        model: Its tree.
        loops: Its loops.
        close_loops: Assembles and closes a machine with some loops, or raises.

    Returns:
        The error to report, None if no axis is wrong.
    """
    equations = LoopEquations(model, loops, spec.couplings)
    data = model.createData()
    # at zero coordinates a wrong axis has not moved anything out of the plane
    coordinates = equations.coordinates
    jacobian = pin.computeJointJacobians(
        model, data, coordinates.configuration(np.zeros(model.nv))
    ).reshape(6, -1)
    sliding, names = coordinates.is_translation, coordinates.names
    for index, loop in enumerate(loops):
        if loop.type not in (*_REVOLUTE_LOOP_TYPES, "prismatic"):
            continue
        loop_columns = [int(i) for i in np.flatnonzero(equations.sign[index])]
        axes = [[jacobian[:3, i] if sliding[i] else jacobian[3:, i]] for i in loop_columns]
        axes.append([
            (data.oMi[joint].rotation @ place.rotation)[:, 2]
            for joint, place in equations.frames[2 * index : 2 * index + 2]
        ])  # fmt: skip
        is_rotation = [not sliding[i] for i in loop_columns] + [loop.type in _REVOLUTE_LOOP_TYPES]
        labels = [*(names[i] for i in loop_columns), f"loop {loop.name}"]
        for odd, normal in _misaligned_axes(axes, is_rotation):
            column = loop_columns[odd] if odd < len(loop_columns) else None
            if column is not None and not model.existJointName(names[column]):
                continue  # a floating base has no axes
            # axes of the frame in which the axis is written
            frame = (
                pin.updateFramePlacement(model, data, frame_id(model, loop.predecessor))
                if column is None
                else data.oMi[model.getJointId(names[column])]
            ).rotation
            corrected_axis = _corrected_axis(
                frame.T @ axes[odd][0], frame.T @ normal, is_rotation[odd]
            )
            changed, changed_loops = spec, list(loops)
            if column is None:
                changed_loops[index] = dataclasses.replace(loop, axis=corrected_axis)
            else:
                joint = dataclasses.replace(spec.tree.joints[names[column]], axis=corrected_axis)
                changed = dataclasses.replace(spec, tree=spec.tree.with_parts(joint))
            try:
                close_loops(changed, changed_loops)
            except CraneError:
                continue
            others = [x for k, x in enumerate(labels) if k != odd and is_rotation[k]]
            return _wrong_axis_error(
                spec, labels[odd], axes[odd][0], normal, corrected_axis, is_rotation[odd], others
            )
    return None


def _misaligned_axes(axes: list[list[Array]], is_rotation: list[bool]) -> list[tuple[int, Array]]:
    """Indices of single axes that do not fit the plane of all others, and the plane's normal.

    Args:
        axes: Directions (3,) of each joint; of a loop in both its frames.
        is_rotation: Whether each joint is revolute, else prismatic.
    """

    def fits(k: int, normal: Array) -> bool:
        off = [
            np.linalg.norm(np.cross(a, normal)) if is_rotation[k] else a @ normal for a in axes[k]
        ]
        return bool(np.abs(off).max() < _PARALLEL_TOLERANCE)

    found = []
    for odd in range(len(axes)):
        turning = [k for k in range(len(axes)) if is_rotation[k] and k != odd]
        if len(turning) < 2:
            continue
        normal = axes[turning[0]][0]
        rest = [k for k in range(len(axes)) if k != odd]
        if not fits(odd, normal) and all(fits(k, normal) for k in rest):
            found.append((odd, normal))
    return found


def _corrected_axis(axis: Array, normal: Array, is_rotation: bool) -> tuple[float, float, float]:
    """The direction nearest to an axis that fits a plane, in the frame of the axis."""
    corrected = (
        normal * (np.sign(axis @ normal) or 1.0)
        if is_rotation
        else axis - normal * (axis @ normal)
    )
    if (
        np.linalg.norm(corrected) < _PARALLEL_TOLERANCE
    ):  # a prismatic axis normal to the plane: any direction in the plane
        corrected = np.cross(np.eye(3)[np.abs(normal).argmin()], normal)
    corrected = corrected / np.linalg.norm(corrected)
    corrected = np.where(np.abs(corrected) < 1e-9, 0.0, corrected)
    if (
        is_rotation
        and abs(axis @ normal) < _PARALLEL_TOLERANCE
        and corrected[np.abs(corrected).argmax()] < 0
    ):
        corrected = -corrected
    x, y, z = (float(value) + 0.0 for value in corrected)
    return x, y, z


def _wrong_axis_error(
    spec: MachineSpec,
    label: str,
    axis: Array,
    normal: Array,
    corrected_axis: tuple[float, float, float],
    is_rotation: bool,
    others: list[str],
) -> MechanismError:
    share = abs(float(axis @ normal))
    angle = np.degrees(np.arccos(min(1.0, share)) if is_rotation else np.arcsin(min(1.0, share)))
    is_loop = label.startswith("loop ")
    what = f"loop '{label.removeprefix('loop ')}'" if is_loop else f"joint '{label}'"
    place = (
        spec.source_locations.get(label, spec.path.name)
        if is_loop
        else spec.tree.joints[label].source_location
    )
    numbers = [f"{value:.6g}" for value in corrected_axis]
    in_xml = not is_loop or spec.path.suffix.lower() != ".yaml"
    right = f'<axis xyz="{" ".join(numbers)}"/>' if in_xml else f"axis: [{', '.join(numbers)}]"
    against = "those of" if is_rotation else "the plane that is normal to"
    return MechanismError(
        f"{place}: {what}: its axis is {angle:.3g} degrees off {against} its neighbours "
        f"{', '.join(others)}, so that it cannot move with them: turn it to {right}",
        label if is_loop else f"joint {label}",
    )
