"""Simplification to an exact budget: rounds of drop, merge and trim (section 3.2 of the paper)."""

from g2ard.stages.simplify.config import SimplifyConfig, round_counts
from g2ard.stages.simplify.pairs import Visibility, VisibilitySource
from g2ard.stages.simplify.reduce import Simplified, flag, simplify

__all__ = [
    "Simplified",
    "SimplifyConfig",
    "Visibility",
    "VisibilitySource",
    "flag",
    "round_counts",
    "simplify",
]
