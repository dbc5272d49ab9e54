"""Views of scenes without an extent, or of next to nothing, are planned, finite and show them."""

import numpy as np
import pytest

from g2ard.poses import best_views, plan_pool, turntable
from g2ard.rendering.renderer import Renderer
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats
from helpers.scenes import around, degenerate_scenes, in_units

SCENES = degenerate_scenes()
_SIZE = (64, 48)


def _most_shown(scene: Splats, cameras: Cameras) -> np.ndarray:
    """Return the largest alpha of each view."""
    renderer = Renderer(scene)
    return np.array([renderer.render(camera).alpha.max() for camera in cameras])


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("name", "unit"),
    [*((name, 1.0) for name in SCENES), ("1", 1e4), ("2", 1e-3), ("on a plane", 1e4)],
)
def test_views_of_a_degenerate_scene_show_it(name: str, unit: float) -> None:
    scene, _ = in_units(SCENES[name], around(1), unit)
    best, turn = best_views(scene, 3, size=_SIZE), turntable(scene, 5, size=_SIZE)[0]
    pool = plan_pool(scene, 8, size=_SIZE).cameras
    assert 1 <= len(best) <= 3
    assert (len(turn), len(pool)) == (5, 8)
    for cameras in (best, turn, pool):
        assert np.isfinite(cameras.viewmats).all()
        assert (_most_shown(scene, cameras) > 0.3).all()


@pytest.mark.parametrize("name", ["1", "50 in one place", "nearly in one place", "one visible"])
def test_a_scene_of_one_place_is_shown_whole(name: str) -> None:
    """All of the Gaussian is in frame, and it is no speck."""
    scene = SCENES[name]
    for cameras in (best_views(scene, 1, size=_SIZE), turntable(scene, 4, size=_SIZE)[0]):
        for camera in cameras:
            alpha = Renderer(scene).render(camera).alpha
            edge = max(alpha[0].max(), alpha[-1].max(), alpha[:, 0].max(), alpha[:, -1].max())
            assert edge < 0.5 * alpha.max()
            assert (alpha > 0.5 * alpha.max()).mean() > 0.02
