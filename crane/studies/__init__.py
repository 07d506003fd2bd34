"""Model-based design studies: measures of a machine over its parameters."""

from crane.studies.run import study
from crane.studies.sway import SwayRow, SwayStudy, sway_study
from crane.studies.table import Study

__all__ = ["Study", "SwayRow", "SwayStudy", "study", "sway_study"]
