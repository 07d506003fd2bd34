"""The command line."""

from crane.cli.entry import main
from crane.cli.shared import app

__all__ = ["app", "main"]
