"""Sensitivities of a simulation."""
