"""Many steps by one call of machine code after the other."""

from collections.abc import Callable

import numpy as np

from crane.common.samples import Array
from crane.control import TracedController
from crane.machine import Machine
from crane.simulation.integration.machine_formulas import reference_samples

_BLOCK_STEPS = (
    1000  # steps of a call: their rows stay in the cache until they are where they belong
)


def run_in_blocks(
    call: Callable[[int, Array, Array], int],
    machine: Machine,
    control: TracedController,
    times: Array,
    step: float,
    rows: Array,
) -> int:
    """Steps from the first of `times` on, one row before each.

    Args:
        call: (count, references (2 count + 1, c), out (count, .)) -> how many steps were done.
        machine: What has references of forces from outside.
        control: What has the others.
        times: (steps,) [s].
        step: [s].
        rows: (steps, .) in any order, filled.

    Returns:
        How many steps were done; the one after them needs a closer look.
    """
    length = min(_BLOCK_STEPS, len(times))
    half_step_times = times[::length, None] + 0.5 * step * np.arange(2 * length + 1)
    block_starts = range(0, len(times), length)
    instants = half_step_times.ravel()[: 2 * len(times) + len(block_starts)]
    references = reference_samples(machine, control, instants)
    out = np.empty((length, rows.shape[1]))
    for i, first in enumerate(block_starts):
        count = min(length, len(times) - first)
        done = call(count, references[i * half_step_times.shape[1] :], out)
        rows[first : first + done] = out[:done]
        if done < count:
            return first + done
    return len(times)
