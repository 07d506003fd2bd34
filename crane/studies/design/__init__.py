"""Numbers of a machine that are best for measures of it."""

from crane.studies.design.optimum import Design, Solution, design

__all__ = ["Design", "Solution", "design"]
