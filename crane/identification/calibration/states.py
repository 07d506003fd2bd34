"""Where fitted machines are: what is left of recordings depends on speed and pressure, or not."""

from collections.abc import Mapping
from dataclasses import replace

from crane.common.errors import CraneError
from crane.common.samples import Array
from crane.description.sensors import PRESSURE, VELOCITY
from crane.identification.calibration.problem import Problem


def states(problem: Problem, z: Array) -> dict[str, Mapping[str, Array]]:
    """By recording, velocities and chamber pressures (N,) of what its valves drive.

    By the simulation of the fitted machine, which has no noise.

    Args:
        problem: What was fitted.
        z: The unknowns.
    """
    hydraulics = problem.machine.hydraulics
    joints = () if hydraulics is None else hydraulics.joints
    names = [name for x in joints
             for name in (x + VELOCITY, f"{PRESSURE}{x}_a", f"{PRESSURE}{x}_b")]  # fmt: skip
    found: dict[str, Mapping[str, Array]] = {}
    for case in problem.cases if names else ():
        try:
            curve = problem.simulated(replace(case, sensors=names), z, False)
        except CraneError:  # as its channels, which say why
            continue
        found[case.name] = dict(zip(names, curve(case.inputs.time).T, strict=True))
    return found
