"""Numbers that recordings cannot tell apart: directions in which all of them are known badly.

With R the correlations of the estimates and s their deviations, a change s_i v_i of every number
i, v an eigenvector of R to the eigenvalue m, has the deviation sqrt(m) |v|: directions of large m
are shared by several numbers. Those are looked for among numbers that lean on each other: strongly
in pairs, one after the other, or else all those that would be known much better if the others were
known, by the factor sqrt((R^-1)_ii) (the variance inflation, Marquardt 1970).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from crane.common.samples import Array

_PAIR_CORRELATION = 0.9  # correlation of numbers that lean on each other
_MIN_INFLATION = 3.0  # how many times as wide a number's interval is by the others
_MIN_SHARED_EIGENVALUE = 1.5  # eigenvalue of a direction that several numbers share
_MIN_COMPONENT = 0.25  # of a direction, of its largest component


def correlated_directions(
    names: Sequence[str], correlation: Array, half_widths: Array
) -> list[dict[str, float]]:
    """Changes of numbers that may be made together: by name, up to where an interval ends.

    Args:
        names: Of n numbers.
        correlation: (n, n) their correlations; 0 where a number is known exactly.
        half_widths: (n,) half of their intervals.
    """
    if len(correlation) < 2:
        return []
    found = []
    for group in filter(None, _correlated_groups(correlation)):
        sizes, directions = np.linalg.eigh(correlation[np.ix_(group, group)])
        v = directions[:, -1]
        v = v * np.sign(v[0]) / np.abs(v).max()
        parts = {names[i]: float(x * half_widths[i]) for i, x in zip(group, v, strict=True)
                 if abs(x) > _MIN_COMPONENT}  # fmt: skip
        if sizes[-1] > _MIN_SHARED_EIGENVALUE and len(parts) > 1:
            found.append(parts)
    return found


def _correlated_groups(correlation: Array) -> list[list[int]]:
    """Numbers that lean on each other, each in one group at most."""
    linked = np.abs(correlation) > _PAIR_CORRELATION
    groups, remaining = [], set(range(len(correlation)))
    while remaining:
        group = _connected_component(linked, min(remaining))
        remaining -= set(group)
        groups.append(group)
    singles = [group[0] for group in groups if len(group) == 1]
    inverse = np.linalg.pinv(correlation, rcond=1e-12, hermitian=True)
    inflated = np.sqrt(np.maximum(np.diag(inverse), 0.0)) > _MIN_INFLATION
    pairs = [group for group in groups if len(group) > 1]
    return [*pairs, [i for i in singles if inflated[i]]]


def _connected_component(linked: NDArray[np.bool_], start: int) -> list[int]:
    found, pending = {start}, [start]
    while pending:
        neighbours = set(np.flatnonzero(linked[pending.pop()]).tolist()) - found
        found |= neighbours
        pending += neighbours
    return sorted(found)
