"""Numbers that recordings cannot tell apart: directions in which all of them are known badly.

With R the correlations of the estimates and s their deviations, a change s_i v_i of every number
i, v an eigenvector of R to the eigenvalue m, has the deviation sqrt(m) |v|: directions of large m
are shared by several numbers. Of those, the numbers count that would be known much better if the
others were known, by the factor sqrt((R^-1)_ii) (the variance inflation, Marquardt 1970).
"""

from collections.abc import Sequence

import numpy as np

from crane.common.samples import Array

_SHARED = 1.5  # eigenvalue of a direction that several numbers share
_INFLATED = 3.0  # how many times as wide a number's interval is by the others
_PART = 0.25  # of a direction, of its largest component


def together(names: Sequence[str], R: Array, ends: Array) -> list[dict[str, float]]:
    """Changes of numbers that may be made together: by name, up to where intervals end.

    Args:
        names: Of n numbers.
        R: (n, n) their correlations; 0 where a number is known exactly.
        ends: (n,) half of their intervals.
    """
    if len(R) < 2:
        return []
    inverse = np.linalg.pinv(R, rcond=1e-12, hermitian=True)
    inflated = np.sqrt(np.maximum(np.diag(inverse) * np.diag(R), 0.0)) > _INFLATED
    sizes, directions = np.linalg.eigh(R)
    found = []
    for size, v in sorted(zip(sizes, directions.T, strict=True), key=lambda x: -x[0]):
        some = inflated & (np.abs(v) > _PART * np.abs(v).max())
        if size < _SHARED or some.sum() < 2:
            continue
        at = np.flatnonzero(some).tolist()
        v = v * np.sign(v[at[0]]) / np.abs(v[at]).max()
        found.append({names[i]: float(v[i] * ends[i]) for i in at})
    return found
