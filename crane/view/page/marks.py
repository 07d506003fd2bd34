"""What a page draws on the machine: forces of its drives and loads, springs between its bodies."""

from typing import TYPE_CHECKING, Any

import numpy as np

from crane.common.samples import Array
from crane.description.spec import ForceElement, GasSpring
from crane.dynamics.lengths import Lengths
from crane.machine import Machine
from crane.view.page.arrays import packed
from crane.view.page.motion import place
from crane.view.page.visuals import longest

if TYPE_CHECKING:
    from crane.recordings.recording import Recording

_FULL = 99.5  # percentile of the forces that has a full arrow: a single spike does not count
_NOTHING = 1e-6  # share of the machine's weight that is rounding noise, as a force or torque
_LOOKED_AT = 300  # postures that tell how short a strut gets


def actuators(machine: Machine, recording: "Recording", rows: np.ndarray) -> list[dict[str, Any]]:
    """Where the driven joints act and how strongly, in shares of what has a full arrow."""
    model = machine.model
    ends = [loop.successor for loop in machine.closure.equations.loops]
    ends += [loop.predecessor for loop in machine.closure.equations.loops]
    places = [place(machine, end) for end in ends]
    forces = {x: recording.tau[:, recording.joints.index(x)] for x in machine.driven_joints}
    nothing = _NOTHING * 9.81 * sum(inertia.mass for inertia in model.inertias)
    full = full_arrows(
        machine, {x: float(np.percentile(np.abs(force), _FULL)) for x, force in forces.items()}
    )
    found = []
    for joint, force in forces.items():
        index, shown = model.getJointId(joint) - 1, force[rows]
        slides = machine.unit(joint) == "m"
        eyes = [there for there in places if there["joint"] == index] if slides else []
        share = np.where(np.abs(shown) > nothing, shown, 0.0) / full[joint]
        found.append(
            {
                "joint": index,
                "at": eyes[0]["placement"][12:15] if eyes else [0.0, 0.0, 0.0],
                "name": joint,
                "share": packed(share, "f4"),
            }
        )
    return found


def full_arrows(machine: Machine, peaks: dict[str, float]) -> dict[str, float]:
    """The force or torque of each driven joint that has a full arrow [N or N m].

    In proportion to their limits (`effort`) where all have one, so that arrows tell how hard each
    works for what it can. Else to forces, torques by the longest body as their lever. The joint
    that is largest by that has a full arrow at its peak.

    Args:
        machine: The machine.
        peaks: Largest force or torque of each joint.
    """
    limits = [machine.model.effortLimit[machine.column(joint)] for joint in peaks]
    if all(0 < limit < np.inf for limit in limits):
        whole = dict(zip(peaks, map(float, limits), strict=True))
    else:
        lever = longest(machine)
        whole = {joint: 1.0 if machine.unit(joint) == "m" else lever for joint in peaks}
    most = max((peak / whole[joint] for joint, peak in peaks.items()), default=0.0) or 1.0
    return {joint: most * one for joint, one in whole.items()}


def loads(machine: Machine, recording: "Recording", rows: np.ndarray) -> list[dict[str, Any]]:
    """Where forces from outside act and how strongly, in shares of the largest."""
    known = [*machine.external, *(x for task in machine.tasks.values() for x in task.loads)]
    frames = {link: link for link in machine.tree.links} | {x.name: x.frame for x in known}
    seen, forces = recording.channels, {}
    for column in seen:
        name = column.removeprefix("load_").removesuffix("_force_x")
        if column == f"load_{name}_force_x" and name in frames:
            axes = (seen.get(f"load_{name}_force_{axis}") for axis in "xyz")
            forces[name] = [np.zeros(len(recording.time)) if x is None else x for x in axes]
    for name in machine.supports:
        if f"support_{name}" in seen and name not in forces:
            forces[name] = [np.zeros(len(recording.time))] * 2 + [seen[f"support_{name}"]]
    if not forces:
        return []
    sizes = [np.linalg.norm(force, axis=0) for force in forces.values()]
    full = float(np.percentile(np.maximum.reduce(sizes), _FULL)) or 1.0
    return [
        {
            "name": name, "place": place(machine, frames[name]), "full": full,
            "share": [packed((x / full)[rows], "f4") for x in force],
        }
        for name, force in forces.items()
    ]  # fmt: skip


def springs(machine: Machine, q: Array) -> list[dict[str, Any]]:
    """What acts between two frames of a machine: where, what it looks like, and its lengths.

    A coil where there is a spring, a strut where there is a damper or gas, else a line.

    Args:
        machine: The machine.
        q: (N, nq) postures that are shown.
    """
    there = [(item, item.between) for item in machine.elements if item.between is not None]
    if not there:
        return []
    lengths = Lengths(machine, [pair for _, pair in there])
    some = q[np.unique(np.linspace(0, len(q) - 1, _LOOKED_AT).astype(int))]
    every, home = lengths.at(some)[0], lengths.at(machine.home)[0]
    found = []
    for i, (item, pair) in enumerate(there):
        coil = isinstance(item, ForceElement) and item.stiffness > 0
        strut = isinstance(item, GasSpring) or isinstance(item, ForceElement) and item.damping > 0
        found.append(
            {
                "name": f"{item.kind} {pair[0]}-{pair[1]}",
                "ends": [place(machine, link) for link in pair],
                "parts": [x for x, is_ in (("coil", coil), ("strut", strut)) if is_] or ["line"],
                "length": float(home[i]),
                "least": float(every[:, i].min()),
            }
        )
    return found
