"""Tests of the fields of view with which pages open, by the shape of the window."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike

from g2ard.jobs.framing import choose_fields
from g2ard.scene.cameras import Camera, Cameras
from g2ard.scene.splats import Splats
from helpers.pages import half_height as half

ASPECTS = (390 / 844, 1.0, 1.6, 16 / 9)


def wall(left: float, right: float, low: float = -2.0, high: float = 2.0) -> Splats:
    """A wall of discs in the plane y = 0."""
    x, z = np.meshgrid(np.arange(left, right, 0.04), np.arange(low, high, 0.04))
    places = np.stack([x.ravel(), 0 * x.ravel(), z.ravel()], axis=1)
    scales = np.full(places.shape, [0.03, 0.001, 0.03])
    return Splats.create(places, scales=scales, logit_opacities=np.full(len(places), 6.0))


def photos(places: ArrayLike = (0.0, 0.02, 0.04, 0.06, 0.08)) -> Cameras:
    """Upright photos of the wall side by side: at distance 1, each shows 0.8 × 1.6."""
    fov = 2 * np.degrees(np.arctan(0.4))
    views = [
        Camera.facing([x, -2, 0], [x, 0, 0], width=30, height=60, fov=fov, name=f"{x:.2f}")
        for x in np.asarray(places)
    ]
    return replace(Cameras.of(views), image_paths=tuple(Path(view.name) for view in views))


@pytest.mark.parametrize("size", [(0.1, 0.4), (0.3, 0.1), (0.2, 0.2)])
@pytest.mark.parametrize("aspect", ASPECTS)
def test_a_subject_fills_the_window(size: tuple[float, float], aspect: float) -> None:
    """It fits, and along one side of the window hardly more than it."""
    view = Camera.facing([0, -1, 0], [0, 0, 0], width=400, height=300, fov=80)
    flat = np.random.default_rng(0).uniform(-1, 1, (4000, 2)) * size
    points = np.insert(flat, 1, 0.0, axis=1)
    tall = half(choose_fields(view, subject=points), aspect)
    used = max(size[0] / (tall * aspect), size[1] / tall)
    assert 0.85 < used < 1


@pytest.mark.parametrize("aspect", ASPECTS)
def test_all_of_a_view_fits_into_the_window(aspect: float) -> None:
    view = Camera.facing(
        [0, -1, 0], [0, 0, 0], width=400, height=300, fov=2 * np.degrees(np.arctan(0.4))
    )
    tall = half(choose_fields(view), aspect)
    assert max(0.4 / (tall * aspect), 0.3 / tall) == pytest.approx(1)


@pytest.mark.parametrize("aspect", ASPECTS)
def test_what_no_photo_saw_is_outside(aspect: float) -> None:
    views, scene = photos(), wall(-4, 4, -4, 4)
    tall = half(choose_fields(views[2], scene=scene, cameras=views), aspect)
    whole = half(choose_fields(views[2]), aspect)
    seen = min(1, 0.42 / (tall * aspect)) * min(1, 0.8 / tall)
    assert seen > 0.9
    assert tall <= whole * 1.001
    assert max(tall * aspect / 0.4, tall / 0.8) > 0.9  # and not much nearer than that needs


@pytest.mark.parametrize("aspect", ASPECTS[1:])  # a phone shows more above and below than any photo
def test_what_other_photos_saw_may_be_shown(aspect: float) -> None:
    views = photos(0.1 * np.arange(-40, 41))
    fields = choose_fields(views[40], scene=wall(-4, 4), cameras=views)
    assert half(fields, aspect) == pytest.approx(half(choose_fields(views[40]), aspect), rel=0.01)


@pytest.mark.parametrize("aspect", ASPECTS)
def test_photos_of_an_object_before_nothing_keep_what_is_empty(aspect: float) -> None:
    views, scene = photos(), wall(-0.2, 0.2, -0.4, 0.4)
    fields = choose_fields(views[2], scene=scene, cameras=views)
    assert half(fields, aspect) == pytest.approx(half(choose_fields(views[2]), aspect), rel=0.01)
