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

_PAIR = 0.9  # correlation of numbers that lean on each other
_INFLATED = 3.0  # how many times as wide a number's interval is by the others
_SHARED = 1.5  # eigenvalue of a direction that several numbers share
_PART = 0.25  # of a direction, of its largest component


def together(names: Sequence[str], R: Array, ends: Array) -> list[dict[str, float]]:
    """Changes of numbers that may be made together: by name, up to where an interval ends.

    Args:
        names: Of n numbers.
        R: (n, n) their correlations; 0 where a number is known exactly.
        ends: (n,) half of their intervals.
    """
    if len(R) < 2:
        return []
    found = []
    for group in filter(None, _groups(R)):
        sizes, directions = np.linalg.eigh(R[np.ix_(group, group)])
        v = directions[:, -1]
        v = v * np.sign(v[0]) / np.abs(v).max()
        parts = {names[i]: float(x * ends[i]) for i, x in zip(group, v, strict=True)
                 if abs(x) > _PART}  # fmt: skip
        if sizes[-1] > _SHARED and len(parts) > 1:
            found.append(parts)
    return found


def _groups(R: Array) -> list[list[int]]:
    """Numbers that lean on each other, each in one group at most."""
    linked = np.abs(R) > _PAIR
    groups, left = [], set(range(len(R)))
    while left:
        group = _reached(linked, min(left))
        left -= set(group)
        groups.append(group)
    alone = [group[0] for group in groups if len(group) == 1]
    inverse = np.linalg.pinv(R, rcond=1e-12, hermitian=True)
    inflated = np.sqrt(np.maximum(np.diag(inverse), 0.0)) > _INFLATED
    pairs = [group for group in groups if len(group) > 1]
    return [*pairs, [i for i in alone if inflated[i]]]


def _reached(linked: NDArray[np.bool_], start: int) -> list[int]:
    found, waiting = {start}, [start]
    while waiting:
        more = set(np.flatnonzero(linked[waiting.pop()]).tolist()) - found
        found |= more
        waiting += more
    return sorted(found)
