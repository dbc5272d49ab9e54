"""SOG scenes."""

from __future__ import annotations

from pathlib import Path


def chunks_of(path: Path) -> list[Path]:
    return []
