"""Parts and loops added to machines that were described without them."""

from crane.formats.adding.cylinder import AddedCylinder, add_cylinder

__all__ = ["AddedCylinder", "add_cylinder"]
