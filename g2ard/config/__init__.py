"""Configuration: constants by name, names to choose from, presets of published methods."""
