"""Machine code as far as it gets, and one careful step where it stops."""

from collections.abc import Callable


def run_with_fallback(
    count: int,
    run_compiled: Callable[[int, int], int] | None,
    run_fallback: Callable[[int], None],
    max_chunk: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> None:
    """Do things one after the other, each by machine code or, where that stops, with care.

    Machine code does only what succeeds at once; what needs a closer look succeeds in the
    careful step or raises there, saying why.

    Args:
        count: How many things there are.
        run_compiled: (first, beyond) -> how many of them were done from the first on; None if
            there is no machine code.
        run_fallback: Does one.
        max_chunk: How many at most are asked of `run_compiled` at once.
        progress: Called with how many are done.
    """
    done = 0
    while done < count:
        chunk_end = min(done + (max_chunk or count), count)
        if run_compiled is not None:
            done += run_compiled(done, chunk_end)
        if done < chunk_end:
            run_fallback(done)
            done += 1
        if progress is not None:
            progress(done)
