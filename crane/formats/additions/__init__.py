"""Cylinders and loops added to machines that were described without them."""

from crane.formats.additions.machine_additions import (
    AddedCylinder,
    AddedLoops,
    add_cylinder,
    add_loops,
)
from crane.formats.additions.open_loop_search import LoopProposal, propose_loops

__all__ = [
    "AddedCylinder", "AddedLoops", "LoopProposal", "add_cylinder", "add_loops", "propose_loops",
]  # fmt: skip
