"""Positions, loop equations and gamma as traced formulas of one machine."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pinocchio as pin

from crane.closure.equations import LoopEquations, aligned_axes, turned
from crane.closure.exactness import CLOSED
from crane.closure.rotations import turned_by
from crane.closure.screws import Pair, Vector, minus, paired
from crane.closure.structure import Indices, Structure
from crane.codegen.scalar import (
    Number,
    Tape,
    add,
    apply,
    cross,
    dot,
    largest,
    maximum,
    product,
    scale,
    solve,
    subtract,
    times,
    transposed,
)  # fmt: skip
from crane.common.samples import Array
from crane.description import LOOP_TYPES

_ROUNDING = 1e-15  # of a rotation by a right angle


@dataclass(frozen=True, eq=False)
class Geometry:
    """What the formulas of a machine's positions depend on.

    Body i (1 to nb) is moved by joint i, which turns about or slides along the body's own z;
    body 0 is the world. A free-flyer is six bodies in a row on the world, at the place of the last
    one, which alone has mass: its velocities are along and about the axes of that body.

    Attributes:
        parents: (nb + 1,) parent bodies.
        revolute: (nb + 1,) whether the joint turns.
        flyers: First body of each free-flyer.
        turns: (nb + 1, 3, 3) from the body's directions here to those of Pinocchio's joint.
        numbers: (12 (nb + frames) + 1,) rotation and origin of every joint frame in its parent
            body, then of every loop frame in its body; one over the machine's size.
        frame_bodies: Body of each loop frame, predecessor and successor of each loop in turn.
    """

    parents: tuple[int, ...]
    revolute: tuple[bool, ...]
    flyers: tuple[int, ...]
    turns: Array
    numbers: Array
    frame_bodies: tuple[int, ...]

    @property
    def trunk(self) -> int:
        """The body in whose frame formulas are shortest: the one that carries all others, if any.

        Seen from there its own joint moves nothing but the world, and what lies in a plane of it
        stays in that plane.
        """
        if self.parents.count(0) != 2 or 0 in self.frame_bodies:
            return 0
        return 6 if self.flyers else 1

    @property
    def flying(self) -> frozenset[int]:
        """All bodies of free-flyers."""
        return frozenset(i + k for i in self.flyers for k in range(6))

    @property
    def massless(self) -> frozenset[int]:
        """Those of them that are none."""
        return frozenset(i + k for i in self.flyers for k in range(5))


def geometry_of(equations: LoopEquations) -> Geometry:
    """Read the geometry off an assembled model."""
    model, coordinates = equations.model, equations.coordinates
    parents, turns = coordinates.parents, [pin.SE3.Identity()]
    revolute = [False, *(not slides for slides in coordinates.slides)]
    last = coordinates.bodies
    places = []
    for i in range(1, model.njoints):
        joint = model.joints[i]
        place = turns[last[model.parents[i]]].inverse() * model.jointPlacements[i]
        if joint.nv == 6:
            places += [place, *[pin.SE3.Identity()] * 5]
            turns += [pin.SE3.Identity()] * 6
            continue
        data = joint.createData()
        joint.calc(data, np.zeros(model.nq))
        column = np.asarray(data.S).ravel()
        axis = column[3:] if revolute[last[i]] else column[:3]
        turn = pin.SE3(np.eye(3) if axis[2] == 1 else turned(axis.tolist()), np.zeros(3))
        places.append(place * turn)
        turns.append(turn)
    frames = equations.frames
    places += [turns[last[body]].inverse() * place for body, place in frames]
    numbers = [np.concatenate([_clean(p.rotation).ravel(), p.translation]) for p in places]
    return Geometry(
        parents,
        tuple(revolute),
        tuple(column + 1 for column in coordinates.floating),
        np.array([turn.rotation for turn in turns]),
        np.concatenate([*numbers, [1.0 / equations.size]]),
        tuple(last[body] for body, _ in frames),
    )


def _clean(rotation: Array) -> Array:
    """Exact zeros and ones, so that they are folded."""
    near = np.round(rotation)
    return np.where(np.abs(rotation - near) < _ROUNDING, near, rotation)


class Constants:
    """Numbers of a machine: 0, 1 and -1 become part of the formulas, the others stay arguments.

    Args:
        tape: Where they are read.
        array: Which argument holds them.
        values: Their values while tracing.
    """

    def __init__(self, tape: Tape, array: int, values: Array):
        self._tape, self._array, self._values = tape, array, values

    def __getitem__(self, index: int) -> Number:
        value = float(self._values[index])
        return value if value in (0.0, 1.0, -1.0) else self._tape.load(self._array, index)

    def vector(self, start: int, count: int = 3) -> Vector:
        """Consecutive numbers."""
        return [self[start + i] for i in range(count)]

    def place(self, index: int) -> tuple[list[Vector], Vector]:
        """Rotation (3, 3) and origin (3,) number `index` of a geometry."""
        start = 12 * index
        return [self.vector(start + 3 * row) for row in range(3)], self.vector(start + 9)


def folded(values: Array) -> bytes:
    """What of a machine's numbers is part of its formulas."""
    return np.where(np.isin(values, (0.0, 1.0, -1.0)), values, 2.0).tobytes()


class Bodies:
    """Bodies and loops at traced coordinates, seen from the geometry's trunk.

    Args:
        geometry: The machine's geometry.
        constants: Its numbers.
        q: (nb,).

    Attributes:
        q: (nb,).
        rotation: Of every body, (3, 3).
        origin: Of every body, (3,).
        columns: Of every joint, its spatial column at the trunk's origin: linear, angular.
        arms: Of every body, its origin seen from its parent's; not of those on the world.
    """

    def __init__(self, geometry: Geometry, constants: Constants, q: Sequence[Number]):
        self.geometry, self._constants, self.q = geometry, constants, list(q)
        still: list[Vector] = [[float(r == c) for c in range(3)] for r in range(3)]
        self.rotation: list[list[Vector]] = [still]
        self.origin: list[Vector] = [[0.0] * 3]
        self.arms: list[Vector] = [[0.0] * 3]
        self.columns: list[tuple[Vector, Vector]] = [([0.0] * 3, [0.0] * 3)]
        for i, parent in enumerate(geometry.parents[1:], start=1):
            arm: Vector = [0.0] * 3
            if i in geometry.flying - set(geometry.flyers):
                rotation, origin = self.rotation[parent], self.origin[parent]
            else:
                flies = i in geometry.flyers
                rotation, arm = self._flown(i) if flies else self._moved(i, q[i - 1])
                origin = add(self.origin[parent], arm)
                if geometry.trunk and parent == 0:
                    back = transposed(rotation)
                    self.rotation[0], self.origin[0] = back, scale(-1.0, times(back, origin))
                    rotation, origin = still, [0.0] * 3
            self.arms.append(scale(float(parent > 0), arm))
            self.rotation.append(rotation)
            self.origin.append(origin)
            axis = self.axis(i)
            self.columns.append(
                (cross(origin, axis), axis) if geometry.revolute[i] else (axis, [0.0] * 3)
            )

    @property
    def per_size(self) -> Number:
        """One over the machine's size."""
        return self._constants[len(self.geometry.numbers) - 1]

    def axis(self, i: int) -> Vector:
        """Along or about which joint i moves."""
        flyers = self.geometry.flyers
        along = 2 if i not in self.geometry.flying else (i - max(j for j in flyers if j <= i)) % 3
        return [row[along] for row in self.rotation[i]]

    def axes(self, i: int) -> tuple[Vector, Vector]:
        """How origin and directions of body i move per unit of its joint: linear, angular."""
        along: Vector = self.axis(i)
        still: Vector = [0.0] * 3
        return (still, along) if self.geometry.revolute[i] else (along, still)

    def _flown(self, i: int) -> tuple[list[Vector], Vector]:
        """Rotation and origin of a free-flyer, from its place and rotation vector."""
        turn, place = self._constants.place(i - 1)
        position, vector = self.q[i - 1 : i + 2], self.q[i + 2 : i + 5]
        # the world is at its origin, and turned if the trunk flies
        return product(turn, turned_by(vector)), add(place, times(turn, position))

    def _moved(self, i: int, q: Number) -> tuple[list[Vector], Vector]:
        """Rotation of body i and its origin from its parent's, whose rotation is known."""
        parent = self.geometry.parents[i]
        turn, place = self._constants.place(i - 1)
        rotation = product(self.rotation[parent], turn)
        arm = times(self.rotation[parent], place)
        if self.geometry.revolute[i]:
            c, s = apply("cos", q), apply("sin", q)
            return [[c * x + s * y, c * y - s * x, z] for x, y, z in rotation], arm
        return rotation, add(arm, scale(q, [row[2] for row in rotation]))

    def frame(self, index: int) -> tuple[list[Vector], Vector]:
        """Axes (columns of a rotation) and origin of a loop frame."""
        body = self.geometry.frame_bodies[index]
        turn, place = self._constants.place(len(self.geometry.parents) - 1 + index)
        axes = product(self.rotation[body], turn)
        return axes, add(self.origin[body], times(self.rotation[body], place))


@dataclass(frozen=True)
class Row:
    """One traced loop equation; see `LoopEquations`.

    Attributes:
        bodies: On which the two frames are.
        moves: Whether it is about a length.
        steady: Whether its axis may as well stand still: the two origins stay together.
        axis: Of the first frame.
        arm: Axis or origin of the second.
        wrench: That is measured by phi.
        phi: Zero where it holds.
        slopes: dphi/dq by joint.
    """

    bodies: tuple[int, int]
    moves: bool
    steady: bool
    axis: Vector
    arm: Vector
    wrench: Pair
    phi: Number
    slopes: dict[int, Number]

    def rates(self, one: Pair, two: Pair) -> tuple[Vector, Vector]:
        """Of axis and arm, whose bodies move so."""
        axis: Vector = [0.0] * 3 if self.steady else cross(one[1], self.axis)
        arm = cross(two[1], self.arm)
        return axis, add(arm, two[0]) if self.moves else arm

    def rate(self, one: Pair, two: Pair) -> Pair:
        """Of the wrench."""
        axis, arm = self.rates(one, two)
        moment = add(cross(arm, self.axis), cross(self.arm, axis))
        return (axis if self.moves else [0.0] * 3), moment


def _coupled(factors: Array, offset: float, q: Sequence[Number]) -> Row:
    """A coupling of joints, whose slopes are constant: nothing bends it."""
    still: Vector = [0.0] * 3
    slopes: dict[int, Number] = {i + 1: float(x) for i, x in enumerate(factors) if x}
    phi = dot([float(x) for x in factors], q) - float(offset)
    return Row((0, 0), False, False, still, still, (still, still), phi, slopes)


def largest_share(values: Sequence[Number], long: Sequence[bool], per_size: Number) -> Number:
    """The largest absolute value in rad and shares of the machine's size.

    Args:
        values: Angles and lengths.
        long: Which are lengths.
        per_size: One over the machine's size.
    """
    turns = [value for value, is_long in zip(values, long, strict=True) if not is_long]
    lengths = [value for value, is_long in zip(values, long, strict=True) if is_long]
    most = largest(turns)
    return maximum(most, per_size * largest(lengths)) if lengths else most


class Loops:
    """The independent loop equations at a traced posture.

    `alignments` are cosines that are 1 where the loops' axes are not opposed.

    Args:
        equations: All equations of the machine.
        structure: Which of them count.
        active: Columns of the active joints.
        passive: Columns of the others.
        posture: The posture.
    """

    def __init__(
        self,
        equations: LoopEquations,
        structure: Structure,
        active: Indices,
        passive: Indices,
        posture: Bodies,
    ):
        self._structure, self._posture = structure, posture
        self._long = equations.is_translation
        self.active_joints = [int(column) + 1 for column in active]
        self.passive_joints = [int(column) + 1 for column in passive]
        self._frames = [posture.frame(i) for i in range(len(posture.geometry.frame_bodies))]
        self.rows = [self._row(equations, int(row), posture) for row in structure.rows]
        self.alignments = [
            dot([line[k] for line in one[0]], [line[k] for line in two[0]])
            for loop, one, two in zip(
                equations.loops, self._frames[::2], self._frames[1::2], strict=True
            )
            for k in aligned_axes(loop.type)
        ]
        self._others = [self._row(equations, int(row), posture) for row in structure.redundant]

    def _row(self, equations: LoopEquations, row: int, posture: Bodies) -> Row:
        coupling = int(equations.loop_of_row[row]) - len(equations.loops)
        if coupling >= 0:
            return _coupled(equations.factors[coupling], equations.offsets[coupling], posture.q)
        one = 2 * int(equations.loop_of_row[row])
        (axes1, origin1), (axes2, origin2) = self._frames[one], self._frames[one + 1]
        axis = [line[equations.axis1[row]] for line in axes1]
        moves = bool(equations.is_translation[row])
        if moves:
            arm = origin2
            wrench, phi = (axis, cross(arm, axis)), dot(axis, subtract(origin2, origin1))
        else:
            arm = [line[equations.axis2[row]] for line in axes2]
            wrench, phi = ([0.0] * 3, cross(arm, axis)), dot(axis, arm)
        slopes = {}
        for column, sign in enumerate(equations.sign[one // 2]):
            if sign:
                linear, angular = posture.columns[column + 1]
                slope = dot(wrench[0], linear) + dot(wrench[1], angular)
                slopes[column + 1] = float(sign) * slope
        bodies = posture.geometry.frame_bodies
        together = all(LOOP_TYPES[equations.loops[one // 2].type][:3])
        steady = moves and together and self._structure.surplus.allowed <= CLOSED
        pair = bodies[one], bodies[one + 1]
        return Row(pair, moves, steady, axis, arm, wrench, phi, slopes)

    def solve(
        self, known: dict[int, Vector], right: Sequence[Vector]
    ) -> tuple[dict[int, Vector], list[Number]]:
        """Solve J x = right for the passive joints, block after block.

        Args:
            known: Rows of x of the active joints, by joint.
            right: Right sides, by row.

        Returns:
            Rows of x of all joints, and the determinants of the blocks.
        """
        x = dict(known)
        determinants = []
        for rows, columns in self._structure.blocks:
            joints = [self.passive_joints[c] for c in columns]
            matrix = [[self.rows[r].slopes.get(joint, 0.0) for joint in joints] for r in rows]
            # the order of the blocks knows which slopes vanish everywhere
            before = {joint: row for joint, row in x.items() if joint not in joints}
            sides = [self._right_side(r, before, right[r]) for r in rows]
            found, determinant = solve(matrix, sides)
            determinants.append(determinant)
            x |= dict(zip(joints, found, strict=True))
        return x, determinants

    def _right_side(self, row: int, x: dict[int, Vector], side: Vector) -> Vector:
        """Right side of a row without what the joints in x have to do with it."""
        for joint, slope in self.rows[row].slopes.items():
            if joint in x:
                side = subtract(side, scale(slope, x[joint]))
        return side

    @cached_property
    def _gamma(self) -> tuple[dict[int, Vector], list[Number]]:
        n = len(self.active_joints)
        known: dict[int, Vector] = {
            joint: [float(i == k) for k in range(n)] for i, joint in enumerate(self.active_joints)
        }
        return self.solve(known, [[0.0] * n for _ in self.rows])

    @property
    def gamma(self) -> dict[int, Vector]:
        """Rows of gamma (n,) by joint."""
        return self._gamma[0]

    @property
    def determinants(self) -> list[Number]:
        """Of the blocks, in their order."""
        return self._gamma[1]

    @cached_property
    def correction(self) -> dict[int, Number]:
        """Newton's step of the passive joints, by joint."""
        held: dict[int, Vector] = {joint: [0.0] for joint in self.active_joints}
        x, _ = self.solve(held, [[-row.phi] for row in self.rows])
        return {joint: x[joint][0] for joint in self.passive_joints}

    @property
    def residual(self) -> Number:
        """The largest absolute phi of the independent equations, in shares of the size."""
        return self._largest(self.rows, self._structure.rows)

    @property
    def surplus(self) -> Number:
        """The largest absolute phi of the redundant equations, likewise."""
        return self._largest(self._others, self._structure.redundant)

    def _largest(self, rows: Sequence[Row], indices: Indices) -> Number:
        long = self._long[indices].tolist()
        return largest_share([row.phi for row in rows], long, self._posture.per_size)


class MovingBodies:
    """Bodies in motion at a traced posture.

    Args:
        posture: Bodies.
        loops: Loops at that posture.
        rates: (nb + 1,) joint velocities, 0 for the world.
        gravity: (3,) in the trunk's directions; the world accelerates with -gravity, so that
            weights need no terms of their own.
        carriers: (nb + 1,) the body whose motion each body shares, its parent or 0.

    Attributes:
        velocity: Of every body, linear at the trunk's origin, angular.
        acceleration: The same at zero joint acceleration.
    """

    def __init__(
        self,
        posture: Bodies,
        loops: Loops,
        rates: Sequence[Number],
        gravity: Sequence[Number],
        carriers: Sequence[int],
    ):
        self._posture, self._loops = posture, loops
        self.velocity: list[tuple[Vector, Vector]] = [([0.0] * 3, [0.0] * 3)]
        self.acceleration: list[tuple[Vector, Vector]] = [([-g for g in gravity], [0.0] * 3)]
        for i in range(1, len(posture.columns)):
            parent = carriers[i]
            linear, angular = (scale(rates[i], part) for part in posture.columns[i])
            v, w = self.velocity[parent]
            a, e = self.acceleration[parent]
            if i not in posture.geometry.flying:  # whose columns turn with the last of its bodies
                a = add(a, cross(w, linear), cross(v, angular))
                e = add(e, cross(w, angular))
            self.acceleration.append((a, e))
            self.velocity.append((add(v, linear), add(w, angular)))

    @cached_property
    def drift(self) -> Vector:
        """(nb + 1,) accelerations of the joints at a_A = 0."""
        held: dict[int, Vector] = {joint: [0.0] for joint in self._loops.active_joints}
        x, _ = self._loops.solve(held, [[-self.bend(row)] for row in self._loops.rows])
        return [0.0] + [x[i][0] for i in range(1, len(self._posture.columns))]

    def bend(self, row: Row) -> Number:
        """Second derivative of phi at zero joint acceleration; see `LoopEquations.curvature`."""
        one, two = row.bodies
        first, second = self.velocity[one], self.velocity[two]
        turned = paired(row.rate(first, second), minus(second, first))
        return turned + paired(row.wrench, minus(self.acceleration[two], self.acceleration[one]))
