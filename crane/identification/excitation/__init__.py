"""Motions that tell most of the parameters."""
