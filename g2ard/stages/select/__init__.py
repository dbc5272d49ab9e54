"""View selection."""

from __future__ import annotations

from g2ard.stages.select.choose import POLICIES, Selection, select
from g2ard.stages.select.surfaces import CoverageOptions, Surface, Visible, surface, visible_cells

__all__ = [
    "POLICIES",
    "CoverageOptions",
    "Selection",
    "Surface",
    "Visible",
    "select",
    "surface",
    "visible_cells",
]
