"""Titles of the panels that `--help` groups options in."""

from __future__ import annotations

__all__ = ["BUDGET", "COMMON", "LARGE", "METHOD", "OUTPUT", "RECOVERY", "VIEWS"]

BUDGET = "Budget"
VIEWS = "Views"
METHOD = "Method"
RECOVERY = "Recovery"
OUTPUT = "Output"
LARGE = "Large scenes"
COMMON = "Common"
