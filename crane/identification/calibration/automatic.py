"""What is fitted where nobody says what: all that recordings may tell, then what they do tell."""

import numpy as np

from crane.common.errors import InputError
from crane.identification.calibration.problem import Problem
from crane.identification.calibration.search import Progress, Search

_TOLD = 0.7  # of the deviation that a number had before, what is left of it where it is told
_STAYED = 0.1  # of it, by which a number has not moved
_SPRING, _DAMPER = ".stiffness", ".damping"  # of which one is nothing without the other


def told(problem: Problem, progress: Progress | None) -> tuple[Problem, Search, list[str]]:
    """Fit all numbers, each held by what is known of it before, and keep those that are told.

    A number is told where its standard deviation afterwards is below 0.7 of that before, or it has
    moved by more than a tenth of that, and has not stayed on a bound where it was: no air, no
    leakage, no delay, or a structure so stiff that it might be rigid. The others stay as the
    machine has them.

    Args:
        problem: Of the numbers; those without a prior are kept anyway, the scale of the others
            is the standard deviation that they have before.
        progress: See `calibrate`.

    Returns:
        The problem of the numbers that are told, a search that goes on there, and names of the
        others.

    Raises:
        InputError: None is told.
    """
    search = Search(problem, progress)
    z = search.begun()
    count = len(problem.unknowns)
    deviations = np.sqrt(np.maximum(np.diag(search.covariance(z)[0])[:count], 0.0))
    kept, left = [], []
    for i, unknown in enumerate(problem.unknowns):
        was_rigid = dict(unknown.members).get(unknown.name) == 0.0 and unknown.start > 0.0
        stays = z[i] == 0.0 or was_rigid and z[i] >= search.high[i]
        still = deviations[i] > _TOLD and abs(z[i]) < _STAYED
        if unknown.prior and (stays or still):
            left.append(unknown.name)
        else:
            kept.append(i)
    rigid = {name for name in left if name.endswith(_SPRING)}
    loose = {name.removesuffix(_SPRING) + _DAMPER for name in rigid}
    left += [problem.unknowns[i].name for i in kept if problem.unknowns[i].name in loose]
    kept = [i for i in kept if problem.unknowns[i].name not in loose]
    if not kept:
        raise InputError("the recordings tell nothing of the machine: move more, or name numbers")
    narrower = Problem(problem.machine, [problem.unknowns[i] for i in kept], problem.cases)
    narrower.runs = problem.runs
    return narrower, search.narrowed(narrower, np.concatenate([z[kept], z[count:]])), left
