"""Numbers of a machine that are best for measures of it."""

from crane.studies.design.design_optimization import Design, DesignSolution, design

__all__ = ["Design", "DesignSolution", "design"]
