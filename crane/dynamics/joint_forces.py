"""Forces along joints and distances: friction, springs, dampers, gas, end stops, ropes.

Stick-slip friction has modes, see `JointForces.set_stick_slip_modes`; a simulation switches them
at stick-slip transitions in `crane.simulation.integration.stick_slip_modes`.
"""

from collections import Counter

import numpy as np

from crane.common.samples import Array
from crane.description.force_elements import ForceElement, Friction, GasSpring, Rope
from crane.dynamics.frame_jacobians import FrameDistances, FramePair
from crane.dynamics.friction_history import dahl_deflections, remembered_speeds
from crane.machine.machine import Machine

LAW_PARAMETER_NAMES = (
    "coulomb", "coulomb_offset", "viscous", "viscous_offset", "sharpness", "stiction", "stribeck",
    "stiction_2", "stribeck_2", "memory", "memory_speed", "root",
    "slip_sign", "is_held", "inverse_velocity",
    "stiffness", "damping", "constant", "energy_offset",
    "stop_stiffness", "stop_damping", "lower_limit", "upper_limit",
    "gas_force", "gas_area_per_volume", "gas_rest_position", "gas_exponent",
)  # fmt: skip
PARAMETER_COUNT = len(LAW_PARAMETER_NAMES)  # values of a law, see `JointForces.table`
BREAKAWAY_INDICES = [
    LAW_PARAMETER_NAMES.index(name) for name in ("coulomb", "stiction", "stiction_2", "memory")
]
SHARPNESS_INDEX = LAW_PARAMETER_NAMES.index("sharpness")
SLIP_INDEX = LAW_PARAMETER_NAMES.index("slip_sign")  # first of the stick-slip mode
END_STOP_INDEX = LAW_PARAMETER_NAMES.index("stop_stiffness")  # first of the end stop
_MODE_FIELDS = slice(SLIP_INDEX, LAW_PARAMETER_NAMES.index("inverse_velocity") + 1)
_SPRING_FIELDS = slice(
    LAW_PARAMETER_NAMES.index("stiffness"), LAW_PARAMETER_NAMES.index("energy_offset") + 1
)
_END_STOP_FIELDS = slice(END_STOP_INDEX, LAW_PARAMETER_NAMES.index("upper_limit") + 1)
_GAS_FIELDS = slice(LAW_PARAMETER_NAMES.index("gas_force"), PARAMETER_COUNT)
# for joints with circuit friction only, so that friction is never zero
MIN_COULOMB_FRICTION = 1e-6
REST_VELOCITY = 5e-10  # scaled velocity that counts as rest
REST_ACCELERATION = 1e-9  # [rad/s^2], [m/s^2] acceleration that counts as rest
_UNSMOOTHED_SHARPNESS = 1e300  # sharpness of a discontinuous sign
ROOT_VELOCITY = 1e-8  # [rad/s], [m/s] below which the root of the speed is a line


class JointForces:
    """Friction and passive forces of a machine, as forces along the joints of its tree.

    A passive force acts along a coordinate: that of a joint, or the distance of two frames. The
    law is the same; a force F along a distance l acts on the joints with F dl/dv.

    `crane.dynamics.joint_force_formulas.evaluate_force_law` has the same laws as formulas, on
    purpose: each checks the other.

    Args:
        machine: The machine whose `friction`, `forces`, `gas_springs`, `ropes` and `end_stops`
            act.

    Attributes:
        lengths: The m distances that force elements act along.
        stick_slip_columns: Columns of the joints with stick-slip friction.
        circuit_friction_columns: Columns of the joints with circuit friction.
        circuit_friction: (nv,) current circuit friction [N], [N m]; see `set_circuit_friction`.
        moving_factor: 0 where friction holds the whole machine at rest, else 1; see
            `set_stick_slip_modes`.
        table: (nv + m, 27) per joint, then per distance: Coulomb friction with that of presliding,
            its offset, viscous friction, its offset, one over the smoothing velocity; two
            stictions, each with one over its Stribeck velocity; memory and one over its speed;
            factor of the root of the speed; the stick-slip mode: sign of the slip or share of the
            limit at rest, whether it is held, one over a velocity of the machine
            (`set_stick_slip_modes`); stiffness, damping, constant force, energy of the spring at
            q = 0; stiffness and damping of the end stops, lower and upper limit; force of a gas
            spring at rest, its area over its volume there, rest position, exponent. A rope is an
            end stop.
    """

    def __init__(self, machine: Machine):
        rows, pairs = _table_rows(machine)
        self._joint_count, self.lengths = machine.model.nv, FrameDistances(machine, pairs)
        self._laws_with_history = {
            machine.column(joint): law
            for joint, law in machine.friction.items()
            if law.has_history
        }
        law_table = self.table = np.zeros((self._joint_count + len(pairs), PARAMETER_COUNT))
        self.stick_slip_columns, self.moving_factor = find_stick_slip_columns(machine), 1.0
        self.circuit_friction_columns, self.circuit_friction = (
            find_circuit_friction_columns(machine),
            np.zeros(self._joint_count),
        )
        for joint, friction in (
            dict.fromkeys(machine.joints, Friction()) | dict(machine.friction)
        ).items():
            column = machine.column(joint)
            only_circuit_friction = (
                column in self.stick_slip_columns and not friction.has_stick_slip
            )
            law_table[column, :SLIP_INDEX] = (
                MIN_COULOMB_FRICTION if only_circuit_friction else friction.sliding_force,
                friction.coulomb_offset,
                friction.viscous,
                friction.viscous_offset,
                1.0 / friction.smoothing if friction.smoothing else _UNSMOOTHED_SHARPNESS,
                friction.stiction,
                1.0 / friction.stribeck,
                friction.stiction_2,
                1.0 / friction.stribeck_2,
                friction.memory,
                1.0 / friction.memory_speed,
                friction.root,
            )
        for stop in machine.end_stops:
            i = machine.column(stop.joint)
            lower, upper = machine.coordinates.lower, machine.coordinates.upper
            law_table[i, _END_STOP_FIELDS] = stop.stiffness, stop.damping, lower[i], upper[i]
        law_table[:, _GAS_FIELDS] = 0.0, 1.0, 0.0, 1.0
        for row, item in zip(rows, machine.force_elements, strict=True):
            match item:
                case ForceElement():
                    # springs of one joint add up: sum k (q - rest) = K q - sum k rest
                    law_table[row, _SPRING_FIELDS] += (
                        item.stiffness,
                        item.damping,
                        item.force + item.stiffness * item.rest,
                        0.5 * item.stiffness * item.rest**2,
                    )
                case GasSpring():
                    law_table[row, _GAS_FIELDS] = (
                        item.area * item.pressure,
                        item.area / item.volume,
                        item.rest,
                        item.exponent,
                    )
                case Rope():
                    law_table[row, _END_STOP_FIELDS] = (
                        item.stiffness,
                        item.damping,
                        0.0,
                        item.length,
                    )
        (
            self._stiffness,
            self._damping,
            self._constant,
            self._energy_offset,
            self._stop_stiffness,
            self._stop_damping,
            self._lower_limits,
            self._upper_limits,
            self._gas_force,
            self._gas_area_per_volume,
            self._gas_rest_position,
            self._gas_exponent,
        ) = np.ascontiguousarray(law_table[:, _SPRING_FIELDS.start :].T)

    @property
    def breakaway(self) -> Array:
        """(k,) largest friction of the stick-slip joints at rest, relative to its offset."""
        return self._joint_breakaway + self.circuit_friction[list(self.stick_slip_columns)]

    @property
    def _joint_breakaway(self) -> Array:
        """The same without circuit friction."""
        law = self.table[list(self.stick_slip_columns)]
        return np.asarray(law[:, BREAKAWAY_INDICES].sum(axis=1))

    def friction_at_rest(self, limit_share: Array) -> Array:
        """(k,) friction of stick-slip joints at rest, from shares (k,) of its limit."""
        return (
            self.table[list(self.stick_slip_columns), LAW_PARAMETER_NAMES.index("coulomb_offset")]
            + limit_share * self.breakaway
        )

    @property
    def stick_slip_modes(self) -> tuple[Array, Array, Array]:
        """(k,) each, the arguments of `set_stick_slip_modes`."""
        slip_sign, is_held, inverse_velocity = self.table[
            list(self.stick_slip_columns), _MODE_FIELDS
        ].T
        return slip_sign, is_held, inverse_velocity

    def set_stick_slip_modes(
        self, slip_sign: Array, is_held: Array, inverse_velocity: Array, is_moving: bool
    ) -> None:
        """Set which stick-slip joints slip, rest or are held.

        Args:
            slip_sign: (k,) signs of their slips, or shares of the limit for those at rest.
            is_held: (k,) 1 where a joint is held at rest by the necessary friction, else 0.
            inverse_velocity: (k,) one over velocities of the machine.
            is_moving: Whether anything moves.
        """
        self.moving_factor = float(is_moving)
        modes = np.array([slip_sign, is_held, inverse_velocity]).T
        self.table[list(self.stick_slip_columns), _MODE_FIELDS] = modes

    def set_circuit_friction(self, circuit_friction: Array) -> None:
        """Set the circuit friction (g,) of the joints of `circuit_friction_columns`."""
        self.circuit_friction[list(self.circuit_friction_columns)] = circuit_friction

    def friction_forces(self, v: Array, use_modes: bool = False) -> Array:
        """Drive force that overcomes friction at every joint at steady speeds.

        tau_F = (F_C + sum_i F_Si e^-(v / v_Si)^2 + F_M e^-|v / v_M|) s + D_C + F_V v + D_V v s
        + F_R v / |v|^(1/2) with s = tanh(v / smoothing) or sign(v): equation (5) of the
        reduced-scale forwarder paper with the sign that brakes, see `Friction`.

        Args:
            v: (nv,) or (N, nv) [m/s], [rad/s]; one sample with modes.
            use_modes: Whether s of the stick-slip joints comes from `set_stick_slip_modes`, and
                F_C includes circuit friction.

        Returns:
            (nv,) or (N, nv) [N], [N m].
        """
        (
            coulomb, coulomb_offset, viscous, viscous_offset, sharpness, stiction, stribeck,
            stiction_2, stribeck_2, memory, memory_speed, root,
        ) = self.table[: self._joint_count].T[:SLIP_INDEX]  # fmt: skip
        sign = np.tanh(v * sharpness)
        if use_modes:
            stick_slip = list(self.stick_slip_columns)
            sign[stick_slip] = self.table[stick_slip, SLIP_INDEX]
            coulomb = coulomb + self.circuit_friction
        slow = stiction * np.exp(-((v * stribeck) ** 2))
        slow += stiction_2 * np.exp(-((v * stribeck_2) ** 2))
        slow += memory * np.exp(-np.abs(v * memory_speed))
        return (
            (coulomb + slow) * sign
            + coulomb_offset
            + (viscous + viscous_offset * sign) * v
            + root * root_speed(v)
        )

    def friction_along_motion(self, q: Array, v: Array, step: float) -> Array:
        """Drive force that overcomes friction along a motion, which begins without history.

        In place of the steady values of `friction_forces` it has those of the history,
        F_P z + F_M e^-(w / v_M) s, see `Friction`.

        Args:
            q: (N, nq) [m], [rad].
            v: (N, nv) [m/s], [rad/s].
            step: Step of the samples [s].

        Returns:
            (N, nv) [N], [N m].
        """
        force = self.friction_forces(v)
        for i, law in self._laws_with_history.items():
            sign = np.tanh(v[:, i] * self.table[i, SHARPNESS_INDEX])
            w, _ = remembered_speeds(v[:, i], step, law.memory_time)
            remembered, steady = np.exp(-np.stack([w, np.abs(v[:, i])]) / law.memory_speed)
            z = dahl_deflections(q[:, i], law.presliding_length)
            force[:, i] += law.memory * (remembered - steady) * sign + law.presliding * (z - sign)
        return force

    def breakaway_forces(self, v: Array, a: Array) -> Array:
        """Breakaway friction of stick-slip joints that start to move from rest.

        Args:
            v: (nv,) or (N, nv) [m/s], [rad/s].
            a: (nv,) or (N, nv) [m/s^2], [rad/s^2].

        Returns:
            (nv,) or (N, nv) in addition to `friction_forces`, (F_C + F_S) sign(a) where v = 0 [N],
            [N m].
        """
        stick_slip = list(self.stick_slip_columns)
        out = np.zeros_like(v)
        starts = (v[..., stick_slip] == 0) & (np.abs(a[..., stick_slip]) > REST_ACCELERATION)
        out[..., stick_slip] = np.where(
            starts, np.sign(a[..., stick_slip]) * self._joint_breakaway, 0.0
        )
        return out

    def passive_forces(self, q: Array, v: Array) -> Array:
        """Force of springs, dampers, constant forces, gas, end stops and ropes on every joint.

        f = force - stiffness (q - rest) - damping v; for end stops at a depth d beyond the limit
        f = -+ stiffness d max(0, 1 + damping d') (Hunt and Crossley, 1975); for gas springs
        f = area pressure (V0 / V)^exponent.

        Args:
            q: (nq,) or (N, nq) [m], [rad].
            v: (nv,) or (N, nv) [m/s], [rad/s].

        Returns:
            (nv,) or (N, nv) [N], [N m].
        """
        return self._project_on_joints(*self.passive_forces_by_element(q, v))

    def passive_forces_by_element(self, q: Array, v: Array) -> tuple[Array, Array]:
        """`passive_forces` by joint and distance.

        Args:
            q: (nq,) or (N, nq) [m], [rad].
            v: (nv,) or (N, nv) [m/s], [rad/s].

        Returns:
            Forces along joints, then distances (nv + m,) or (N, nv + m) [N], [N m], and dl/dv of
            the distances.
        """
        frame_distances, distance_jacobian = self.lengths.evaluate(q)
        rates = np.einsum("...ki,...i->...k", distance_jacobian, v)
        q, v = np.concatenate([q, frame_distances], axis=-1), np.concatenate([v, rates], axis=-1)
        beyond_upper, beyond_lower = (
            np.maximum(0.0, q - self._upper_limits),
            np.maximum(0.0, self._lower_limits - q),
        )
        stopping = beyond_lower * np.maximum(
            0.0, 1 - self._stop_damping * v
        ) - beyond_upper * np.maximum(0.0, 1 + self._stop_damping * v)
        springs = self._constant - self._stiffness * q - self._damping * v
        return springs + self._stop_stiffness * stopping + self._gas_element_forces(
            q
        ), distance_jacobian

    def gas_forces(self, q: Array) -> Array:
        """Force of the gas springs on every joint.

        Args:
            q: (nq,) or (N, nq) [m], [rad].

        Returns:
            (nv,) or (N, nv) [N], [N m].
        """
        lengths, distance_jacobian = self.lengths.evaluate(q)
        return self._project_on_joints(
            self._gas_element_forces(np.concatenate([q, lengths], axis=-1)), distance_jacobian
        )

    def _project_on_joints(self, element_forces: Array, distance_jacobian: Array) -> Array:
        """Forces along joints and distances (nv + m,) as forces along joints (nv,)."""
        joints = element_forces[..., : self._joint_count]
        return joints + np.einsum(
            "...ki,...k->...i", distance_jacobian, element_forces[..., self._joint_count :]
        )

    def _gas_element_forces(self, q: Array) -> Array:
        """Gas forces along joints and distances (nv + m,)."""
        out = np.zeros_like(q)
        here = np.flatnonzero(self._gas_force)
        volume_ratio = 1.0 + self._gas_area_per_volume[here] * (
            q[..., here] - self._gas_rest_position[here]
        )
        out[..., here] = self._gas_force[here] * volume_ratio ** -self._gas_exponent[here]
        return out

    def potential_energy(self, q: Array) -> float:
        """Energy stored in springs, constant forces, gas, end stops and ropes [J].

        Args:
            q: (nq,) [m], [rad].
        """
        q = np.concatenate([q, self.lengths.evaluate(q)[0]])
        depth = np.maximum(0.0, np.maximum(q - self._upper_limits, self._lower_limits - q))
        here = np.flatnonzero(self._gas_force)
        volume_ratio = 1.0 + self._gas_area_per_volume[here] * (
            q[here] - self._gas_rest_position[here]
        )
        less = 1.0 - self._gas_exponent[here]
        work = np.where(
            less == 0,
            np.log(volume_ratio),
            (volume_ratio**less - 1) / np.where(less == 0, 1.0, less),
        )
        return float(
            -(self._gas_force[here] / self._gas_area_per_volume[here]) @ work
            + 0.5 * self._stiffness @ q**2
            - self._constant @ q
            + self._energy_offset.sum()
            + 0.5 * self._stop_stiffness @ depth**2
        )


def root_speed(v: Array) -> Array:
    """Root of the speed with the sign of the velocity, a line below `ROOT_VELOCITY`."""
    return v / np.sqrt(np.maximum(np.abs(v), ROOT_VELOCITY))


def find_stick_slip_columns(machine: Machine) -> tuple[int, ...]:
    """Columns of the joints with stick-slip friction, in order.

    By their own law, or by circuit friction if their law is not smoothed.
    """
    laws = machine.friction.items()
    found = {machine.column(joint) for joint, law in laws if law.has_stick_slip}
    return tuple(
        sorted(
            found
            | set(find_circuit_friction_columns(machine))
            - {machine.column(joint) for joint, law in laws if law.smoothing}
        )
    )


def find_circuit_friction_columns(machine: Machine) -> tuple[int, ...]:
    """Columns of the joints with circuit friction, in the order of the circuit."""
    joints = machine.hydraulics.circuit_friction_joints if machine.hydraulics is not None else ()
    return tuple(machine.column(joint) for joint in joints)


def _table_rows(machine: Machine) -> tuple[list[int], list[FramePair]]:
    """The table row of each force element, and the frames of the rows after the joints.

    Springs between the same frames share a row, as on one joint; so do a spring, a gas spring and
    a rope. Two gas springs or two ropes have separate rows.
    """
    found: dict[tuple[FramePair, int], int] = {}
    same_pair_count: Counter[tuple[str, FramePair]] = Counter()
    rows = []
    for item in machine.force_elements:
        if item.between is None:
            rows.append(machine.column(item.joint))
            continue
        number = same_pair_count[item.kind, item.between]
        if not isinstance(item, ForceElement):
            same_pair_count[item.kind, item.between] += 1
        rows.append(found.setdefault((item.between, number), machine.model.nv + len(found)))
    return rows, [pair for pair, _ in found]
