"""Inputs of registration: photos with intrinsics, starting poses, and reference poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from g2ard.config.choices import Alpha
from g2ard.errors import InputError
from g2ard.io import ace, read_view_set
from g2ard.io.detect import file_format
from g2ard.io.paths import is_photo
from g2ard.io.photos import has_alpha, photo_size
from g2ard.progress import Progress, Say, silent, unsaid
from g2ard.scene.cameras import Camera, Cameras
from g2ard.scene.splats import Splats

Poses = dict[str, NDArray[np.float64]]
Found = TypeVar("Found")

_ROWS = 200_000
"""Gaussians that poses are planned on."""


def photos_of(
    path: Path,
    *,
    split: str = "all",
    intrinsics: Path | None = None,
    focal: float | None = None,
    alpha: Alpha = "composite",
    say: Say = unsaid,
) -> Cameras:
    """Read photos with their intrinsics.

    Args:
        path: views with photos, or a folder of photos.
        split: split of the views, see `g2ard.io.splits`; "all" for a folder.
        intrinsics: for a folder: views with the intrinsics of each photo by name, or the same for all.
        focal: for a folder: focal length in pixels of the stored photo; centred principal point, no
            distortion.
        alpha: "mask" ignores transparent pixels instead of showing them over the background.

    Returns:
        C cameras; photos from a folder have the identity as pose.
    """
    files = _photos_in(path)
    if not files:
        found = read_view_set(path, split=split, alpha=alpha)
        for note in found.notes:
            say(f"{path}: {note}")
        missing = next((v.name for v in found.cameras if v.image_path is None), None)
        if missing is not None:
            raise InputError(f"view {missing} has no photo to register; pass the folder of photos", path=path)
        if intrinsics is not None or focal is not None:
            raise InputError(
                "these views state their intrinsics; drop the option that gives others", path=path
            )
        return found.cameras
    if split != "all":
        raise InputError(
            f"a folder of photos has no split {split!r}; pass views, or drop the split", path=path
        )
    if (intrinsics is None) == (focal is None):
        raise InputError(
            "photos without views need their intrinsics",
            path=path,
            hint="give {intrinsics=VIEWS} or {focal=PIXELS}",
        )
    names = [file.relative_to(path).as_posix() for file in files]
    sizes = _sizes(files)
    if focal is not None:
        views = [_centred(focal, size) for size in sizes]
    else:
        assert intrinsics is not None
        views = _lenses(intrinsics, names)
        _check_aspects(files, sizes, views)
    return Cameras.of(
        replace(
            view,
            name=name,
            image_path=file,
            mask_path=file if alpha == "mask" and has_alpha(file) else None,
            viewmat=np.eye(4),
        )
        for view, name, file in zip(views, names, files, strict=True)
    )


def _photos_in(path: Path) -> list[Path]:
    """Return the photos of a folder without views, or [] for anything else."""
    if not path.is_dir():
        return []
    try:
        file_format(path)
    except InputError:
        files = sorted(f for f in path.rglob("*") if is_photo(f) and f.is_file())
        if not files:
            raise InputError("neither photos nor views in this folder", path=path) from None
        return files
    return []


def _sizes(files: list[Path]) -> list[tuple[int, int]]:
    """Return the width and height of each photo.

    A broken photo, which registration rejects later, gets the size of another, or (0, 0) if all are broken.
    """
    found: list[tuple[int, int] | None] = []
    for file in files:
        try:
            found.append(photo_size(file))
        except InputError:
            found.append(None)
    usual = next((size for size in found if size), (0, 0))
    return [size or usual for size in found]


def _centred(focal: float, size: tuple[int, int]) -> Camera:
    size = max(size[0], 1), max(size[1], 1)
    K = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]])
    return Camera(np.eye(4), K, *size)


def _lenses(path: Path, names: list[str]) -> list[Camera]:
    """Return the view of each name, or the intrinsics that all views share."""
    views = read_view_set(path, unpictured=True).cameras
    by_name = matched({view.name: view for view in views}, names)
    one = views[0]
    shared = all(_same_lens(view, one) for view in views)
    missing = next((name for name in names if name not in by_name), None)
    if missing is not None and not shared:
        raise InputError(
            f"no intrinsics for {missing}, and its views have different ones; add that name, or "
            "use the same intrinsics for all",
            path=path,
        )
    return [by_name.get(name, one) for name in names]


def _same_lens(a: Camera, b: Camera) -> bool:
    same = np.array_equal(a.K, b.K) and np.array_equal(a.distortion, b.distortion)
    return same and (a.width, a.height) == (b.width, b.height)


def _check_aspects(files: list[Path], sizes: list[tuple[int, int]], views: list[Camera]) -> None:
    """Reject intrinsics that fit none of the photos; single misfits are rejected later."""
    off = [
        abs(w * v.height - h * v.width) > 0.02 * h * v.width for (w, h), v in zip(sizes, views, strict=True)
    ]
    if all(off) and any(sizes[0]):
        (w, h), view = sizes[0], views[0]
        raise InputError(
            f"the photo is {w}×{h}, but its intrinsics are for {view.width}×{view.height}; "
            "pass intrinsics with the aspect ratio of these photos",
            path=files[0],
        )


def read_poses(path: Path) -> Poses:
    """Read name → (4, 4) camera_from_world from views in any format, or from ACE's text (`g2ard.io.ace`)."""
    if path.suffix.lower() == ".txt" and path.is_file():
        return ace.read(path)
    cameras = read_view_set(path, unpictured=True).cameras
    return dict(zip(cameras.names, cameras.viewmats, strict=True))


def poses_for(path: Path, names: Sequence[str]) -> Poses:
    """Read the poses of the named photos, see `read_poses` and `matched`."""
    found = matched(read_poses(path), names)
    if not found:
        raise InputError(f"no pose has the name of a photo (the first photo is {names[0]})", path=path)
    return found


def matched(found: Mapping[str, Found], names: Sequence[str]) -> dict[str, Found]:
    """Look up each of `names` by full name, or by a stem that is unique on both sides.

    >>> matched({"seq/a.png": 1, "b": 2}, ["a.jpg", "c.jpg"])
    {'a.jpg': 1}
    """
    out = {name: found[name] for name in names if name in found}
    stems = [PurePosixPath(name).stem for name in found]
    ours = [PurePosixPath(name).stem for name in names]
    by_stem = {
        stem: value for stem, value in zip(stems, found.values(), strict=True) if stems.count(stem) == 1
    }
    for name, stem in zip(names, ours, strict=True):
        if name not in out and stem in by_stem and ours.count(stem) == 1:
            out[name] = by_stem[stem]
    return out


def pool_of(scene: Splats, pool: str, seed: int, progress: Progress = silent, say: Say = unsaid) -> Cameras:
    """Return poses from a file of views, or plan as many as a number says; `say` receives their kind."""
    if not pool.strip().isdigit():
        return read_view_set(Path(pool), unpictured=True).cameras
    from g2ard.poses import plan_pool

    planned = plan_pool(scene, int(pool), seed=seed, rows=_ROWS, progress=progress)
    say(
        f"pool: {len(planned.cameras)} poses, {planned.kind} ({planned.why}); if the photos were taken "
        "differently, generate similar poses with `g2ard poses --kind` and pass the file to --pool"
    )
    return planned.cameras
