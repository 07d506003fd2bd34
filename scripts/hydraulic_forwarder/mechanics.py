"""Inertial and friction parameters from pressures: equations (1) to (20)."""

from dataclasses import dataclass

import numpy as np

import crane
from crane.common.samples import Array
from crane.identification.mechanics.identification_result import Identification
from crane.identification.mechanics.identify import identify
from crane.identification.mechanics.model_terms import (
    InertialTerm,
    ModelTerm,
    MotionSamples,
    body_names,
    friction_term,
)
from crane.identification.signals.signal_processing import Motion, differentiate, low_pass
from hydraulic_forwarder.experiment import CYLINDERS, STEP, Crane, averaged
from hydraulic_forwarder.paper import ANGLES

BANDWIDTH = 2.0  # [Hz] of both sides of (17): above the motion, below the boom on its oil
BODIES = ("lift_boom", "tilt_boom", "extension")  # of the paper; the last with its load
REST = {
    "bracket1, bracket2": ("bracket1", "bracket2"),
    "tilt cylinder": ("tilt_barrel", "tilt_rod"),
    "lift cylinder": ("lift_barrel", "lift_rod"),
}
# theta_1 to theta_7 in words: (4) to (10)
THETA = (
    "m_FL r_FL^2 + I_FL [kg m2]",
    "m_SL r_SL [kg m]",
    "m_SL [kg]",
    "m_Gr r_7 + m_TL r_TL [kg m]",
    "m_TL + m_Gr [kg]",
    "I_SL + I_TL + I_Gr + ... [kg m2]",
    "m_FL r_FL [kg m]",
)


class Seven:
    """The paper's seven parameters of an open chain of three bodies, as a term of the model.

    With PER_BODY parameters of the machine, tau = Y B theta: Y of all bodies, B (p, 7). The
    directions from the pins to the centres of mass count as known, as in the paper.

    Args:
        machine: Driven by q2, q3, q4.

    Attributes:
        B: See above.
    """

    names = tuple(f"theta_{i}" for i in range(1, 8))
    nonnegative = (False,) * 7

    def __init__(self, machine: crane.Machine):
        self._dynamics = crane.Dynamics(machine)
        parameters, bodies = self._dynamics.parameters, body_names(machine)
        start = {name: 10 * i for i, name in enumerate(bodies)}
        first, second, third = (parameters[start[x] : start[x] + 10] for x in BODIES)
        self.B = np.zeros((len(parameters), 7))
        for name, body, moment, inertia in (
            ("lift_boom", first, 6, 0),
            ("tilt_boom", second, 1, 5),
        ):
            at = start[name]
            self.B[at + 1 : at + 3, moment] = body[1:3] / np.hypot(*body[1:3])
            self.B[at + 9, inertia] = 1.0
        self.B[start["tilt_boom"], 2] = 1.0
        at = start["extension"]  # its centre of mass stays at one height on the tilt boom
        self.B[at + 1, 3] = 1.0
        self.B[at, 4], self.B[at + 2, 4] = 1.0, third[2] / third[0]
        self.nominal = np.array(
            [first[9], np.hypot(*second[1:3]), second[0], third[1], third[0],
             second[9] + third[9], np.hypot(*first[1:3])]
        )  # fmt: skip

    def columns(self, samples: MotionSamples) -> Array:
        """See `ModelTerm`."""
        return self._dynamics.regressor(samples.q_a, samples.v_a, samples.a_a) @ self.B


def joint_motion(plant: Crane, recording: crane.Recording, period: float) -> Motion:
    """Averaged joint coordinates with their Kalman estimates, and torques by (18) to (20).

    The averaged period is repeated for the smoother, which then has no ends.
    """
    one = averaged(recording, period)
    q = np.column_stack([one.channels["q2"], one.channels["q3"], one.q[:, 2]])
    count = len(q)
    found = differentiate(STEP * np.arange(3 * count), np.tile(q, (3, 1)))
    kept = slice(count, 2 * count)
    torques = plant.torques(q, one.tau)
    return Motion(one.time, found.q[kept], found.v[kept], found.a[kept], torques)


def without(joints: crane.Machine, motion: Motion, bodies: tuple[str, ...]) -> Motion:
    """The same motion, its forces less those of some bodies by the machine's description."""
    forces = motion.tau - forces_of(joints, motion, bodies)
    return Motion(motion.time, motion.q, motion.v, motion.a, forces)


def forces_of(joints: crane.Machine, motion: Motion, bodies: tuple[str, ...]) -> Array:
    """Forces (N, 3) that some bodies ask for."""
    dynamics, names = crane.Dynamics(joints), body_names(joints)
    parameters = dynamics.parameters
    for i, name in enumerate(names):
        if name not in bodies:
            parameters[10 * i : 10 * i + 10] = 0.0
    return dynamics.regressor(motion.q, motion.v, motion.a) @ parameters


@dataclass(frozen=True, eq=False)
class HeldOutForces:
    """Measured and modelled forces (N, 3) of a held-out set, both filtered alike.

    Attributes:
        time: (N,) [s].
        measured: tau_2, tau_3, F_4.
        modelled: Likewise.
        moving: (N, 3) where the joint moves, so that its friction is known.
    """

    time: Array
    measured: Array
    modelled: Array
    moving: np.ndarray

    @property
    def rmse(self) -> Array:
        """(3,) where the joints move."""
        gaps = np.where(self.moving, self.measured - self.modelled, 0.0)
        return np.sqrt((gaps**2).sum(axis=0) / self.moving.sum(axis=0))

    @property
    def relative_error(self) -> Array:
        """(3,) `rmse` over the root mean square of the measured forces at the same samples."""
        squares = (np.where(self.moving, self.measured, 0.0) ** 2).sum(axis=0)
        return self.rmse / np.sqrt(squares / self.moving.sum(axis=0))

    @property
    def whole(self) -> Array:
        """(3,) relative error of all samples, those at standstill included."""
        gaps = np.linalg.norm(self.measured - self.modelled, axis=0)
        return gaps / np.linalg.norm(self.measured, axis=0)


def judge(found: Identification, motion: Motion, added: Array | None = None) -> HeldOutForces:
    """Forces of a held-out set by identified parameters, with known forces added."""
    modelled = found.predict(motion.q, motion.v, motion.a)
    return _judged(motion, modelled if added is None else modelled + added)


def true_forces(joints: crane.Machine, motion: Motion) -> HeldOutForces:
    """Forces by the true parameters: the residual is noise, and what the filter removes."""
    modelled = crane.Dynamics(joints).inverse(motion.q, motion.v, motion.a, friction=True)
    return _judged(motion, modelled)


def _judged(motion: Motion, modelled: Array) -> HeldOutForces:
    both = np.tile(np.hstack([motion.tau, modelled]), (3, 1))
    count = len(motion.time)
    passed = low_pass(STEP * np.arange(3 * count), both, BANDWIDTH)[count : 2 * count]
    moving = np.abs(motion.v) > 0.02 * np.abs(motion.v).max(axis=0)
    return HeldOutForces(motion.time, passed[:, :3], passed[:, 3:], moving)


def learned(
    joints: crane.Machine, motion: Motion, model: str, stribeck: tuple[float, ...] = ()
) -> Identification:
    """Parameters from a motion.

    Args:
        joints: The machine driven by its joints.
        motion: To learn from.
        model: "closed": all bodies, friction along the cylinders; "seven": the paper's three
            bodies; "seven, friction at joints": and its friction (15).
        stribeck: Velocities of stiction, which (14) does not have [m/s].
    """
    bodies: ModelTerm = InertialTerm(joints) if model == "closed" else Seven(joints)
    places = ANGLES if "joints" in model else CYLINDERS
    terms = [bodies, *(friction_term(joints, place, stribeck=stribeck) for place in places)]
    return identify(joints, motion, terms=terms, bandwidth=BANDWIDTH)


def elbow(joints: crane.Machine) -> float:
    """Distance L from the lift boom's pin to the tilt boom's [m]."""
    place = joints.model.jointPlacements[joints.model.getJointId("q3")].translation
    return float(np.linalg.norm(place))


def combined(found: Identification, factors: dict[str, float]) -> tuple[float, float, float]:
    """A combination of parameters and the ends of its 95 % interval."""
    from scipy.stats import t

    row = np.array([factors.get(name, 0.0) for name in found.names])
    value = float(row @ found.values)
    half = float(np.sqrt(row @ found.covariance @ row)) * float(
        t.ppf(0.975, found.estimate.degrees_of_freedom)
    )
    return value, value - half, value + half
