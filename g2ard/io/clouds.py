"""A folder of point clouds, such as the tiles of a survey, read as one."""

from __future__ import annotations

from pathlib import Path

from g2ard.io.detect import clouds_in
from g2ard.io.source import Source
from g2ard.io.stream import PointStream, joined_clouds


def Stream(path: Path) -> PointStream:
    """Return the clouds of a folder as one."""
    return joined_clouds([Source(file).cloud(bare=True) for file in clouds_in(path)])
