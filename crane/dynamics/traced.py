"""One forward sweep (Kane's form) and the forces along joints and distances, as formulas."""

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from crane.closure.rotations import turned_by, vector_rate
from crane.closure.screws import Pair, Vector
from crane.closure.traced import Bodies, Constants, Geometry, Loops, MovingBodies
from crane.codegen.factors import Positive
from crane.codegen.scalar import (
    Number,
    add,
    apply,
    cross,
    dot,
    maximum,
    minimum,
    product,
    scale,
    subtract,
    times,
    transposed,
    where_positive,
)  # fmt: skip
from crane.common.samples import Array
from crane.dynamics.composite import Composite
from crane.dynamics.formulation import carriers
from crane.dynamics.joint_forces import AT_REST, STILL, JointForces
from crane.dynamics.law import NONE, NUMBERS, SLIP, STOP, Effects, effects, sign_of
from crane.dynamics.lengths import LEAST
from crane.dynamics.moving import Moving
from crane.dynamics.recursion import Plan, accelerations, planned
from crane.machine import Machine

BODY = 10  # numbers of a body
_SOLVED = 7  # freedoms up to which solving with M_A takes fewer operations than recursion
_UPPER = np.triu_indices(3)
Spans = tuple[tuple[int, int], ...]  # by distance the bodies of both ends; 0 is the world


def numbers_of(machine: Machine, geometry: Geometry, forces: JointForces) -> Array:
    """Inertias, force laws and gravity in the order that `Sweep` reads them.

    Per body mass, COM (3), inertia about it (xx, xy, xz, yy, yz, zz) in the body's directions of
    the geometry; per joint the 22 numbers of `JointForces.table`; gravity (3); per joint its rotor
    inertia; per distance its 22 numbers, and where its two ends are on their bodies, likewise;
    whether anything moves; what a circuit adds to the Coulomb friction of joints
    (`JointForces.gripped`); mass and first moment of what stands (4); where the tip is on its
    body, likewise, if there is one.
    """
    bodies = []
    for i, joint in enumerate(machine.coordinates.joints, start=1):
        if i in geometry.massless:
            bodies.append([0.0] * BODY)
            continue
        turn, inertia = geometry.turns[i], machine.model.inertias[int(joint)]
        tensor = turn.T @ inertia.inertia @ turn
        bodies.append([inertia.mass, *(turn.T @ inertia.lever), *tensor[_UPPER]])
    gravity = machine.model.gravity.linear
    rotors = machine.model.armature
    joints, lengths = np.split(forces.table, [len(bodies)])
    numbers = [np.ravel(bodies), np.ravel(joints), gravity, rotors]
    for law, ends in zip(lengths, forces.lengths.ends, strict=True):
        turns = (geometry.turns[machine.coordinates.bodies[joint]] for joint, _ in ends)
        places = (turn.T @ place for turn, (_, place) in zip(turns, ends, strict=True))
        numbers += [law, *places]
    numbers += [[forces.moving], forces.grip[list(forces.gripped)]]
    still = machine.model.inertias[0]
    numbers += [[still.mass], still.mass * still.lever]
    if machine.tip is not None:
        body, place = tip_of(machine)
        numbers.append(geometry.turns[body].T @ place)
    return np.concatenate(numbers)


def tip_of(machine: Machine) -> tuple[int, Array]:
    """The body of a machine's tip, and where it is on it (3,) [m]."""
    assert machine.tip is not None
    frame = machine.model.frames[machine.frame(machine.tip)]
    return machine.coordinates.bodies[frame.parentJoint], np.array(frame.placement.translation)


def grips_at(machine: Machine, forces: JointForces) -> list[int]:
    """Where `numbers_of` has what `JointForces.set_grip` says."""
    first = modes_at(machine, forces)[-1] + 1
    return list(range(first, first + len(forces.gripped)))


def modes_at(machine: Machine, forces: JointForces) -> list[int]:
    """Where `numbers_of` has what `JointForces.set_modes` says, joint by joint."""
    bodies = machine.model.nv
    first = BODY * bodies + SLIP
    last = (BODY + NUMBERS + 1) * bodies + 3 + (NUMBERS + 6) * len(forces.lengths.ends)
    return [first + NUMBERS * i + k for i in forces.sticking for k in range(3)] + [last]


@dataclass(frozen=True)
class Form:
    """What a machine's formulas depend on besides its loops and numbers.

    Attributes:
        carriers: See `crane.dynamics.formulation`.
        plan: How forward dynamics goes through the machine's clusters; see
            `crane.dynamics.recursion`.
        spans: By distance of `JointForces.lengths` the bodies that its ends are on.
        sticking: Columns of the joints whose friction sticks.
        gripped: Columns of the joints whose Coulomb friction a circuit adds to.
        tip: Body of the tip, if there is one.
    """

    carriers: tuple[int, ...]
    plan: Plan
    spans: Spans
    sticking: tuple[int, ...]
    gripped: tuple[int, ...]
    tip: int | None

    @classmethod
    def of(cls, machine: Machine, formulation: str, forces: JointForces) -> "Form":
        """That of a machine.

        Raises:
            InputError: Unknown formulation.
        """
        bodies = machine.coordinates.bodies
        spans = ((bodies[one], bodies[two]) for (one, _), (two, _) in forces.lengths.ends)
        plan = planned(machine) if formulation == "exact" else ()
        kinds = forces.sticking, forces.gripped
        tip = None if machine.tip is None else tip_of(machine)[0]
        return cls(carriers(machine, formulation), plan, tuple(spans), *kinds, tip)


@dataclass(frozen=True)
class Moved:
    """A machine under forces, with friction that sticks.

    Attributes:
        a_a: (n,) accelerations.
        rest: (k,) friction of the joints at rest whose friction sticks, 0 of those that slip.
        friction: gamma^T tau_F (n,).
        margin: What is left until a joint slips that is at rest, as a share of its limit, or
            comes to rest that slips, as a velocity of the machine; the least. Negative beyond.
    """

    a_a: Vector
    rest: Vector
    friction: Vector
    margin: Number


class Sweep:
    """Dynamics at a traced closed posture.

    Args:
        posture: Bodies.
        loops: Loops at that posture.
        constants: See `numbers_of`.
        q: (nb,).
        v_a: (n,).
        form: What goes where.
        modes: Whether `JointForces.set_modes` says what joints do whose friction sticks, not their
            velocities.
        drift: If it is known already.

    Attributes:
        posture: Bodies.
        loops: Loops.
        q: (nb,).
        v_a: (n,).
        rotors: (nb + 1,) rotor inertias, 0 for the world.
        gamma: Rows of gamma by joint.
        rates: (nb + 1,) joint velocities, 0 for the world.
        drift: (nb + 1,) accelerations of the joints at a_A = 0.
        told: (g,) what the constants say that a circuit adds to Coulomb friction.
    """

    def __init__(
        self,
        posture: Bodies,
        loops: Loops,
        constants: Constants,
        q: Sequence[Number],
        v_a: Sequence[Number],
        form: Form,
        modes: bool = False,
        drift: Vector | None = None,
    ):
        self.form, self._modes = form, modes
        self.v_a = list(v_a)
        self.posture, self.loops, self.q = posture, loops, q
        self._size = len(posture.geometry.parents)
        self._n = len(v_a)
        bodies = self._size - 1
        self._inertias = [constants.vector(BODY * i, BODY) for i in range(bodies)]
        first = BODY * bodies
        self._laws = [constants.vector(first + NUMBERS * i, NUMBERS) for i in range(bodies)]
        gravity = constants.vector((BODY + NUMBERS) * bodies)
        self._gravity = times(posture.rotation[0], gravity)
        self.rotors: Vector = [0.0, *constants.vector((BODY + NUMBERS) * bodies + 3, bodies)]
        after = (BODY + NUMBERS + 1) * bodies + 3
        self._span_numbers = [
            constants.vector(after + (NUMBERS + 6) * k, NUMBERS + 6)
            for k in range(len(form.spans))
        ]
        last = after + (NUMBERS + 6) * len(form.spans)
        self._moving = constants[last]
        self.told = constants.vector(last + 1, len(form.gripped))
        last += len(form.gripped)
        self._standing = constants.vector(last + 1, 4)
        self._tip = None if form.tip is None else constants.vector(last + 5)
        self.gamma = loops.gamma
        self.rates: Vector = [0.0, *(dot(self.gamma[i], v_a) for i in range(1, self._size))]
        # the loops' drift is that of the whole machine whatever carries a body
        whole, alone = (
            MovingBodies(posture, loops, self.rates, self._gravity, parents)
            for parents in (posture.geometry.parents, form.carriers)
        )
        self.drift = whole.drift if drift is None else drift
        self._whole, self._motion = whole, alone

    def gripped(self, grip: Sequence[Number]) -> "Sweep":
        """The same with what a circuit adds to the Coulomb friction of `Form.gripped` (g,)."""
        if not self.form.gripped:
            return self
        out = copy(self)
        for name in ("_at_joints", "_passive"):  # what is known already of their friction
            out.__dict__.pop(name, None)
        out._laws = list(self._laws)
        for i, more in zip(self.form.gripped, grip, strict=True):
            out._laws[i] = [self._laws[i][0] + more, *self._laws[i][1:]]
        return out

    @cached_property
    def _columns(self) -> list[list[tuple[Vector, Vector]]]:
        """Per body dV/dv_A (linear at the trunk's origin, angular) by column, then the drift."""
        columns: list[list[tuple[Vector, Vector]]] = [[([0.0] * 3, [0.0] * 3)] * (self._n + 1)]
        for i in range(1, self._size):
            linear, angular = self.posture.columns[i]
            factors = [*self.gamma[i], self.drift[i]]
            carried = columns[self.form.carriers[i]]
            columns.append(
                [
                    (add(v, scale(factor, linear)), add(w, scale(factor, angular)))
                    for factor, (v, w) in zip(factors, carried, strict=True)
                ]
            )
        return columns

    @cached_property
    def _masses(self) -> list[tuple[Number, Vector, list[Vector]]]:
        """Per body mass, lever from origin to COM, inertia about it, in the trunk's axes."""
        out: list[tuple[Number, Vector, list[Vector]]] = []
        for i in range(1, self._size):
            mass, *rest = self._inertias[i - 1]
            rotation = self.posture.rotation[i]
            xx, xy, xz, yy, yz, zz = rest[3:]
            half = product(rotation, [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            tensor: list[Vector] = [[0.0] * 3 for _ in range(3)]
            for r in range(3):
                for c in range(r + 1):
                    tensor[r][c] = tensor[c][r] = dot(half[r], rotation[c])
            out.append((mass, times(rotation, rest[:3]), tensor))
        return out

    @cached_property
    def bodies(self) -> list[tuple[Number, Vector, list[Vector]]]:
        """Per body mass, COM, inertia about it, in the trunk's frame."""
        origins = self.posture.origin[1:]
        return [
            (mass, add(origin, lever), tensor)
            for origin, (mass, lever, tensor) in zip(origins, self._masses, strict=True)
        ]

    def _at_centre(self, i: int) -> list[tuple[Vector, Vector]]:
        """Columns of body i: linear at its COM, angular."""
        _, centre, _ = self.bodies[i - 1]
        return [(add(v, cross(w, centre)), w) for v, w in self._columns[i][: self._n]]

    @cached_property
    def mass(self) -> list[Vector]:
        """M_A = sum J_b^T I_b J_b + sum gamma_i^T I_r,i gamma_i."""
        if self.form.plan:
            clusters = [cluster for cluster, _ in self.form.plan]
            masses, rotors = self._masses, self.rotors
            return Composite(self.posture, self.loops, masses, rotors, clusters).mass
        out: list[Vector] = [[0.0] * self._n for _ in range(self._n)]
        for i in range(1, self._size):
            mass, _, tensor = self.bodies[i - 1]
            columns = self._at_centre(i)
            for k, (v, w) in enumerate(columns):
                momentum, spin = scale(mass, v), times(tensor, w)
                for j in range(k + 1):
                    out[k][j] = out[k][j] + dot(momentum, columns[j][0]) + dot(spin, columns[j][1])
                    out[j][k] = out[k][j]
        for i, row in self.gamma.items():
            for k in range(self._n):
                for j in range(k + 1):
                    out[j][k] = out[k][j] = out[k][j] + self.rotors[i] * row[k] * row[j]
        return out

    def projected(self, along: Sequence[Number]) -> Vector:
        """gamma^T of forces along the joints (nb + 1,)."""
        out: Vector = [0.0] * self._n
        for i, row in self.gamma.items():
            out = add(out, scale(along[i], row))
        return out

    def _along_tree(self, wrenches: Sequence[Pair]) -> Vector:
        """Forces along the joints (nb + 1,) that hold wrenches at the bodies' COMs."""
        forces = [force for force, _ in wrenches]
        moments = [
            add(moment, cross(lever, force))
            for (_, lever, _), (force, moment) in zip(self._masses, wrenches, strict=True)
        ]
        out: Vector = [0.0] * self._size
        for i in range(self._size - 1, 0, -1):
            force, moment = forces[i - 1], moments[i - 1]
            axis = self.posture.axis(i)
            out[i] = dot(axis, moment if self.posture.geometry.revolute[i] else force)
            carrier = self.form.carriers[i]
            if carrier:
                arm = self.posture.arms[i]
                forces[carrier - 1] = add(forces[carrier - 1], force)
                moments[carrier - 1] = add(moments[carrier - 1], moment, cross(arm, force))
        return out

    def motions(self, rates: Sequence[Number]) -> tuple[list[Pair], list[Pair]]:
        """Velocities and accelerations of the bodies whose joints accelerate so (nb + 1,).

        Linear at the trunk's origin, angular; the world accelerates with -gravity.
        """
        gained: list[Pair] = [([0.0] * 3, [0.0] * 3)]
        for i in range(1, self._size):
            linear, angular = (scale(rates[i], part) for part in self.posture.columns[i])
            before = gained[self.form.carriers[i]]
            gained.append((add(before[0], linear), add(before[1], angular)))
        accelerations = [
            (add(a, more), add(e, turned))
            for (a, e), (more, turned) in zip(self._motion.acceleration, gained, strict=True)
        ]
        return self._motion.velocity, accelerations

    def wrenches(self, rates: Sequence[Number]) -> list[Pair]:
        """Wrenches about the COMs that accelerate the joints so (nb + 1,), weights included."""
        wrenches: list[Pair] = []
        velocities, accelerations = self.motions(rates)
        for i in range(1, self._size):
            mass, centre, tensor = self.bodies[i - 1]
            (v, w), (a, e) = velocities[i], accelerations[i]
            at = add(a, cross(e, centre), cross(w, add(v, cross(w, centre))))
            wrenches.append((scale(mass, at), add(times(tensor, e), cross(w, times(tensor, w)))))
        return wrenches

    def _along_inertial(self, rates: Sequence[Number]) -> Vector:
        """Forces along the joints (nb + 1,) that accelerate them so, weights included."""
        rotors = [inertia * rate for inertia, rate in zip(self.rotors, rates, strict=True)]
        return add(self._along_tree(self.wrenches(rates)), rotors)

    @cached_property
    def inertial_bias(self) -> Vector:
        """Sum J_b^T (I_b a_b + v_b x* I_b v_b) at a_A = 0, weights and rotors included."""
        return self.projected(self._along_inertial(self.drift))

    @cached_property
    def weight(self) -> Vector:
        """gamma^T g(q)."""
        wrenches: list[Pair] = [
            (scale(-mass, self._gravity), [0.0] * 3) for mass, _, _ in self._masses
        ]
        return self.projected(self._along_tree(wrenches))

    @property
    def statics(self) -> list[Number]:
        """What loads at rest depend on, a number of `crane.dynamics.statics.layout` each.

        First moment s = sum m c of all masses and ds/dq_A, mass, gamma^T f (at rest where v_A is
        0); tip and dtip/dq_A if there is one; in the world. With what joint j carries, m_j, s_j,

            ds/dq_k = sum_j gamma_jk (m_j l_j + a_j x s_j),

        l_j, a_j its column, linear at the trunk's origin and angular.
        """
        posture, parents = self.posture, self.posture.geometry.parents
        carried: list[tuple[Number, Vector]] = [(0.0, [0.0] * 3)]
        carried += [(mass, scale(mass, centre)) for mass, centre, _ in self.bodies]
        for i in range(self._size - 1, 0, -1):
            mass, moment = carried[parents[i]]
            carried[parents[i]] = (mass + carried[i][0], add(moment, carried[i][1]))
        mass, moment = carried[0]
        moment = self._in_world(subtract(moment, scale(mass, posture.origin[0])))
        slopes: list[Vector] = [[0.0] * 3 for _ in range(self._n)]
        for i in range(1, self._size):
            linear, angular = posture.columns[i]
            way = add(scale(carried[i][0], linear), cross(angular, carried[i][1]))
            slopes = [add(x, scale(f, way)) for x, f in zip(slopes, self.gamma[i], strict=True)]
        out = [*add(moment, self._standing[1:]), *_by_row(map(self._in_world, slopes))]
        out += [mass + self._standing[0], *self.passive]
        if self._tip is None or self.form.tip is None:
            return out
        body = self.form.tip
        point = add(posture.origin[body], times(posture.rotation[body], self._tip))
        slopes = [[0.0] * 3 for _ in range(self._n)]
        for i in sorted(_carriers(parents, body)):
            linear, angular = posture.columns[i]
            way = add(linear, cross(angular, point))
            slopes = [add(x, scale(f, way)) for x, f in zip(slopes, self.gamma[i], strict=True)]
        out += self._in_world(subtract(point, posture.origin[0]))
        return [*out, *_by_row(map(self._in_world, slopes))]

    def _in_world(self, vector: Vector) -> Vector:
        """A vector in the world's directions."""
        return times(transposed(self.posture.rotation[0]), vector)

    @cached_property
    def _at_joints(self) -> list[Effects]:
        """What happens at all joints (nb + 1,)."""
        every = zip(self._laws, self.q, self.rates[1:], strict=True)
        sticking = self.form.sticking
        laws = (effects(*x, i in sticking, self._modes) for i, x in enumerate(every))
        return [NONE, *laws]

    @cached_property
    def _at_lengths(self) -> list[tuple[dict[int, Number], Effects, Number]]:
        """Of every distance dl/dv by joint, what happens along it, and itself.

        See `crane.dynamics.lengths`.
        The force along it is a wrench [u; p_2 x u] on the second body, and its reaction on the
        first, so what carries both feels nothing.
        """
        posture, out = self.posture, []
        for bodies, numbers in zip(self.form.spans, self._span_numbers, strict=True):
            law, places = numbers[:NUMBERS], (numbers[NUMBERS:-3], numbers[-3:])
            one, two = (
                add(posture.origin[body], times(posture.rotation[body], place))
                for body, place in zip(bodies, places, strict=True)
            )
            way = subtract(two, one)
            length = apply("sqrt", dot(way, way))
            direction = scale(1.0 / maximum(length, LEAST), way)
            moment = cross(two, direction)
            before, behind = (_carriers(posture.geometry.parents, body) for body in bodies)
            slopes: dict[int, Number] = {}
            for i in sorted(before ^ behind):
                linear, angular = posture.columns[i]
                slope = dot(direction, linear) + dot(moment, angular)
                slopes[i] = slope if i in behind else -slope
            rate = dot(list(slopes.values()), [self.rates[i] for i in slopes])
            out.append((slopes, effects(law, length, rate, False, False), length))
        return out

    @cached_property
    def _passive(self) -> Vector:
        """f, passive forces along the joints (nb + 1,)."""
        out = [found.force for found in self._at_joints]
        for slopes, found, _ in self._at_lengths:
            for i, slope in slopes.items():
                out[i] = out[i] + found.force * slope
        return out

    @property
    def _friction(self) -> Vector:
        """tau_F, friction along the joints (nb + 1,)."""
        return [found.friction for found in self._at_joints]

    @property
    def _everywhere(self) -> list[Effects]:
        """What happens at all joints and along all distances."""
        return [*self._at_joints, *(found for _, found, _ in self._at_lengths)]

    @property
    def stiffness(self) -> list[Vector]:
        """d(gamma^T f)/dq_A of springs, gas, end stops and ropes at frozen gamma (n, n)."""
        along = [(self.gamma[i], self._at_joints[i].slope) for i in range(1, self._size)]
        for slopes, found, _ in self._at_lengths:
            row: Vector = [0.0] * self._n
            for i, slope in slopes.items():
                row = add(row, scale(slope, self.gamma[i]))
            along.append((row, found.slope))
        out: list[Vector] = [[0.0] * self._n for _ in range(self._n)]
        for row, stiffness in along:
            for k, entry in enumerate(row):
                out[k] = add(out[k], scale(entry * stiffness, row))
        return out

    def edges(self, units: Sequence[float], size: float) -> Vector:
        """How far what stops is beyond where it begins to, each over its unit.

        Args:
            units: (nb,) of the joints.
            size: Of the machine, that of ropes [m].
        """
        out: Vector = []
        for law, q, unit in zip(self._laws, self.q, units, strict=True):
            if law[STOP] != 0.0:
                out += [(q - law[STOP + 3]) * (1.0 / unit), (law[STOP + 2] - q) * (1.0 / unit)]
        for numbers, (_, _, length) in zip(self._span_numbers, self._at_lengths, strict=True):
            if numbers[STOP] != 0.0:
                out.append((length - numbers[STOP + 3]) * (1.0 / size))
        return out

    @property
    def ways(self) -> list[Vector]:
        """d(slopes)/dv_A (nb, n), none of free-flyers."""
        flying = {i + k for i in self.posture.geometry.flyers for k in range(6)}
        none: Vector = [0.0] * self._n
        return [none if i in flying else self.gamma[i] for i in range(1, self._size)]

    @property
    def free(self) -> Vector:
        """(n,) 0 of active joints that are at rest to the last bit, else 1."""
        out: Vector = [self._moving] * self._n
        held = {i: self._laws[i][SLIP + 1] for i in self.form.sticking}
        for k, joint in enumerate(self.loops.active_joints):
            if joint - 1 in held:
                out[k] = self._moving * (1.0 - held[joint - 1])
        return out

    @property
    def slopes(self) -> Vector:
        """Time derivatives of the coordinates (nb,): the rates, but of rotation vectors."""
        return self._slopes(self.rates)

    def way(self, k: int) -> Vector:
        """How the coordinates (nb,) change with the motion v_k = 1."""
        return self._slopes([0.0, *(self.gamma[i][k] for i in range(1, self._size))])

    def _slopes(self, rates: Vector) -> Vector:
        out = list(rates[1:])
        for i in self.posture.geometry.flyers:
            linear, angular = out[i - 1 : i + 2], out[i + 2 : i + 5]
            vector = self.q[i + 2 : i + 5]
            out[i - 1 : i + 2] = times(turned_by(vector), linear)
            out[i + 2 : i + 5] = vector_rate(vector, angular)
        return out

    @property
    def passive(self) -> Vector:
        """gamma^T f."""
        return self.projected(self._passive)

    @property
    def friction(self) -> Vector:
        """gamma^T tau_F."""
        return self.projected(self._friction)

    @property
    def dissipation(self) -> Number:
        """Power that friction, dampers, end stops and ropes take out [W]."""
        total: Number = 0.0
        for found in self._everywhere:
            total = total + found.lost
        return total

    @cached_property
    def kinetic(self) -> Number:
        """v_A^T M_A v_A / 2, summed over bodies [J]."""
        velocity = self._motion.velocity
        total: Number = 0.0
        for i in range(1, self._size):
            mass, centre, tensor = self.bodies[i - 1]
            v, w = velocity[i]
            at = add(v, cross(w, centre))
            total = total + 0.5 * mass * dot(at, at) + 0.5 * dot(w, times(tensor, w))
        for inertia, rate in zip(self.rotors, self.rates, strict=True):
            total = total + 0.5 * inertia * rate * rate
        return total

    @cached_property
    def potential(self) -> Number:
        """Weights, springs, constant forces, gas, end stops, ropes [J]."""
        total: Number = 0.0
        for found in self._everywhere:
            total = total + found.stored
        for mass, centre, _ in self.bodies:
            height = subtract(centre, self.posture.origin[0])
            total = total - mass * dot(self._gravity, height)
        return total

    def inverse(self, a_a: Sequence[Number], friction: bool) -> Vector:
        """M_A a_A + bias - passive [+ friction]; friction at rest is against the acceleration."""
        rates = [0.0, *(dot(row, a_a) + self.drift[i] for i, row in sorted(self.gamma.items()))]
        along = subtract(self._along_inertial(rates), self.forces(friction))
        for i in self.form.sticking if friction else ():
            law, rate = self._laws[i], rates[i + 1]
            sign = sign_of(law, self.rates[i + 1], True, self._modes)
            back = where_positive(-STILL - rate, -1.0, 0.0)
            start = (law[0] + law[5]) * (where_positive(rate - STILL, 1.0, back) - sign)
            along[i + 1] = along[i + 1] + where_positive(1.0 - apply("abs", sign), start, 0.0)
        return self.projected(along)

    def forces(self, friction: bool) -> Vector:
        """Forces along the joints (nb + 1,) that nobody commands."""
        return subtract(self._passive, self._friction) if friction else self._passive

    def forward(self, tau: Sequence[Number], friction: bool) -> Vector:
        """M_A^-1 (tau - bias + passive [- friction])."""
        if self.form.plan and self._n > _SOLVED:
            return self._recursive(tau, friction)
        right = add(tau, self.projected(self.forces(friction)))
        return Positive(self.mass).solve(subtract(right, self.inertial_bias))

    def resting(self, tau: Sequence[Number]) -> Vector:
        """What tells which joints stick: M_A (n^2), rows of gamma (k n), their drift (k), net (n).

        Of the joints whose friction sticks; net is what tau leaves behind bias and friction.
        """
        rows = [entry for i in self.form.sticking for entry in self.gamma[i + 1]]
        drift = [self.drift[i + 1] for i in self.form.sticking]
        return [*(entry for row in self.mass for entry in row), *rows, *drift, *self._net(tau)]

    def _net(self, tau: Sequence[Number]) -> Vector:
        """What is left of tau behind bias and friction."""
        return subtract(add(tau, self.projected(self.forces(True))), self.inertial_bias)

    @property
    def held(self) -> list[tuple[Number, Vector]]:
        """Of each joint that can stick, whether it is held, and its row of gamma."""
        return [(self._laws[i][SLIP + 1], self.gamma[i + 1]) for i in self.form.sticking]

    def moved(self, tau: Sequence[Number], rest: bool) -> Moved:
        """Accelerations under active forces, with joints at rest or without.

        Joints k that are held accelerate by nothing, Gamma a_A + d = 0 with Gamma their rows of
        gamma and d their drift, and r is what that takes beside the offset of their friction:

            M_A a_A = f - Gamma^T r,    Gamma M_A^-1 Gamma^T r = Gamma M_A^-1 f + d.

        Args:
            tau: (n,).
            rest: Whether some joint is at rest.
        """
        laws = [self._laws[i] for i in self.form.sticking]
        slip, held, pace = ([law[SLIP + k] for law in laws] for k in range(3))
        limits = [law[0] + law[5] for law in laws]
        rates = [self.rates[i + 1] for i in self.form.sticking]
        slips = [s * v * p for s, v, p in zip(slip, rates, pace, strict=True)]
        if not rest:
            none: Vector = [0.0] * len(laws)
            return Moved(self.forward(tau, True), none, self.friction, _least(slips))
        rows = [self.gamma[i + 1] for i in self.form.sticking]
        right = self._net(tau)
        mass = Positive(self.mass)
        half = [scale(w, mass.halved(row)) for w, row in zip(held, rows, strict=True)]
        weighed = [[x * d for x, d in zip(row, mass.inverse, strict=True)] for row in half]
        ahead = mass.halved(right)
        matrix = [[dot(one, other) for other in half] for one in weighed]
        asked: Vector = []
        for k, (i, w) in enumerate(zip(self.form.sticking, held, strict=True)):
            matrix[k][k] = matrix[k][k] + (1.0 - w)
            asked.append(dot(weighed[k], ahead) + w * self.drift[i + 1])
        reach = Positive(matrix).solve(asked)
        braking: Vector = [0.0] * self._n
        for r, row in zip(reach, rows, strict=True):
            braking = add(braking, scale(r, row))
        a_a = mass.solve(subtract(right, braking))
        a_a = [a * free for a, free in zip(a_a, self.free, strict=True)]
        left = [1.0 - apply("abs", r) / limit for r, limit in zip(reach, limits, strict=True)]
        margins = [
            where_positive(w - 0.5, one, other)
            for w, one, other in zip(held, left, slips, strict=True)
        ]
        some = 1.0 - _least([1.0 - w for w in held])  # whether any is held
        # at rest: held, or with a share of its limit, or all of it, beside others that are held
        at_rest = [
            where_positive(
                1.0 - apply("abs", s),
                law[1] + limit * s + r,
                where_positive(some * AT_REST - apply("abs", v) * p, law[1] + limit * s, 0.0),
            )
            for s, law, limit, r, v, p in zip(slip, laws, limits, reach, rates, pace, strict=True)
        ]
        return Moved(a_a, at_rest, add(self.friction, braking), _least(margins))

    def _recursive(self, tau: Sequence[Number], friction: bool) -> Vector:
        """The same without M_A."""
        forces = list(self.forces(friction))
        for joint, force in zip(self.loops.active_joints, tau, strict=True):
            forces[joint] = forces[joint] + force
        still = {i for cluster, by_forces in self.form.plan if by_forces for i in cluster.joints}
        reference = [0.0 if i in still else x for i, x in enumerate(self.drift)]
        moving = Moving(
            self.posture, self.loops, self._whole, reference, self._masses,
            self.wrenches(reference), self.rotors, forces,
        )  # fmt: skip
        rates = accelerations(moving, self.form.plan)
        return [rates[joint] for joint in self.loops.active_joints]

    def regressor(self, a_a: Sequence[Number]) -> list[Vector]:
        """Y_A (n, 10 nb + nr), inertial parameters in Pinocchio's joint frames, then rotors'."""
        velocity, acceleration = self._motion.velocity, self._motion.acceleration
        out: list[Vector] = [[] for _ in range(self._n)]
        for i in sorted(set(range(1, self._size)) - self.posture.geometry.massless):
            turn = self.posture.geometry.turns[i]
            axes = product(self.posture.rotation[i], turn.T.tolist())  # columns: joint's axes
            local = list(zip(*axes, strict=True))  # rows: trunk to joint
            origin = self.posture.origin[i]
            v, w = velocity[i]
            a, e = acceleration[i]
            for k in range(self._n + 1):
                factor: Number = a_a[k] if k < self._n else 1.0
                a = add(a, scale(factor, self._columns[i][k][0]))
                e = add(e, scale(factor, self._columns[i][k][1]))
            at = add(a, cross(e, origin), cross(w, add(v, cross(w, origin))))
            w, e, at = times(local, w), times(local, e), times(local, at)
            for k in range(self._n):
                linear, angular = self._columns[i][k]
                u = times(local, add(linear, cross(angular, origin)))
                out[k] += _body_row(u, times(local, angular), w, e, at)
        for i, row in sorted(self.gamma.items()):
            if self.rotors[i] != 0.0:
                rate = dot(row, a_a) + self.drift[i]
                for k in range(self._n):
                    out[k].append(row[k] * rate)
        return out


def _by_row(columns: Iterable[Vector]) -> Vector:
    """The entries of a matrix (3, n), row by row."""
    return [entry for row in zip(*columns, strict=True) for entry in row]


def _least(values: Sequence[Number]) -> Number:
    """The least, 1 of none."""
    out: Number = 1.0
    for value in values:
        out = minimum(out, value)
    return out


def _carriers(parents: Sequence[int], body: int) -> set[int]:
    """The joints that carry a body."""
    found = set()
    while body:
        found.add(body)
        body = parents[body]
    return found


def _body_row(u: Vector, r: Vector, w: Vector, e: Vector, a: Vector) -> Vector:
    """Ten entries u . f + r . t per unit of each inertial parameter, all in the body's frame."""
    # mass times COM: f = e x c + w x (w x c), t = c x a
    first = add(cross(u, e), cross(w, cross(w, u)), cross(a, r))
    # inertia: t = I e + w x (I w), so r . t = r . I e + (r x w) . I w
    s = cross(r, w)

    def entry(j: int, k: int) -> Number:
        if j == k:
            return r[j] * e[j] + s[j] * w[j]
        return r[j] * e[k] + r[k] * e[j] + s[j] * w[k] + s[k] * w[j]

    pairs = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))
    return [dot(u, a), *first, *(entry(j, k) for j, k in pairs)]
