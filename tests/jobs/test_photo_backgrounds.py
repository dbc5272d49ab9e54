"""Photos with alpha, their background, and where photos and test views are found."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import g2ard
from g2ard.io import read_view_set, write_splats
from g2ard.io.describe import describe
from g2ard.io.images import write_png
from g2ard.io.photos import measure_traits
from g2ard.io.types import ViewFiles
from g2ard.rendering.targets import Photos
from helpers.commands import CommandLine, refused, succeeds
from helpers.photos import BALL, cloud_of, photos_of, rgba_photos_of
from helpers.scenes import around
from helpers.trainer_files import inria

WHITE = (1.0, 1.0, 1.0)


@pytest.fixture
def rgba(tmp_path: Path) -> Path:
    rgba_photos_of(tmp_path / "ball")
    write_splats(tmp_path / "ball.ply", BALL)
    return tmp_path


def scored(command_line: CommandLine, folder: Path, *options: object) -> tuple[float, str]:
    ask = ("evaluate", "ball.ply", "--json", "-", "--views")
    out, error = succeeds(command_line, folder, *ask, *options)
    return json.loads(out)["scenes"][0]["psnr"], error


def test_alpha_is_composited_over_the_background(command_line: CommandLine, rgba: Path) -> None:
    for background in ("white", "0.2,0.9,0.4", "black"):
        psnr, error = scored(command_line, rgba, "ball", "--background", background)
        assert psnr > 40, background
        assert "note:" not in error
    psnr, error = scored(command_line, rgba, "ball")
    assert psnr > 40
    assert "8 photos with alpha, composited over black, the default; most" in error


def test_a_run_is_drawn_on_its_own_background(command_line: CommandLine, rgba: Path) -> None:
    made = (
        "distill",
        "--views",
        "ball",
        "-n",
        300,
        "--steps",
        5,
        "--background",
        "white",
        "--no-page",
    )
    succeeds(command_line, rgba, *made, "-o", "run")
    told = succeeds(command_line, rgba, "evaluate", "run", "--views", "ball")
    assert "background: white, as run was made with" in told.err
    assert (
        told.out
        == succeeds(
            command_line, rgba, "evaluate", "run", "--views", "ball", "--background", "white"
        ).out
    )
    for ask in (
        ("render", "run", "--orbit", 1, "-o", "pictures"),
        ("compare", "run", "ball.ply", "-k", 1),
        ("view", "run", "-o", "page.html"),
        ("adapt", "run", "--views", "ball", "--steps", 2, "-o", "adapted.ply"),
        ("recover", "run", "--views", "ball", "--steps", 2, "-o", "recovered.ply"),
        ("register", "run", "--images", "ball", "-o", "poses.json", "--matcher", "direct"),
    ):
        _, _, error = command_line(*ask, cwd=rgba)
        assert "background: white, as run was made with" in error, error
    _, _, error = command_line("register", "ball.ply", *ask[2:], cwd=rgba)
    assert "24 photos with alpha, composited over black, the default; most" in error


@pytest.mark.parametrize(
    ("report", "said"),
    [
        ({"settings": 3}, "property 'settings' is 3, expected an object"),
        (
            {"settings": {"recover.background": "white"}},
            "property 'settings.recover.background' is the string 'white'",
        ),
        (
            {"settings": {"recover.background": [0, 2, 0]}},
            "property 'settings.recover.background[1]' is 2, expected a number",
        ),
    ],
)
def test_a_damaged_report_of_a_run_is_named(
    command_line: CommandLine, rgba: Path, report: dict[str, Any], said: str
) -> None:
    (rgba / "run").mkdir()
    shutil.copy(rgba / "ball.ply", rgba / "run" / "scene.ply")
    (rgba / "run" / "report.json").write_text(json.dumps(report), encoding="utf-8")
    error = refused(command_line, rgba, "evaluate", "run", "--views", "ball", status=1)
    assert "report.json" in error
    assert said in error


def test_alpha_masks_if_requested(command_line: CommandLine, rgba: Path) -> None:
    cameras = read_view_set(ViewFiles(rgba / "ball", alpha="mask"), split="test").cameras
    targets = Photos(cameras, background=WHITE)
    mask = targets.mask(0)
    assert mask is not None
    assert 0.1 < mask.mean() < 0.9
    assert not targets[0][~mask].any()
    messy = np.asarray(Image.open(cameras.image_paths[0])).copy()
    messy[messy[..., 3] < 128, :3] = 77
    Image.fromarray(messy).save(cameras.image_paths[0])
    psnr, _ = scored(command_line, rgba, "ball", "--alpha", "mask", "--background", "white")
    assert psnr > 40


def test_test_views_are_found_beside_the_training_views(rgba: Path) -> None:
    folder = rgba / "ball"
    found = read_view_set(folder / "transforms_train.json")
    assert (found.splits.count("train"), found.splits.count("test")) == (16, 8)
    assert "transforms_test.json beside it has the test views" in [
        str(note) for note in found.notes
    ]
    (folder / "transforms_test.json").unlink()
    alone = read_view_set(folder / "transforms_train.json")
    assert (len(alone.cameras), alone.splits) == (16, ())
    assert "every 8th of its views is held out" in str(alone.notes[0])


def test_info_describes_the_photos(rgba: Path, tmp_path: Path) -> None:
    def notes(folder: Path) -> dict[str, str]:
        return {note["code"]: note["text"] for note in describe(folder)["notes"]}

    assert notes(rgba / "ball")["alpha"].startswith("24 photos of 24 have alpha")
    photos_of(tmp_path / "plain")
    assert "constant border colour: black" in notes(tmp_path / "plain")["constant_border"]
    first, second = (tmp_path / "plain" / "images" / f"00{i}.png" for i in (0, 1))
    write_png(first, np.full((24, 32, 3), 0.5), overwrite=True)
    assert "23 photos of 64×48 pixels, 1 of other sizes" in notes(tmp_path / "plain")["mixed_sizes"]
    opaque = np.concatenate(
        [np.asarray(Image.open(second)), np.full((48, 64, 1), 255, np.uint8)], 2
    )
    Image.fromarray(opaque).save(second)
    assert measure_traits([second]).alpha == 0  # an alpha channel that hides nothing


def test_distill_proposes_the_border_colour(command_line: CommandLine, tmp_path: Path) -> None:
    photos_of(tmp_path / "photos", points=True)
    ask = ("distill", "--views", "photos", "-n", 200, "--steps", 2, "--no-page", "-o")
    assert "border" not in succeeds(command_line, tmp_path, *ask, "black").err
    error = succeeds(command_line, tmp_path, *ask, "white", "--background", "white").err
    assert "a constant border of black, but the background is white" in error
    assert "give --background black" in error


def test_missing_photos_are_named_with_the_option_for_their_folder(
    command_line: CommandLine, rgba: Path
) -> None:
    (rgba / "empty").mkdir()
    ask = ("evaluate", "ball.ply", "--views", "ball", "--images", "empty")
    error = refused(command_line, rgba, *ask, status=1)
    assert "neither w and h nor a photo empty" in error
    assert "--images DIR names the folder" in error


def model(folder: Path, images: str = "images", scale: float = 1.0) -> dict[str, Any]:
    """Write INRIA's cameras.json, photos in a folder, and points; return the cameras' intrinsics."""
    views = around(16)
    (folder / images).mkdir(parents=True)
    for i, view in enumerate(views):
        image = g2ard.render(BALL, view).image
        write_png(folder / images / f"photo_{i}.png", image)
    focal = {"fx": views.Ks[0, 0, 0] * scale, "fy": views.Ks[0, 1, 1] * scale}
    lens = {"width": round(64 * scale), "height": round(48 * scale), **focal}
    inria(folder / "cameras.json", list(views.viewmats))
    listed = json.loads((folder / "cameras.json").read_text())
    for i, camera in enumerate(listed):
        camera |= {**lens, "img_name": f"photo_{i}"}
    (folder / "cameras.json").write_text(json.dumps(listed))
    return lens


def test_images_beside_cameras_json_are_found_and_fitted(tmp_path: Path) -> None:
    model(tmp_path / "toy", scale=4)
    found = read_view_set(tmp_path / "toy" / "cameras.json").cameras
    assert all(found.image_paths)
    assert (found.widths[0], found.heights[0]) == (64, 48)
    np.testing.assert_allclose(found.Ks[0], around(16).Ks[0])
    shutil.rmtree(tmp_path / "toy" / "images")
    assert not any(read_view_set(tmp_path / "toy").cameras.image_paths)


def test_a_cloud_is_topped_up_from_photos_elsewhere(
    command_line: CommandLine, tmp_path: Path
) -> None:
    model(tmp_path / "toy", images="elsewhere")
    cloud_of(tmp_path / "toy" / "input.ply", BALL.take(np.arange(300)))
    ask = (
        "distill",
        "toy/input.ply",
        "--views",
        "toy",
        "-n",
        500,
        "--steps",
        2,
        "--no-page",
        "--json",
        "-",
    )
    found = succeeds(command_line, tmp_path, *ask, "-o", "found").err
    assert "photos are in toy/elsewhere, not in toy/images" in found
    out, error = succeeds(command_line, tmp_path, *ask, "--images", "toy/elsewhere", "-o", "run")
    assert json.loads(out)["output_count"] == 500
    assert "starting from 300 sparse points and 200 points along camera rays" in error
    _, error = succeeds(
        command_line, tmp_path, ask[0], *ask[2:], "--images", "toy/elsewhere", "-o", "alone"
    )
    assert "starting from 300 sparse points" in error  # input.ply belongs to the model
    assert "--images goes with --views" in refused(
        command_line,
        tmp_path,
        "render",
        "toy/input.ply",
        "--images",
        "toy/elsewhere",
        "-o",
        "renders",
    )
