"""Distillation from photos without a scene."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import g2ard
from g2ard.errors import InputError
from g2ard.io import Source
from g2ard.io.images import write_png
from g2ard.io.photos import load_photo
from g2ard.io.types import Points
from g2ard.jobs.budget import Budget
from g2ard.jobs.distill import prepare
from g2ard.jobs.distill_options import DistillOptions
from g2ard.jobs.start_points import choose_count, top_up_points
from g2ard.progress import silent, unsaid
from g2ard.stages.photo_points.hull import visual_hull
from g2ard.stages.photo_points.rays import distinct, points_along_rays
from g2ard.stages.recover.config import TUNED
from helpers.commands import CommandLine, refused, succeeds
from helpers.photos import photos_of, rgba_photos_of


@pytest.mark.parametrize("points", [False, True])
def test_photos_alone_are_enough(points: bool, command_line: CommandLine, tmp_path: Path) -> None:
    photos_of(tmp_path / "photos", points)
    ask = ("distill", "--views", "photos", "-o", "run", "--json", "-")
    out, error = succeeds(command_line, tmp_path, *ask, "-n", 500, "--steps", 150, "-v")
    found = json.loads(out)
    assert (found["output_count"], found["against"]) == (500, "photos")
    assert found["scores"]["recovered"]["psnr"] > max(17, found["scores"]["simplified"]["psnr"] + 1)
    said = (
        "starting from 1,200 sparse points\n"
        if points
        else "starting from 500 points along camera rays\n"
    )
    assert said in error
    assert "regularisers: none;" in error
    ours = g2ard.distill(None, views=tmp_path / "photos", count=500, steps=150).splats
    g2ard.save(tmp_path / "ours.ply", ours)
    assert (tmp_path / "ours.ply").read_bytes() == (tmp_path / "run" / "scene.ply").read_bytes()
    status, _, error = command_line(*ask, "-r", 4, "--steps", 5, "-w", cwd=tmp_path)
    assert status == (0 if points else 1)
    assert points or "give --count COUNT" in error
    assert "give a SCENE, or photos" in refused(
        command_line, tmp_path, "distill", "-n", 500, "-o", "run"
    )


def test_sparse_points_given_as_a_cloud_are_known_and_other_clouds_are_surfaces(
    command_line: CommandLine, tmp_path: Path
) -> None:
    photos_of(tmp_path / "photos", points=True)
    (tmp_path / "scan.ply").write_bytes((tmp_path / "photos" / "sparse.ply").read_bytes())
    ask = ("--views", "photos", "-n", 900, "--steps", 3)
    sparse = succeeds(
        command_line, tmp_path, "distill", "photos/sparse.ply", *ask, "-o", "run", "-v"
    ).err
    assert "regularisers: none;" in sparse
    assert "sparse.ply has" not in sparse, sparse
    scan = succeeds(command_line, tmp_path, "distill", "scan.ply", *ask, "-o", "scan", "-v").err
    assert "regularisers: lift" in scan
    assert "MB, scan.ply has 0." in scan, scan


def test_points_along_rays_lie_on_the_surface(tmp_path: Path) -> None:
    photos_of(tmp_path / "photos")
    cameras = g2ard.load_views(tmp_path / "photos")
    found = points_along_rays(cameras, 600)
    assert found.positions.shape == (600, 3)
    bright = found.colors.max(1) > 0.1  # the background is black everywhere, and everywhere agrees
    away = np.abs(np.linalg.norm(found.positions[bright], axis=1) - 1)
    assert np.median(away) < 0.15
    np.testing.assert_array_equal(found.positions, points_along_rays(cameras, 600).positions)


@pytest.mark.parametrize("repeated", [0, 300])
def test_points_of_photos_are_at_as_many_places_as_asked(repeated: int, tmp_path: Path) -> None:
    photos_of(tmp_path / "photos", points=bool(repeated), count=12)
    cameras = g2ard.load_views(tmp_path / "photos")
    points = None
    if repeated:
        spots = np.random.default_rng(1).normal(size=(500, 3))
        spots = np.concatenate([spots, spots[:repeated]])
        points = distinct(Points(spots, np.full((len(spots), 3), 0.5, np.float32)))
    found = top_up_points(
        points,
        cameras,
        1_000,  # of 36,864 pixels, so that some are drawn twice
        background=(0.0, 0.0, 0.0),
        seed=0,
        progress=silent,
        say=unsaid,
    )
    assert len(found) == len(g2ard.lift(found.positions, found.colors)) == 1_000


def test_alpha_carves_the_start(tmp_path: Path) -> None:
    cameras = rgba_photos_of(tmp_path, distance=5)
    found = g2ard.load_views(tmp_path, split="train")
    for background in ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)):
        points = points_along_rays(found, 600, background=background)
        away = np.linalg.norm(points.positions, axis=1)
        assert np.quantile(np.abs(away - 1), 0.9) < 0.25, background
    outlines = [np.ones((48, 64), bool)] * len(cameras)
    assert visual_hull(cameras, outlines, np.zeros(3)) is None  # nothing is empty


def test_a_hull_encloses_the_object_closely(tmp_path: Path) -> None:
    cameras = rgba_photos_of(tmp_path, distance=5)
    found = g2ard.load_views(tmp_path)
    outlines = [load_photo(found, view, None)[0][..., 3] > 0.5 for view in range(24)]
    hull = visual_hull(found, outlines, np.zeros(3))
    assert hull is not None
    directions = np.random.default_rng(0).normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    assert hull.holds(0.9 * directions).all()
    assert hull.holds(1.6 * directions).mean() < 0.1
    assert not hull.holds(cameras.positions).any()


def test_more_gaussians_of_photos_take_more_steps(
    tmp_path: Path, command_line: CommandLine
) -> None:
    photos_of(tmp_path / "photos")
    ask = (
        "distill",
        "--views",
        "photos",
        "--dry-run",
        "-o",
        "run",
        "--json",
        "-",
        "--schedule",
        "fast",
    )

    def steps(*budget: object) -> int:
        return int(json.loads(succeeds(command_line, tmp_path, *ask, *budget).out)["steps"])

    assert [steps("-n", count) for count in (500, 2_000)] == [300, 379]
    assert steps("-n", 600, "--steps", 50) == 50


@pytest.mark.parametrize(
    ("scene", "settings", "finest"),
    [
        (None, {}, 0.0),
        (None, {"recover.schedule": "fast"}, 0.0),
        ("photos/sparse.ply", {}, 0.0),
        ("scan.ply", {}, 1.0),
        (None, {"recover.schedule.finest": 0.5}, 0.5),
        (None, {"recover.schedule": replace(TUNED, finest=2.0)}, 2.0),
    ],
)
def test_points_of_photos_move_however_small_they_are(
    scene: str | None, settings: dict[str, Any], finest: float, tmp_path: Path
) -> None:
    photos_of(tmp_path / "photos", points=True)
    (tmp_path / "scan.ply").write_bytes((tmp_path / "photos" / "sparse.ply").read_bytes())
    options = DistillOptions(views=tmp_path / "photos", settings={"recover.steps": 3, **settings})
    job = prepare(scene and Source(tmp_path / scene), Budget(500), options)
    assert job.config.recover.schedule.finest == finest
    assert job.config.recover.from_points == (finest != 1.0)


def test_points_that_no_second_photo_supports_are_dropped(tmp_path: Path) -> None:
    photos_of(tmp_path / "photos", count=48)
    cameras = g2ard.load_views(tmp_path / "photos")
    noise = np.random.default_rng(0)
    for path in cameras.image_paths[::4]:
        assert path is not None
        # a quarter shows nothing of it
        write_png(path, noise.uniform(0.2, 1, (48, 64, 3)), overwrite=True)
    found = points_along_rays(cameras, 600)
    away = np.abs(np.linalg.norm(found.positions, axis=1) - 1)
    assert np.mean(away < 0.25) > 0.8


def test_rays_may_give_no_point(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("g2ard.stages.photo_points.rays._RAYS", 70)  # or it tries 131,072
    photos_of(tmp_path / "photos")
    cameras = g2ard.load_views(tmp_path / "photos").take([0, 8, 16])
    # no two alike, until the limits are relaxed
    for i, path in enumerate(filter(None, cameras.image_paths)):
        write_png(path, np.full((48, 64, 3), 0.2 + 0.3 * i), overwrite=True)
    assert len(points_along_rays(cameras, 70)) == 70
    write_png(tmp_path / "mask.png", np.zeros((48, 64)))
    with pytest.raises(InputError, match="found 0 points that three views see"):
        points_along_rays(replace(cameras, mask_paths=(tmp_path / "mask.png",) * 3), 70)


def _of_photos(folder: Path, *ask: object, command_line: CommandLine) -> tuple[int, str]:
    words = (
        "distill",
        "--views",
        "photos",
        "--steps",
        2,
        "--no-page",
        "-o",
        "run",
        "-w",
        "--json",
        "-",
    )
    out, error = succeeds(command_line, folder, *words, *ask)
    return json.loads(out)["output_count"], error


def test_photos_alone_need_no_count(command_line: CommandLine, tmp_path: Path) -> None:
    """It is one Gaussian per 100 pixels of the photos trained on, to two digits."""
    photos_of(tmp_path / "photos")
    train = g2ard.load_views(tmp_path / "photos", split="train")
    for size in (None, 24):
        given = () if size is None else ("--size", size)
        count, error = _of_photos(tmp_path, *given, command_line=command_line)
        cameras = train.resized(size)
        pixels = int((cameras.widths * cameras.heights).sum())
        assert count == int(float(f"{pixels / 100:.2g}"))
        assert f"{count:,} Gaussians, one per " in error
        assert f" pixels of {len(train)} photos; a count changes it\n" in error
        assert (
            g2ard.distill(None, views=tmp_path / "photos", steps=2, size=size)
            .report.rounds[-1]
            .count
            == count
        )
    assert "has no budget" not in refused(
        command_line, tmp_path, "distill", "photos", "-o", "other"
    )


def test_transparent_pixels_need_no_gaussians(command_line: CommandLine, tmp_path: Path) -> None:
    rgba_photos_of(tmp_path / "photos")
    train = g2ard.load_views(tmp_path / "photos", split="train")
    shares = [(load_photo(train, view, None)[0][..., 3] > 0.5).mean() for view in range(len(train))]
    count, _ = _of_photos(tmp_path, command_line=command_line)
    pixels = int((train.widths * train.heights).sum())
    assert count == pytest.approx(np.mean(shares) * pixels / 100, rel=0.06)
    assert np.mean(shares) < 0.7


def test_no_count_is_above_its_limit_but_for_sparse_points(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    photos_of(tmp_path / "photos")
    monkeypatch.setattr("g2ard.jobs.start_points._MOST_USUAL_COUNT", 50)
    train = g2ard.load_views(tmp_path / "photos", split="train")
    for sparse, expected in ((0, 50), (70, 70)):
        assert choose_count(train, None, sparse, unsaid) == expected
