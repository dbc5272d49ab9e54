"""Evaluators as other people's: INRIA's conventions, 8-bit renders, unscaled LPIPS, mixed targets."""

import json
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from g2ard import io
from g2ard.errors import InputError
from g2ard.io.images import as_saved, write_png
from g2ard.rendering.metrics import METRICS, Lpips, psnr
from g2ard.rendering.renderer import RasterSettings, render
from g2ard.rendering.targets import PhotosOrRenders, TeacherRenders
from g2ard.stages.evaluate import Scores, evaluate
from helpers.commands import CommandLine, refused, succeeds
from helpers.lpips_weights import weights
from helpers.photos import rgba_photos_of
from helpers.scenes import around, checkered_ball
from helpers.studies import pictured

INRIA = RasterSettings(convention="inria")


def test_inrias_convention_reaches_renders_and_targets() -> None:
    # nearer than 0.2 to some of the discs
    ball, views = checkered_ball(300), around(2, distance=1.15)
    own, theirs = (
        evaluate(ball, TeacherRenders(ball, views, settings=s), settings=s).psnr
        for s in (None, INRIA)
    )
    assert own == theirs == 100  # the same conventions on both sides
    mixed = evaluate(ball, TeacherRenders(ball, views), settings=INRIA)
    assert mixed.psnr < 60
    expected = psnr(
        np.clip(render(ball, views[0], settings=INRIA).image, 0, 1),
        np.clip(render(ball, views[0]).image, 0, 1),
    )
    assert mixed.views[0].psnr == pytest.approx(expected, abs=1e-4)  # targets have 16 bits


def test_eight_bit_rounds_both_sides_as_png_does(tmp_path: Path) -> None:
    ball, views = checkered_ball(300), around(2)
    small = ball.take(slice(150))
    found = evaluate(small, TeacherRenders(ball, views), eight_bit=True)
    images = []
    for scene in (small, ball):
        write_png(tmp_path / "x.png", render(scene, views[0]).image, overwrite=True)
        with Image.open(tmp_path / "x.png") as image:
            images.append(np.asarray(image, np.float32) / 255)
    assert found.views[0].psnr == pytest.approx(psnr(*images), abs=1e-4)
    assert found.views[0].psnr != evaluate(small, TeacherRenders(ball, views)).views[0].psnr
    assert as_saved(np.array([0.4999, 1.2])).tolist() == [np.float32(127 / 255), 1.0]


def test_unscaled_lpips_feeds_images_as_they_are() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.random((70, 66, 3), np.float32), rng.random((70, 66, 3), np.float32)
    scaled, plain = (Lpips("alex", *weights(), scaled=scaled) for scaled in (True, False))
    assert plain(a, b) == pytest.approx(scaled((a + 1) / 2, (b + 1) / 2), rel=1e-4)
    assert abs(plain(a, b) - scaled(a, b)) > 1e-3


def test_each_view_has_its_photo_or_the_teachers_render(tmp_path: Path) -> None:
    ball, views = checkered_ball(300), pictured(tmp_path)
    targets = PhotosOrRenders(views, ball)
    rendered = TeacherRenders(ball, views)
    for view in range(4):
        expected = np.full((48, 64, 3), 64 / 255, np.float32) if view in (0, 2) else rendered[view]
        assert np.array_equal(targets[view], expected)
    found = evaluate(ball, targets)
    assert [v.against for v in found.views] == ["photo", "teacher", "photo", "teacher"]
    assert found.views[1].psnr == 100 > found.views[0].psnr
    only = PhotosOrRenders(pictured(tmp_path, ()), ball)
    assert np.array_equal(only[3], rendered[3])
    with pytest.raises(InputError, match="exposure of view_000"):
        PhotosOrRenders(views, ball, exposures={"view_000": np.zeros((3, 4))})


def test_every_metric_has_a_field_and_a_column(command_line: CommandLine, folder: Path) -> None:
    assert [field.name for field in fields(Scores)] == [*METRICS]
    of = ("--views", "views.json", "--teacher", "ball.ply", "--size", 24)
    done = succeeds(command_line, folder, "evaluate", "ball.ply", *of, "--json", "found.json")
    (scene,) = json.loads((folder / "found.json").read_text())["scenes"]
    for name, metric in METRICS.items():
        assert {name} <= {*scene} & {*scene["views"][0]}
        assert metric.heading in done.out


def test_reports_state_file_sizes(command_line: CommandLine, folder: Path) -> None:
    assert command_line("convert", "ball.ply", "ball.sog", cwd=folder)[0] == 0
    assert command_line("convert", "ball.ply", "folder/meta.json", cwd=folder)[0] == 0
    ask = (
        "evaluate",
        "ball.ply",
        "ball.sog",
        "folder",
        "--teacher",
        "ball.ply",
        "--views",
        "views.json",
    )
    out, error = succeeds(command_line, folder, *ask, "--json", "-")
    assert " MB " in error
    whole, packed, chunks = (row["file_bytes"] for row in json.loads(out)["scenes"])
    assert (whole, packed) == tuple(
        (folder / name).stat().st_size for name in ("ball.ply", "ball.sog")
    )
    assert chunks == sum(file.stat().st_size for file in (folder / "folder").iterdir())
    assert f"{whole / 1e6:.2f}" != f"{packed / 1e6:.2f}"
    assert f"{packed / 1e6:.2f}" in error


def test_unscaled_images_need_a_network(folder: Path, command_line: CommandLine) -> None:
    ask = ("evaluate", "ball.ply", "--views", "views.json", "--lpips-input", "unscaled")
    assert "--lpips-input" in refused(command_line, folder, *ask)


@pytest.mark.parametrize("photos", [True, False])
def test_a_run_is_scored_as_it_was_made(
    photos: bool, tmp_path: Path, command_line: CommandLine
) -> None:
    ball = checkered_ball(400)
    io.write_splats(tmp_path / "ball.ply", ball)
    rgba_photos_of(tmp_path / "photos")
    of = ("--views", "photos", "-n", 80) if photos else ("ball.ply", "-r", 5)
    made = ("distill", *of, "--steps", 4, "--size", 40, "--background", "0.2,0.3,0.4", "-o", "run")
    succeeds(command_line, tmp_path, *made)
    (tmp_path / "elsewhere").mkdir()
    there = tmp_path / "elsewhere" if photos else tmp_path
    out = succeeds(command_line, there, "evaluate", tmp_path / "run", "--json", "-").out
    told = json.loads((tmp_path / "run" / "report.json").read_text())["scores"]["recovered"]
    found = json.loads(out)
    assert found["against"] == ("photos" if photos else "teacher")
    assert [view["name"] for view in found["scenes"][0]["views"]] == [
        view["name"] for view in told["views"]
    ]
    assert found["scenes"][0]["psnr"] == pytest.approx(told["psnr"], abs=1e-6)
    if not photos:
        (tmp_path / "ball.ply").unlink()
        assert "ball.ply" in refused(command_line, tmp_path, "evaluate", "run", status=1)
