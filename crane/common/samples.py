"""One sample (n,) or a stack of them (N, n): every public function takes both."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crane.common.errors import ClosureError, InputError

Array = NDArray[np.float64]


def as_samples(value: ArrayLike, size: int, what: str, names: Sequence[str] = ()) -> Array:
    """A finite float64 array (size,) or (N, size).

    Args:
        value: What the user gave.
        size: Length of one sample.
        what: Its name, for errors.
        names: Names of the columns, for errors.

    Raises:
        InputError: Wrong shape, not numbers, or not finite.
    """
    array = _numbers(value, what, f"give {size} per sample")
    if array.ndim not in (1, 2) or array.shape[-1] != size:
        columns = f" ({', '.join(names)})" if names else ""
        raise InputError(
            f"{what} has the shape {array.shape}, give ({size},) or (N, {size}){columns}"
        )
    bad = ~np.isfinite(array)
    if bad.any():
        index = tuple(int(i) for i in np.argwhere(bad)[0])
        column = names[index[-1]] if names else f"column {index[-1]}"
        sample = f" of sample {index[0]}" if len(index) == 2 else ""
        raise InputError(f"{what} is {array[index]} at {column}{sample}, give finite numbers")
    return array


def as_sample(value: ArrayLike, size: int, what: str, names: Sequence[str] = ()) -> Array:
    """`as_samples` of exactly one sample (size,).

    Raises:
        InputError: Also for a stack.
    """
    shape = _numbers(value, what, f"give {size}").shape
    if shape != (size,):
        columns = f" ({', '.join(names)})" if names else ""
        raise InputError(f"{what} has the shape {shape}, give ({size},){columns}")
    return as_samples(value, size, what, names)


# Between these lies every quantity of a machine in SI units but zero, and its square is a number.
SMALLEST, LARGEST = 1e-30, 1e30
FARTHEST = 1e6  # coordinate [m], [rad] whose sine still has ten digits
MOST_SEEDS = 2**64 - 1


def as_number(
    value: object, what: str, unit: str, above: float = -np.inf, most: float = LARGEST
) -> float:
    """A number that a quantity of a machine can have.

    Args:
        value: What the user gave.
        what: Its name, for errors.
        unit: Its unit, for errors.
        above: What it has to be above; of what has to be above zero, `SMALLEST` is the least.
        most: What it may be at most, to both sides of zero.

    Raises:
        InputError: It is not.
    """
    array = _numbers(value, what, "give a number")
    shown = " ".join(f"{what} is {value} {unit}".split())
    if array.ndim or not np.isfinite(array) or not array > above:
        bound = f" above {above:g}" if above > -np.inf else ""
        raise InputError(f"{shown}, give a number{bound}")
    if abs(array) > most or (above == 0 and array < SMALLEST):
        least = SMALLEST if above == 0 else above if above > -np.inf else -most
        raise InputError(f"{shown}, give a number from {least:g} to {most:g}")
    return float(array)


def as_count(value: object, what: str, least: int = 1, most: int = 10**9) -> int:
    """A whole number within bounds.

    Raises:
        InputError: It is not.
    """
    if not isinstance(value, int | np.integer) or not least <= value <= most:
        raise InputError(f"{what} is {value}, give a whole number from {least} to {most}")
    return int(value)


def as_seed(value: object) -> int:
    """A seed of random numbers.

    Raises:
        InputError: It is negative, or no whole number.
    """
    return as_count(value, "the seed", 0, MOST_SEEDS)


def _numbers(value: object, what: str, wanted: str) -> Array:
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "biuf":
            raise TypeError
        return array.astype(np.float64, copy=False)
    except (TypeError, ValueError):
        raise InputError(f"{what} is not made of real numbers, {wanted}") from None


def solve(matrix: Array, right: Array) -> Array:
    """Solution x of matrix x = right, float64 for the type checker too."""
    return np.asarray(np.linalg.solve(matrix, right), dtype=np.float64)


def _named(sample: int, function: Callable[..., Array], *arrays: Array) -> Array:
    """Call a function and name the sample in errors of the closure."""
    try:
        return function(*arrays)
    except ClosureError as error:
        raise type(error)(f"{error} (sample {sample})") from None


def per_sample(function: Callable[..., Array], *arrays: Array) -> Array:
    """Apply a function of single samples to single samples or row by row to stacks.

    Single samples among stacks hold for every row.

    Raises:
        InputError: The stacks differ in length.
    """
    lengths = {len(array) for array in arrays if array.ndim == 2}
    if not lengths:
        return function(*arrays)
    if len(lengths) > 1:
        raise InputError(f"stacks of {sorted(lengths)} samples do not go together, give equal N")
    (count,) = lengths
    rows: Iterable[Array] = (
        _named(i, function, *(array[i] if array.ndim == 2 else array for array in arrays))
        for i in range(count)
    )
    first = next(iter(rows), None)
    if first is None:
        raise InputError("the stack is empty, give at least one sample")
    out = np.empty((count, *np.shape(first)))
    out[0] = first
    for i, row in enumerate(rows, start=1):
        out[i] = row
    return out
