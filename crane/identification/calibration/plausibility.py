"""Plausibility of a calibration: payload by statics, deviations from what is usual.

The force of a cylinder, F = A_A p_A - A_B p_B, carries the weight g(q; m) = g_0 + m g_1, linear in
the mass m of the payload, and the friction: at most F_C where it stands at the start of a
recording, and F_C in the direction of its motion, on the average over the motion. The payload is
that of the least friction,

    min_m sum_j F_Cj(m)^2,    F_Cj = max(|F_j - g_j| at rest, mean (F_j - g_j) sign(v) in motion).
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d

from crane.common.samples import Array
from crane.description.sensors import PRESSURE_PREFIX
from crane.dynamics.dynamics import Dynamics
from crane.formats.machine_loading import MachineVariants
from crane.identification.calibration.calibration_problem import CalibrationProblem
from crane.identification.calibration.levenberg_marquardt import (
    LevenbergMarquardt,
    SearchState,
)
from crane.identification.calibration.recording_case import RecordingCase
from crane.identification.calibration.unknowns import Unknown
from crane.machine.machine import Machine
from crane.recordings.timeseries import table_column

PAYLOAD_MASS = "payload.mass"
_MAX_DEVIATIONS = 3.0  # standard deviations of what is believable
_NEAR_MINIMUM = 0.1  # relative excess of the cost of another minimum that is reported
_TEST_MASS = 100.0  # [kg]
_SAMPLE_COUNT = 300  # samples of a recording
_SMOOTHING_SHARE = 30  # samples of a recording per window of a speed
_MOVING_SHARE = 0.5  # of the largest speed
_MIN_MOTION = 0.02  # of a stroke
_GEOMETRY_STD = 0.05 / 3.0  # relative deviation, of zeros of pressures and of levers


class StaticPayload(NamedTuple):
    """Mass of a payload by statics.

    Attributes:
        mass: Mass of the least friction [kg].
        std: Its standard deviation, of areas, pressures and levers.
        rest_mass: Mass of the least friction at rest alone [kg].
    """

    mass: float
    std: float
    rest_mass: float

    def candidates(self, known: float) -> list[Unknown]:
        """The payload as a candidate of a calibration, if there is one.

        It starts from statics where the file says otherwise.

        Args:
            known: Mass in the machine file [kg], 0 if it has no payload.
        """
        if known and not self.finding(known):
            std = max(self.std, abs(self.mass - known))
            return [
                Unknown(
                    PAYLOAD_MASS, known, known / _MAX_DEVIATIONS, known * _MAX_DEVIATIONS, std,
                    prior=1.0,
                )
            ]  # fmt: skip
        if self.mass < _MAX_DEVIATIONS * self.std:
            return []
        return [
            Unknown(
                PAYLOAD_MASS, self.mass, self.mass - _MAX_DEVIATIONS * self.std,
                self.mass + _MAX_DEVIATIONS * self.std, self.std, prior=1.0,
            )
        ]  # fmt: skip

    def finding(self, known: float) -> str:
        """Text about a payload that the machine file lacks or has otherwise, or ""."""
        if abs(self.mass - known) < _MAX_DEVIATIONS * self.std:
            return ""
        return (
            f"By statics the pressures carry {self.mass:.3g} kg at the tip, {self.rest_mass:.3g} "
            f"kg if no friction acts at rest; the machine file has {PAYLOAD_MASS} {known:.4g}."
        )


def static_payload(
    variants: MachineVariants, pins: Mapping[str, float], cases: Sequence[RecordingCase]
) -> StaticPayload | None:
    """Payload by statics, None if no recording starts at rest.

    Args:
        variants: Variants of the machine, which has a payload of any mass.
        pins: Coordinates of pins that the sensors of motion tell better than the file.
        cases: The recordings.
    """
    from scipy.optimize import minimize_scalar

    empty, loaded = (variants.machine({**pins, PAYLOAD_MASS: x}) for x in (0.0, _TEST_MASS))
    terms = [x for case in cases for x in _friction_terms(empty, loaded, case)]
    if not terms:
        return None

    def squares(mass: float, parts: slice) -> float:
        return sum(float(np.max((a - mass * b)[parts])) ** 2 for a, b in terms)

    largest = max(float(np.max(np.abs(a) / np.abs(b))) for a, b in terms)
    mass, rest_mass = (
        float(minimize_scalar(squares, None, (0.0, largest), (parts,), "bounded").x)
        for parts in (slice(None), slice(2))  # all, rest
    )
    return StaticPayload(mass, _GEOMETRY_STD * max(mass, _TEST_MASS), rest_mass)


def _friction_terms(
    empty: Machine, loaded: Machine, case: RecordingCase
) -> Iterator[tuple[Array, Array]]:
    """Friction of each cylinder, the largest of a - m b, with a and b of rest and motion.

    Args:
        empty: Machine without a payload.
        loaded: Machine with the test mass.
        case: Recording.
    """
    inputs, circuit, table = case.inputs, empty.hydraulics, case.table
    measured = all(x in table.units for x in empty.active)
    if circuit is None or inputs.initial is None or np.any(inputs.initial[1]) or not measured:
        return
    q = np.vstack([
        inputs.initial[0], np.column_stack([table_column(table, x) for x in empty.active])
    ])[:: max(1, len(table.values) // _SAMPLE_COUNT)]  # fmt: skip
    weight, with_load = (Dynamics(x).gravity(q) for x in (empty, loaded))
    for joint, (a, b) in inputs.pressures.items():
        names = [f"{PRESSURE_PREFIX}{joint}_{side}" for side in "ab"]
        if not all(x in table.units for x in names):
            continue
        i, cylinder = empty.active.index(joint), circuit.cylinders[joint]
        pressures = np.vstack([(a, b), np.column_stack([table_column(table, x) for x in names])])
        force = pressures[:: max(1, len(table.values) // _SAMPLE_COUNT)] @ [
            cylinder.area_a, -cylinder.area_b
        ] - weight[:, i]  # fmt: skip
        per_mass = (with_load[:, i] - weight[:, i]) / _TEST_MASS
        speed = np.gradient(uniform_filter1d(q[:, i], max(len(q) // _SMOOTHING_SHARE, 1)))
        moves = np.abs(speed) > _MOVING_SHARE * np.abs(speed).max()
        frictions, levers = [force[0], -force[0]], [per_mass[0], -per_mass[0]]
        if np.ptp(q[:, i]) > _MIN_MOTION * (empty.upper[i] - empty.lower[i]):
            sign = np.sign(speed[moves])
            frictions.append(np.mean(force[moves] * sign))
            levers.append(np.mean(per_mass[moves] * sign))
        yield np.array(frictions), np.array(levers)


def implausible_values(search: LevenbergMarquardt, z: Array) -> Iterator[str]:
    """Texts about parameters that are far from what is usual, and about those on a bound."""
    for unknown, x, low, high in zip(
        search.problem.unknowns, z, search.low, search.high, strict=False
    ):
        value = unknown.start + unknown.scale * x
        if unknown.prior * abs(x) > _MAX_DEVIATIONS - 1e-6:
            yield (
                f"{unknown.name} = {value:.4g} is not believable, {unknown.prior * abs(x):.3g} "
                f"deviations from {unknown.start:.4g}: the model lacks something, a load or "
                "another effect."
            )
        elif not low < x < high:
            yield f"{unknown.name} = {value:.4g} is on its bound."


def near_minima(problem: CalibrationProblem, minima: Sequence[SearchState]) -> Iterator[str]:
    """Texts about other minima that are about as low.

    Args:
        problem: Problem of the search from several starts.
        minima: Its minima with smoothed friction, first the one from which it went on.
    """
    for other in minima[1:]:
        values = problem.values(other.z)
        far = np.abs(other.z - minima[0].z) > 1.0
        names = [x.name for x, is_far in zip(problem.unknowns, far, strict=False) if is_far]
        excess = other.cost / minima[0].cost - 1.0
        if excess < _NEAR_MINIMUM and names:
            yield (
                f"With smoothed friction another minimum has {100 * abs(excess):.1f} % "
                f"{'more' if excess >= 0.0 else 'less'} squares: "
                + ", ".join(f"{name} = {values[name]:.4g}" for name in names)
            )
