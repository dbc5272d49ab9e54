"""Measuring: speed against the machine's limit, quality against the baselines."""
