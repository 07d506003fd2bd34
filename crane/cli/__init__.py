"""The command line."""

from crane.cli.entry import main, program

__all__ = ["main", "program"]
