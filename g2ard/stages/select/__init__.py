"""View selection."""

from g2ard.stages.select.choose import Selection, select
from g2ard.stages.select.surfaces import CoverageOptions, Surface, surface, visible_cells

__all__ = ["CoverageOptions", "Selection", "Surface", "select", "surface", "visible_cells"]
