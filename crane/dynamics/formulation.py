"""The exact formulation of the dynamics, and the published one with chains on bases held still."""

from crane.common.errors import InputError, suggest_names
from crane.machine import Machine

FORMULATIONS = ("exact", "decoupled")


def carrier_bodies(machine: Machine, formulation: str) -> tuple[int, ...]:
    """The body whose motion each body shares.

    "exact": the parent in the tree. "decoupled": the same within a sub-chain, but every sub-chain
    stands on a base held still at its current pose, equations (16) to (21) of the reduced-scale
    forwarder paper; the forces of a chain on the chain that carries it are left out.

    Args:
        machine: The machine.
        formulation: One of `FORMULATIONS`.

    Returns:
        (nv + 1,) indices in the numbering of `Coordinates.parents`; 0 for the world, which is at
        rest.

    Raises:
        InputError: Unknown formulation.
    """
    if formulation not in FORMULATIONS:
        raise InputError(
            f"formulation '{formulation}' is unknown, {suggest_names(FORMULATIONS, formulation)}"
        )
    parents = machine.coordinates.parents
    if formulation == "exact":
        return parents
    chain = {joint: chain.name for chain in machine.chains for joint in chain.joints}
    names = [None, *(chain[joint] for joint in machine.joints)]
    return tuple(p if names[p] == names[i] else 0 for i, p in enumerate(parents))
