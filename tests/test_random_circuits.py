"""Random circuits, also damaged and starved ones, keep their balances or end with one line."""

import pytest
from random_circuits import bounded


@pytest.mark.slow
@pytest.mark.parametrize(
    "first", [0, *(pytest.param(x, marks=pytest.mark.long) for x in (10, 20, 30))]
)
def test_random_circuits_balance(first):
    """Oil and energy to 1e-6 of what went through, within a minute each."""
    found = [bounded(seed) for seed in range(first, first + 10)]
    assert not [one for one in found if one.bad]
    assert sum(one.what == "runs" for one in found) > 5
