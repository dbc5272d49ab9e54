"""Coloured points from photos with poses: along camera rays, and within the outlines of photos with alpha."""
