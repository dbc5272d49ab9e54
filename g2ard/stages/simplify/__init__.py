"""Simplification to an exact budget: rounds of drop, merge and trim (section 3.2 of the paper)."""

from g2ard.stages.simplify.config import Default, Fast, Pairs, Paper, SimplifyConfig, round_counts
from g2ard.stages.simplify.pairs import VisibilitySource
from g2ard.stages.simplify.reduce import Simplified, simplify

__all__ = [
    "Default",
    "Fast",
    "Pairs",
    "Paper",
    "Simplified",
    "SimplifyConfig",
    "VisibilitySource",
    "round_counts",
    "simplify",
]
