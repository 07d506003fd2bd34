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
    parts,
    regions,
    shifted,
)
from crane.identification.signals.weak_form import Windows
from crane.machine import Machine


@dataclass(frozen=True, eq=False)
class Sides:
    """Both sides of equation (29) [m2/s], or [m3/(rad s)].

    Attributes:
        time: (K,) [s].
        left: A X by the estimated parameters (K,).
        right: Y as measured (K,).
    """

    time: Array
    left: Array
    right: Array

    @property
    def relative(self) -> float:
        """Norm of right less left over that of right."""
        return float(np.linalg.norm(self.right - self.left) / np.linalg.norm(self.right))


class OrificeRows:
    """Rows of one recording, E equations on two halves of the samples of K windows.

    Args:
        machine: With hydraulics.
        joint: The cylinder's.
        signals: Of the recording.
        window: Length [s].
        chambers: Whether both equations (23), or their difference (29).

    Attributes:
        mix: Chambers' equations (A, B) in each equation (E, 2).
        windows: Test functions.
        kept: Windows without kinks of the opening (K,).
        W: Of X (E, 2, K, 5).
        y: Right sides (E, 2, K).
    """

    def __init__(
        self, machine: Machine, joint: str, signals: CylinderSignals, window: float, chambers: bool
    ):
        cylinder, _ = parts(machine, joint)
        areas = np.array([cylinder.area_a, -cylinder.area_b])
        self.machine, self.joint, self.signals = machine, joint, signals
        self.mix = np.eye(2) if chambers else areas[None]
        self._whole = areas if chambers else np.ones(1)  # of the equations, in (29)
        self.windows = w = Windows.over(len(signals.time), signals.step, window)
        self.kept = w.within(regions(signals.opening))
        states, columns = self._mixed(signals)
        self.W = np.empty((len(self.mix), 2, len(w.centres), 5))
        self.y = np.empty(self.W.shape[:3])
        for e in range(len(self.mix)):
            self.W[e, :, :, 0] = w.apply(w.slope, states[e, 0])
            for j in range(4):
                self.W[e, :, :, 1 + j] = w.apply(w.phi, columns[e, j])
            self.y[e] = -w.apply(w.slope, states[e, 1])

    def _mixed(self, signals: CylinderSignals) -> tuple[Array, Array]:
        states, columns = terms(self.machine, self.joint, signals)
        return np.tensordot(self.mix, states, 1), np.tensordot(self.mix, columns, 1)

    def sides(self, X: Array) -> Sides:
        """Both sides of (29) by X (5,), all windows."""
        W, y = np.tensordot(self._whole, self.W, 1), np.tensordot(self._whole, self.y, 1)
        time = self.signals.time[self.windows.centres]
        return Sides(time, (W @ X).mean(axis=0), y.mean(axis=0))

    def sensitivity(self, X: Array, sensor: str, by: float) -> tuple[Array, Array]:
        """By what noise of a sensor moves the differentiated part, and the other, (E, N) each."""
        ends = []
        for sign in (1, -1):
            states, columns = self._mixed(shifted(self.signals, sensor, sign * by))
            f = states[:, 0] * X[0] + states[:, 1]
            ends.append((f, np.tensordot(columns, X[1:], (1, 0))))
        return 0.5 * (ends[0][0] - ends[1][0]), 0.5 * (ends[0][1] - ends[1][1])


def terms(machine: Machine, joint: str, signals: CylinderSignals) -> tuple[Array, Array]:
    """Of both chambers what is differentiated, and what is not.

    Returns:
        (p_A, ln V_A), (p_B, ln V_B) as (2, 2, N), and the columns of c1 to c4 (2, 4, N), so that
        p' / beta + columns c = -(ln V)'.
    """
    cylinder, valve = parts(machine, joint)
    volume_a = cylinder.hose_a + cylinder.area_a * signals.x
    volume_b = cylinder.hose_b + cylinder.area_b * (signals.stroke - signals.x)
    up, down = np.maximum(signals.opening, 0), np.minimum(signals.opening, 0)

    def inlet(drop: Array) -> Array:
        return _root(np.clip(drop, 0, valve.margin) if valve.margin else drop)

    none = np.zeros_like(up)
    columns = np.array(
        [
            [
                -up * inlet(signals.p_s - signals.p_a) / volume_a,
                none,
                -down * _root(signals.p_a - signals.p_r) / volume_a,
                none,
            ],
            [
                none,
                up * _root(signals.p_b - signals.p_r) / volume_b,
                none,
                down * inlet(signals.p_s - signals.p_b) / volume_b,
            ],
        ]
    )
    states = np.array([[signals.p_a, np.log(volume_a)], [signals.p_b, np.log(volume_b)]])
    return states, columns


def _root(drop: Array) -> Array:
    """Signed square root."""
    return np.copysign(np.sqrt(np.abs(drop)), drop)
