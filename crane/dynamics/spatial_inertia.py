"""Spatial inertias and the mass matrix as symbolic formulas.

The wrench [f, n] of an acceleration [a, e] of a point and of a body's axes is

    f = M a + H e,    n = H^T a + I e.

M and I are symmetric. Wrenches and inertias refer to that point.

A unit acceleration of a joint moves all bodies beyond it as one body with the inertia C; the
wrench C s, propagated towards the world, acts along the joints that carry it (Featherstone 2008,
section 6.2). Columns of one cluster are combined by gamma before they leave it, so that M_A takes
operations in proportion to its entries.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from crane.closure.kinematics_formulas import (
    ZERO_VECTOR,
    PositionKinematics,
    SpatialVector,
    Vector,
    add_spatial,
    scale_spatial,
    shift_wrench,
    spatial_dot,
)
from crane.closure.loop_equations import Cluster
from crane.closure.loop_formulas import LoopFormulas
from crane.codegen.symbolic import (
    Scalar,
    add_vectors,
    cross,
    dot,
    matmul,
    matvec,
    scale_vector,
    subtract_vectors,
    transpose,
)
from crane.codegen.symbolic_linear_algebra import LdltFactorization

Matrix = list[Vector]


def forward_substitute(
    factorization: LdltFactorization, vectors: Sequence[SpatialVector]
) -> list[SpatialVector]:
    """L^-1 of a column of spatial vectors."""
    rows = transpose(
        [
            factorization.forward_substitute(column)
            for column in zip(*([*linear, *angular] for linear, angular in vectors), strict=True)
        ]
    )
    return [(row[:3], row[3:]) for row in rows]


class SpatialInertia:
    """A symmetric 6 by 6 inertia.

    Args:
        mass: M (3, 3).
        coupling: H (3, 3).
        rotational: I (3, 3).
    """

    def __init__(self, mass: Matrix, coupling: Matrix, rotational: Matrix):
        self.mass, self.mixed, self.turning = mass, coupling, rotational

    @classmethod
    def rigid_body(cls, mass: Scalar, lever: Vector, tensor: Matrix) -> "SpatialInertia":
        """Inertia of a rigid body.

        Args:
            mass: Its mass.
            lever: From the point to its COM (3,).
            tensor: Inertia about the COM (3, 3).
        """
        moment = scale_vector(mass, lever)
        out = symmetric_matrix(
            lambda r, c: (
                tensor[r][c] - moment[r] * lever[c] + (dot(moment, lever) if r == c else 0.0)
            )
        )
        return cls(
            [[mass if r == c else 0.0 for c in range(3)] for r in range(3)],
            [scale_vector(-1.0, row) for row in _skew(moment)],
            out,
        )

    def __add__(self, other: "SpatialInertia") -> "SpatialInertia":
        return SpatialInertia(
            symmetric_matrix(lambda r, c: self.mass[r][c] + other.mass[r][c]),
            [add_vectors(one, two) for one, two in zip(self.mixed, other.mixed, strict=True)],
            symmetric_matrix(lambda r, c: self.turning[r][c] + other.turning[r][c]),
        )

    def apply_to(self, motion: SpatialVector) -> SpatialVector:
        """The wrench of a motion."""
        a, e = motion
        force = add_vectors(matvec(self.mass, a), matvec(self.mixed, e))
        return force, add_vectors(matvec(transpose(self.mixed), a), matvec(self.turning, e))

    def subtract_columns(
        self, columns: Sequence[SpatialVector], factors: Sequence[Scalar]
    ) -> "SpatialInertia":
        """I - sum factor u u^T over columns u."""
        mass, mixed, turning = self.mass, self.mixed, self.turning
        for (f, n), factor in zip(columns, factors, strict=True):
            g, m = scale_vector(factor, f), scale_vector(factor, n)
            mass = _subtract_symmetric_product(mass, g, f)
            turning = _subtract_symmetric_product(turning, m, n)
            mixed = [
                subtract_vectors(row, scale_vector(x, n)) for row, x in zip(mixed, g, strict=True)
            ]
        return SpatialInertia(mass, mixed, turning)

    def shift_origin(self, arm: Vector) -> "SpatialInertia":
        """The same inertia, referred to the point from which `arm` leads to the present one."""
        skew = _skew(arm)
        coupling = [
            subtract_vectors(*rows)
            for rows in zip(self.mixed, matmul(self.mass, skew), strict=True)
        ]
        old, new, across = transpose(self.mixed), transpose(coupling), transpose(skew)
        return SpatialInertia(
            self.mass,
            coupling,
            symmetric_matrix(
                lambda r, c: self.turning[r][c] - dot(old[r], across[c]) + dot(skew[r], new[c])
            ),
        )


def symmetric_matrix(
    entry: Callable[[int, int], Scalar], size: int = 3, upper: bool = False
) -> Matrix:
    """The symmetric matrix of some entries, from its lower or upper triangle row by row."""
    out: Matrix = [[0.0] * size for _ in range(size)]
    for r in range(size):
        for c in range(r, size) if upper else range(r + 1):
            out[r][c] = out[c][r] = entry(r, c)
    return out


def _subtract_symmetric_product(matrix: Matrix, one: Vector, two: Vector) -> Matrix:
    """A symmetric matrix without a symmetric product."""
    return symmetric_matrix(lambda r, c: matrix[r][c] - one[r] * two[c])


def _skew(v: Vector) -> Matrix:
    return [[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]]


class ClusterMassColumns:
    """Forces and wrenches of unit accelerations of a cluster's independent coordinates.

    Args:
        kinematics: Position kinematics.
        cluster: The cluster.
        gamma: (n,) of the cluster's coordinates, by joint.
        composite_inertias: Inertia of all bodies beyond each joint, at the origin of its body.
        rotor_inertias: (nb + 1,) rotor inertias.

    Attributes:
        mass_block: (n, n) mass matrix of the coordinates.
        base_wrenches: By coordinate, wrench on the body that carries the cluster, at its origin.
    """

    def __init__(
        self,
        kinematics: PositionKinematics,
        cluster: Cluster,
        gamma: Mapping[int, Vector],
        composite_inertias: Mapping[int, SpatialInertia],
        rotor_inertias: Vector,
    ):
        count = range(len(gamma[cluster.joints[0]]))
        tree: dict[int, dict[int, Scalar]] = {i: {} for i in cluster.joints}
        self.base_wrenches = [ZERO_VECTOR for _ in count]
        for j in cluster.joints:
            wrench = composite_inertias[j].apply_to(kinematics.body_motion_axes(j))
            for i, met, beyond in propagate_wrench(kinematics, j, wrench, cluster.base):
                tree[i][j] = tree[j][i] = met
                wrench = beyond
            tree[j][j] = tree[j][j] + rotor_inertias[j]
            self.base_wrenches = [
                add_spatial(self.base_wrenches[k], scale_spatial(gamma[j][k], wrench))
                for k in count
            ]
        moved = {
            i: [dot([*row.values()], [gamma[j][k] for j in row]) for k in count]
            for i, row in tree.items()
        }
        columns = [[row[k] for row in moved.values()] for k in count]
        self.mass_block = symmetric_matrix(
            lambda k, j: dot([row[j] for row in gamma.values()], columns[k]), len(count)
        )


def propagate_wrench(
    kinematics: PositionKinematics, body: int, wrench: SpatialVector, base: int
) -> Iterator[tuple[int, Scalar, SpatialVector]]:
    """Propagate a wrench on a body to the joints that carry it.

    Yields:
        Each joint, the force along it, and the wrench at the origin of its parent body.
    """
    while body != base:
        joint_force = spatial_dot(kinematics.body_motion_axes(body), wrench)
        wrench = shift_wrench(wrench, kinematics.offsets[body])
        yield body, joint_force, wrench
        body = kinematics.geometry.parents[body]


def composite_mass_matrix(
    kinematics: PositionKinematics,
    loops: LoopFormulas,
    body_inertias: Sequence[tuple[Scalar, Vector, list[Vector]]],
    rotor_inertias: Vector,
    clusters: Sequence[Cluster],
) -> Matrix:
    """M_A = gamma^T M gamma (n, n).

    Args:
        kinematics: Position kinematics.
        loops: Loop formulas.
        body_inertias: For every body mass, lever from its origin to the COM, inertia about the
            COM.
        rotor_inertias: (nb + 1,) rotor inertias of the joints.
        clusters: Clusters of the joints.
    """
    n, parents = len(loops.active_joints), kinematics.geometry.parents
    inertias = {
        i: SpatialInertia.rigid_body(*body) for i, body in enumerate(body_inertias, start=1)
    }
    for i in range(len(body_inertias), 0, -1):
        if parents[i]:
            inertias[parents[i]] = inertias[parents[i]] + inertias[i].shift_origin(
                kinematics.offsets[i]
            )
    out: Matrix = [[0.0] * n for _ in range(n)]
    coordinates_of_joint = {
        i: cluster.own_coordinates(loops.active_joints)
        for cluster in clusters
        for i in cluster.joints
    }
    for cluster in clusters:
        coordinates = coordinates_of_joint[cluster.joints[0]]
        gamma = {i: [loops.gamma[i][k] for k in coordinates] for i in cluster.joints}
        columns = ClusterMassColumns(kinematics, cluster, gamma, inertias, rotor_inertias)
        for row, k in zip(columns.mass_block, coordinates, strict=True):
            for entry, j in zip(row, coordinates, strict=True):
                out[k][j] = entry
        for k, wrench in zip(coordinates, columns.base_wrenches, strict=True):
            for i, met, _ in propagate_wrench(kinematics, cluster.base, wrench, 0):
                for j in coordinates_of_joint[i]:
                    entry = out[j][k] + loops.gamma[i][j] * met
                    out[j][k] = out[k][j] = entry
    return out


@dataclass(frozen=True)
class MassMoments:
    """Sums over the points r of bodies that move as one, with velocities r'.

    Attributes:
        mass: sum m.
        first_moment: sum m r (3,).
        inertia_tensor: sum m (r^2 - r r^T) (3, 3).
        momentum: sum m r' (3,).
        moment_rate: tr(K) - K (3, 3), K = sum m r' r^T.
    """

    mass: Scalar
    first_moment: Vector
    inertia_tensor: Matrix
    momentum: Vector
    moment_rate: Matrix

    @classmethod
    def rigid_body(
        cls, mass: Scalar, centre: Vector, tensor: Matrix, motion: SpatialVector
    ) -> "MassMoments":
        """Moments of a rigid body.

        Args:
            mass: Its mass.
            centre: Its centre of mass.
            tensor: Inertia about the centre of mass.
            motion: Its twist.
        """
        first = scale_vector(mass, centre)
        square = dot(first, centre)
        inertia = symmetric_matrix(
            lambda r, c: tensor[r][c] - first[r] * centre[c] + (square if r == c else 0.0),
            upper=True,
        )
        v, w = motion
        momentum = scale_vector(mass, add_vectors(v, cross(w, centre)))
        # second moments about the centre, tr(I) / 2 - I
        half = 0.5 * (tensor[0][0] + tensor[1][1] + tensor[2][2])
        spread = symmetric_matrix(
            lambda r, c: (half if r == c else 0.0) - tensor[r][c], upper=True
        )
        spun = transpose([cross(w, column) for column in spread])
        k = [
            [p * x + more for x, more in zip(centre, row, strict=True)]
            for p, row in zip(momentum, spun, strict=True)
        ]
        sums = [k[1][1] + k[2][2], k[0][0] + k[2][2], k[0][0] + k[1][1]]
        return cls(
            mass,
            first,
            inertia,
            momentum,
            [[sums[r] if r == c else -k[r][c] for c in range(3)] for r in range(3)],
        )

    def __add__(self, other: "MassMoments") -> "MassMoments":
        return MassMoments(
            self.mass + other.mass,
            add_vectors(self.first_moment, other.first_moment),
            symmetric_matrix(
                lambda r, c: self.inertia_tensor[r][c] + other.inertia_tensor[r][c], upper=True
            ),
            add_vectors(self.momentum, other.momentum),
            [
                add_vectors(one, two)
                for one, two in zip(self.moment_rate, other.moment_rate, strict=True)
            ],
        )

    def inertial_wrench(self, acceleration: SpatialVector) -> SpatialVector:
        """I A."""
        a, e = acceleration
        force = add_vectors(scale_vector(self.mass, a), cross(e, self.first_moment))
        return force, add_vectors(cross(self.first_moment, a), matvec(self.inertia_tensor, e))

    def velocity_wrench(self, angular: Vector) -> SpatialVector:
        """B of a motion; its linear part has no effect."""
        return cross(angular, self.momentum), matvec(self.moment_rate, angular)

    def transposed_velocity_product(self, motion: SpatialVector) -> Vector:
        """Angular part of B^T of a motion."""
        v, w = motion
        return add_vectors(cross(self.momentum, v), matvec(transpose(self.moment_rate), w))
