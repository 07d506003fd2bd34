"""Description of an identified machine: friction laws, bodies of locked joints, motors."""

from collections.abc import Mapping
from dataclasses import fields

import numpy as np

from crane.common.errors import InputError
from crane.common.samples import Array
from crane.description.force_elements import Friction
from crane.description.kinematic_tree import Inertial, Joint, Link
from crane.dynamics.dynamics import Dynamics
from crane.formats.machine_file.machine_writer import MachineDraft, friction_data
from crane.formats.xml_file import add_joint, add_link
from crane.identification.mechanics.feasible_parameters import (
    body_parameters,
    pseudo_inertia,
    thicken_body,
)
from crane.identification.mechanics.identification_model import IdentificationModel
from crane.identification.mechanics.model_terms import (
    DirectionalTerm,
    ForceDirection,
    FrictionTerm,
    VelocityFriction,
    body_names,
)
from crane.machine.machine import Machine

SpeedRanges = Mapping[str, tuple[float, float]]
FRICTION_PARAMETERS = tuple(item.name for item in fields(Friction))
_SPEED_COUNT = 100  # speeds of a comparison of laws, in each direction
_MAX_STRIBECK_SHARE = 0.3  # largest Stribeck velocity, relative to the largest speed
_STRIBECK_GRID_SIZE = 30  # Stribeck velocities of the search
_FLATNESS_TOLERANCE = 1e-6  # smallest eigenvalue of the scaled pseudo-inertia of a flat body


def friction_laws(
    model: IdentificationModel, parameters: Array, speed_ranges: SpeedRanges
) -> tuple[dict[str, Friction], dict[str, float]]:
    """Friction law of each direction with friction terms in the model.

    Terms that a machine file does not contain (presliding, frictional memory, root of the speed,
    several Stribeck velocities) are replaced by the law that is nearest in least squares to the
    total friction at steady speeds in both directions.

    Args:
        model: The model.
        parameters: All parameters (p,).
        speed_ranges: Least and largest speed of the comparison by direction [m/s], [rad/s].

    Returns:
        Laws by direction; and of those that are not exact the largest difference at a steady
        speed [N], [N m].

    Raises:
        InputError: Identified friction is negative.
    """
    values = dict(zip(model.names, parameters.tolist(), strict=True))
    terms_by_direction: dict[str, list[FrictionTerm]] = {}
    for term in model.terms:
        if isinstance(term, FrictionTerm):
            terms_by_direction.setdefault(term.direction.name, []).append(term)
    laws, deviations = dict[str, Friction](), dict[str, float]()
    for name, terms in terms_by_direction.items():
        law = _exact_law(model, name, terms, values)
        if law is None:
            law, deviations[name] = _nearest_law(terms, values, speed_ranges[name])
        laws[name] = law
    return laws, deviations


def _exact_law(
    model: IdentificationModel, name: str, terms: list[FrictionTerm], values: Mapping[str, float]
) -> Friction | None:
    found = {each.removeprefix(f"{name}."): values[each] for term in terms for each in term.names}
    if not found.keys() <= set(FRICTION_PARAMETERS) or found.get("stiction", 0.0) < 0:
        return None
    # a joint without described friction is identified with an unsmoothed sign
    law = model.machine.friction.get(name, Friction(smoothing=0.0))
    stribeck_velocities = [
        v for term in terms if isinstance(term, VelocityFriction) for v in term.stribeck_velocities
    ]
    try:
        stribeck = stribeck_velocities[0] if stribeck_velocities else law.stribeck
        return Friction(smoothing=law.smoothing, stribeck=stribeck, **found)
    except InputError as error:
        raise InputError(f"'{name}': {error}, give feasible=True") from None


def _nearest_law(
    terms: list[FrictionTerm], values: Mapping[str, float], speed_range: tuple[float, float]
) -> tuple[Friction, float]:
    from scipy.optimize import lsq_linear

    low, high = speed_range
    v = np.linspace(low, high, _SPEED_COUNT)
    v = np.concatenate([-v[::-1], v])
    identified_force = np.zeros_like(v)
    for term in terms:
        identified_force += term.steady_forces(v) @ [values[each] for each in term.names]
    sign, best, lowest_cost = np.sign(v), Friction(), np.inf
    first = min(max(low, high / 1e3), _MAX_STRIBECK_SHARE * high)
    for stribeck in np.geomspace(first, _MAX_STRIBECK_SHARE * high, _STRIBECK_GRID_SIZE).tolist():
        basis = np.column_stack(
            [sign, np.ones_like(v), v, np.abs(v), sign * np.exp(-((v / stribeck) ** 2))]
        )
        bounds = np.array([0.0, -np.inf, 0.0, -np.inf, 0.0]), np.full(5, np.inf)
        found = lsq_linear(basis, identified_force, bounds)
        if found.cost < lowest_cost:
            lowest_cost = found.cost
            max_deviation = float(np.abs(basis @ found.x - identified_force).max())
            coulomb, offset, viscous, viscous_offset, stiction = np.round(found.x, 12).tolist()
            stiction_parameters = {"stiction": stiction, "stribeck": stribeck} if stiction else {}
            best = Friction(coulomb, offset, viscous, viscous_offset, 0.0, **stiction_parameters)
    return best, max_deviation


def divide_locked_bodies(
    machine: Machine, parameters: Array, unlocked_machine: Machine
) -> dict[str, Array]:
    """Divide the parameters of bodies with locked joints among their links, (10,) each.

    For a body with the pseudo-inertia P (`pseudo_inertia`) that consists of links with the
    descriptions D_k, whose sum is D, link k gets

        P_k = T D_k T^T,   T = L L_D^-1,   P = L L^T,  D = L_D L_D^T,

    all in the frame of the body's joint: the sum of the links is P, each link is feasible if its
    description is, and P = D gives the descriptions. Rods and plates without thickness are
    thickened. Links that locks fix to the ground are unchanged.

    Args:
        machine: Machine with locked joints.
        parameters: (10 nb,) parameters of its bodies.
        unlocked_machine: The machine without locked joints.

    Raises:
        InputError: A body is not feasible.
    """
    names = body_names(unlocked_machine)
    described = Dynamics(unlocked_machine).parameters[: 10 * len(names)].reshape(-1, 10)
    links_by_body: dict[int, list[tuple[str, Array, Array]]] = {}
    out = {}
    for name, body in zip(names, described, strict=True):
        frame = machine.model.frames[machine.frame(name)]
        A = frame.placement.homogeneous  # the pseudo-inertia about the body's joint is A P A^T
        if frame.parentJoint == 0:
            out[name] = body
            continue
        P = pseudo_inertia(body)
        units = np.sqrt(np.maximum(np.diag(P), np.finfo(float).tiny))
        if np.linalg.eigvalsh(P / np.outer(units, units))[0] <= _FLATNESS_TOLERANCE:
            P = pseudo_inertia(thicken_body(body))
        links_by_body.setdefault(frame.parentJoint - 1, []).append((name, A, P))
    for i, links in links_by_body.items():
        body = parameters[10 * i : 10 * i + 10]
        if len(links) == 1:
            out[links[0][0]] = body
            continue
        try:
            L = np.linalg.cholesky(pseudo_inertia(body))
            D = np.linalg.cholesky(sum(A @ P @ A.T for _, A, P in links))
        except np.linalg.LinAlgError:
            listed = ", ".join(f"'{name}'" for name, *_ in links)
            raise InputError(
                f"the body of the locked links {listed} is not feasible, give feasible=True"
            ) from None
        T = L @ np.linalg.inv(D)
        for name, A, P in links:
            link_transform = np.linalg.inv(A) @ T @ A
            out[name] = body_parameters(link_transform @ P @ link_transform.T)
    return out


def joint_combinations(model: IdentificationModel) -> list[ForceDirection]:
    """Directions of a model that combine several active joints."""
    directions = [term.direction for term in model.terms if isinstance(term, DirectionalTerm)]
    return list({x.name: x for x in directions if x.factors}.values())


def add_motor(
    draft: MachineDraft, direction: ForceDirection, parent: str, law: Friction, inertia: float
) -> None:
    """Add the rotor of a motor that turns several joints, and its coupling with them.

    Its joint has the name of the direction and carries rotor inertia and friction. Its angle is
    that of the motor on the joints' side. Its link has a mass of 1 mg, as bodies need a mass.
    """
    name, zero = direction.name, (0.0, 0.0, 0.0)
    rotor = Inertial(1e-6, zero, zero, (1e-12, 0.0, 0.0, 1e-12, 0.0, 1e-12))
    robot = draft.urdf_of_link(parent)
    add_link(robot, Link(f"{name}_rotor", "", rotor))
    add_joint(robot, Joint(name, "revolute", parent, f"{name}_rotor", "", axis=(0.0, 0.0, 1.0)))
    turned = {joint: -factor for joint, factor in (direction.factors or {}).items()}
    draft.data["couplings"].append({"name": name, "joints": {name: 1.0} | turned})
    draft.data["friction"][name] = friction_data(law)
    draft.data["rotor_inertia"][name] = inertia
