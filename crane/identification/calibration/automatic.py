"""What is fitted where nobody says what: all that recordings may tell and that is there."""

import numpy as np

from crane.common.errors import InputError
from crane.identification.calibration.problem import Problem
from crane.identification.calibration.search import Progress, Search

_SPRING, _DAMPER = ".stiffness", ".damping"  # of which one is nothing without the other


def told(problem: Problem, progress: Progress | None) -> tuple[Problem, Search, list[str]]:
    """Fit all numbers, each held by what is known of it before, and leave out what is not there.

    Left out is what stays on a bound where the machine has it: no air, no leakage, no delay, or a
    structure so stiff that it might be rigid.

    Args:
        problem: Of the numbers; those without a prior are kept anyway.
        progress: See `calibrate`.

    Returns:
        The problem of the numbers that are kept, a search that goes on there, and names of the
        others.

    Raises:
        InputError: None is kept.
    """
    search = Search(problem, progress)
    z, unknowns = search.begun(), problem.unknowns
    left = set()
    for i, unknown in enumerate(unknowns):
        rigid = dict(unknown.members).get(unknown.name) == 0.0 and unknown.start > 0.0
        if unknown.prior and (z[i] == 0.0 or rigid and z[i] >= search.high[i]):
            left.add(unknown.name)
    springs = [name.removesuffix(_SPRING) for name in left if name.endswith(_SPRING)]
    left |= {x.name for x in unknowns if x.prior} & {name + _DAMPER for name in springs}
    kept = [i for i, unknown in enumerate(unknowns) if unknown.name not in left]
    if not kept:
        raise InputError("the recordings tell nothing of the machine: move more, or name numbers")
    narrower = Problem(problem.machine, [unknowns[i] for i in kept], problem.cases)
    narrower.runs = problem.runs
    begins = np.concatenate([z[kept], z[len(unknowns) :]])
    names = [unknown.name for unknown in unknowns if unknown.name in left]
    return narrower, search.narrowed(narrower, begins), names
