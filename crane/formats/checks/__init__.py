"""Checks of a description: all errors and warnings at once."""
