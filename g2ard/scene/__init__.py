"""Scenes and what stages pass on: splats, cameras, targets, images, splits, regions."""
