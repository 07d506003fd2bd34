"""A dimensioned drawing of the mechanism."""

from crane.view.sketch.draw import sketch

__all__ = ["sketch"]
