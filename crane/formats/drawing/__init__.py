"""Machines drawn by their pins, translated to URDF."""
