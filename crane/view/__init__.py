"""Seeing a machine: pages, plots, sketches, and one to play with."""
