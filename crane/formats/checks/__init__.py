"""Checks of a description: all errors and warnings at once."""

from crane.formats.checks.check_report import CheckReport, Finding, check

__all__ = ["Finding", "CheckReport", "check"]
