"""Targets: what is kept, at what precision, and what identifies it."""

import errno
import gc
import os
import pickle
from collections.abc import Callable
from dataclasses import replace
from io import FileIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from g2ard.progress import silent
from g2ard.rendering.renderer import Renderer
from g2ard.rendering.targets import (
    Cached,
    Photos,
    Subset,
    TeacherRenders,
    alpha_of,
    checked_targets,
    fill,
    fingerprint_of,
    mask_of,
)
from g2ard.scene.cameras import Cameras
from g2ard.system import spill
from helpers.scenes import around, checkered_ball
from helpers.view_files import photo


def test_renders_are_kept_in_16_bits() -> None:
    ball, views = checkered_ball(), around().resized(32)
    targets = TeacherRenders(ball, views)
    for i, view in enumerate(views):
        assert targets[i].dtype == np.float32
        assert 0 < np.abs(targets[i] - Renderer(ball).clipped(view)).max() <= 0.51 / 65535
    assert sum(kept.nbytes for kept in targets._kept.values()) == 2 * 3 * sum(
        views.widths * views.heights
    )


IMAGE_BYTES = 2 * 3 * 32 * 24


@pytest.mark.parametrize("limit", [0, 4 * IMAGE_BYTES + 99, 10**6])
def test_targets_are_filled_once(limit: int, monkeypatch: pytest.MonkeyPatch) -> None:
    ball, views = checkered_ball(400), around(12, (32, 24))
    rendered: list[str] = []
    real = TeacherRenders._make
    monkeypatch.setattr(
        TeacherRenders,
        "_make",
        lambda self, view: rendered.append(views.names[view]) or real(self, view),
    )
    targets = TeacherRenders(ball, views, limit=limit, lazy=True)
    targets[7]
    some = Subset(Subset(targets, [9, 7, 3, 1, 5]), [4, 3, 2, 1])  # rows 5, 1, 3 and 7
    told: list[tuple[int, int]] = []
    for _ in range(2):
        fill(some, lambda stage, done, total, info=None: told.append((done, total)))
    assert sorted(rendered) == sorted(views.names[row] for row in (7, 5, 1, 3))
    assert told == [(1, 3), (2, 3), (3, 3)]
    fill(targets, silent)
    assert len(rendered) == len(set(rendered)) == 12
    assert len(targets._kept) == min(12, limit // IMAGE_BYTES)


class NearlyFull(FileIO):
    """A file that takes three writes, then only a part."""

    writes = 0

    def write(self, data: Any) -> int:
        self.writes += 1
        return super().write(data if self.writes <= 3 else bytes(data)[:9])


def _refuse(**options: object) -> FileIO:
    raise OSError(errno.EROFS, "read-only file system")


@pytest.mark.parametrize(
    ("cause", "written"), [("no room", 0), ("read-only", 0), ("nearly full", 3)]
)
def test_targets_are_made_again_if_the_disk_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cause: str, written: int
) -> None:
    ball, views = checkered_ball(400), around(12, (32, 24))
    want = list(TeacherRenders(ball, views))
    name, double = {
        "no room": ("disk_usage", lambda folder: SimpleNamespace(free=10**8)),
        "read-only": ("TemporaryFile", _refuse),
        "nearly full": ("TemporaryFile", lambda **_: NearlyFull(tmp_path / "file", "w+b")),
    }[cause]
    monkeypatch.setattr(f"g2ard.system.spill.{name}", double)
    rendered: list[object] = []
    real = Renderer.clipped
    monkeypatch.setattr(
        Renderer, "clipped", lambda self, view: rendered.append(view) or real(self, view)
    )
    spill.notes()
    targets = TeacherRenders(ball, views, limit=5 * IMAGE_BYTES + 99)
    rendered.clear()
    fill(targets, silent)
    assert not rendered
    (note,) = spill.notes()
    assert "TMPDIR" in note
    assert spill.notes() == []
    for _ in range(2):
        for view in range(12):
            np.testing.assert_array_equal(targets[view], want[view])
    assert [targets._holds(view) for view in range(12)].count(True) == 5 + written


def _pictured(folder: Path) -> Cameras:
    """Views with photos that have alpha, and masks."""
    views = around(6, (32, 24))
    random = np.random.default_rng(0)
    paths: dict[str, list[Path]] = {"photo": [], "mask": []}
    for name in views.names:
        for kind, channels in (("photo", 4), ("mask", 3)):
            path = folder / f"{kind}-{Path(name).stem}.png"
            Image.fromarray(random.integers(0, 256, (24, 32, channels), np.uint8)).save(path)
            paths[kind].append(path)
    return replace(views, image_paths=tuple(paths["photo"]), mask_paths=tuple(paths["mask"]))


def _given_images(folder: Path, limit: int) -> Photos:
    images = np.random.default_rng(1).random((6, 24, 32, 4)).astype(np.float32)
    return Photos(around(6, (32, 24)), images, limit=limit)


@pytest.mark.parametrize(
    "make",
    [
        lambda folder, limit: Photos(_pictured(folder), limit=limit),
        _given_images,
        lambda folder, limit: TeacherRenders(checkered_ball(400), around(6, (32, 24)), limit=limit),
    ],
    ids=["photos", "images", "renders"],
)
def test_a_limit_changes_no_target(tmp_path: Path, make: Callable[[Path, int], Cached]) -> None:
    def values(targets: Cached) -> list[Any]:
        views = range(len(targets.cameras))
        parts = [(targets[view], mask_of(targets, view), alpha_of(targets, view)) for view in views]
        return [each for part in parts for each in part]

    want = values(make(tmp_path, 10**9))
    assert sum(each is not None for each in want) >= 6
    for limit in (0, 3 * 32 * 24 * 5):
        targets = make(tmp_path, limit)
        for _ in range(2):  # made, then read
            for got, expected in zip(values(targets), want, strict=True):
                np.testing.assert_array_equal(got, expected)
        kept = sum(array.nbytes for array in targets._kept.values() if array is not None)
        assert kept == targets._bytes <= limit
        assert not targets._spill.full
        there = pickle.loads(pickle.dumps(targets))
        assert not any(key in there._spill for key in targets._spill._places)
        np.testing.assert_array_equal(there[5], targets[5])


def test_a_target_from_the_file_can_be_changed() -> None:
    targets = _given_images(Path(), 0)
    first = targets[0]
    targets[0][:] = 0.5
    np.testing.assert_array_equal(targets[0], first)


@pytest.mark.skipif(
    not Path("/proc/self/fd").exists(), reason="open files cannot be counted on this system"
)
def test_the_file_disappears_with_its_targets() -> None:
    def opened() -> int:
        return len(list(Path("/proc/self/fd").iterdir()))

    gc.collect()
    before = opened()
    targets = TeacherRenders(checkered_ball(400), around(3, (32, 24)), limit=0)
    images = [targets[view] for view in range(3)]
    assert opened() == before + 1
    del targets, images
    gc.collect()
    assert opened() == before


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
        **{
            f"part {row}": lambda row=row: Subset(Photos(twins, list(images)), [row])
            for row in range(3)
        },
        **{
            f"own {row}": lambda row=row: Subset(checked_targets(Plain(images)), [row])
            for row in (0, 1)
        },
    }
    first, again = (
        [fingerprint_of(checked_targets(make())) for make in made.values()] for _ in range(2)
    )
    assert first == again
    for i, name in enumerate(made):
        same = [other for other, key in zip(made, first, strict=True) if key == first[i]]
        assert same == [name]
