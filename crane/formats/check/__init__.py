"""Everything that is wrong or unusual about a description, at once."""

from crane.formats.check.report import Finding, Report, check

__all__ = ["Finding", "Report", "check"]
