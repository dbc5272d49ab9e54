"""Levels of detail: one kd-tree over all levels, and the error of each level in each leaf."""

from g2ard.levels.error import leaf_errors
from g2ard.levels.tileset import Georeference, save_tileset
from g2ard.levels.tree import Cut, Leaf, Node, cut
from g2ard.levels.write import save_levels

__all__ = [
    "Cut",
    "Georeference",
    "Leaf",
    "Node",
    "cut",
    "leaf_errors",
    "save_levels",
    "save_tileset",
]
