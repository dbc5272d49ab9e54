"""Benchmarks: speed, and quality against other methods."""
