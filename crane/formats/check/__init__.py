"""Everything that is wrong or unusual about a description, at once."""

from crane.formats.check.check_report import CheckReport, Finding, check

__all__ = ["Finding", "CheckReport", "check"]
