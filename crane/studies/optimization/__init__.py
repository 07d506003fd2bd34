"""Design optimization: parameters of a machine that are best for measures of it."""

from crane.studies.optimization.design_optimization import design
from crane.studies.optimization.design_result import Design, DesignSolution

__all__ = ["Design", "DesignSolution", "design"]
