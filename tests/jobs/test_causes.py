"""Likely causes of a poor result: each is named where it was put, and a fine result names none."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from g2ard.io.images import write_png
from g2ard.jobs.causes import likely_causes
from g2ard.rendering.renderer import Renderer
from g2ard.rendering.targets import Photos
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats
from g2ard.stages.recover.report import Gain, RecoverReport, Regularized
from helpers.scenes import around, checkered_ball

BALL = checkered_ball(800)
VIEWS = around(12)
BLACK = (0.0, 0.0, 0.0)

Change = Callable[[np.ndarray, int], np.ndarray]


def photos(folder: Path, change: Change = lambda image, view: image, of: Splats = BALL) -> Photos:
    """Photos of the ball in every third view, each changed by its index."""
    cameras = VIEWS.take(range(0, 12, 3))
    renderer = Renderer(of)
    for view, name in enumerate(cameras.names):
        write_png(folder / f"{name}.png", np.clip(change(renderer.image(cameras[view]), view), 0, 1))
    return Photos(replace(cameras, image_paths=tuple(folder / f"{name}.png" for name in cameras.names)))


def report(trained: float, steps: int = 900, loss: list[float] | None = None) -> RecoverReport:
    rest = [(), Regularized(1, 0.0, 100), (), None, 1.0, False, None, {}]
    gain = Gain(10.0, trained)
    return RecoverReport(steps, 1.0, loss or [0.1] * 100, gain, 1.0, None, 0.0, (), 0.0, 0.0, (), *rest[1:])


def causes(
    held_out: Photos,
    splats: Splats = BALL,
    *,
    scored: float = 15.0,
    trained: float = 16.0,
    views: Cameras = VIEWS,
    **of_report: object,
) -> list[str]:
    return likely_causes(splats, held_out, views, report(trained, **of_report), scored, BLACK)


def test_a_fine_result_names_no_cause(tmp_path: Path) -> None:
    assert causes(photos(tmp_path), scored=21.0, trained=23.9) == []


def test_a_poor_result_without_a_usual_cause_says_so(tmp_path: Path) -> None:
    fine = replace(BALL, scales=BALL.scales / 4)
    (line,) = causes(photos(tmp_path, of=fine), fine)
    assert line.startswith("the result scores only 15.0 dB in held-out views, and no usual cause")


@pytest.mark.parametrize("times", [1, 9])  # as large as 9 times, Gaussians fill the background
def test_a_white_background_is_named(tmp_path: Path, times: int) -> None:
    alpha = [Renderer(BALL).render(camera).alpha for camera in VIEWS.take(range(0, 12, 3))]
    held_out = photos(tmp_path, lambda image, view: image + 1 - alpha[view][..., None])
    lines = causes(held_out, replace(BALL, scales=BALL.scales * times))
    assert lines[0] == "the result scores only 15.0 dB in held-out views; likely causes:"
    assert lines[1] == "  - background: the photos show white around the scene, not black (--background)"


def test_photos_of_another_place_have_no_background(tmp_path: Path) -> None:
    noise = np.random.default_rng(0)
    lines = causes(photos(tmp_path, lambda image, view: noise.uniform(size=image.shape)))
    assert lines[1].startswith("  - poses: renders look unlike the photos (correlation ")


def test_photos_of_other_poses_are_named(tmp_path: Path) -> None:
    shifted = causes(photos(tmp_path, lambda image, view: np.roll(image, image.shape[1] // 2, axis=1)))
    assert shifted[1].startswith("  - poses: renders look unlike the photos (correlation -")


def test_changing_exposure_is_named(tmp_path: Path) -> None:
    lines = causes(photos(tmp_path, lambda image, view: image * (0.4 + 0.1 * view)))
    assert lines[1].startswith("  - exposure: fitting each photo's brightness would gain ")


@pytest.mark.parametrize(
    ("changed", "cause"),
    [
        ({"steps": 20}, "too few steps: 20 for 12 views"),
        ({"loss": [1 / (1 + step) for step in range(100)]}, "too few steps: the loss still fell by 22%"),
        ({"splats": replace(BALL, scales=BALL.scales * 2)}, "too few Gaussians: the standard deviation"),
    ],
)
def test_steps_and_gaussians_are_named(tmp_path: Path, changed: dict, cause: str) -> None:
    assert any(cause in line for line in causes(photos(tmp_path), **changed))


def test_a_gap_between_training_and_held_out_views_is_explained(tmp_path: Path) -> None:
    held_out = photos(tmp_path)
    lines = causes(held_out, scored=25.0, trained=30.0)
    assert lines == [
        "held-out views score 5.0 dB less than training views; likely causes:",
        "  - too few views for 800 Gaussians: 12 for training; give more views, or lower -n",
    ]
    near = replace(VIEWS, viewmats=np.repeat(VIEWS.viewmats[:1], 12, axis=0))
    near.viewmats[:, 0, 3] += np.linspace(0, 0.1, 12)
    apart = causes(held_out, scored=25.0, trained=30.0, views=near)
    assert "times as far from training cameras as these from each other" in apart[1]
