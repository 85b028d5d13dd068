"""The command line: ``motorid fit RUN...`` and its fellows; `motorid.cli.app` lists the commands."""

from motorid.cli.app import main

__all__ = ["main"]
