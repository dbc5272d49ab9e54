"""A city as a folder: cloud, photos, the views of each split, and the options that made it."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from benchmarks.synth.city import City, CityConfig, city
from g2ard import __version__
from g2ard.io import atomic_folder, check_output, write_views
from g2ard.io.cloud_ply import write_blocks
from g2ard.io.types import Points
from g2ard.progress import Progress, silent
from g2ard.scene.cameras import Cameras

__all__ = ["write_city"]


def write_city(
    folder: str | Path,
    config: CityConfig | None = None,
    *,
    overwrite: bool = False,
    tile: float | None = None,
    threads: int = 0,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Build a city and write it as a data set, whole or not at all.

    Args:
        folder: output; holds cloud.ply, images/, train.json, val.json, adapt.json, ood.json, manifest.json.
        config: its configuration; None is the default city.
        overwrite: whether to replace an existing folder.
        tile: write the cloud as .laz files of squares of this side, metres, in cloud/.
        threads: photos to take in parallel; 0 means every core. The result does not depend on it.
        progress: callback per block of points and per photo.

    Returns:
        The manifest.

    Raises:
        OutputError: the folder exists and may not be overwritten, or cannot be written.
    """
    config = config or CityConfig()
    check_output(folder, overwrite, folder=True)
    town = city(config)
    with atomic_folder(folder, overwrite) as place:
        parts = _scanned(town, progress)
        if tile is None:
            write_blocks(place / "cloud.ply", town.config.points, parts)
        else:
            _write_tiles(place / "cloud", parts, np.asarray(town.config.offset), tile)
        for name, cameras in town.views.items():
            paths = tuple(place / "images" / f"{view}.png" for view in cameras.names)
            write_views(place / f"{name}.json", replace(cameras, image_paths=paths))
        _photograph(town, place, threads, progress)
        manifest = _manifest(town)
        (place / "manifest.json").write_text(
            json.dumps(manifest, indent=2) + "\n", encoding="utf-8", newline="\n"
        )
    return manifest


def _scanned(town: City, progress: Progress) -> Iterator[Points]:
    count, done = town.config.points, 0
    progress("cloud", 0, count)
    for part in town.scans():
        yield Points(part.positions, part.colors)
        done += len(part.positions)
        progress("cloud", done, count)


def _write_tiles(
    folder: Path, parts: Iterator[Points], offset: NDArray[np.float64], side: float
) -> None:
    """Write points as .laz files, one per square, named by its column and row from the centre."""
    import laspy

    folder.mkdir()
    header = laspy.LasHeader(point_format=2, version="1.2")
    header.offsets, header.scales = offset, [1e-3] * 3
    with ExitStack() as opened:
        files: dict[tuple[int, int], Any] = {}
        for part in parts:
            cells = np.floor((part.positions[:, :2] - offset[:2]) / side).astype(int)
            for column, row in np.unique(cells, axis=0).tolist():
                here = (cells == (column, row)).all(axis=1)
                if (column, row) not in files:
                    writer = laspy.open(folder / f"{column}_{row}.laz", mode="w", header=header)
                    files[column, row] = opened.enter_context(writer)
                points = laspy.ScaleAwarePointRecord.zeros(int(here.sum()), header=header)
                points.x, points.y, points.z = part.positions[here].T
                colors = np.rint(part.colors[here] * 65535).astype(np.uint16)
                points.red, points.green, points.blue = colors.T
                files[column, row].write_points(points)


def _photograph(town: City, place: Path, threads: int, progress: Progress) -> None:
    (place / "images").mkdir()
    jobs = [(cameras, i) for cameras in town.views.values() for i in range(len(cameras))]

    def shoot(cameras: Cameras, index: int) -> None:
        pixels = np.rint(town.photo(cameras, index) * 255).astype(np.uint8)
        Image.fromarray(pixels).save(place / "images" / f"{cameras.names[index]}.png")

    pool = ThreadPoolExecutor(threads or os.cpu_count() or 1)
    try:
        for done, future in enumerate(
            as_completed([pool.submit(shoot, *job) for job in jobs]), start=1
        ):
            future.result()
            progress("photos", done, len(jobs))
    finally:
        pool.shutdown(cancel_futures=True)


def _manifest(town: City) -> dict[str, Any]:
    return {
        "generator": f"python -m benchmarks synth city {__version__}",
        "options": asdict(town.config),
        "background": town.config.sky,
        "primitives": len(town.layout.shapes),
        "points": town.config.points,
        "views": {name: len(cameras) for name, cameras in town.views.items()},
    }
