"""Machine code as far as it gets, and one careful step where it stops."""

from collections.abc import Callable


def carefully(
    count: int,
    fast: Callable[[int, int], int] | None,
    slow: Callable[[int], None],
    chunk: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> None:
    """Do things one after the other, each by machine code or, where that stops, with care.

    Machine code does only what succeeds at once; what needs a closer look succeeds in the
    careful step or raises there, saying why.

    Args:
        count: How many things there are.
        fast: (first, beyond) -> how many of them were done from the first on; None if there is
            no machine code.
        slow: Does one.
        chunk: How many at most are asked of `fast` at once.
        progress: Called with how many are done.
    """
    done = 0
    while done < count:
        beyond = min(done + (chunk or count), count)
        if fast is not None:
            done += fast(done, beyond)
        if done < beyond:
            slow(done)
            done += 1
        if progress is not None:
            progress(done)
