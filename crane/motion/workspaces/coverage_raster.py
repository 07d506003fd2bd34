"""The area that patches cover in the section."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_closing

from crane.common.samples import Array

_RASTER_POINTS = 800  # along the longer side


class CoverageRaster:
    """Points of a fine grid over the section, and which of them some cell covers.

    Args:
        points: (N, 2) all that is to be covered lies among them [m].

    Attributes:
        u: (W,) first coordinates of the points [m].
        w: (H,) second coordinates [m].
        covered: (H, W).
    """

    def __init__(self, points: Array):
        low, high = points.min(axis=0), points.max(axis=0)
        self.spacing = (float((high - low).max()) or 1.0) / _RASTER_POINTS  # any of a single point
        count = np.ceil((high - low) / self.spacing).astype(int) + 3
        self.u = low[0] + self.spacing * (np.arange(count[0]) - 0.5)
        self.w = low[1] + self.spacing * (np.arange(count[1]) - 0.5)
        self.covered: NDArray[np.bool_] = np.zeros((count[1], count[0]), dtype=bool)

    @property
    def area(self) -> float:
        """Of what is covered [m2]."""
        return float(self.covered.sum()) * self.spacing**2

    def fill_cracks(self, width: int) -> Array:
        """(H, W) 1 where covered or in a crack of at most 2 width points, else 0."""
        padded = np.pad(self.covered, width + 1)
        return binary_closing(padded, iterations=width)[
            width + 1 : -width - 1, width + 1 : -width - 1
        ].astype(np.float64)

    def cover(self, triangles: Array) -> None:
        """Cover all points within triangles (N, 3, 2)."""
        start = np.array([self.u[0], self.w[0]])
        grid_positions = (triangles - start) / self.spacing
        low = np.maximum(np.ceil(grid_positions.min(axis=1) - 1e-9).astype(int), 0)
        high = np.floor(grid_positions.max(axis=1) + 1e-9).astype(int) + 1
        for corners, (x0, y0), (x1, y1) in zip(grid_positions, low, high, strict=True):
            if x1 <= x0 or y1 <= y0:
                continue
            block = self.covered[y0:y1, x0:x1]
            if block.all():
                continue
            x, y = np.arange(x0, x1), np.arange(y0, y1)[:, None]
            edge_functions = []
            for (ax, ay), (bx, by) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
                edge_functions.append((bx - ax) * (y - ay) - (by - ay) * (x - ax))
            is_inside = (np.minimum.reduce(edge_functions) >= -1e-9) | (
                np.maximum.reduce(edge_functions) <= 1e-9
            )
            block |= is_inside
