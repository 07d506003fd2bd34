"""Points of a grid that lie within a patch of postures."""

import numpy as np
from numpy.typing import NDArray

from crane.common.samples import Array
from crane.motion.workspaces.patch import Patch

_BEYOND = 0.5  # of a triangle at a patch's border, that a posture is sought beyond it
_TOUCHES = 1e-9  # of a triangle


def within(
    patch: Patch, nodes: Array, axes: tuple[Array, Array]
) -> tuple[NDArray[np.intp], Array]:
    """Points of a grid within a patch, and postures close to them.

    A cell is two triangles, between whose corners postures are interpolated. Those of cells at the
    border, and at folds, reach beyond it, where the patch ends or turns back in a curve.

    Args:
        patch: The patch.
        nodes: (a, b, 2) where its nodes are in the section, NaN where open.
        axes: Coordinates of the grid.

    Returns:
        (M,) indices of points, the first coordinate fastest, and (M, nq) postures.
    """
    around = ((slice(-1), slice(-1)), (slice(1, None), slice(-1)),
              (slice(1, None), slice(1, None)), (slice(-1), slice(1, None)))  # fmt: skip
    full = np.stack([patch.closed[x] for x in around]).all(axis=0)
    padded = np.pad(full, 1)
    inner = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    inner &= _alike(nodes)
    corners = np.stack([nodes[x] for x in around], axis=2)[full]
    postures = np.stack([patch.q[x] for x in around], axis=2)[full]
    beyond = np.where(inner[full], _TOUCHES, _BEYOND)
    three = [[0, 1, 2], [0, 2, 3]]
    corners, postures = (x[:, three].reshape(-1, 3, x.shape[-1]) for x in (corners, postures))
    return _within(corners, postures, np.repeat(beyond, 2), axes)


def _alike(nodes: Array) -> NDArray[np.bool_]:
    """Which cells (a - 1, b - 1) are turned the same way as those beside them: not at a fold."""
    along, across = nodes[1:] - nodes[:-1], nodes[:, 1:] - nodes[:, :-1]
    one, two = along[:, :-1], across[:-1]
    turned = np.sign(one[..., 0] * two[..., 1] - one[..., 1] * two[..., 0])
    far = np.pad(turned, 1, mode="edge")
    beside = (far[:-2, 1:-1], far[2:, 1:-1], far[1:-1, :-2], far[1:-1, 2:])
    return np.all([turned == x for x in beside], axis=0)


def _within(
    corners: Array, postures: Array, beyond: Array, axes: tuple[Array, Array]
) -> tuple[NDArray[np.intp], Array]:
    """Points of a grid within triangles (T, 3, 2), and postures between those of the corners."""
    low, high = corners.min(axis=1), corners.max(axis=1)
    more = beyond[:, None] * (high - low)
    first = [np.searchsorted(x, low[:, k] - more[:, k]) for k, x in enumerate(axes)]
    last = [np.searchsorted(x, high[:, k] + more[:, k], "right") for k, x in enumerate(axes)]
    size = [b - a for a, b in zip(first, last, strict=True)]
    every = size[0] * size[1]
    which = np.repeat(np.arange(len(corners)), every)
    k = np.arange(len(which)) - np.repeat(np.cumsum(every) - every, every)
    i, j = first[0][which] + k % size[0][which], first[1][which] + k // size[0][which]
    point = np.column_stack([axes[0][i], axes[1][j]])
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]
    away = point - corners[which, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        second = (away[:, 0] * two[which, 1] - away[:, 1] * two[which, 0]) / area[which]
        third = (one[which, 0] * away[:, 1] - one[which, 1] * away[:, 0]) / area[which]
    shares = np.column_stack([1.0 - second - third, second, third])
    hit = (shares >= -beyond[which, None]).all(axis=1)
    which, shares = which[hit], shares[hit]
    q = np.einsum("tk,tkq->tq", shares, postures[which])
    return np.asarray(j[hit] * len(axes[0]) + i[hit]), q
