"""`g2ard.register`: photos with intrinsics and starting poses, then the stage."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from g2ard.arrays import Float
from g2ard.config.checks import AboveZero, checks_arguments, signature_of
from g2ard.config.choices import BLACK, Alpha, Colour, Keep, RenderModel
from g2ard.errors import InputError, require
from g2ard.io import read_view_set
from g2ard.io.detect import file_format
from g2ard.io.finding import photos_in
from g2ard.io.photo_headers import has_alpha, have_same_aspect, read_focal, read_size
from g2ard.io.signs import explained
from g2ard.jobs.inputs import Scene, load_scene
from g2ard.jobs.trajectory import is_trajectory, read_ace, read_trajectory
from g2ard.jobs.view_checks import propose_background
from g2ard.pipeline.presets import configure
from g2ard.poses import plan_pool
from g2ard.progress import Progress, Say, plural, silent, unsaid
from g2ard.scene.cameras import Camera, Cameras
from g2ard.scene.lenses import pinhole_matrix
from g2ard.scene.splats import Splats
from g2ard.stages.register import PhotoReport, PoseError, RegisterConfig, Registered, pose_error
from g2ard.stages.register import register as find_poses
from g2ard.stages.register.config import ROUGH_FOCAL_SIGMA, STATED_FOCAL_SIGMA

Poses = Mapping[str, ArrayLike]
Found = TypeVar("Found")

_POSE_SAMPLE = 200_000
"""Gaussians that poses are planned on."""


@dataclass(frozen=True, eq=False)
class RegisterJob:
    """A prepared registration: inputs are read and everything is decided. The fields are those of
    `g2ard.stages.register.register`, and true poses by name."""

    scene: Splats
    photos: Cameras
    starts: dict[str, Float]
    pool: Cameras | None
    config: RegisterConfig
    keep: Keep
    background: Colour
    progress: Progress = silent
    truth: Mapping[str, Float] = field(default_factory=dict)

    def run(self) -> Registered:
        """Find the poses, and compare them with the true ones."""
        given = {name: value for name, value in vars(self).items() if name != "truth"}
        found = find_poses(**given)
        if not self.truth:
            return found
        photos = tuple(map(self._compare, found.report.photos))
        return replace(found, report=replace(found.report, photos=photos))

    def _compare(self, row: PhotoReport) -> PhotoReport:
        """Add the errors of a photo's poses to its report."""
        true = self.truth.get(row.name)
        if true is None:
            return row
        start = self.starts.get(row.name)
        if start is None and self.pool is not None and row.start is not None:
            start = self.pool.viewmats[self.pool.names.index(row.start)]
        end = row.camera_from_world
        return replace(
            row,
            start_error=None if start is None else PoseError(*pose_error(start, true)),
            error=None if end is None else PoseError(*pose_error(np.array(end), true)),
        )


@checks_arguments
def prepare(
    scene: Scene,
    photos: Cameras | str | Path,
    *,
    poses: Poses | str | Path | None = None,
    pool: Cameras | str | Path | int | None = None,
    truth: Poses | str | Path | None = None,
    config: RegisterConfig | None = None,
    settings: Mapping[str, Any] | None = None,
    keep: Keep = "registered",
    split: str = "all",
    intrinsics: str | Path | None = None,
    focal: AboveZero | None = None,
    alpha: Alpha = "composite",
    background: Colour | None = None,
    render_model: RenderModel | None = None,
    seed: int = 0,
    progress: Progress = silent,
    say: Say = unsaid,
) -> RegisterJob:
    """Read the inputs of `register`, whose arguments these are, and decide everything."""
    config = configure(config or RegisterConfig(), settings=settings)
    taken = photos
    posed = True
    if isinstance(taken, Cameras):
        stated = {"intrinsics": intrinsics, "focal": focal, "split": split, "alpha": alpha}
        for name, value in stated.items():
            require(
                name,
                value,
                value in (None, "all", "composite"),
                "photos by their path, not cameras",
            )
    else:
        path = Path(taken)
        posed = not _photos_in(path)
        lens = None if intrinsics is None else Path(intrinsics)
        taken = photos_of(path, split=split, intrinsics=lens, focal=focal, alpha=alpha, say=say)
        if not posed and intrinsics is None and config.focal_sigma == STATED_FOCAL_SIGMA:
            config = replace(config, focal_sigma=ROUGH_FOCAL_SIGMA)
    if poses is None and pool is None and not posed:
        raise InputError("photos have no initial pose", path=path, hint="give {poses} or {pool}")
    if poses is None:
        poses = dict(zip(taken.names, taken.viewmats, strict=True)) if pool is None else {}
    starts = _named(poses, taken.names)
    true = _named(truth or {}, taken.names)
    splats = load_scene(scene, say, render_model)
    behind = background or BLACK
    propose_background(taken, behind, background is not None, say)
    if not isinstance(pool, Cameras | None):
        pool = pool_of(splats, pool, seed, progress, say)
    return RegisterJob(splats, taken, starts, pool, config, keep, behind, progress, true)


@signature_of(prepare)
def register(*inputs: Any, **options: Any) -> Registered:
    """Estimate camera poses of photos against a scene, exactly like the command `g2ard register`.

    A photo starts from its pose in `poses`, or from the most similar view of `pool`. Features matched with a
    render there give a new pose by PnP, which is refined; with too few matches, the photo is aligned directly
    with renders, coarse to fine. The result's likeness to the photo decides its status: registered, uncertain
    or refused. See `g2ard.stages.register.register`.

    Args:
        scene: the scene, or its path; poses are in world coordinates.
        photos: views with photos, or their path, or a folder of photos.
        poses: name → (4, 4) camera_from_world, or a file of poses: views in any format, or ACE's text. None
            starts from the photos' own poses, unless there is a pool.
        pool: starting views for photos that are not in `poses`: cameras, their path, or a number of views to
            generate.
        truth: true poses to compare with, given like `poses`; not used otherwise.
        config: options of registration; None means the defaults.
        settings: values of `config` by path, such as {"register.passes": 1}.
        keep: poses to keep: "registered", "uncertain" (both), or "all", which falls back to the start.
        split: split of the views in `photos`.
        intrinsics: for a folder of photos: views with the intrinsics of each photo by name, or the same for
            all.
        focal: for a folder of photos: focal length, pixels. Without it and `intrinsics`, EXIF states it.
        alpha: "mask" ignores transparent pixels instead of showing them over the background.
        background: RGB in [0, 1] behind the scene; None means black.
        render_model: overrides what the scene's file says.
        seed: seed of a generated pool.
        progress: called after every photo.
        say: called with log messages.

    Returns:
        The kept cameras, and a report on all photos.

    Raises:
        InputError: no photos, no starting pose or pool, an invalid pose or setting, or an unreadable scene.
        MissingDependencyError: a matcher is requested but the extra `register` is not installed.

    >>> from g2ard.scene.cameras import Camera
    >>> dot = Splats.create([[0, 0, 0]], scales=[[0.1] * 3], logit_opacities=[9])
    >>> view = Cameras.of([Camera.facing([0, -2, 0], [0, 0, 0], name="a.png")])
    >>> report = register(dot, view).report
    >>> report.photos[0].status, report.photos[0].reason
    ('refused', 'view 0 (a.png) has no photo; pass views with photos')
    """
    return prepare(*inputs, **options).run()


def _named(given: Poses | str | Path, names: Sequence[str]) -> dict[str, Float]:
    if isinstance(given, str | Path):
        return poses_for(Path(given), names)
    return {name: np.asarray(pose, np.float64) for name, pose in given.items()}


def photos_of(
    path: Path,
    *,
    split: str = "all",
    intrinsics: Path | None = None,
    focal: float | None = None,
    alpha: Alpha = "composite",
    say: Say = unsaid,
) -> Cameras:
    """Read views with photos, or a folder of photos with their intrinsics; see `register` for the arguments.

    `focal` is in pixels of the stored photo, with a centred principal point and no distortion. Photos from a
    folder have the identity as pose.
    """
    files = _photos_in(path)
    if not files:
        found = read_view_set(path, split=split, alpha=alpha)
        for note in found.notes:
            say(f"{path}: {note}")
        missing = next((v.name for v in found.cameras if v.image_path is None), None)
        if missing is not None:
            raise InputError(
                f"view {missing} has no photo to register; pass the folder of photos", path=path
            )
        if intrinsics is not None or focal is not None:
            raise InputError(
                "these views state their intrinsics; drop the option that gives others", path=path
            )
        return found.cameras
    if split != "all":
        raise InputError(
            f"a folder of photos has no split {split!r}; pass views, or drop the split", path=path
        )
    if intrinsics is not None and focal is not None:
        raise InputError("give intrinsics or a focal length, not both", parameter="intrinsics")
    names = [file.relative_to(path).as_posix() for file in files]
    sizes = _sizes(files)
    if intrinsics is None:
        focals = [focal] * len(files) if focal is not None else _exif_focals(path, files, say)
        views = [_centred(pixels, size) for pixels, size in zip(focals, sizes, strict=True)]
    else:
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


def _exif_focals(path: Path, files: list[Path], say: Say) -> list[float]:
    """Return each photo's focal length in pixels by its EXIF; photos without one get the median."""
    stated = [read_focal(file) for file in files]
    known = [pixels for pixels in stated if pixels is not None]
    if not known:
        raise InputError(
            "photos without views need their intrinsics, and no EXIF states a focal length",
            path=path,
            hint="give {intrinsics=VIEWS} or {focal=PIXELS}",
        )
    usual = float(np.median(known))
    without = len(files) - len(known)
    others = f"; {plural(without, 'photo')} without one get the median" if without else ""
    say(
        f"note: {path}: focal lengths by EXIF, {usual:,.0f} pixels in the median, no distortion{others}"
    )
    return [usual if pixels is None else pixels for pixels in stated]


def _photos_in(path: Path) -> list[Path]:
    """Return the photos of a folder without views, or [] for anything else."""
    if not path.is_dir():
        return []
    try:
        file_format(path)
    except InputError:
        files = photos_in(path, below=True)
        if not files:
            raise InputError("neither photos nor views in this folder", path=path) from None
        return files
    return []


def _sizes(files: list[Path]) -> list[tuple[int, int]]:
    """Return the width and height of each photo.

    A broken photo, which registration rejects later, gets the size of another, or (0, 0) if all are broken.
    """
    found: dict[Path, tuple[int, int]] = {}
    for file in files:
        with suppress(InputError):
            found[file] = read_size(file)
    usual = next(iter(found.values()), (0, 0))
    return [found.get(file, usual) for file in files]


def _centred(focal: float, size: tuple[int, int]) -> Camera:
    size = max(size[0], 1), max(size[1], 1)
    K = pinhole_matrix(focal, focal, size[0] / 2, size[1] / 2)
    return Camera(np.eye(4), K, *size)


def _lenses(path: Path, names: list[str]) -> list[Camera]:
    """Return the view of each name, or the intrinsics that all views share."""
    views = read_view_set(path, unpictured=True).cameras
    by_name = matched({view.name: view for view in views}, names)
    lenses = {(*view.K.ravel(), *view.distortion, view.width, view.height) for view in views}
    missing = next((name for name in names if name not in by_name), None)
    if missing is not None and len(lenses) > 1:
        raise InputError(
            f"no intrinsics for {missing}, and its views have different ones; add that name, or "
            "use the same intrinsics for all",
            path=path,
        )
    return [by_name.get(name, views[0]) for name in names]


def _check_aspects(files: list[Path], sizes: list[tuple[int, int]], views: list[Camera]) -> None:
    """Reject intrinsics that fit none of the photos; single misfits are rejected later."""
    if any(sizes[0]) and not any(map(_suits, files, sizes, views)):
        width, height = sizes[0]
        view = views[0]
        raise InputError(
            f"the photo is {width}×{height}, but its intrinsics are for {view.width}×{view.height}; "
            "pass intrinsics with the aspect ratio of these photos",
            path=files[0],
        )


def _suits(file: Path, size: tuple[int, int], view: Camera) -> bool:
    """Return whether a photo, upright if EXIF says so, has the aspect of its view."""
    like = view.width, view.height
    with suppress(InputError):
        size = read_size(file, like=like)
    return have_same_aspect(size, like)


@explained
def read_poses(path: Path) -> dict[str, Float]:
    """Read name → (4, 4) camera_from_world from views in any format, or from ACE's text (`read_ace`)."""
    if path.suffix.lower() == ".txt" and path.is_file():
        return read_ace(path)
    cameras = read_view_set(path, unpictured=True).cameras
    return dict(zip(cameras.names, cameras.viewmats, strict=True))


def poses_for(path: Path, names: Sequence[str]) -> dict[str, Float]:
    """Read the poses of the named photos, see `read_poses` and `matched`, or those of a trajectory."""
    if is_trajectory(path):
        return read_trajectory(path, names)
    found = matched(read_poses(path), names)
    if not found:
        raise InputError(
            f"no pose has the name of a photo (the first photo is {names[0]})", path=path
        )
    return found


def matched(found: Mapping[str, Found], names: Sequence[str]) -> dict[str, Found]:
    """Look up each of `names` by full name, by path with `_` for `/`, or by file name, without suffixes.

    ACE writes `seq2/frame00001.png` as `seq2_frame00001.png`. Shortened names must be unique on both sides.

    >>> matched({"seq/a.png": 1, "b": 2}, ["a.jpg", "c.jpg"])
    {'a.jpg': 1}
    >>> matched({"seq2_frame1.png": 1, "seq3_frame1.png": 2}, ["seq3/frame1.png"])
    {'seq3/frame1.png': 2}
    """
    out = {name: found[name] for name in names if name in found}
    for shortened in (_flat, _stem):
        theirs = Counter(map(shortened, found))
        ours = Counter(map(shortened, names))
        known = {
            shortened(name): value for name, value in found.items() if theirs[shortened(name)] == 1
        }
        for name in names:
            if name not in out and shortened(name) in known and ours[shortened(name)] == 1:
                out[name] = known[shortened(name)]
    return out


def _stem(name: str) -> str:
    return PurePosixPath(name).stem


def _flat(name: str) -> str:
    path = PurePosixPath(name)
    return str(path.parent / path.stem).replace("/", "_")


def pool_of(
    scene: Splats, pool: str | Path | int, seed: int, progress: Progress = silent, say: Say = unsaid
) -> Cameras:
    """Return poses from a file of views, or plan as many as a number says, and `say` so."""
    if not isinstance(pool, int) and not str(pool).strip().isdigit():
        return read_view_set(Path(str(pool)), unpictured=True).cameras
    count = int(str(pool))
    require("pool", count, count >= 1, "at least 1 view")
    planned = plan_pool(scene, count, seed=seed, rows=_POSE_SAMPLE, progress=progress)
    say(f"starting from {plural(len(planned.cameras), 'generated view')} ({planned.kind})")
    return planned.cameras
