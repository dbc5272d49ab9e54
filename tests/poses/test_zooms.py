"""Zooms of training views."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from g2ard.poses.zooms import zoomed
from g2ard.rendering.renderer import Renderer
from g2ard.scene.cameras import ZOOM, Cameras
from helpers.scenes import around, checkered_ball


def test_a_zoom_is_a_window_of_its_view_at_twice_the_size() -> None:
    scene, views = checkered_ball(), around(12, (120, 90))
    found = zoomed(scene, views)
    zooms = [i for i, kind in enumerate(found.kinds) if kind == ZOOM]
    assert len(zooms) == 3
    renderer = Renderer(scene)
    for i in zooms:
        large, window = renderer.clipped(views.scaled(240)[i]), found[i]
        x, y = np.round(2 * views[i].K[:2, 2] - window.K[:2, 2]).astype(int)
        assert 0 <= x <= 120
        assert 0 <= y <= 90
        here = window.K.copy()
        here[:2, 2] = 2 * views[i].K[:2, 2] - [x, y]  # whole pixels
        np.testing.assert_allclose(
            renderer.clipped(replace(window, K=here)), large[y : y + 90, x : x + 120], atol=0.02
        )
    others = [i for i in range(12) if i not in zooms]
    assert found.take(others).fingerprint() == views.take(others).fingerprint()


def test_only_views_of_small_gaussians_zoom(tmp_path: Path) -> None:
    scene, views = checkered_ball(), around(12, (120, 90))
    large = replace(scene, scales=scene.scales * 20)
    assert ZOOM not in zoomed(large, views).kinds
    assert ZOOM in zoomed(large, views, represents=1e4).kinds
    assert zoomed(scene, views, share=0.4).kinds.count(ZOOM) == 1
    pictured = replace(views, image_paths=(tmp_path / "a.png",) * 12)
    assert ZOOM not in zoomed(scene, pictured).kinds
    nowhere = replace(scene, logit_opacities=scene.logit_opacities - 99)
    assert ZOOM not in zoomed(nowhere, views).kinds


@pytest.mark.parametrize("count", [1, 2])
def test_few_views_stay(count: int) -> None:
    views = around(count, (64, 48))
    assert zoomed(checkered_ball(), Cameras.of(list(views))).kinds.count(ZOOM) <= 1
