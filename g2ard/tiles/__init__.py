"""Scenes larger than memory, stored as tiles in a folder."""
