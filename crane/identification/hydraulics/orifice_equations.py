"""Rows of the equations that hold bulk modulus and orifice coefficients.

The rates of the chambers' pressures, equation (23) with the flows (21), (22), over V and beta:

    A:  p_A' / beta - (c1 y+ r1 + c3 y- r3) / V_A = -(ln V_A)'
    B:  p_B' / beta + (c2 y+ r2 + c4 y- r4) / V_B = -(ln V_B)'

    r1 = root(p_S - p_A), r2 = root(p_B - p_R), r3 = root(p_A - p_R), r4 = root(p_S - p_B),

y+ = max(y, 0), y- = min(y, 0) of the opening, root(d) = sign(d) sqrt(|d|): an edge passes oil
either way. A valve with a margin limits r1 and r4 to its root and lets nothing back. Area A times
the first less area B times the second is equation (29), A X = Y, X = [1/beta, c1, c2, c3, c4].

Equations are those of the electro-hydraulic forwarder paper (IROS 2012).
"""

from dataclasses import dataclass

import numpy as np

from crane.common.samples import Array
from crane.identification.hydraulics.cylinder_signals import (
    CylinderSignals,
    cylinder_and_valve,
    opening_regions,
    shift_signal,
)
from crane.identification.signals.weak_form import WeakFormWindows
from crane.machine import Machine


@dataclass(frozen=True, eq=False)
class EquationSides:
    """Both sides of equation (29) [m2/s], or [m3/(rad s)].

    Attributes:
        time: (K,) [s].
        predicted: A X by the estimated parameters (K,).
        measured: Y as measured (K,).
    """

    time: Array
    predicted: Array
    measured: Array

    @property
    def relative_error(self) -> float:
        """Norm of right less left over that of right."""
        return float(
            np.linalg.norm(self.measured - self.predicted) / np.linalg.norm(self.measured)
        )


class OrificeEquations:
    """Rows of one recording, E equations on two halves of the samples of K windows.

    Args:
        machine: With hydraulics.
        joint: The cylinder's.
        signals: Of the recording.
        window_length: Length [s].
        per_chamber: Whether both equations (23), or their difference (29).

    Attributes:
        combination: Chambers' equations (A, B) in each equation (E, 2).
        windows: Test functions.
        is_smooth: Windows without kinks of the opening (K,).
        W: Of X (E, 2, K, 5).
        y: Right sides (E, 2, K).
    """

    def __init__(
        self,
        machine: Machine,
        joint: str,
        signals: CylinderSignals,
        window_length: float,
        per_chamber: bool,
    ):
        cylinder, _ = cylinder_and_valve(machine, joint)
        areas = np.array([cylinder.area_a, -cylinder.area_b])
        self.machine, self.joint, self.signals = machine, joint, signals
        self.combination = np.eye(2) if per_chamber else areas[None]
        self._difference_weights = (
            areas if per_chamber else np.ones(1)
        )  # of the equations, in (29)
        self.windows = w = WeakFormWindows.create(len(signals.time), signals.step, window_length)
        self.is_smooth = w.are_uniform(opening_regions(signals.opening))
        states, columns = self._combined_terms(signals)
        self.W = np.empty((len(self.combination), 2, len(w.centres), 5))
        self.y = np.empty(self.W.shape[:3])
        for e in range(len(self.combination)):
            self.W[e, :, :, 0] = w.integrate(w.phi_derivative, states[e, 0])
            for j in range(4):
                self.W[e, :, :, 1 + j] = w.integrate(w.phi, columns[e, j])
            self.y[e] = -w.integrate(w.phi_derivative, states[e, 1])

    def _combined_terms(self, signals: CylinderSignals) -> tuple[Array, Array]:
        states, columns = chamber_terms(self.machine, self.joint, signals)
        return np.tensordot(self.combination, states, 1), np.tensordot(
            self.combination, columns, 1
        )

    def sides(self, X: Array) -> EquationSides:
        """Both sides of (29) by X (5,), all windows."""
        W, y = (
            np.tensordot(self._difference_weights, self.W, 1),
            np.tensordot(self._difference_weights, self.y, 1),
        )
        time = self.signals.time[self.windows.centres]
        return EquationSides(time, (W @ X).mean(axis=0), y.mean(axis=0))

    def noise_sensitivity(self, X: Array, sensor: str, offset: float) -> tuple[Array, Array]:
        """By what noise of a sensor moves the differentiated part, and the other, (E, N) each."""
        ends = []
        for sign in (1, -1):
            states, columns = self._combined_terms(
                shift_signal(self.signals, sensor, sign * offset)
            )
            f = states[:, 0] * X[0] + states[:, 1]
            ends.append((f, np.tensordot(columns, X[1:], (1, 0))))
        return 0.5 * (ends[0][0] - ends[1][0]), 0.5 * (ends[0][1] - ends[1][1])


def chamber_terms(machine: Machine, joint: str, signals: CylinderSignals) -> tuple[Array, Array]:
    """Of both chambers what is differentiated, and what is not.

    Returns:
        (p_A, ln V_A), (p_B, ln V_B) as (2, 2, N), and the columns of c1 to c4 (2, 4, N), so that
        p' / beta + columns c = -(ln V)'.
    """
    cylinder, valve = cylinder_and_valve(machine, joint)
    volume_a = cylinder.hose_a + cylinder.area_a * signals.x
    volume_b = cylinder.hose_b + cylinder.area_b * (signals.stroke - signals.x)
    up, down = np.maximum(signals.opening, 0), np.minimum(signals.opening, 0)

    def inlet(drop: Array) -> Array:
        return _signed_sqrt(np.clip(drop, 0, valve.margin) if valve.margin else drop)

    none = np.zeros_like(up)
    columns = np.array(
        [
            [
                -up * inlet(signals.p_s - signals.p_a) / volume_a,
                none,
                -down * _signed_sqrt(signals.p_a - signals.p_r) / volume_a,
                none,
            ],
            [
                none,
                up * _signed_sqrt(signals.p_b - signals.p_r) / volume_b,
                none,
                down * inlet(signals.p_s - signals.p_b) / volume_b,
            ],
        ]
    )
    states = np.array([[signals.p_a, np.log(volume_a)], [signals.p_b, np.log(volume_b)]])
    return states, columns


def _signed_sqrt(drop: Array) -> Array:
    """Signed square root."""
    return np.copysign(np.sqrt(np.abs(drop)), drop)
