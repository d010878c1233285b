"""The commands. This is the only place that opens hardware and wires the parts together."""

from fes.cli.main import main

__all__ = ["main"]
