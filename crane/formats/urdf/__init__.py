"""URDF, with loops as elements of its own."""
