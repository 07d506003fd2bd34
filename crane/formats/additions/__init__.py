"""Cylinders and loops added to machines that were described without them."""
