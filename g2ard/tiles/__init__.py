"""Scenes larger than memory, as tiles in a folder."""
