"""URDF, with elements for loops and couplings."""
