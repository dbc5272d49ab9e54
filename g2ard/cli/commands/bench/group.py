"""The group that the benchmarks' commands belong to."""

from g2ard.cli.frame import group

bench = group("bench", "Measure on this machine.\n\nExample: g2ard bench raster scene.ply --json -")
