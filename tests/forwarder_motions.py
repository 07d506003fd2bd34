"""Motions of the mini forwarder with the forces of its own parameters, for identification."""

import dataclasses

import numpy as np

import crane
from crane.identification.signals.signal_processing import Motion

NOISE = np.array([5e-3, 0.5, 0.3])  # [N m], [N], [N]


def motion(machine, seed=0, *, period=10.0, duration=30.0, step=4e-3, still=(), noise=0.0):
    """Five harmonics within the strokes, and the machine's forces with `noise` times NOISE.

    Args:
        machine: The machine.
        seed: Of the harmonics and the noise.
        period: Of the first harmonic [s].
        duration: [s].
        step: [s].
        still: Active joints that do not move.
        noise: How much noise there is.
    """
    rng = np.random.default_rng(seed)
    time = np.arange(0, duration, step)
    w = 2 * np.pi / period * np.arange(1, 6)
    a, b = rng.normal(size=(2, 5, 3))
    phase = time[:, None] * w
    q = np.sin(phase) @ (a / w[:, None]) - np.cos(phase) @ (b / w[:, None])
    v = np.cos(phase) @ a + np.sin(phase) @ b
    acc = -np.sin(phase) @ (a * w[:, None]) + np.cos(phase) @ (b * w[:, None])
    size = np.array([1.5, 0.013, 0.013]) / np.abs(q).max(axis=0)
    size[list(still)] = 0.0
    q, v, acc = np.array([0, 0.015, 0.015]) + q * size, v * size, acc * size
    tau = crane.Dynamics(machine).inverse(q, v, acc, friction=True)
    return Motion(time, q, v, acc, tau + noise * NOISE * rng.normal(size=tau.shape))


def noisy(given, seed, level=1.0):
    """A motion with `level` times NOISE on its forces."""
    noise = level * NOISE * np.random.default_rng(seed).normal(size=given.tau.shape)
    return dataclasses.replace(given, tau=given.tau + noise)
