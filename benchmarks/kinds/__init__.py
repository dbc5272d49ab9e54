"""Kinds of studies, one per module."""
