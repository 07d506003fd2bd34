"""Measures of a machine over its parameters, and of its runs."""

from crane.studies.hydraulic_power_balance import power_balance
from crane.studies.power_balance_result import PowerBalance, PowerComparison
from crane.studies.residual_sway_study import SwayRow, SwayStudy, sway_study
from crane.studies.study_table import Study
from crane.studies.variant_study import study

__all__ = [
    "PowerBalance", "PowerComparison", "Study", "SwayRow", "SwayStudy", "power_balance", "study",
    "sway_study",
]  # fmt: skip
