"""Inertial parameters of the links of a machine some of whose joints were locked."""

import numpy as np

from crane.common.errors import InputError
from crane.common.samples import Array
from crane.dynamics import Dynamics
from crane.identification.mechanics.feasible_estimate import thicken_body
from crane.identification.mechanics.feasible_parameters import body_parameters, pseudo_inertia
from crane.identification.mechanics.inertial_terms import body_names
from crane.machine import Machine

_FLATNESS_TOLERANCE = (
    1e-6  # smallest eigenvalue of a flat body's pseudo-inertia, its diagonal scaled to one
)


def divide_locked_bodies(
    machine: Machine, parameters: Array, unlocked_machine: Machine
) -> dict[str, Array]:
    """Parameters (10,) of each moving link, from those of what locked joints make one body.

    Of a body with the pseudo-inertia P (`feasible.pseudo_inertia`) that consists of links whose
    descriptions D_k add up to D, link k gets

        P_k = T D_k T^T,   T = L L_D^-1,   P = L L^T,  D = L_D L_D^T,

    all in the frame of the body's joint: the parts add up to P, each is as possible as its
    description, and all are the described ones where P is D. Descriptions of rods and plates
    without thickness count with some. Links that the locks fix to the ground stay as described.

    Args:
        machine: With locked joints.
        parameters: (10 nb,) of its bodies.
        unlocked_machine: The same without.

    Raises:
        InputError: A body cannot exist.
    """
    described = (
        Dynamics(unlocked_machine)
        .parameters[: 10 * (unlocked_machine.model.njoints - 1)]
        .reshape(-1, 10)
    )
    links_by_body: dict[int, list[tuple[str, Array, Array]]] = {}
    out = {}
    for name, body in zip(body_names(unlocked_machine), described, strict=True):
        frame = machine.model.frames[machine.frame(name)]
        A = frame.placement.homogeneous  # P about the body's joint is A P A^T
        if frame.parentJoint == 0:
            out[name] = body
        else:
            P = pseudo_inertia(body if is_solid(body) else thicken_body(body))
            links_by_body.setdefault(frame.parentJoint - 1, []).append((name, A, P))
    for i, links in links_by_body.items():
        body_parameters_given = parameters[10 * i : 10 * i + 10]
        if len(links) == 1:
            out[links[0][0]] = body_parameters_given
            continue
        try:
            L = np.linalg.cholesky(pseudo_inertia(body_parameters_given))
            D = np.linalg.cholesky(sum(A @ P @ A.T for _, A, P in links))
        except np.linalg.LinAlgError:
            names = ", ".join(f"'{name}'" for name, *_ in links)
            raise InputError(
                f"what the locks make one body of {names} cannot exist, give feasible=True"
            ) from None
        T = L @ np.linalg.inv(D)
        for name, A, P in links:
            link_transform = np.linalg.inv(A) @ T @ A
            out[name] = body_parameters(link_transform @ P @ link_transform.T)
    return out


def is_solid(body: Array) -> bool:
    """Whether a body of parameters (10,) has mass in all directions, far above rounding."""
    P = pseudo_inertia(body)
    units = np.sqrt(np.maximum(np.diag(P), np.finfo(float).tiny))
    return bool(np.linalg.eigvalsh(P / np.outer(units, units))[0] > _FLATNESS_TOLERANCE)
