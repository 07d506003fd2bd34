"""Where fitted machines are: what is left of recordings depends on speed and pressure, or not."""

from collections.abc import Mapping
from dataclasses import replace

from crane.common.errors import CraneError
from crane.common.samples import Array
from crane.description.sensors import PRESSURE_PREFIX, VELOCITY_SUFFIX
from crane.identification.calibration.calibration_problem import CalibrationProblem


def simulated_states(problem: CalibrationProblem, z: Array) -> dict[str, Mapping[str, Array]]:
    """By recording, velocities and chamber pressures (N,) of what its valves drive.

    By the simulation of the fitted machine, which has no noise.

    Args:
        problem: What was fitted.
        z: The unknowns.
    """
    hydraulics = problem.machine.hydraulics
    joints = () if hydraulics is None else hydraulics.joints
    names = [
        name
        for x in joints
        for name in (x + VELOCITY_SUFFIX, f"{PRESSURE_PREFIX}{x}_a", f"{PRESSURE_PREFIX}{x}_b")
    ]
    found: dict[str, Mapping[str, Array]] = {}
    for case in problem.cases if names else ():
        try:
            curve = problem.simulate_readings(replace(case, sensors=names), z, False)
        except CraneError:  # as its channels, which say why
            continue
        found[case.name] = dict(zip(names, curve(case.inputs.time).T, strict=True))
    return found
