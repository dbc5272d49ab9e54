"""Levels of detail: one kd-tree over all levels, written as streamed SOG or 3D Tiles."""

from g2ard.levels.streamed_sog import save_levels
from g2ard.levels.tileset import Georeference, save_tileset
from g2ard.levels.tree import Cut, Node, cut

__all__ = ["Cut", "Georeference", "Node", "cut", "save_levels", "save_tileset"]
