"""Published values of the reduced-scale forwarder paper: tables, facts in the text, misprints."""

from dataclasses import dataclass

import numpy as np

TASKS = ("loading", "return", "lift")  # trajectories 1, 2, 3
SIGNALS = ("tau_1", "F_A1", "F_A2")
JOINTS = ("q1", "X1", "X2")
DURATION = 10.0  # [s]

# Table 2 with its rows in order: I_VD and I_VE [N2 m2 s], [N2 s] by signal.
TABLE_2 = {
    "loading": ((0.0023, 0.0867), (10.1685, 3101.10), (23.3439, 411.216)),
    "return": ((0.0133, 0.5133), (235.0016, 3424.60), (369.0757, 2564.90)),
    "lift": ((0.0, 0.0), (51.4743, 15574.05), (55.9491, 373.93)),
}

# Table 1 as printed, terms of equation (5): F_C, Delta_C, F_V, Delta_V.
FRICTION = {
    "q1": (-0.1010, -0.0110, 0.0, 0.0),
    "X1": (-16.0, 6.0, -600.0, 0.0),
    "X2": (-7.5, -21.5, -500.0, 300.0),
}
VISCOUS = {"q1": 0.8, "X1": 0.4, "X2": 0.4}  # mu_v of the active joints; passive ones 0.4

# Velocities over which sign(v) turns in simulations of it [rad/s], [m/s]; A.
SMOOTHING = {"q1": 1e-2, "X1": 1e-3, "X2": 1e-3}
SMOOTH = {f"friction.{joint}.smoothing": value for joint, value in SMOOTHING.items()}

# Facts of the text on the strokes: task, joint, second of the reversal.
REVERSALS = (("return", "X1", 7.0), ("return", "X2", 4.0), ("lift", "X2", 6.0))
CRUISE = -2e-3  # [m/s] X1' of trajectory 1 from second 2 to 8

MISPRINTS = (
    ("Table 1", "friction coefficients negative, with + F_F on the left of (6): they would drive "
     "the motion", "signs reversed; tau_1 of trajectory 2 confirms it (see the scoreboard)"),
    ("(7)", "K_i1 in the second row, K_p2 twice in Table 1", "one pair of gains per joint"),
    ("Table 2", "rows and columns scrambled",
     "PE = I_VD / I_VE identifies the place of every number"),
    ("Table 2, trajectory 1", "integrals about five times smaller than the text's statement "
     "that F_A1 agrees with trajectory 3 permits",
     "both readings are on the scoreboard; PE does not depend on it"),
    ("Table 4", "unit gr/m3 of the inertias", "g m2"),
    ("Table 4, links 3 to 7", "inertias about the proximal pin, not the centre of mass: their "
     "radii of gyration exceed half the length", "moved to the centre of mass"),
    ("Table 4, link 2", "inertia 0.00817 g m2, a tenth of that of a body of this size",
     "0.0817 g m2"),
    ("Table 4(h)", "the actuators' mass is missing, values shifted by one row",
     "0.034 kg assumed; its effect is shown below"),
    ("before (13)", "A_2^0 and A_3^0 count links on the left, rows of Table 3(a) on the right: "
     "read literally, poses are off by 5 cm", "CM3 stands on rows 1 to 3, CM7 on rows 1 to 5"),
    ("(13), Table 4(b)", "PCY3 in the equation, PCZ3 in the table", "the same length, 0.0109 m"),
    ("(15)", "a fifth column in the matrix of CMA2", "four"),
    ("(14), (15)", "K_m is called proportional to the displacement", "the constant factor itself"),
    ("Table 4(f)", "A2B and A2C rounded to 0.1 mm",
     "0.042426 m and 0.051614 m, from the triangle"),
    ("not printed", "pins G (rod eye of A2 on link 3) and K (link 6 on link 7)",
     "reconstructed; their effect is shown below"),
    ("(10), (11)", "according to the text trajectory 2 starts where trajectory 1 "
     "ends; they are 2 cm apart",
     "taken as printed"),
    ("2.5.1", "percentage error: a ratio of energies", "the relative RMS error is its root"),
)  # fmt: skip


@dataclass(frozen=True)
class Published:
    """What Table 2 says of one signal.

    The simulated force lies within I_VD of the measured one, so by the triangle inequality its
    RMS lies in (1 +- sqrt(PE)) times the measured RMS.

    Attributes:
        rms: Of the measured force [N], [N m].
        low: Least RMS that the published simulation can have had.
        high: Largest.
        pe: Percentage error, equation (9).
    """

    rms: float
    low: float
    high: float
    pe: float


def published(task: str, signal: int, times: float = 1.0) -> Published:
    """Table 2, its integrals multiplied by `times`."""
    difference, experiment = TABLE_2[task][signal]
    rms = float(np.sqrt(times * experiment / DURATION))
    ratio = difference / experiment if experiment else 0.0
    spread = float(np.sqrt(ratio))
    return Published(rms, rms * (1 - spread), rms * (1 + spread), 100 * ratio)
