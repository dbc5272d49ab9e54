"""Configuration: settings by dotted path, allowed names, presets of published methods."""
