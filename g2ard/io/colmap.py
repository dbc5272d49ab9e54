"""COLMAP models."""

from __future__ import annotations

from pathlib import Path


def model_folder(path: Path) -> Path | None:
    return None
