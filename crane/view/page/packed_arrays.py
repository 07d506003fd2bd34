"""Arrays as short texts that a page's script turns back into typed arrays."""

import base64
from typing import Any

import numpy as np

from crane.common.samples import Array

_LEVELS = 2**32 - 1


def pack_base64(values: np.ndarray, dtype_name: str) -> str:
    """Base64 of little-endian numbers.

    Args:
        values: Any shape, written row by row.
        dtype_name: numpy's name of the type, "f4", "f8" or "u4".
    """
    return base64.b64encode(
        np.ascontiguousarray(values, dtype=f"<{dtype_name}").tobytes()
    ).decode()


def quantise(values: Array) -> dict[str, Any]:
    """Coordinates in four bytes each, to 1.2e-10 of their range (float32 would have 6e-8).

    Args:
        values: (N,) finite.

    Returns:
        low, step and levels: value = low + step level; no levels where all are low.
    """
    low = float(values.min())
    step = (float(values.max()) - low) / _LEVELS
    if not step:
        return {"low": low, "step": 0.0, "levels": ""}
    return {"low": low, "step": step, "levels": pack_base64(np.rint((values - low) / step), "u4")}
