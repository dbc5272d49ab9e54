"""A folder of point clouds, such as the tiles of a survey, read as one."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

from g2ard.io.detect import KINDS, file_format
from g2ard.io.source import Source
from g2ard.io.stream import PointStream, joined_clouds

SUFFIXES = (".las", ".laz", ".e57", ".pcd", ".ply")
"""Suffixes of files that a folder of clouds may hold."""

_BESIDE = (".lax", ".lasx", ".copc", ".prj", ".wkt", ".xml", ".txt", ".md", ".pdf", ".json")
"""Suffixes of files that surveys keep beside their clouds."""


def clouds_in(folder: Path) -> list[Path]:
    """Return the clouds of a folder of clouds alone, by name; an empty list for another folder."""
    files = [file for file in sorted(folder.iterdir()) if not file.name.startswith(".")]
    clouds = [file for file in files if file.suffix.lower() in SUFFIXES]
    others = [file for file in files if file.suffix.lower() not in (*SUFFIXES, *_BESIDE)]
    return [] if others else clouds


def holds(folder: Path) -> bool:
    """Return whether a folder holds point clouds and nothing else; the first few are looked into."""
    clouds = clouds_in(folder)
    return bool(clouds) and all(KINDS[file_format(file)] == "points" for file in islice(clouds, 4))


def Stream(path: Path) -> PointStream:
    """Return the clouds of a folder as one."""
    return joined_clouds([Source(file).cloud(bare=True) for file in clouds_in(path)])
