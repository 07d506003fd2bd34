"""Controllers whose references are samples over time."""

from copy import copy
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import InputError
from crane.common.samples import Array, as_sample, as_samples
from crane.control.control_law import ControlLaw
from crane.control.valve_commands import ValveCommand

Law = TypeVar("Law", bound=ControlLaw | ValveCommand)


def interpolate_references(controller: Law, times: ArrayLike, samples: ArrayLike) -> Law:
    """A controller whose references are linear between samples, and constant outside of them.

    So does an exported program with its inputs. The controller has no trajectory as `reference`:
    a simulation starts at home by default.

    Args:
        controller: A control law, or a valve command.
        times: (N,) [s], increasing.
        samples: (N, c) rows of `references`.

    Raises:
        InputError: Shapes differ, or times do not increase.
    """
    instants = as_sample(times, np.size(times), "times of the references").copy()
    count = controller.references(np.zeros(1)).shape[1]
    rows = as_samples(samples, count, "the references")
    if rows.shape != (len(instants), count) or not (np.diff(instants) > 0).all():
        raise InputError(
            f"references have the shape {rows.shape} at {len(instants)} times, give "
            f"({len(instants)}, {count}) at times that increase"
        )

    def references(at: Array) -> Array:
        return np.column_stack(
            [np.zeros((len(at), 0)), *(np.interp(at, instants, x) for x in rows.T)]
        )

    found = copy(controller)
    vars(found).update(reference=None, references=references, breaks=lambda: instants)
    return found
