"""Markers of a page: forces of drives and loads, springs and dampers."""

from typing import Any

import numpy as np

from crane.common.samples import Array
from crane.description.force_elements import ForceElement, GasSpring
from crane.dynamics.frame_jacobians import FrameDistances
from crane.machine.machine import Machine
from crane.recordings.recording import Recording
from crane.view.page.page_motion import frame_data, pack_base64
from crane.view.page.scene import largest_body_extent

_FULL_ARROW_PERCENTILE = (
    99.5  # percentile of the forces that has a full arrow: a single spike does not count
)
_MIN_WEIGHT_SHARE = (
    1e-6  # share of the machine's weight on earth that is rounding noise, as a force or torque
)
_SAMPLED_CONFIGURATIONS = 300  # configurations that determine the shortest length


def actuator_markers(
    machine: Machine, recording: Recording, rows: np.ndarray
) -> list[dict[str, Any]]:
    """Return position and force over time of the driven joints, as shares of a full arrow."""
    model = machine.model
    loop_links = [loop.successor for loop in machine.closure.equations.loops]
    loop_links += [loop.predecessor for loop in machine.closure.equations.loops]
    loop_frames = [frame_data(machine, end) for end in loop_links]
    forces = {x: recording.tau[:, recording.joints.index(x)] for x in machine.driven_joints}
    zero_threshold = _MIN_WEIGHT_SHARE * 9.81 * sum(x.mass for x in model.inertias)
    full_arrow = full_arrow_forces(
        machine,
        {
            x: float(np.percentile(np.abs(force), _FULL_ARROW_PERCENTILE))
            for x, force in forces.items()
        },
    )
    markers = []
    for joint, force in forces.items():
        index = int(machine.coordinates.joints[machine.column(joint)]) - 1
        shown_force = force[rows]
        pin_frames = (
            [frame for frame in loop_frames if frame["joint"] == index]
            if (machine.unit(joint) == "m")
            else []
        )
        markers.append(
            {
                "joint": index,
                "at": pin_frames[0]["placement"][12:15] if pin_frames else [0.0, 0.0, 0.0],
                "name": joint,
                "share": pack_base64(
                    np.where(np.abs(shown_force) > zero_threshold, shown_force, 0.0)
                    / full_arrow[joint],
                    "f4",
                ),
            }
        )
    return markers


def full_arrow_forces(machine: Machine, peaks: dict[str, float]) -> dict[str, float]:
    """Return the force of each driven joint that is drawn as a full arrow [N], [N m].

    Forces are scaled by the effort limits if all joints have one, so that arrows show the
    utilization of each drive. Otherwise torques are divided by the length of the longest body. The
    joint with the largest scaled force has a full arrow at its peak.

    Args:
        machine: The machine.
        peaks: Largest force or torque of each joint.
    """
    limits = [machine.model.effortLimit[machine.column(joint)] for joint in peaks]
    if all(0 < limit < np.inf for limit in limits):
        reference_forces = dict(zip(peaks, map(float, limits), strict=True))
    else:
        reference_forces = {
            joint: 1.0 if machine.unit(joint) == "m" else largest_body_extent(machine)
            for joint in peaks
        }
    largest_ratio = (
        max((peak / reference_forces[joint] for joint, peak in peaks.items()), default=0.0) or 1.0
    )
    return {
        joint: largest_ratio * reference_force
        for joint, reference_force in reference_forces.items()
    }


def load_markers(machine: Machine, recording: Recording, rows: np.ndarray) -> list[dict[str, Any]]:
    """Return frame and force over time of external forces, as shares of the largest."""
    known_forces = [
        *machine.external_forces,
        *(x for task in machine.tasks.values() for x in task.loads),
    ]
    frames = {link: link for link in machine.tree.links} | {x.name: x.frame for x in known_forces}
    channels, forces = recording.channels, {}
    for column in channels:
        name = column.removeprefix("load_").removesuffix("_force_x")
        if column == f"load_{name}_force_x" and name in frames:
            forces[name] = [
                np.zeros(len(recording.time)) if x is None else x
                for x in (channels.get(f"load_{name}_force_{axis}") for axis in "xyz")
            ]
    for name in machine.supports:
        if f"support_{name}" in channels and name not in forces:
            forces[name] = [np.zeros(len(recording.time))] * 2 + [channels[f"support_{name}"]]
    if not forces:
        return []
    full_arrow = (
        float(
            np.percentile(
                np.maximum.reduce([np.linalg.norm(force, axis=0) for force in forces.values()]),
                _FULL_ARROW_PERCENTILE,
            )
        )
        or 1.0
    )
    return [
        {
            "name": name, "place": frame_data(machine, frames[name]), "full": full_arrow,
            "share": [pack_base64((x / full_arrow)[rows], "f4") for x in force],
        }
        for name, force in forces.items()
    ]  # fmt: skip


def spring_markers(machine: Machine, q: Array) -> list[dict[str, Any]]:
    """Return the force elements between two frames: ends, symbols and lengths.

    Springs are drawn as coils, dampers and gas springs as struts, others as lines.

    Args:
        machine: The machine.
        q: (N, nq) configurations of the page.
    """
    element_pairs = [
        (element, element.between)
        for element in machine.force_elements
        if element.between is not None
    ]
    if not element_pairs:
        return []
    lengths = FrameDistances(machine, [pair for _, pair in element_pairs])
    sampled_configurations = q[
        np.unique(np.linspace(0, len(q) - 1, _SAMPLED_CONFIGURATIONS).astype(int))
    ]
    sampled_lengths, home_lengths = (
        lengths.evaluate(sampled_configurations)[0],
        lengths.evaluate(machine.home)[0],
    )
    markers = []
    for i, (item, pair) in enumerate(element_pairs):
        has_coil = isinstance(item, ForceElement) and item.stiffness > 0
        has_strut = (
            isinstance(item, GasSpring) or isinstance(item, ForceElement) and item.damping > 0
        )
        markers.append(
            {
                "name": f"{item.kind} {pair[0]}-{pair[1]}",
                "ends": [frame_data(machine, link) for link in pair],
                "parts": [x for x, is_ in (("coil", has_coil), ("strut", has_strut)) if is_]
                or ["line"],
                "length": float(home_lengths[i]),
                "least": float(sampled_lengths[:, i].min()),
            }
        )
    return markers
