"""Forces of resting joints: bounded least squares and independent rows."""

import numpy as np
import pytest
from scipy.linalg import qr
from scipy.optimize import lsq_linear

from crane.simulation.integration.stick_slip_modes import (
    _RANK_TOLERANCE,
    _bounded_least_squares,
    _independent_columns,
)


@pytest.mark.parametrize("over", [1e-10, 0.3, 3.0])
def test_shares_are_the_least_within_their_limits(over):
    """Most searches end at once: nothing is beyond, or an event has brought one joint there."""
    draw = np.random.default_rng(0)
    full = 0
    for _ in range(300):
        k = int(draw.integers(1, 5))
        reach = draw.normal(size=(int(draw.integers(k, 6)), k)) * 10 ** draw.uniform(-3, 3, k)
        shares = draw.uniform(-1.0, 1.0, k)
        shares[: draw.integers(k + 1)] *= 1.0 + over
        shares[0] = np.sign(shares[0]) * (1.0 + over)
        size = np.linalg.norm(reach, axis=0).max()
        net = reach @ shares + draw.normal(size=len(reach)) * 1e-2 * size
        found = _bounded_least_squares(reach, net)
        wanted = lsq_linear(reach, net, (-1.0, 1.0), method="bvls", tol=1e-15).x
        assert np.abs(found).max() <= 1.0 + 1e-15  # as scipy has it
        off = np.linalg.norm(reach * (found - wanted), axis=0).max()
        assert off <= 1e-12 * size
        full += int((np.abs(found) >= 1.0).sum())
    assert full > 200


@pytest.mark.parametrize("near", [0.0, 1e-12, 3e-9, 1e-6, 1.0])
def test_independent_columns_are_those_of_a_pivoted_qr(near):
    draw = np.random.default_rng(1)
    for _ in range(200):
        n, k = int(draw.integers(1, 6)), int(draw.integers(0, 6))
        columns = draw.normal(size=(n, k)) * 10 ** draw.uniform(-6, 6, k)
        if k > 1 and draw.random() < 0.7:  # one that nearly follows from the others
            size = np.linalg.norm(columns[:, -1])
            columns[:, -1] *= near
            columns[:, -1] += size * columns[:, 0] / np.linalg.norm(columns[:, 0])
        if k and draw.random() < 0.2:
            columns[:, draw.integers(k)] = 0.0
        kept, rank = _independent_columns(columns)
        if not k:
            assert (len(kept), rank) == (0, 0)
            continue
        upper, order = qr(columns, mode="r", pivoting=True)
        sizes = np.abs(np.diag(upper))
        own = np.linalg.norm(columns, axis=0)[order[: len(sizes)]]
        independent = sizes > _RANK_TOLERANCE * own
        assert rank == independent.sum()
        assert set(kept) == set(order[:rank])
