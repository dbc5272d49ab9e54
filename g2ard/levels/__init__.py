"""Levels of detail: one kd-tree over all of them, and what each loses in each of its leaves."""

from g2ard.levels.error import leaf_errors
from g2ard.levels.tree import Cut, Leaf, Node, cut
from g2ard.levels.write import save_levels

__all__ = ["Cut", "Leaf", "Node", "cut", "leaf_errors", "save_levels"]
