"""Photos that belong to a scene, and photos of others, for all kinds of scenes and backgrounds."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import g2ard
from g2ard.config.choices import Colour
from g2ard.errors import InputError
from g2ard.io.types import Points
from g2ard.jobs import view_checks
from g2ard.jobs.budget import Budget
from g2ard.jobs.distill import prepare
from g2ard.jobs.distill_options import DistillOptions
from g2ard.jobs.view_checks import check_photos
from g2ard.scene.splats import SH_C0
from helpers.photos import photographed
from helpers.scenes import around, checkered_ball

BALL = checkered_ball(1200)
VIEWS = around(12, (48, 36))


STRIPED = replace(BALL, sh0=np.sin(6 * BALL.means + [0, 1, 2])[:, None].astype(np.float32))


def _lifted(scene: g2ard.Splats) -> g2ard.Splats:
    colors = np.clip(0.5 + SH_C0 * scene.sh0[:, 0], 0, 1)
    points = Points(scene.means.astype(np.float64), colors.astype(np.float32))
    return g2ard.lift(points.positions, points.colors)


KINDS = {
    "trained": lambda scene: scene,
    "lifted": _lifted,
    "small": lambda scene: g2ard.simplify(scene, ratio=4).splats,
}


@pytest.mark.parametrize("background", [(0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0.6, 0.8, 1.0)])
@pytest.mark.parametrize("kind", KINDS)
def test_only_photos_of_the_scene_are_accepted(
    kind: str, background: Colour, tmp_path: Path
) -> None:
    scene = KINDS[kind](BALL)
    darker = photographed(tmp_path, BALL, VIEWS, gain=0.6, bias=0.1)
    said: list[str] = []
    check_photos(scene, darker, background, said.append)
    assert said == []
    paths = darker.image_paths
    shifted = replace(darker, image_paths=(*paths[5:], *paths[:5]))
    (tmp_path / "other").mkdir()
    other = photographed(tmp_path / "other", STRIPED, VIEWS)
    far = replace(around(12, (48, 36), distance=40.0), image_paths=paths)
    for wrong, what in (
        (shifted, "correlation"),
        (other, "correlation"),
        (far, "covers less than 5%"),
    ):
        with pytest.raises(InputError, match="the photos do not show the scene") as refused:
            check_photos(scene, wrong, background, said.append)
        assert what in str(refused.value)
        said.clear()
        check_photos(scene, wrong, background, said.append, insisted=True)
        assert "does not look like the photos" in said[0]


def test_few_gaussians_are_too_little_to_reject_photos(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    photos, said = photographed(tmp_path, BALL, VIEWS), []
    monkeypatch.setattr(view_checks, "_compare_photos", lambda *_: ([0.1] * 12, [0.65] * 12))
    check_photos(BALL.take(range(999)), photos, (0, 0, 0), said.append)
    assert "does not look like the photos (correlation 0.10)" in said[0]
    with pytest.raises(InputError, match="the photos do not show the scene"):
        check_photos(BALL, photos, (0, 0, 0), said.append)


@pytest.mark.parametrize("kind", ["renders", "photos", "both"])
def test_a_job_uses_photos_over_renders_where_it_has_both(kind: str, tmp_path: Path) -> None:
    pictured = photographed(tmp_path, BALL, VIEWS)
    views = {
        "renders": VIEWS,
        "photos": pictured,
        "both": replace(pictured, image_paths=(*pictured.image_paths[:6], *[None] * 6)),
    }[kind]
    job = prepare(BALL, Budget(300), DistillOptions(views=views))
    assert job.teaching.photos == (kind != "renders")
    assert (not job.renders) == (kind == "photos")
