"""Targets: what is kept, at what precision, and what identifies it."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from g2ard.progress import silent
from g2ard.rendering.renderer import Renderer
from g2ard.rendering.targets import Photos, Subset, TeacherRenders, checked_targets, fill, fingerprint_of
from helpers.photos import photographed
from helpers.scenes import around, checkered_ball
from helpers.view_files import photo


def test_renders_are_kept_in_16_bits() -> None:
    ball, views = checkered_ball(), around().resized(32)
    targets = TeacherRenders(ball, views)
    for i, view in enumerate(views):
        assert targets[i].dtype == np.float32
        assert 0 < np.abs(targets[i] - Renderer(ball).clipped(view)).max() <= 0.51 / 65535
    assert sum(kept.nbytes for kept in targets._kept.values()) == 2 * 3 * sum(views.widths * views.heights)


def test_no_more_is_rendered_than_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    ball, views = checkered_ball(400), around(12, (32, 24))
    rendered: list[object] = []
    real = Renderer.clipped
    monkeypatch.setattr(Renderer, "clipped", lambda self, view: rendered.append(view) or real(self, view))
    targets = TeacherRenders(ball, views, limit=5 * 2 * 3 * 32 * 24 + 99)
    assert len(rendered) == len(targets._kept) == 5


@pytest.mark.parametrize("limit", [10**6, 4 * 2 * 3 * 32 * 24 + 99])
def test_targets_are_filled_once_and_within_the_limit(limit: int, monkeypatch: pytest.MonkeyPatch) -> None:
    ball, views = checkered_ball(400), around(12, (32, 24))
    rendered: list[str] = []
    real = TeacherRenders._make
    monkeypatch.setattr(
        TeacherRenders, "_make", lambda self, view: rendered.append(views.names[view]) or real(self, view)
    )
    targets = TeacherRenders(ball, views, limit=limit, lazy=True)
    targets[7]
    some = Subset(Subset(targets, [9, 7, 3, 1, 5]), [4, 3, 2, 1])  # rows 5, 1, 3 and 7
    told: list[tuple[int, int]] = []
    for _ in range(2):
        fill(some, lambda stage, done, total, info=None: told.append((done, total)))
    assert rendered == [views.names[row] for row in (7, 5, 1, 3)]
    assert told == [(1, 3), (2, 3), (3, 3)]
    fill(targets, silent)
    assert len(rendered) == len(targets._kept) == (12 if limit == 10**6 else 4)


def test_masks_count_towards_the_limit(tmp_path: Path) -> None:
    views = photographed(tmp_path, checkered_ball(400), around(6, (32, 24)))
    photos = Photos(replace(views, mask_paths=views.image_paths[::-1]), limit=3 * (3 + 1) * 32 * 24 + 99)
    for view in range(6):
        assert photos[view].shape == (24, 32, 3)
    kept = [*photos._kept.values(), *photos._masks.values()]
    assert sum(array.nbytes for array in kept if array is not None) <= photos._limit
    assert len(kept) == 6


def test_a_replaced_photo_or_mask_changes_the_fingerprint(tmp_path: Path) -> None:
    paths = [photo(tmp_path / f"{name}.png", (32, 24)) for name in ("photo", "mask")]
    views = replace(around(1, (32, 24)), image_paths=(paths[0],), mask_paths=(paths[1],))
    before = fingerprint_of(Photos(views))
    assert fingerprint_of(Photos(views)) == before
    for path in paths:
        old = path.stat()
        photo(path, (32, 24), red=9)
        os.utime(path, ns=(old.st_atime_ns, old.st_mtime_ns))
        after = fingerprint_of(Photos(views))
        assert after != before
        before = after


class Plain:
    """Images of a class that knows nothing of this package."""

    def __init__(self, images: np.ndarray, masks: np.ndarray | None = None) -> None:
        self.cameras, self.images, self.masks = around(3, (32, 24)), images, masks

    def __getitem__(self, view: int) -> np.ndarray:
        return self.images[view]


class Masked(Plain):
    def mask(self, view: int) -> np.ndarray | None:
        return None if self.masks is None else self.masks[view]


class Darker(TeacherRenders):
    """Renders whose class has their `source` and changes the images."""

    share = 0.5

    def __getitem__(self, view: int) -> np.ndarray:
        return super().__getitem__(view) * np.float32(self.share)


class Darkest(Darker):
    share = 0.25


def test_the_fingerprint_of_any_class_is_that_of_its_images() -> None:
    ball, views = checkered_ball(400), around(3, (32, 24))
    images = np.random.default_rng(0).random((3, 24, 32, 3)).astype(np.float32)
    other = images.copy()
    other[2, 23, 31, 2] = 0
    holes = np.ones((3, 24, 32), bool)
    holes[1, 0, 0] = False
    twins = replace(views, viewmats=views.viewmats[[0, 0, 0]])  # only their images differ
    made = {
        "images": lambda: Plain(images),
        "one value": lambda: Plain(other),
        "bytes": lambda: Plain((images * 255).astype(np.uint8)),
        "all valid": lambda: Masked(images, np.ones_like(holes)),
        "one hole": lambda: Masked(images, holes),
        "darker": lambda: Darker(ball, views),
        "darkest": lambda: Darkest(ball, views),
        "renders": lambda: TeacherRenders(ball, views),
        "photos": lambda: Photos(views, list(images)),
        "other photos": lambda: Photos(views, list(other)),
        **{f"part {row}": lambda row=row: Subset(Photos(twins, list(images)), [row]) for row in range(3)},
        **{f"own {row}": lambda row=row: Subset(checked_targets(Plain(images)), [row]) for row in (0, 1)},
    }
    first, again = ([fingerprint_of(checked_targets(make())) for make in made.values()] for _ in range(2))
    assert first == again
    for i, name in enumerate(made):
        same = [other for other, key in zip(made, first, strict=True) if key == first[i]]
        assert same == [name]
