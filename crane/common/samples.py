"""Validation of arguments: one sample (n,) or a stack (N, n), which public functions accept."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crane.common.errors import ClosureError, InputError

Array = NDArray[np.float64]


def as_samples(value: ArrayLike, size: int, label: str, names: Sequence[str] = ()) -> Array:
    """A finite float64 array (size,) or (N, size).

    Args:
        value: The argument.
        size: Length of one sample.
        label: Its name, for errors.
        names: Names of the columns, for errors.

    Raises:
        InputError: Wrong shape, not numbers, or not finite.
    """
    array = _as_real_array(value, label, f"give {size} per sample")
    if array.ndim not in (1, 2) or array.shape[-1] != size:
        columns = f" ({', '.join(names)})" if names else ""
        raise InputError(
            f"{label} has the shape {array.shape}, give ({size},) or (N, {size}){columns}"
        )
    bad = ~np.isfinite(array)
    if bad.any():
        index = tuple(int(i) for i in np.argwhere(bad)[0])
        column = names[index[-1]] if names else f"column {index[-1]}"
        sample = f" of sample {index[0]}" if len(index) == 2 else ""
        raise InputError(f"{label} is {array[index]} at {column}{sample}, give finite numbers")
    return array


def as_sample(value: ArrayLike, size: int, label: str, names: Sequence[str] = ()) -> Array:
    """`as_samples` for exactly one sample (size,).

    Raises:
        InputError: As `as_samples`, and for a stack.
    """
    shape = _as_real_array(value, label, f"give {size}").shape
    if shape != (size,):
        columns = f" ({', '.join(names)})" if names else ""
        raise InputError(f"{label} has the shape {shape}, give ({size},){columns}")
    return as_samples(value, size, label, names)


# Bounds of nonzero quantities in SI units, whose squares neither overflow nor underflow.
MIN_QUANTITY, MAX_QUANTITY = 1e-30, 1e30
MAX_COORDINATE = 1e6  # [m], [rad], sines still have ten digits
MAX_SEED = 2**64 - 1


def as_number(
    value: object,
    label: str,
    unit: str,
    greater_than: float = -np.inf,
    max_magnitude: float = MAX_QUANTITY,
) -> float:
    """A number within the range of quantities of a machine.

    Args:
        value: The argument.
        label: Its name, for errors.
        unit: Its unit, for errors.
        greater_than: Exclusive lower bound; for 0 the least value is `MIN_QUANTITY`.
        max_magnitude: Largest absolute value.

    Raises:
        InputError: Not a number within these bounds.
    """
    array = _as_real_array(value, label, "give a number")
    shown = " ".join(f"{label} is {value} {unit}".split())
    if array.ndim or not np.isfinite(array) or not array > greater_than:
        bound = f" above {greater_than:g}" if greater_than > -np.inf else ""
        raise InputError(f"{shown}, give a number{bound}")
    if abs(array) > max_magnitude or (greater_than == 0 and array < MIN_QUANTITY):
        least = (
            MIN_QUANTITY
            if greater_than == 0
            else greater_than
            if greater_than > -np.inf
            else -max_magnitude
        )
        raise InputError(f"{shown}, give a number from {least:g} to {max_magnitude:g}")
    return float(array)


def as_count(value: object, label: str, minimum: int = 1, maximum: int = 10**9) -> int:
    """A whole number within bounds.

    Raises:
        InputError: It is not.
    """
    if not isinstance(value, int | np.integer) or not minimum <= value <= maximum:
        raise InputError(f"{label} is {value}, give a whole number from {minimum} to {maximum}")
    return int(value)


def as_seed(value: object) -> int:
    """A seed of a random generator.

    Raises:
        InputError: It is negative, or not a whole number.
    """
    return as_count(value, "the seed", 0, MAX_SEED)


def _as_real_array(value: object, label: str, hint: str) -> Array:
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "biuf":
            raise TypeError
        return array.astype(np.float64, copy=False)
    except (TypeError, ValueError):
        raise InputError(f"{label} is not made of real numbers, {hint}") from None


def solve_linear(matrix: Array, right_side: Array) -> Array:
    """Solution x of matrix x = right_side as float64."""
    return np.asarray(np.linalg.solve(matrix, right_side), dtype=np.float64)


def independent_rows(rows: Array, tolerance: float) -> list[int]:
    """Indices of rows (m, k) that do not depend on those before them, up to a share of them."""
    basis, found = np.zeros((0, rows.shape[1])), list[int]()
    for i, row in enumerate(rows):
        rest = row - basis.T @ (basis @ row)
        rest -= basis.T @ (basis @ rest)  # twice is sufficient (Kahan, Parlett)
        size = np.linalg.norm(rest)
        if size > tolerance * np.linalg.norm(row):
            basis = np.vstack([basis, rest / size])
            found.append(i)
    return found


def true_runs(mask: NDArray[np.bool_]) -> NDArray[np.intp]:
    """First indices, and those after the last, of the runs (k, 2) of a mask (N,)."""
    return np.flatnonzero(np.diff(mask.astype(np.int8), prepend=0, append=0)).reshape(-1, 2)


def root_mean_square(x: Array) -> float:
    """Root of the mean square of all numbers of an array."""
    return float(np.sqrt(np.mean(np.square(x))))


def read_only_copy(array: Array) -> Array:
    """A read-only copy of an array."""
    out = array.copy()
    out.flags.writeable = False
    return out


def stack_length(arrays: Iterable[Array]) -> int | None:
    """Common length N of the stacks (N, n) among samples (n,) and stacks; None without stacks.

    Raises:
        InputError: The stacks differ in length.
    """
    lengths = {len(array) for array in arrays if array.ndim == 2}
    if len(lengths) > 1:
        raise InputError(f"stacks of {sorted(lengths)} samples do not go together, give equal N")
    return lengths.pop() if lengths else None


def apply_per_sample(function: Callable[..., Array], *arrays: Array) -> Array:
    """Apply a function of single samples, row by row to stacks.

    Single samples among stacks apply to every row.

    Raises:
        InputError: The stacks differ in length.
    """
    count = stack_length(arrays)
    if count is None:
        return function(*arrays)
    if not count:
        raise InputError("the stack is empty, give at least one sample")
    out = np.empty(0)
    for i in range(count):
        try:
            row = function(*(array[i] if array.ndim == 2 else array for array in arrays))
        except ClosureError as error:
            raise type(error)(f"{error} (sample {i})") from None
        if i == 0:
            out = np.empty((count, *np.shape(row)))
        out[i] = row
    return out
