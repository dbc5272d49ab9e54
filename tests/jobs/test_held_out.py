"""Held-out photos are unreachable for whatever learns: painted red, they change no bit of a result."""

import json
import shutil
import struct
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import g2ard
from g2ard.io import Source, write_views
from g2ard.io.colmap import texts_of
from g2ard.io.images import write_png
from g2ard.io.types import Points
from g2ard.jobs.budget import Budget
from g2ard.jobs.distill import open_job
from g2ard.jobs.distill_options import DistillOptions
from g2ard.jobs.tile_options import Tiling
from helpers.photos import photographed
from helpers.scenes import around, assert_same_bits, checkered_ball

BALL, VIEWS = checkered_ball(500), around(14, (40, 30))
RNG = np.random.default_rng(3)
HELD_OUT = sorted(RNG.choice(len(VIEWS), 4, replace=False).tolist())
SCAN = Points(BALL.means.astype(np.float64), np.zeros((len(BALL), 3), np.float32))  # has no colours

Split = tuple[Path, Path | None, Iterable[int]]
"""The views, those given for scores, and which photos are held out."""


def names_of(rows: Iterable[int]) -> list[str]:
    return [VIEWS.names[row] for row in rows]


def by_the_rule(folder: Path, views: g2ard.Cameras) -> Split:
    write_views(folder / "views.json", views)
    return folder / "views.json", None, range(0, len(views), 8)


def stated(folder: Path, views: g2ard.Cameras) -> Split:
    splits = ["test" if row in HELD_OUT else "train" for row in range(len(views))]
    write_views(folder / "views.json", views, splits=splits)
    return folder / "views.json", None, HELD_OUT


def in_a_split_file(folder: Path, views: g2ard.Cameras) -> Split:
    write_views(folder / "views.json", views)
    train = [row for row in range(len(views)) if row not in HELD_OUT]
    (folder / "split.json").write_text(
        json.dumps({"train": names_of(train), "test": names_of(HELD_OUT)})
    )
    return folder / "views.json", None, HELD_OUT


def in_a_table(folder: Path, views: g2ard.Cameras) -> Split:
    write_views(folder / "views.json", views)
    (folder / "test.txt").write_text("\n".join(names_of(HELD_OUT)))
    return folder / "views.json", None, HELD_OUT


def in_another_file(folder: Path, views: g2ard.Cameras) -> Split:
    write_views(folder / "views.json", views)
    write_views(folder / "scores.json", views.take(HELD_OUT))
    return folder / "views.json", folder / "scores.json", HELD_OUT


def by_other_names(folder: Path, views: g2ard.Cameras) -> Split:
    """The file for scores lists links to the photos, and poses that differ a little."""
    write_views(folder / "views.json", views)
    held_out = views.take(HELD_OUT).recentred([0.01, 0, 0])
    (folder / "links").mkdir()
    links = tuple(folder / "links" / f"{row}.png" for row in HELD_OUT)
    for photo, link in zip(held_out.image_paths, links, strict=True):
        link.symlink_to(str(photo))
    write_views(folder / "scores.json", replace(held_out, image_paths=links))
    return folder / "views.json", folder / "scores.json", HELD_OUT


def copied(folder: Path, views: g2ard.Cameras) -> Split:
    """The file for scores lists copies of the photos, and poses in single precision."""
    write_views(folder / "views.json", views)
    held_out = views.take(HELD_OUT)
    (folder / "copies").mkdir()
    copies = tuple(folder / "copies" / f"{row}.png" for row in HELD_OUT)
    for photo, copy in zip(held_out.image_paths, copies, strict=True):
        assert photo is not None
        shutil.copy(photo, copy)
    rounded = held_out.viewmats.astype(np.float32).astype(np.float64)
    write_views(folder / "scores.json", replace(held_out, viewmats=rounded, image_paths=copies))
    return folder / "views.json", folder / "scores.json", HELD_OUT


def linked(folder: Path, views: g2ard.Cameras) -> Split:
    """Two names of one photo, of which one is held out."""
    photo, again = views.image_paths[1], folder / "again.png"
    assert photo is not None
    again.symlink_to(photo)
    twice = replace(views.take([1]), names=("again",), image_paths=(again,))
    every = g2ard.Cameras.of([*views, *twice])
    write_views(folder / "views.json", every, splits=["train"] * len(views) + ["test"])
    return folder / "views.json", None, [1]


SPLITS = [
    by_the_rule,
    stated,
    in_a_split_file,
    in_a_table,
    in_another_file,
    by_other_names,
    copied,
    linked,
]


def distilled(scene: Any, **more: Any) -> Callable[[Path, Path | None], Any]:
    def run(views: Path, held_out: Path | None) -> Any:
        return g2ard.distill(scene, views=views, held_out=held_out, steps=3, **more)

    return run


def small() -> g2ard.Splats:
    return checkered_ball(80, seed=2)


LEARNERS: dict[str, Callable[[Path, Path | None], Any]] = {
    "photos alone": distilled(None),
    "points along rays": distilled(None, count=120),
    "a cloud without colours": distilled(SCAN, count=90),
    "a cloud with too few points": distilled(
        Points(SCAN.positions[:50], SCAN.colors[:50]), count=90
    ),
    "a scene": distilled(BALL, count=90),
    "recover": lambda views, _: g2ard.recover(small(), views=views, steps=25),
    "simplify": lambda views, _: g2ard.simplify(BALL, count=90, views=views),
}
SPLIT_ALONE = ("recover", "simplify")
"""Commands that take no other views for scores."""


CASES = [("photos alone", split) for split in SPLITS] + [
    (name, split)
    for name in LEARNERS
    for split in (stated, copied)
    if name != "photos alone" and not (split is copied and name in SPLIT_ALONE)
]
"""All splits are read before any learner begins: one learner meets all, the others one of each sort."""


@pytest.mark.parametrize(("name", "split"), CASES, ids=lambda part: getattr(part, "__name__", part))
def test_red_held_out_photos_change_no_bit(
    name: str, split: Callable[[Path, g2ard.Cameras], Split], tmp_path: Path
) -> None:
    (tmp_path / "photos").mkdir()
    views, scores, held_out = split(tmp_path, photographed(tmp_path / "photos", BALL, VIEWS))
    before = LEARNERS[name](views, scores)
    red = np.zeros((30, 40, 3))
    red[..., 0] = 1
    photos = [tmp_path / "photos" / f"{one}.png" for one in names_of(held_out)]
    for path in (*photos, *tmp_path.glob("copies/*")):
        assert path.exists()
        write_png(path, red, overwrite=True)
    after = LEARNERS[name](views, scores)
    assert_same_bits(before.splats, after.splats)


@pytest.mark.parametrize("name", [name for name in LEARNERS if name != "simplify"])
def test_training_photos_change_the_result(name: str, tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    found = []
    for gain in (1.0, 0.8):
        views, scores, _ = stated(tmp_path, photographed(tmp_path / "photos", BALL, VIEWS, gain))
        found.append(LEARNERS[name](views, scores).splats)
        shutil.rmtree(tmp_path)
        (tmp_path / "photos").mkdir(parents=True)
    assert len(found[0]) != len(found[1]) or np.any(found[0].sh0 != found[1].sh0)


def _model(folder: Path, suffix: str, moved: bool) -> Path:
    """Write a COLMAP model of the ball, whose points each state 1 to 5 images; return their file.

    Args:
        moved: move and repaint the points that fewer than two training photos see.
    """
    folder.mkdir(parents=True)
    views = replace(VIEWS, names=tuple(f"{name}.png" for name in VIEWS.names))
    (folder / "images").mkdir()
    photographed(folder / "images", BALL, VIEWS)
    (folder / "sparse" / "0").mkdir(parents=True)
    for name, text in texts_of(views).items():
        (folder / name).write_text(text)
    rng = np.random.default_rng(0)
    train = [row for row in range(len(VIEWS)) if row not in HELD_OUT]
    points = []
    colours = np.rint(255 * np.clip(0.5 + 0.282 * BALL.sh0[:, 0], 0, 1)).astype(int).tolist()
    for xyz, rgb in zip(BALL.means.astype(float), colours, strict=True):
        track = rng.choice(len(VIEWS), int(rng.integers(6)), replace=False)
        if moved and len(track) and np.isin(track, train).sum() < 2:
            xyz, rgb = xyz * 1.7, [255, 0, 0]
        points.append((xyz, rgb, (track + 1).tolist()))
    file = folder / "sparse" / "0" / f"points3D{suffix}"
    (folder / "sparse" / "0" / "points3D.txt").unlink(missing_ok=True)
    if suffix == ".bin":
        data = struct.pack("<Q", len(points))
        for number, (xyz, rgb, track) in enumerate(points):
            data += struct.pack("<Q3d3BdQ", number, *xyz, *rgb, 0.5, len(track))
            data += b"".join(struct.pack("<II", image, 0) for image in track)
        file.write_bytes(data)
    else:
        lines = [
            " ".join(
                map(str, [number, *map(float, xyz), *rgb, 0.5, *(f"{image} 0" for image in track)])
            )
            for number, (xyz, rgb, track) in enumerate(points)
        ]
        file.write_text("\n".join(lines))
    return file


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
@pytest.mark.parametrize("given", [False, True], ids=["photos alone", "points given"])
@pytest.mark.parametrize("split", ["stated", "given"])
def test_points_that_held_out_photos_found_change_no_bit(
    split: str, given: bool, suffix: str, tmp_path: Path
) -> None:
    """Points of COLMAP that fewer than two training photos see start nothing."""
    found = []
    for moved in (False, True):
        folder = tmp_path / f"{moved}"
        points, held_out = _model(folder, suffix, moved), None
        if split == "stated":
            (points.parent / "test.txt").write_text(
                "\n".join(f"{name}.png" for name in names_of(HELD_OUT))
            )
        else:
            held_out = folder / "scores.json"
            views = g2ard.load_views(folder)
            names = {f"{name}.png" for name in names_of(HELD_OUT)}
            write_views(held_out, views.take([name in names for name in views.names]))
        done = g2ard.distill(
            points if given else None, views=folder, held_out=held_out, count=90, steps=3
        )
        found.append(done.splats)
    assert_same_bits(*found)


def test_points_in_tiles_are_those_that_training_photos_found(tmp_path: Path) -> None:
    found = []
    for moved in (False, True):
        folder = tmp_path / f"{moved}"
        points = _model(folder, ".bin", moved)
        (points.parent / "test.txt").write_text(
            "\n".join(f"{name}.png" for name in names_of(HELD_OUT))
        )
        options = DistillOptions(views=folder, settings={"steps": 3})
        tiling = Tiling(100, workers=1, folder=folder / "work")
        with open_job(Source(points), Budget(count=90), options, tiling) as job:
            found.append(job.run().splats)
    assert_same_bits(*found)
