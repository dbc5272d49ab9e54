"""Viewer pages."""
