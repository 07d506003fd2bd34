"""The kinematic tree of a machine: links and joints with their values and source locations.

A composite joint J is a series of joints J_x, J_y, ... with one degree of freedom each, and with
massless links J_1, J_2, ... between them. Three rotations become one joint again where the machine
is assembled, see `crane.description.rotation_vectors`.
"""

import math
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from crane.common.samples import Array

Vector = tuple[float, float, float]
Placement = tuple[Vector, Vector]  # xyz [m], rpy [rad] as URDF has them: R_z(y) R_y(p) R_x(r)
Freedom = tuple[str, str, Vector]  # of a composite joint: suffix, kind, axis

X_AXIS, Y_AXIS, Z_AXIS = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
ROTATIONS: tuple[Freedom, ...] = (
    ("rx", "revolute", X_AXIS), ("ry", "revolute", Y_AXIS), ("rz", "revolute", Z_AXIS),
)  # fmt: skip
_TRANSLATIONS: tuple[Freedom, ...] = (
    ("x", "prismatic", X_AXIS), ("y", "prismatic", Y_AXIS), ("z", "prismatic", Z_AXIS),
)  # fmt: skip
MULTI_FREEDOM_TYPES = ("floating", "planar", "spherical")  # types of URDF, and ball joints
NO_LIMIT = 1e9  # a limit of this magnitude in a file, in any unit, means none


def parse_limit(value: float) -> float:
    """Return a limit of a file, infinite if it means none."""
    return math.copysign(math.inf, value) if abs(value) >= NO_LIMIT else value


def to_vector(values: np.ndarray) -> Vector:
    """Return three floats, without negative zeros."""
    x, y, z = (float(value) + 0.0 for value in values)
    return x, y, z


@dataclass(frozen=True)
class Inertial:
    """Mass and inertia of a link.

    Attributes:
        mass: [kg].
        com: Centre of mass in the link's frame [m].
        rpy: Rotation from the axes of the link's frame to those of the tensor [rad].
        tensor: xx, xy, xz, yy, yz, zz about the centre of mass [kg m2].
        finding_location: File and line of a tensor with a formal error, see `InertiaProblem`.
    """

    mass: float
    com: Vector
    rpy: Vector
    tensor: tuple[float, ...]
    finding_location: str = ""

    @property
    def inertia_matrix(self) -> np.ndarray:
        """The tensor (3, 3) along its own axes."""
        xx, xy, xz, yy, yz, zz = self.tensor
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


@dataclass(frozen=True)
class Link:
    """A frame, with or without mass.

    Attributes:
        name: Name.
        source_location: File and line.
        inertial: Mass and inertia, None for a frame.
        composite_joint: Name of the composite joint if the link is between the joints of its
            series.
        has_refused_inertial: Whether its inertial was refused while findings are collected.
    """

    name: str
    source_location: str
    inertial: Inertial | None = None
    composite_joint: str | None = None
    has_refused_inertial: bool = False


@dataclass(frozen=True)
class Limits:
    """Limits of a joint; infinite if there is no limit.

    Attributes:
        lower: Of the coordinate [m], [rad]; NaN if refused while findings are collected.
        upper: Of the coordinate.
        effort: [N], [N m].
        velocity: [m/s], [rad/s].
        source_location: File and line.
    """

    lower: float = -math.inf
    upper: float = math.inf
    effort: float = math.inf
    velocity: float = math.inf
    source_location: str = ""

    def __str__(self) -> str:
        location_text = f" ({self.source_location})" if self.source_location else ""
        return f"{self.lower:g} to {self.upper:g}{location_text}"


@dataclass(frozen=True)
class Joint:
    """A joint with one degree of freedom, or none.

    Attributes:
        name: Name.
        kind: "revolute", "prismatic" or "fixed".
        parent: Parent link.
        child: Child link, whose frame is that of the joint at coordinate zero.
        source_location: File and line.
        xyz: Origin in the parent's frame [m].
        rpy: Rotation from the parent's frame to the joint's [rad].
        axis: Unit vector in the joint's frame; without meaning for a fixed joint.
        limits: Limits.
        rotor_inertia: Inertia of the rotor that drives it, reflected to the joint: times the
            square of the gear ratio [kg m2], or [kg] for a prismatic joint.
        is_cut: Whether it closed a cycle and has no ends, while findings are collected.
        floating_joint: Name of the joint with six degrees of freedom that it belongs to, see
            `crane.description.rotation_vectors`.
    """

    name: str
    kind: str
    parent: str
    child: str
    source_location: str
    xyz: Vector = (0.0, 0.0, 0.0)
    rpy: Vector = (0.0, 0.0, 0.0)
    axis: Vector = (1.0, 0.0, 0.0)
    limits: Limits = field(default_factory=Limits)
    rotor_inertia: float = 0.0
    is_cut: bool = False
    floating_joint: str = ""

    @property
    def is_movable(self) -> bool:
        """Whether it has a degree of freedom."""
        return self.kind != "fixed"


@dataclass(frozen=True)
class Tree:
    """Links and the joints between them, in the order of the file.

    Attributes:
        links: By name.
        joints: By name.
    """

    links: Mapping[str, Link]
    joints: Mapping[str, Joint]

    def __iter__(self) -> Iterator[Link | Joint]:
        yield from self.links.values()
        yield from self.joints.values()

    @property
    def moving_joints(self) -> tuple[Joint, ...]:
        """The movable joints."""
        return tuple(joint for joint in self.joints.values() if joint.is_movable)

    @property
    def root_link(self) -> str:
        """The link without parent, "" if there are no links."""
        parent_joints = self.parent_joints
        return next((link for link in self.links if link not in parent_joints), "")

    @property
    def total_mass(self) -> float:
        """Mass of all links [kg]."""
        return sum(link.inertial.mass for link in self.links.values() if link.inertial)

    @property
    def parent_joints(self) -> dict[str, Joint]:
        """By link the joint that carries it."""
        return {joint.child: joint for joint in self.joints.values()}

    def joints_by_parent(self) -> dict[str, list[Joint]]:
        """Return the joints on each link that has child joints."""
        found: dict[str, list[Joint]] = {}
        for joint in self.joints.values():
            if joint.parent and joint.child:
                found.setdefault(joint.parent, []).append(joint)
        return found

    def bodies_by_link(self) -> dict[str, str]:
        """Return by link the first link of its body, to which it is fixed."""
        parent_joints = self.parent_joints
        return {link: body_of(parent_joints, link) for link in self.links}

    def with_parts(self, *parts: Link | Joint) -> "Tree":
        """Return the tree with links and joints added, or replaced if the names exist."""
        links, joints = dict(self.links), dict(self.joints)
        for part in parts:
            if isinstance(part, Link):
                links[part.name] = part
            else:
                joints[part.name] = part
        return Tree(links, joints)


def body_of(parent_joints: Mapping[str, Joint], link: str) -> str:
    """Return the first link of the body that a link belongs to, see `Tree.parent_joints`."""
    while link in parent_joints and not parent_joints[link].is_movable:
        link = parent_joints[link].parent
    return link


def path_to_root(parent_joints: Mapping[str, Joint], link: str) -> list[Joint]:
    """Return the joints from a link to the root, see `Tree.parent_joints`."""
    path: list[Joint] = []
    while link in parent_joints:
        path.append(parent_joints[link])
        link = path[-1].parent
    return path


def unique_name(name: str, used_names: Container[str]) -> str:
    """Return a name that is not used, with underscores appended if necessary."""
    while name in used_names:
        name += "_"
    return name


def with_rotor_inertias(tree: Tree, rotor_inertias: Mapping[str, float]) -> Tree:
    """Return the tree with rotor inertias [kg m2], [kg] by joint."""
    return tree.with_parts(
        *(replace(tree.joints[name], rotor_inertia=x) for name, x in rotor_inertias.items())
    )


def joint_freedoms(kind: str, axis: Sequence[float]) -> tuple[Freedom, ...]:
    """Return the degrees of freedom of a composite joint.

    Args:
        kind: One of `MULTI_FREEDOM_TYPES`.
        axis: Normal of the plane of a planar joint.
    """
    if kind == "spherical":
        return ROTATIONS
    if kind == "floating":
        return (*_TRANSLATIONS, *ROTATIONS)
    normal = np.asarray(axis, dtype=np.float64)
    first = np.cross(np.eye(3)[np.argmin(np.abs(normal))], normal)
    first /= np.linalg.norm(first)
    return (
        ("x", "prismatic", to_vector(first)),
        ("y", "prismatic", to_vector(np.cross(normal, first))),
        ("rz", "revolute", to_vector(normal)),
    )


def joint_series(
    name: str,
    freedoms: Sequence[Freedom],
    placement: Placement,
    end_links: tuple[str, str],
    source_location: str,
) -> list[Link | Joint]:
    """Return the joints of a composite joint, and the links between them.

    Args:
        name: Name of the composite joint.
        freedoms: Its degrees of freedom, from the parent on.
        placement: Placement of the first joint in the parent's frame.
        end_links: Parent and child link.
        source_location: File and line.
    """
    floating_joint = name if tuple(freedoms) == (*_TRANSLATIONS, *ROTATIONS) else ""
    links = [end_links[0], *(f"{name}_{i}" for i in range(1, len(freedoms))), end_links[1]]
    found: list[Link | Joint] = [
        Link(link, source_location, composite_joint=name) for link in links[1:-1]
    ]
    zero = (0.0, 0.0, 0.0)
    for i, (suffix, kind, axis) in enumerate(freedoms):
        xyz, rpy = (zero, zero) if i else placement
        parent, child = links[i : i + 2]
        found.append(
            Joint(
                f"{name}_{suffix}", kind, parent, child, source_location, xyz, rpy, axis,
                floating_joint=floating_joint,
            )
        )  # fmt: skip
    return found


# Violations below these shares of the largest principal moment are rounding of a few digits.
_ROUNDING_TOLERANCE = 1e-4
_NEGATIVE_MOMENT_TOLERANCE = 0.05  # of a negative moment, as by rounding to two digits
_MIN_GYRATION_RADIUS = 1e-10  # [m] of a body with inertia
TENSOR_ATTRIBUTES = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")  # of URDF and SDF


@dataclass(frozen=True)
class InertiaProblem:
    """Why a mass and an inertia are not physically feasible.

    Attributes:
        problem: Description of the problem.
        advice: How to correct it.
        is_formal: Whether computation is possible in spite of it: a planar, rounded or missing
            inertia, of which no principal moment is negative by more than rounding.
        is_negative: Whether a principal moment is negative by more than the last digits, so that
            some motion would have negative kinetic energy and only the nearest feasible inertia
            can be used.
    """

    problem: str
    advice: str = "correct it"
    is_formal: bool = False
    is_negative: bool = False

    def __str__(self) -> str:
        return f"{self.problem}, {self.advice}"


def inertia_problem(mass: float, tensor: np.ndarray) -> InertiaProblem | None:
    """Return the problem of a mass [kg] and a central inertia (3, 3) [kg m2], None if feasible.

    The principal moments of a body are non-negative, and none exceeds the sum of the others. A
    mass of zero with an inertia is a rotor whose mass belongs to another body.
    """
    if not (np.isfinite(mass) and np.isfinite(tensor).all()):
        problem = "a mass or an inertia beyond all numbers"
        return InertiaProblem(problem, "give smaller ones")
    moments = np.linalg.eigvalsh(tensor)
    largest = float(np.abs(moments).max())
    if largest <= _MIN_GYRATION_RADIUS**2 * mass:
        problem, advice = "a mass but no inertia", "give at least a small sphere's"
        return InertiaProblem(problem, advice, is_formal=True) if mass > 0 else None
    if moments[0] < -_ROUNDING_TOLERANCE * largest:
        problem = f"the negative principal moment of inertia {moments[0]:.4g} kg m2"
        if mass < 0 or moments[0] < -_NEGATIVE_MOMENT_TOLERANCE * largest:
            return InertiaProblem(problem)
        return InertiaProblem(
            problem, _nearest_inertia_advice(tensor), is_formal=True, is_negative=True
        )
    if moments[0] + moments[1] < moments[2] * (1 - _ROUNDING_TOLERANCE):
        problem = (
            "an inertia of no possible body: principal moments "
            f"{moments[0]:.4g} + {moments[1]:.4g} < {moments[2]:.4g} kg m2"
        )
        return InertiaProblem(problem, _nearest_inertia_advice(tensor), is_formal=mass >= 0)
    return None


def _nearest_inertia_advice(tensor: Array) -> str:
    return f"the nearest possible is {format_inertia(nearest_inertia(tensor))}, correct it"


def nearest_inertia(tensor: Array) -> Array:
    """Return the physically feasible inertia (3, 3) [kg m2] nearest to a tensor.

    The second moments of mass about the centre of mass, Sigma = tr(I) / 2 1 - I, have no negative
    eigenvalue. The nearest such matrix in the Frobenius norm has zeros in place of the negative
    eigenvalues (Higham 1988). With the eigenvalues J_i of Sigma along principal axes e_i,

        I' = sum_i max(J_i, 0) (1 - e_i e_i^T)

    If only the largest principal moment exceeds the sum of the others, it stays, and the others
    rise by half of the difference each: a flat body.
    """
    second_moments = np.trace(tensor) / 2 * np.eye(3) - tensor
    values, axes = np.linalg.eigh(second_moments)
    feasible_moments = (axes * np.maximum(values, 0.0)) @ axes.T
    return np.asarray(np.trace(feasible_moments) * np.eye(3) - feasible_moments)


def format_inertia(tensor: Array) -> str:
    """Return a tensor as attributes of a URDF, in five digits."""
    rounding = float(np.abs(tensor).max()) * 1e-9
    values = [x if abs(x) > rounding else 0.0 for x in tensor[np.triu_indices(3)].tolist()]
    return " ".join(f'{key}="{x:.5g}"' for key, x in zip(TENSOR_ATTRIBUTES, values, strict=True))
