"""Data types shared by stages: splats, cameras, targets, images, splits, regions."""
