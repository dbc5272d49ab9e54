"""Costs of a file format: bytes and decibels beside the unpacked scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from g2ard.errors import InputError
from g2ard.io.scene_formats import scene_format
from g2ard.io.scenes import read_back
from g2ard.io.spz import names_axes
from g2ard.jobs.budget_search import measure_quality, render_clipped
from g2ard.poses import plan_pool
from g2ard.report.run import WARNED_FORMAT_LOSS, better_format
from g2ard.scene.splats import Splats
from g2ard.scene.transform import change_of_axes, with_axes

_GOOD_PSNR = 35.0
"""PSNR of a good scene, to which the difference between two scenes is related, dB."""
_LOSS_VIEWS = 4
"""Number of generated views to compare in."""
_LOSS_SIZE = (400, 300)
"""Pixels of these views."""
_LOSS_ROWS = 100_000
"""Gaussians that these views are planned by."""
_MOST_COMPARED_GAUSSIANS = 2_000_000
"""Gaussians above which scenes are not compared."""


def describe_format_loss(path: Path, splats: Splats, options: dict[str, Any]) -> str | None:
    """Compare a written file with its scene in a few small generated views; return a warning if a scene of
    35 dB would lose more than 1 dB.

    Nothing is compared if the format is exact, the scene is large or no view shows it.
    """
    if (
        not (scene_format(path).loss or options.get("compress"))
        or len(splats) > _MOST_COMPARED_GAUSSIANS
    ):
        return None
    try:
        cameras = plan_pool(splats, _LOSS_VIEWS, size=_LOSS_SIZE, rows=_LOSS_ROWS).cameras
    except InputError:
        return None
    stored = read_back(path, splats)
    unnamed = options.get("axes") == "RDF" and options.get("spz_version", 3) != 4  # so read as RUB
    if unnamed and not names_axes(path):
        stored = with_axes(stored, change_of_axes("RDF", "RUB"))
    away = measure_quality(render_clipped(splats, cameras), stored, cameras).psnr
    lowered = -10 * float(np.log10(10 ** (-_GOOD_PSNR / 10) + 10 ** (-away / 10)))
    if _GOOD_PSNR - lowered <= WARNED_FORMAT_LOSS:
        return None
    return (
        f"warning: {path}: renders are {away:.1f} dB PSNR from the original's, which lowers a score of "
        f"{_GOOD_PSNR:.0f} dB to {lowered:.1f}; {better_format(path.name)}"
    )
