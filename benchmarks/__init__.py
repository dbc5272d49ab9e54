"""Benchmarks: speed against the machine's limits, quality against other methods."""
