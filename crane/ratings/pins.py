"""Forces in the pins of a machine that holds a load."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from crane.common.errors import InputError, known
from crane.common.samples import Array
from crane.dynamics.reactions import Reactions
from crane.machine import Machine

if TYPE_CHECKING:
    from crane.ratings.lifting import Capacity


class Pins:
    """Forces of pins at rest, on level ground, affine in a force F at a frame: R_0 + R_F F.

    A force has the components that statics determines at home, in the joint's own axes: those
    across a pin, and along it unless loops hold a planar linkage in its plane more often than
    needed, see `Reactions`.

    Args:
        machine: The machine.
        frame: Where the load hangs.
        names: Joints of the tree and loops; all whose forces statics determines if not given.

    Attributes:
        names: (p,) of the pins.

    Raises:
        InputError: An unknown name, or a pin of whose force statics determines nothing.
    """

    def __init__(self, machine: Machine, frame: str, names: Iterable[str] | None = None):
        self._reactions = reactions = Reactions(machine)
        self._frame = frame
        determined = reactions.determined(machine.home)[:, :3]
        if names is None:
            which = np.flatnonzero(determined.any(axis=1)).tolist()
        else:
            which = [self._index(name, determined) for name in names]
        self.names = tuple(reactions.names[k] for k in which)
        self._which, self._counts = which, determined[which]

    def _index(self, name: str, determined: NDArray[np.bool_]) -> int:
        names = self._reactions.names
        if name not in names:
            raise InputError(f"pin '{name}' is no joint or loop, {known(names, name)}")
        if not determined[names.index(name)].any():
            raise InputError(
                f"statics does not determine the force in pin '{name}', leave it out of 'pins'"
            )
        return names.index(name)

    def under(self, q: Array, unit: Array) -> tuple[Array, Array]:
        """The forces without load, and what a force at the frame adds.

        Args:
            q: (N, nq) closed postures.
            unit: (N, 3) that force in the world.

        Returns:
            Twice (N, p, 3) in the joints' own axes [N]; 0 for what statics does not determine.
        """
        if not len(q):
            return np.zeros((0, len(self.names), 3)), np.zeros((0, len(self.names), 3))
        reactions = self._reactions
        axes = reactions.axes(q)[:, self._which]
        without = reactions.at(q)[:, self._which, :3]
        adds = reactions.unit(q, self._frame)[:, self._which, :3] @ unit[:, None, :, None]
        own = np.einsum("npij,npix->npjx", axes, np.stack([without, adds[..., 0]], axis=-1))
        own *= self._counts[:, :, None]
        return own[..., 0], own[..., 1]


def pin_forces(chart: "Capacity") -> dict[str, Array]:
    """Forces in pins at every place, under its rated load, at rest on level ground.

    Args:
        chart: See `crane.capacity`.

    Returns:
        By joint and loop (s, b, a) [N], of the components that statics determines, see `Pins`;
        NaN where there is no load, or no end to it.

    Raises:
        InputError: The chart's ground leans.
        BranchEdgeError: The passive joints are not determined at a place.
    """
    if chart.slope:
        raise InputError(
            f"forces in pins are those on level ground, the chart's leans by "
            f"{np.rad2deg(chart.slope):.3g} degrees: rate without slope"
        )
    machine, here = chart.machine, np.isfinite(chart.loads)
    pins = Pins(machine, chart.frame)
    q = machine.closure.solve(np.ascontiguousarray(chart.q_a[here]))
    gravity = np.broadcast_to(machine.model.gravity.linear, (len(q), 3))
    without, adds = pins.under(q, gravity)
    found = np.linalg.norm(without + chart.loads[here][:, None, None] * adds, axis=2)
    out = {}
    for name, forces in zip(pins.names, found.T, strict=True):
        out[name] = np.full(chart.loads.shape, np.nan)
        out[name][here] = forces
    return out
