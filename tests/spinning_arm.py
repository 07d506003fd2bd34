"""An arm of two links whose first joint turns on, its motion and the forces of it."""

import numpy as np

import crane

URDF = """<robot name="spinning_arm"><link name="base"/>
  <joint name="ja" type="continuous"><parent link="base"/><child link="upper"/>
    <axis xyz="0 1 0"/></joint>
  <link name="upper"><inertial><origin xyz="0.3 0 0.05"/><mass value="5"/>
    <inertia ixx="0.02" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="jb" type="revolute"><origin xyz="0.6 0 0"/><parent link="upper"/>
    <child link="lower"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="100" velocity="5"/></joint>
  <link name="lower"><inertial><origin xyz="0.2 0 0.02"/><mass value="2"/>
    <inertia ixx="0.01" iyy="0.03" izz="0.03" ixy="0" ixz="0" iyz="0"/></inertial></link>
</robot>"""
COULOMB, VISCOUS = np.array([0.8, 0.4]), np.array([0.5, 0.3])  # [N m], [N m s]
# harmonics of both joints: sizes [rad], rates [rad/s], phases [rad]
PARTS = (([1.0, 1.2], [0.9, 1.1], [0.0, 0.0]), ([0.6, 0.5], [2.3, 2.9], [0.0, 1.0]))


def load(folder):
    (folder / "arm.urdf").write_text(URDF)
    return crane.load(folder / "arm.urdf")


def motion(time, drift=1.3):
    """Coordinates, velocities, accelerations (N, 2); the first joint turns at `drift` besides."""
    q = np.outer(time, [drift, 0.0])
    v, a = np.full_like(q, [drift, 0.0]), np.zeros_like(q)
    for size, rate, phase in PARTS:
        size, rate = np.array(size), np.array(rate)
        angle = np.outer(time, rate) + phase
        q += size * np.sin(angle)
        v += size * rate * np.cos(angle)
        a -= size * rate**2 * np.sin(angle)
    return q, v, a


def recording(machine, delay=0.0, noise=(1e-4, 0.05), seed=0, count=6000, friction=True):
    """Measured every 5 ms, with forces that are late by a delay [s].

    Args:
        machine: See `load`.
        delay: Of the forces [s].
        noise: Standard deviations of angles [rad] and forces [N m].
        seed: Of the noise.
        count: Number of samples.
        friction: Whether joints have friction.
    """
    time, rng = 5e-3 * np.arange(count), np.random.default_rng(seed)
    q, (q_tau, v_tau, a_tau) = motion(time)[0], motion(time - delay)
    tau = crane.Dynamics(machine).inverse(q_tau, v_tau, a_tau)
    if friction:
        tau += COULOMB * np.sign(v_tau) + VISCOUS * v_tau
    q, tau = (x + s * rng.normal(size=x.shape) for x, s in zip((q, tau), noise, strict=True))
    units = {joint: "rad" for joint in machine.active}
    rates = np.gradient(q, time, axis=0)
    return crane.Recording(time, machine.active, q, rates, tau, units)
