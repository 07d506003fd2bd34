"""Measured forces beside modelled ones."""

import math
from dataclasses import dataclass

import numpy as np

from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array


@dataclass(frozen=True, eq=False, repr=False)
class ForceComparison(OneLineRepr):
    """Measured and modelled forces of one recording, both through the same filter.

    Attributes:
        time: (M,) [s].
        measured: (M, n) [N], [N m].
        modelled: (M, n).
        is_moving: (M, n) which rows count: those away from zero velocity.
        joints: Names (n,).
    """

    time: Array
    measured: Array
    modelled: Array
    is_moving: np.ndarray
    joints: tuple[str, ...]

    @property
    def residuals(self) -> Array:
        """(M, n) measured less modelled."""
        return self.measured - self.modelled

    def _rms(self, values: Array) -> Array:
        squares = (np.where(self.is_moving, values, 0.0) ** 2).sum(axis=0)
        count = self.is_moving.sum(axis=0)
        return np.sqrt(
            np.divide(squares, count, out=np.full_like(squares, np.nan), where=count > 0)
        )

    @property
    def rmse(self) -> Array:
        """(n,) root mean square of the residuals [N], [N m], nan where nothing moves."""
        return self._rms(self.residuals)

    @property
    def relative_error(self) -> Array:
        """(n,) the same over the root mean square of the measured force, nan of a free one."""
        size = self._rms(self.measured)
        return np.divide(self.rmse, size, out=np.full_like(size, np.nan), where=size > 0)

    @property
    def percentage_error(self) -> Array:
        """(n,) equation (9) of the reduced-scale forwarder paper [%]: 100 relative^2."""
        return 100 * self.relative_error**2

    @property
    def overall_relative_error(self) -> float:
        """Norm of all residuals over that of all measured forces, nan where these are zero."""
        residual_norm, force_norm = (
            np.linalg.norm(x[self.is_moving]) for x in (self.residuals, self.measured)
        )
        return float(residual_norm / force_norm) if force_norm else math.nan
