"""Warnings about views that do not show what a scene resolves, and about regions that lost too much."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from g2ard.io import write_splats
from g2ard.jobs.doubts import doubt_merging, doubt_views
from g2ard.poses import plan_pool
from g2ard.scene.cameras import Camera, Cameras
from g2ard.scene.splats import Splats
from helpers.commands import CommandLine, succeeds
from helpers.skies import courtyard, sign, under_sky

YARD = courtyard(0.1)
UNDER_SKY = under_sky(YARD, 0.35, 500.0, -0.1)


def looking(eyes: list[tuple[float, float, float]], fov: float = 50.0) -> Cameras:
    """Return views at the yard."""
    return Cameras.of(
        [Camera.facing(e, [0, 0, 0.5], fov=fov, name=f"{i}") for i, e in enumerate(eyes)]
    )


@pytest.fixture(scope="module")
def far_views():
    return looking([(x, -5000.0, 300.0) for x in (-400.0, 0.0, 400.0)])


def test_a_pool_of_its_own_raises_no_doubt() -> None:
    for scene in (YARD, UNDER_SKY, sign()):
        assert doubt_views(scene, plan_pool(scene, 48, near=0.25).cameras) == []


def test_views_from_outside_a_sky_show_the_yard_below_a_pixel(far_views) -> None:
    found = doubt_views(UNDER_SKY, far_views)
    assert len(found) == 2
    assert "smaller than a pixel in all views" in found[0]
    assert "3 of 3 views stand outside the sky" in found[1]


def test_views_of_a_corner_are_told_of() -> None:
    corner = looking([(0.0, -9.0, 2.0)], fov=5.0)
    (found,) = doubt_views(UNDER_SKY, corner)
    assert "is in no view" in found
    assert "--views" in found


def test_regions_that_vanish_are_told_of() -> None:
    rng, near = np.random.default_rng(0), np.linalg.norm(UNDER_SKY.means, axis=1) < 100
    fair = UNDER_SKY.take(np.sort(rng.permutation(len(UNDER_SKY))[: len(UNDER_SKY) // 10]))
    assert doubt_merging(UNDER_SKY, fair, blind=False) == []
    few = np.concatenate([np.flatnonzero(near)[:7], np.flatnonzero(~near)[: len(fair)]])
    (found,) = doubt_merging(UNDER_SKY, UNDER_SKY.take(few), blind=False)
    assert "kept 7 of 11,8" in found
    assert near.sum() == pytest.approx(11_850, abs=50)
    half = YARD.take(np.flatnonzero(YARD.means[:, 0] > 0)[::5])
    (found,) = doubt_merging(YARD, half, blind=False)
    assert "kept 0 of" in found


def test_far_rows_and_fast_do_not_go_together() -> None:
    assert doubt_merging(YARD, YARD, blind=True) == []
    assert "far beyond the rest" in doubt_merging(UNDER_SKY, UNDER_SKY, blind=True)[0]


def test_commands_print_and_report_doubts(command_line: CommandLine, tmp_path: Path) -> None:
    write_splats(tmp_path / "yard.ply", UNDER_SKY)
    out, error = succeeds(
        command_line,
        tmp_path,
        "simplify",
        "yard.ply",
        "-r",
        10,
        "-o",
        "a.ply",
        "--method",
        "fast",
        "--json",
        "-",
    )
    warnings = json.loads(out)["warnings"]
    assert any("far beyond the rest" in line for line in warnings)
    assert all(line in error for line in warnings)


def empty() -> Splats:
    return YARD.take([])


def test_nothing_to_doubt() -> None:
    few = YARD.take(range(10))
    assert doubt_views(few, looking([(0.0, -9.0, 0.0)])) == []
    assert doubt_merging(few, few.take([0]), blind=True) == []
    assert doubt_merging(YARD, empty(), blind=False) == []
