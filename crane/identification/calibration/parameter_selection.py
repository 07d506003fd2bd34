"""What is fitted where nobody says what: all that recordings may tell and that is there."""

import numpy as np

from crane.common.errors import InputError
from crane.identification.calibration.calibration_problem import CalibrationProblem
from crane.identification.calibration.levenberg_marquardt import LevenbergMarquardt, Progress

_STIFFNESS_SUFFIX, _DAMPING_SUFFIX = (
    ".stiffness",
    ".damping",
)  # of which one is nothing without the other


def select_parameters(
    problem: CalibrationProblem, progress: Progress | None
) -> tuple[CalibrationProblem, LevenbergMarquardt, list[str]]:
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
    search = LevenbergMarquardt(problem, progress)
    z, unknowns = search.smoothed_minimum(), problem.unknowns
    excluded = set()
    for i, unknown in enumerate(unknowns):
        rigid = dict(unknown.members).get(unknown.name) == 0.0 and unknown.start > 0.0
        if unknown.prior and (z[i] == 0.0 or rigid and z[i] >= search.high[i]):
            excluded.add(unknown.name)
    excluded_springs = [
        name.removesuffix(_STIFFNESS_SUFFIX)
        for name in excluded
        if name.endswith(_STIFFNESS_SUFFIX)
    ]
    excluded |= {x.name for x in unknowns if x.prior} & {
        name + _DAMPING_SUFFIX for name in excluded_springs
    }
    included = [i for i, unknown in enumerate(unknowns) if unknown.name not in excluded]
    if not included:
        raise InputError("the recordings tell nothing of the machine: move more, or name numbers")
    reduced_problem = CalibrationProblem(
        problem.machine, [unknowns[i] for i in included], problem.cases
    )
    reduced_problem.simulation_count = problem.simulation_count
    initial_unknowns = np.concatenate([z[included], z[len(unknowns) :]])
    names = [unknown.name for unknown in unknowns if unknown.name in excluded]
    return reduced_problem, search.restricted_search(reduced_problem, initial_unknowns), names
