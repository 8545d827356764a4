"""The command line, one file a command."""

from estimators.cli.app import main

__all__ = ["main"]
