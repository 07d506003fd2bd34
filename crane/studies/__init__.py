"""Measures of a machine over its parameters, and of its runs."""

from crane.studies.power import PowerAccount, power_account
from crane.studies.power_comparison import PowerComparison
from crane.studies.run import study
from crane.studies.sway import SwayRow, SwayStudy, sway_study
from crane.studies.table import Study

__all__ = [
    "PowerAccount", "PowerComparison", "Study", "SwayRow", "SwayStudy", "power_account", "study",
    "sway_study",
]  # fmt: skip
