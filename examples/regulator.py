"""How do I design a regulator (LQR) for a machine, and does it reject a disturbance?"""

import numpy as np
from scipy.linalg import solve_continuous_are

import crane

machine = crane.load("patu655", lock={"slew": 0.0})
model = crane.linearize(machine, drive="forces")  # x' = A x + B u about home, in deviations
n = len(machine.active)
print(f"states: {', '.join(model.states)}")

# cost: 1 mm and 1 cm/s cost as much as 200 N
Q = np.diag([1 / 1e-3**2] * n + [1 / 1e-2**2] * n)
R = np.eye(n) / 200.0**2
P = solve_continuous_are(model.A, model.B, Q, R)
K = np.linalg.solve(R, model.B.T @ P)  # [N/m], [N s/m]
poles = np.linalg.eigvals(model.A - model.B @ K)
print(f"the slowest pole is at {poles.real.max():.1f} /s")


def regulator(t, q_a, v_a):
    """Holding forces plus feedback of the deviations."""
    return model.u - K @ (np.concatenate([q_a, v_a]) - model.x)


home = model.x[:n]
run = crane.simulate(machine, regulator, home + [0.02, -0.02, 0.05], duration=3.0, step=2e-3)
off = np.abs(run.q - home)
print(
    f"strokes are {1e3 * off[0].max():.0f} mm off at first, {1e3 * off[-1].max():.1f} mm after 3 s"
)

# the remaining force is that of stiction, which balances the feedback; 300 N in the machine file
left = np.abs(K[:, :n] @ (run.q[-1] - home))  # [N]
print(f"which friction holds: {', '.join(f'{x:.0f} N' for x in left)} of 300 N")
assert poles.real.max() < 0 and left.max() < 300.0
