"""A small procedural city: a coloured laser cloud, photos with exact poses and depth, four splits of views."""

from __future__ import annotations

from g2ard.synth.city import City, CityConfig, Cloud, Hits, city

__all__ = ["City", "CityConfig", "Cloud", "Hits", "city"]
