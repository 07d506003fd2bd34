"""Forces in the pins of a machine that holds a load."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from crane.common.errors import InputError, suggest_names
from crane.common.samples import Array
from crane.dynamics.reactions import Reactions
from crane.machine import Machine

if TYPE_CHECKING:
    from crane.ratings.lifting_capacity import Capacity


class PinForces:
    """Forces of pins at rest, on level ground, affine in a force F at a frame: R_0 + R_F F.

    A force has the components that statics determines at home, in the joint's own axes: those
    across a pin, and along it unless loops hold a planar linkage in its plane more often than
    needed, see `Reactions`.

    Args:
        machine: The machine.
        frame: Where the load hangs.
        pin_names: Joints of the tree and loops; all whose forces statics determines if not given.

    Attributes:
        pin_names: (p,) of the pins.

    Raises:
        InputError: An unknown name, or a pin of whose force statics determines nothing.
    """

    def __init__(self, machine: Machine, frame: str, pin_names: Iterable[str] | None = None):
        self._reactions = reactions = Reactions(machine)
        self._frame = frame
        determined = reactions.statically_determined(machine.home)[:, :3]
        if pin_names is None:
            indices = np.flatnonzero(determined.any(axis=1)).tolist()
        else:
            indices = [self._index(name, determined) for name in pin_names]
        self.names = tuple(reactions.names[k] for k in indices)
        self._pin_indices, self._is_determined = indices, determined[indices]

    def _index(self, name: str, determined: NDArray[np.bool_]) -> int:
        pin_names = self._reactions.names
        if name not in pin_names:
            raise InputError(f"pin '{name}' is no joint or loop, {suggest_names(pin_names, name)}")
        if not determined[pin_names.index(name)].any():
            raise InputError(
                f"statics does not determine the force in pin '{name}', leave it out of 'pins'"
            )
        return pin_names.index(name)

    def load_forces(self, q: Array, unit_forces: Array) -> tuple[Array, Array]:
        """The forces without load, and what a force at the frame adds.

        Args:
            q: (N, nq) closed postures.
            unit_forces: (N, 3) that force in the world.

        Returns:
            Twice (N, p, 3) in the joints' own axes [N]; 0 for what statics does not determine.
        """
        if not len(q):
            return np.zeros((0, len(self.names), 3)), np.zeros((0, len(self.names), 3))
        reactions = self._reactions
        axes = reactions.joint_axes(q)[:, self._pin_indices]
        unloaded_forces = reactions.joint_wrenches(q)[:, self._pin_indices, :3]
        load_increments = (
            reactions.unit_load_wrenches(q, self._frame)[:, self._pin_indices, :3]
            @ unit_forces[:, None, :, None]
        )
        joint_axis_forces = np.einsum(
            "npij,npix->npjx", axes, np.stack([unloaded_forces, load_increments[..., 0]], axis=-1)
        )
        joint_axis_forces *= self._is_determined[:, :, None]
        return joint_axis_forces[..., 0], joint_axis_forces[..., 1]


def pin_forces(chart: "Capacity") -> dict[str, Array]:
    """Forces in pins at every place, under its rated load, at rest on level ground.

    Args:
        chart: See `crane.capacity`.

    Returns:
        By joint and loop (s, b, a) [N], of the components that statics determines, see
        `PinForces`; NaN where there is no load, or no end to it.

    Raises:
        InputError: The chart's ground leans.
        BranchEdgeError: The passive joints are not determined at a place.
    """
    if chart.ground_slope:
        raise InputError(
            f"forces in pins are those on level ground, the chart's leans by "
            f"{np.rad2deg(chart.ground_slope):.3g} degrees: rate without slope"
        )
    machine, has_load = chart.machine, np.isfinite(chart.loads)
    calculator = PinForces(machine, chart.frame)
    q = machine.closure.solve(np.ascontiguousarray(chart.q_a[has_load]))
    gravity = np.broadcast_to(machine.model.gravity.linear, (len(q), 3))
    unloaded_forces, load_increments = calculator.load_forces(q, gravity)
    magnitudes = np.linalg.norm(
        unloaded_forces + chart.loads[has_load][:, None, None] * load_increments, axis=2
    )
    out = {}
    for name, forces in zip(calculator.names, magnitudes.T, strict=True):
        out[name] = np.full(chart.loads.shape, np.nan)
        out[name][has_load] = forces
    return out
