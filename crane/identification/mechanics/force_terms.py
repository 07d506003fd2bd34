"""Model terms of friction, gas springs and forces of a known shape."""

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise

import numpy as np

from crane.common.errors import InputError, suggest_names
from crane.common.samples import Array
from crane.description.force_elements import Friction
from crane.dynamics.joint_forces import JointForces
from crane.identification.mechanics.model_term import (
    ForceDirection,
    ModelTerm,
    MotionSamples,
    resolve_direction,
)
from crane.machine.machine import Machine

ForceShape = Callable[[Array], Array]


class VelocityFriction(ModelTerm):
    """Friction term: known functions of the velocity along one direction times parameters.

    Args:
        machine: The machine.
        direction: Name of a joint, or a combination.
        shapes: Functions velocity (N,) -> (N,) by name of the parameter.
        nominal: Nominal values; default zero.
        nonnegative: Names of parameters that must not be negative.

    Attributes:
        direction: Direction of the friction.
        stribeck_velocities: Stribeck velocities [m/s], [rad/s].
    """

    stribeck_velocities: tuple[float, ...] = ()

    def __init__(
        self,
        machine: Machine,
        direction: str | ForceDirection,
        shapes: Mapping[str, ForceShape],
        nominal: Mapping[str, float] | None = None,
        nonnegative: Sequence[str] = (),
    ):
        direction = resolve_direction(machine, direction)
        self._machine, self.direction, self._shapes = machine, direction, shapes
        self.names = tuple(f"{direction.name}.{name}" for name in shapes)
        self.nominal = np.array([(nominal or {}).get(name, 0.0) for name in shapes])
        self.nonnegative = tuple(name in nonnegative for name in shapes)

    def columns(self, samples: MotionSamples) -> Array:
        """See `ModelTerm`."""
        rows = self.direction.jacobian(self._machine, samples)
        speed = np.einsum("ij,ij->i", rows, samples.v_a)
        return rows[:, :, None] * self.steady_forces(speed)[:, None, :]

    def steady_forces(self, v: Array) -> Array:
        """Forces (N, k) per parameter at steady speeds (N,)."""
        return np.stack([shape(v) for shape in self._shapes.values()], axis=1)


def smoothed_sign(smoothing: float) -> ForceShape:
    """Function sign(v), smoothed to tanh(v / smoothing) as in the simulation."""
    if smoothing == 0:
        return np.sign
    return lambda v: np.tanh(v / smoothing)


def friction_term(
    machine: Machine,
    direction: str | ForceDirection,
    kinds: Sequence[str] = ("coulomb", "coulomb_offset", "viscous", "viscous_offset"),
    smoothing: float | None = None,
    stribeck: Sequence[float] = (),
) -> VelocityFriction:
    """Friction term of equation (5) of the reduced-scale forwarder paper, with stiction.

        coulomb s + coulomb_offset + viscous v + viscous_offset |v|
        + sum_i stiction_i s e^-(v / v_i)^2,    s = sign(v).

    Args:
        machine: The machine, whose friction gives the nominal values.
        direction: Name of a joint, or a combination.
        kinds: Names of the kinds, some of the four.
        smoothing: Smoothing velocity of the sign [m/s], [rad/s]; default that of the machine.
        stribeck: Stribeck velocities v_i [m/s], [rad/s]; parameters of several are stiction_1, ...
    """
    name = direction if isinstance(direction, str) else direction.name
    law = machine.friction.get(name, Friction(smoothing=0.0))
    sign = smoothed_sign(law.smoothing if smoothing is None else smoothing)
    shapes_by_kind: dict[str, ForceShape] = {
        "coulomb": sign,
        "coulomb_offset": np.ones_like,
        "viscous": lambda v: v,
        "viscous_offset": lambda v: v * sign(v),
    }
    for kind in kinds:
        if kind not in shapes_by_kind:
            raise InputError(
                f"friction '{kind}' is unknown, {suggest_names(shapes_by_kind, kind)}"
            )
    shapes = {kind: shapes_by_kind[kind] for kind in kinds}
    nominal = {kind: getattr(law, kind) for kind in kinds}
    for i, v_s in enumerate(stribeck, start=1):
        label = "stiction" if len(stribeck) == 1 else f"stiction_{i}"
        shapes[label] = lambda v, v_s=v_s: sign(v) * np.exp(-((v / v_s) ** 2))  # type: ignore[misc]
        if law.stribeck == v_s:
            nominal[label] = law.stiction
    term = VelocityFriction(
        machine, direction, shapes, nominal, nonnegative=("coulomb", "viscous")
    )
    term.stribeck_velocities = tuple(stribeck)
    return term


def root_friction_term(machine: Machine, direction: str | ForceDirection) -> VelocityFriction:
    """Friction term of mixed lubrication: root sign(v) sqrt |v|."""
    shape = {"root": lambda v: np.sign(v) * np.sqrt(np.abs(v))}
    return VelocityFriction(machine, direction, shape)


class FrictionalMemory(ModelTerm):
    """Frictional memory: memory sign(v) e^-(w / speed), lag w' = |v| - w, w = 0 at the start.

    The friction is larger after rest than before it, as the contact changes with a lag.

    Args:
        machine: The machine.
        direction: Name of a joint, or a combination.
        lag: Time constant [s].
        speed: Characteristic speed [m/s], [rad/s].
    """

    def __init__(
        self, machine: Machine, direction: str | ForceDirection, lag: float, speed: float
    ):
        direction = resolve_direction(machine, direction)
        if not (lag > 0 and speed > 0):
            raise InputError(
                f"the memory of '{direction.name}' has the lag {lag:g} s and the speed {speed:g}, "
                "give two numbers above 0"
            )
        self._machine, self.direction, self._lag, self._speed = machine, direction, lag, speed
        self.names, self.nominal = (f"{direction.name}.memory",), np.zeros(1)
        self.nonnegative = (False,)

    def columns(self, samples: MotionSamples) -> Array:
        """See `ModelTerm`."""
        from scipy.signal import lfilter

        if samples.step is None:
            raise InputError(f"'{self.names[0]}' depends on time, give the step of the samples")
        rows = self.direction.jacobian(self._machine, samples)
        v = np.einsum("ij,ij->i", rows, samples.v_a)
        share = -np.expm1(-samples.step / self._lag)  # exact for constant speed
        w, state = np.empty_like(v), samples.term_states.get(self, np.zeros(1))
        edges = sorted({0, *samples.starts, len(v)})
        for start, end in pairwise(edges):
            state = np.zeros(1) if start in samples.starts else state
            w[start:end], state = lfilter([share], [1, share - 1], np.abs(v[start:end]), zi=state)
        samples.term_states[self] = state
        return (rows * (np.sign(v) * np.exp(-w / self._speed))[:, None])[:, :, None]

    def steady_forces(self, v: Array) -> Array:
        """Force (N, 1) per parameter at steady speeds (N,), where w = |v|."""
        return (np.sign(v) * np.exp(-np.abs(v) / self._speed))[:, None]


class PreslidingFriction(ModelTerm):
    """Presliding friction: Dahl's law over the travelled distance.

    F = force z, dz = (1 - sign(v) z) ds / length, z = 0 at the start of a recording (Dahl, 1968).

    Args:
        machine: The machine.
        direction: Name of a joint, or a combination.
        length: Characteristic distance [m], [rad].
    """

    def __init__(self, machine: Machine, direction: str | ForceDirection, length: float):
        direction = resolve_direction(machine, direction)
        if not length > 0:
            raise InputError(f"the length of presliding of '{direction.name}' is {length:g}")
        self._machine, self.direction, self._length = machine, direction, length
        self.names, self.nominal = (f"{direction.name}.presliding",), np.zeros(1)
        self.nonnegative = (True,)

    def columns(self, samples: MotionSamples) -> Array:
        """See `ModelTerm`."""
        rows = self.direction.jacobian(self._machine, samples)
        travel = self.direction.coordinate(self._machine, samples)
        state, last = samples.term_states.get(self, (0.0, travel[0]))
        steps = np.diff(travel, prepend=last) / self._length
        steps[list(samples.starts)] = 0.0
        z = np.empty(len(travel))
        restarts = set(samples.starts)
        for i, step in enumerate(steps.tolist()):
            if i in restarts:
                state = 0.0
            limit = 1.0 if step > 0 else -1.0
            state = limit + (state - limit) * np.exp(-abs(step))  # exact for a constant direction
            z[i] = state
        samples.term_states[self] = (state, travel[-1])
        return rows[:, :, None] * z[:, None, None]

    def steady_forces(self, v: Array) -> Array:
        """Force (N, 1) per parameter at steady speeds (N,), fully developed."""
        return np.sign(v)[:, None]


FrictionTerm = VelocityFriction | PreslidingFriction | FrictionalMemory


class GasSpringTerm(ModelTerm):
    """Term of a gas spring: a factor on its force with the nominal value 1.

    Args:
        machine: The machine.
        joint: Joint of the gas spring, or its name.
    """

    def __init__(self, machine: Machine, joint: str):
        springs = [spring for spring in machine.gas_springs if spring.joint == joint]
        if not springs:
            names = [spring.joint for spring in machine.gas_springs]
            raise InputError(f"joint '{joint}' has no gas spring, {suggest_names(names, joint)}")
        self._joint_forces = JointForces(machine.replace(gas_springs=tuple(springs)))
        self.names, self.nominal, self.nonnegative = (f"{joint}.gas_scale",), np.ones(1), (True,)

    def columns(self, samples: MotionSamples) -> Array:
        """See `ModelTerm`."""
        return -np.einsum("kij,ki->kj", samples.gamma, self._joint_forces.gas_forces(samples.q))[
            :, :, None
        ]


class ForceElementTerm(ModelTerm):
    """Passive force of known shape along a joint or distance times a factor.

    Args:
        machine: The machine.
        direction: Name of a joint, active or passive, or a combination or distance.
        shape: Function coordinate (N,) [m], [rad] -> force in the positive direction per factor.
        name: Name of the factor.
        nominal: Nominal value of the factor.
    """

    def __init__(
        self,
        machine: Machine,
        direction: str | ForceDirection,
        shape: ForceShape,
        name: str,
        nominal: float = 0.0,
    ):
        self._machine, self._shape = machine, shape
        self._direction = resolve_direction(machine, direction)
        self.names, self.nominal = (f"{self._direction.name}.{name}",), np.array([nominal])
        self.nonnegative = (False,)

    def columns(self, samples: MotionSamples) -> Array:
        """See `ModelTerm`."""
        force = self._shape(self._direction.coordinate(self._machine, samples))
        return -(self._direction.jacobian(self._machine, samples) * force[:, None])[:, :, None]
