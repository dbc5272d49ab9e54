"""Errors for inputs that are missing, damaged or of the wrong kind."""

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import g2ard
from g2ard.errors import InputError
from helpers.commands import CommandLine, refused, succeeds
from helpers.photos import cloud_of, photos_of
from helpers.scenes import checkered_ball


def test_a_wrong_kind_of_input_names_the_command_that_takes_it(
    command_line: CommandLine, folder: Path
) -> None:
    photos_of(folder / "photos", points=True)
    for ask, status, words in (
        (("distill", "photos", "-n", 100, "-o", "x"), 2, "photos holds views, not a scene"),
        (("clean", "photos/sparse.ply", "-o", "x.ply"), 1, "`g2ard lift` turns it into a scene"),
    ):
        assert words in refused(command_line, folder, *ask, status=status)


def test_simplify_lifts_a_point_cloud_as_lift_does(command_line: CommandLine, folder: Path) -> None:
    photos_of(folder / "photos", points=True)
    cloud = "photos/sparse.ply"
    succeeds(command_line, folder, "lift", cloud, "-o", "lifted.ply")
    succeeds(
        command_line, folder, "simplify", "lifted.ply", "-r", 4, "--method", "fast", "-o", "two.ply"
    )
    ask = ("simplify", cloud, "-r", 4, "--method", "fast", "-o", "one.ply", "--memory", "8GB")
    told = succeeds(command_line, folder, *ask).err
    points = len(g2ard.load_points(folder / cloud))
    assert re.search(rf"{cloud}: {points:,} points lifted to [\d,]+ discs", told)
    one, two = (g2ard.load(folder / name) for name in ("one.ply", "two.ply"))
    assert len(one) == len(two)
    np.testing.assert_allclose(np.sort(one.means, axis=0), np.sort(two.means, axis=0), atol=1e-3)
    ours = g2ard.simplify(folder / cloud, ratio=4, method="fast").splats
    np.testing.assert_allclose(ours.means, one.means, atol=1e-6)


def test_errors_point_to_the_poses_of_photos(folder: Path) -> None:
    (folder / "scan" / "shots").mkdir(parents=True)
    Image.new("RGB", (8, 8)).save(folder / "scan" / "shots" / "a.png")
    shots = folder / "scan" / "shots"
    with pytest.raises(InputError, match="estimate them with `colmap"):
        g2ard.load_views(shots)
    (folder / "scan" / "transforms.json").write_text("{}")
    with pytest.raises(InputError, match=r"give .*scan/transforms\.json, which has their poses$"):
        g2ard.load_views(shots)
    (folder / "scan" / "transforms.json").rename(folder / "scan" / "cameras.json")
    with pytest.raises(InputError, match=r"give .*scan, which has their poses$"):
        g2ard.load_views(shots)
    (folder / "scan" / "cameras.json").unlink()
    (folder / "scan" / "sparse" / "0").mkdir(parents=True)
    for name in ("cameras.bin", "images.bin"):
        (folder / "scan" / "sparse" / "0" / name).write_bytes(bytes(8))
    with pytest.raises(InputError, match=r"give .*scan, which has their poses$"):
        g2ard.load_views(shots)


def test_an_unreadable_folder_names_readable_contents(
    command_line: CommandLine, folder: Path
) -> None:
    for name in ("bare/photo.jpg", "project/images/photo.PNG", "empty"):
        place = folder / name
        (place.parent if place.suffix else place).mkdir(parents=True, exist_ok=True)
        if place.suffix:
            Image.new("RGB", (16, 16)).save(place)
    for name, photos in (("bare", "bare"), ("project", "project/images")):
        error = refused(
            command_line, folder, "distill", "--views", name, "-n", 9, "-o", "x", status=1
        )
        assert "photos without poses: estimate them with `colmap automatic_recon" in error
        assert f"--image_path {photos}` and give project" in error
    assert "looked for SOG's meta.json" in refused(command_line, folder, "info", "empty", status=1)
    ask = ("distill", "ball.ply", "-r", 10, "-o", "run", "--steps", 3, "--size", 32, "--no-page")
    assert command_line(*ask, cwd=folder)[0] == 0
    (folder / "run" / "report.json").unlink()  # a folder as `distill` leaves none
    held = "run: is not a supported folder; give one of its files: scene.ply (a scene), scored.json, views"
    for ask in (
        ("simplify", "run", "-r", 2, "-o", "x.ply"),
        ("evaluate", "ball.ply", "--teacher", "ball.ply", "--views", "run"),
    ):
        assert f"{held}.json (views)\n" in refused(command_line, folder, *ask, status=1)


BALL = checkered_ball(400)


def test_views_without_photos_name_the_substitute(command_line: CommandLine, folder: Path) -> None:
    cloud_of(folder / "cloud.ply", BALL)
    to = ("-r", 4, "-o", "x", "--views", "views.json")
    for ask, words in (
        (("distill", "ball.ply", *to, "--photos"), "leave out --photos to render the scene there"),
        (
            ("distill", "cloud.ply", *to),
            "give views with photos, their --images DIR, or a trained scene",
        ),
        (("distill", *to[2:], "-n", 50), "pass views with photos, their --images DIR, or a scene"),
        (("recover", "ball.ply", "-o", "x.ply", *to[4:]), "render them from --teacher SCENE"),
    ):
        status, _, error = command_line(*ask, cwd=folder)
        last = error.splitlines()[-1]
        assert (status, "has no" in last or "has none" in last, words in last) == (1, True, True), (
            error
        )


def test_a_cloud_without_photos_is_its_own_teacher(command_line: CommandLine, folder: Path) -> None:
    (folder / "alone").mkdir(exist_ok=True)
    cloud_of(folder / "alone" / "cloud.ply", BALL)
    ask = ("distill", "alone/cloud.ply", "-n", 100, "-o", "alone/run", "--steps", 5, "--size", 48)
    status, _, error = command_line(*ask, cwd=folder)
    assert (status, "no photos: the lifted points render the training images" in error) == (
        0,
        True,
    ), error
    assert len(g2ard.load(folder / "alone" / "run" / "scene.ply")) == 100


def test_gaps_are_told(command_line: CommandLine, folder: Path) -> None:
    x, y = np.meshgrid(np.arange(40.0), np.arange(40.0))
    g2ard.save(
        folder / "floor.ply",
        g2ard.lift(np.stack([x, y, 0 * x], 2).reshape(-1, 3), np.full((1600, 3), 0.5)),
    )
    for ratio, told in ((2, False), (100, True)):
        status, _, error = command_line(
            "simplify", "floor.ply", "-r", ratio, "-o", f"{ratio}.ply", cwd=folder
        )
        assert (status, "gaps: " in error) == (0, told), error


def test_an_input_of_the_wrong_kind_is_named(folder: Path) -> None:
    with pytest.raises(InputError, match="found views; give the scene's file"):
        g2ard.load(folder / "views.json")
    with pytest.raises(InputError, match=r"expected views .*, found a Gaussian scene"):
        g2ard.load_views(folder / "ball.ply")


def test_a_name_without_a_similar_one_gets_no_suggestion(folder: Path) -> None:
    (folder / "sub").mkdir()
    with pytest.raises(InputError, match=r"folder$"):
        g2ard.load(folder / "sub" / "zzz.ply")
    with pytest.raises(InputError, match=r"folder, nor a folder .*gone$"):
        g2ard.load(folder / "gone" / "ball.ply")


@pytest.mark.parametrize("suffix", [".ply", ".sog", ".spz", ".glb"])
def test_a_damaged_file_comes_with_advice(
    suffix: str, command_line: CommandLine, folder: Path
) -> None:
    g2ard.save(folder / f"a{suffix}", BALL)
    (folder / f"b{suffix}").write_bytes((folder / f"a{suffix}").read_bytes()[:-700])
    error = refused(command_line, folder, "info", f"b{suffix}", status=1)
    assert error.endswith("; the file is damaged: copy or export it again\n")
