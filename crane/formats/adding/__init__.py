"""Parts and loops added to machines that were described without them."""

from crane.formats.adding.cylinder import AddedCylinder, add_cylinder
from crane.formats.adding.loops import AddedLoops, add_loops
from crane.formats.adding.open_loops import Proposal, proposals

__all__ = [
    "AddedCylinder", "AddedLoops", "Proposal", "add_cylinder", "add_loops", "proposals",
]  # fmt: skip
