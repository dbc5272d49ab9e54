"""Procedural city: coloured LiDAR point cloud, photos with exact poses and depth, four splits."""

from __future__ import annotations

from benchmarks.synth.city import City, CityConfig, Scan, city
from benchmarks.synth.write import write_city

__all__ = ["City", "CityConfig", "Scan", "city", "write_city"]
