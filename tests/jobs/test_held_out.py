"""Held-out photos are unreachable for whatever learns: painted red, they change no bit of a result."""

import json
import shutil
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import g2ard
from g2ard.io import write_views
from g2ard.io.images import write_png
from g2ard.io.types import Points
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
    (folder / "split.json").write_text(json.dumps({"train": names_of(train), "test": names_of(HELD_OUT)}))
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
    "a cloud with too few points": distilled(Points(SCAN.positions[:50], SCAN.colors[:50]), count=90),
    "a scene": distilled(BALL, count=90),
    "recover": lambda views, _: g2ard.recover(small(), views=views, steps=25),
    "simplify": lambda views, _: g2ard.simplify(BALL, count=90, views=views),
}
SPLIT_ALONE = ("recover", "simplify")
"""Those that take no other views for scores."""


@pytest.mark.parametrize("split", SPLITS, ids=lambda split: split.__name__)
@pytest.mark.parametrize("name", LEARNERS)
def test_red_held_out_photos_change_no_bit(
    name: str, split: Callable[[Path, g2ard.Cameras], Split], tmp_path: Path
) -> None:
    (tmp_path / "photos").mkdir()
    views, scores, held_out = split(tmp_path, photographed(tmp_path / "photos", BALL, VIEWS))
    if scores is not None and name in SPLIT_ALONE:
        return
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
