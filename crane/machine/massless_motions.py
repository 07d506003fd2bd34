"""Motions that move no inertia: where the mass matrix is singular, and what is idle everywhere.

Coordinate i would have the inertia

    S_ii = sum m |v|^2 + (m l^2 + tr I) |w|^2

per unit of its velocity, with v of the COM and w of each link it moves, if the masses of its links
were at the characteristic length l. A motion n has no inertia where
n^T M_A n <= `MIN_INERTIA_SHARE` n^T S n: a radius of gyration of less than 3e-6 l, where rounding
leaves fewer than five digits of M_A.

A motion that moves no inertia of any body in any configuration is idle: a rod between two balls
turns about itself and nothing else depends on it. One active coordinate per idle motion is held,
so that the others have a regular mass matrix; M_A a = f is met exactly, because f has no part
along n.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from crane.closure.closure import Closure
from crane.common.errors import ClosureError
from crane.common.samples import Array
from crane.description.kinematic_tree import Tree

MIN_INERTIA_SHARE = 1e-11
_JOINT_SHARE, _BODY_SHARE = 0.1, 1e-6  # velocities that count, of the largest
_SAMPLES, _SAMPLE_RANGE = 4, 0.3  # configurations about home, in coordinate units


def _tree_mass_matrix(model: pin.Model, closure: Closure, q: Array) -> Array:
    """M (nv, nv) of the tree."""
    equations = closure.equations  # creating data is expensive
    configuration = equations.coordinates.configuration(q)
    upper = np.triu(pin.crba(model, equations.data, configuration))
    return np.asarray(upper + np.triu(upper, 1).T)


def project_mass_matrix(model: pin.Model, closure: Closure, q: Array, gamma: Array) -> Array:
    """M_A = gamma^T M gamma (n, n) at a closed configuration (nq,)."""
    return np.asarray(gamma.T @ _tree_mass_matrix(model, closure, q) @ gamma)


def extent_inertias(model: pin.Model, closure: Closure, q: Array, gamma: Array) -> Array:
    """S_ii (n,) of the columns of gamma (nv, n) at a closed configuration (nq,)."""
    mass = _tree_mass_matrix(_with_masses_at_their_extent(model, closure), closure, q)
    return np.einsum("ij,ij->j", gamma, mass @ gamma)


def _with_masses_at_their_extent(model: pin.Model, closure: Closure) -> pin.Model:
    out, square = pin.Model(model), closure.characteristic_length**2
    for i, body in enumerate(list(model.inertias)[1:], start=1):
        mass = abs(body.mass)  # parameters of a fit may be those of no body
        moment = mass * square + abs(np.trace(body.inertia))
        out.inertias[i] = pin.Inertia(mass, body.lever, moment * np.eye(3))
    return out


def _moves_no_body(model: pin.Model, closure: Closure, motion: "IdleMotion") -> bool:
    """Whether motions move no inertia of any single body, however large the others are."""
    extended, data = _with_masses_at_their_extent(model, closure), closure.equations.data
    pin.computeJointJacobians(model, data, closure.equations.coordinates.configuration(motion.q))
    rates = closure.continuation.gamma(motion.q) @ motion.basis
    twists = [
        pin.getJointJacobian(model, data, i, pin.LOCAL).reshape(6, -1) @ rates
        for i in range(1, model.njoints)
    ]
    fastest = np.max(np.abs(twists))
    for i, twist in enumerate(twists, start=1):
        moved, largest = (
            np.sum(twist * (body.matrix() @ twist))
            for body in (model.inertias[i], extended.inertias[i])
        )
        if moved > MIN_INERTIA_SHARE * largest and np.abs(twist).max() > _BODY_SHARE * fastest:
            return False
    return True


def least_inertias(model: pin.Model, closure: Closure) -> Array:
    """(nv,) inertia of each joint that counts as none: `MIN_INERTIA_SHARE` of the largest S_ii.

    S_ii is that of the closed chain for active joints, and that of the tree for others, at home
    and a little off it, where loops need not be closed for an order of magnitude.
    """
    extended = _with_masses_at_their_extent(model, closure)
    home, found = closure.home, []
    step = closure.continuation.gamma(home) @ (_SAMPLE_RANGE * closure.units[closure.active])
    for q in (home, home + step, home - 0.7 * step):
        try:
            gamma = closure.continuation.gamma(q)
        except ClosureError:
            continue
        mass = _tree_mass_matrix(extended, closure, q)
        inertias = np.diag(mass).copy()
        inertias[closure.active] = np.einsum("ij,ij->j", gamma, mass @ gamma)
        found.append(inertias)
    return np.asarray(MIN_INERTIA_SHARE * np.max(found, axis=0))


def massless_motions_at(model: pin.Model, closure: Closure, q: Array) -> Array:
    """Motions (n, k) that move no inertia at a closed configuration (nq,).

    They are orthonormal in units of 1 / sqrt(S_ii).
    """
    gamma = closure.continuation.gamma(q)
    extents = extent_inertias(model, closure, q, gamma)
    scale = 1 / np.sqrt(np.where(extents > 0, extents, 1.0))
    mass = project_mass_matrix(model, closure, q, gamma)
    values, vectors = np.linalg.eigh(mass * scale * scale[:, None])
    return np.asarray(vectors[:, ~(values > MIN_INERTIA_SHARE)] * scale[:, None])


class IdleMotion(NamedTuple):
    """Motions that move no inertia at one of several configurations, as many at each.

    Attributes:
        q: (nq,) closed configuration.
        basis: (n, k), see `massless_motions_at`.
    """

    q: Array
    basis: Array


def find_idle_motions(model: pin.Model, closure: Closure) -> list[IdleMotion]:
    """Motions that move no inertia of any body at some closed configurations, home first.

    Returns:
        Empty if there is none. Without home if the mass matrix is singular there only.
    """
    found = [IdleMotion(closure.home, massless_motions_at(model, closure, closure.home))]
    if not found[0].basis.shape[1]:
        return []
    found += [
        IdleMotion(q, massless_motions_at(model, closure, q))
        for q in _configurations_about_home(closure)
    ]
    count = min(motion.basis.shape[1] for motion in found)
    idle = [motion for motion in found if motion.basis.shape[1] == count]
    return idle if count and _moves_no_body(model, closure, idle[-1]) else []


def _configurations_about_home(closure: Closure) -> Iterator[Array]:
    random, home = np.random.default_rng(0), closure.continuation.home
    units = closure.units[closure.active]
    for _ in range(_SAMPLES):
        step = _SAMPLE_RANGE * random.uniform(-1.0, 1.0, len(units)) * units
        for share in (1.0, 0.3, 0.1):
            try:
                yield closure.continuation.continue_to(home.q_a + share * step, home).q
            except ClosureError:
                continue
            break


def select_held_coordinates(motions: list[IdleMotion]) -> tuple[int, ...]:
    """One active coordinate per idle motion that moves with it in all configurations.

    Args:
        motions: See `find_idle_motions`.
    """
    if not motions:
        return ()
    bases = [np.linalg.qr(motion.basis)[0] for motion in motions]
    shares = np.mean([basis @ basis.T for basis in bases], axis=0)
    held: list[int] = []
    for _ in range(motions[0].basis.shape[1]):  # Cholesky's factorization with pivoting
        i = int(np.argmax(np.diag(shares)))
        held.append(i)
        shares = shares - np.outer(shares[i], shares[i]) / shares[i, i]
    return tuple(sorted(held))


def describe_massless_motion(
    model: pin.Model, closure: Closure, tree: Tree, q: Array, gamma: Array, mass: Array
) -> str:
    """What moves without inertia at a closed configuration (nq,) where M_A (n, n) is singular."""
    extents = extent_inertias(model, closure, q, gamma)
    scale = 1 / np.sqrt(np.maximum(np.where(extents > 0, extents, 1.0), np.diag(mass)))
    v = gamma @ (scale * np.linalg.eigh(mass * scale * scale[:, None])[1][:, 0])
    shares = np.abs(v / closure.units) / np.abs(v / closure.units).max()
    coordinates, data = closure.equations.coordinates, model.createData()
    joints = [name for name, x in zip(coordinates.names, shares, strict=True) if x > _JOINT_SHARE]
    pin.forwardKinematics(model, data, coordinates.configuration(q), v / np.abs(v).max())
    moved = {i for i, body in enumerate(data.v) if np.abs(body.vector).max() > _BODY_SHARE}
    links = [
        frame.name
        for frame in model.frames
        if frame.type == pin.BODY
        and frame.parentJoint in moved
        and tree.links[frame.name].composite_joint is None
    ]
    names = " and ".join(f"'{name}'" for name in joints[:2]) + (" ..." if joints[2:] else "")
    if not links:
        return f"the axes of {names} line up there: keep away from there"
    verb = "moves" if len(joints) == 1 else "move"
    return (
        f"{names} {verb} link '{links[0]}' without inertia there: give it one, or keep away from "
        "there"
    )


def is_definite(mass: Array, least: Array) -> bool:
    """Whether all pivots of mass matrices M (..., n, n) are above the least inertias (..., n)."""
    try:
        pivots = np.diagonal(np.linalg.cholesky(mass), axis1=-2, axis2=-1) ** 2
    except np.linalg.LinAlgError:
        return False
    return bool((pivots > least).all())


def hold_coordinates(mass: Array, held: tuple[int, ...]) -> Array:
    """M (..., n, n) with the rows and columns of held coordinates those of the unit matrix."""
    out = mass.copy()
    for i in held:
        out[..., i, :] = out[..., :, i] = 0.0
        out[..., i, i] = 1.0
    return out
