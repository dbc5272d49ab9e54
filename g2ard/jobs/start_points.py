"""Starting points of views: sparse points of their files, and as a fallback points along camera rays."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from g2ard.config.choices import Colour
from g2ard.errors import G2ardError
from g2ard.io import Source
from g2ard.io.detect import file_format
from g2ard.io.finding import Finder
from g2ard.io.jsonfile import read_json
from g2ard.io.paths import real_path
from g2ard.io.photos import load_photo
from g2ard.io.stream import PointStream
from g2ard.io.types import Cloud, Points, ViewFiles
from g2ard.jobs.inputs import Views
from g2ard.progress import Progress, Say, plural, unsaid
from g2ard.scene.cameras import Cameras
from g2ard.scene.samples import evenly_spaced
from g2ard.stages.photo_points.colors import ColoredStream
from g2ard.stages.photo_points.rays import points_along_rays

_PIXELS_PER_GAUSSIAN = 100
"""Pixels per Gaussian, if no count is given."""
_MOST_USUAL_COUNT = 100_000
"""Most Gaussians, if no count is given."""
_SAMPLED_PHOTOS = 16
"""Photos that are looked at, if no count is given."""
_PHOTO_SIDE = 240
"""Longer side in pixels of the photos used to place points."""


def top_up_points(
    points: Points | None,
    train: Cameras,
    count: int,
    *,
    background: Colour,
    seed: int,
    progress: Progress,
    say: Say,
) -> Points:
    """Add points along the camera rays of training views until there are `count`."""
    sparse = 0 if points is None else len(points)
    parts = [] if points is None else [points]
    told = [plural(sparse, "sparse point")] if sparse else []
    if (missing := count - sparse) > 0:
        small = train.fitted(_PHOTO_SIDE)
        parts.append(
            points_along_rays(small, missing, background=background, seed=seed, progress=progress)
        )
        told.append(f"{plural(missing, 'point')} along camera rays")
    say(f"starting from {' and '.join(told)}")
    return Points(
        np.concatenate([part.positions for part in parts]),
        np.concatenate([part.colors for part in parts]),
    )


def scatter_points(points: Points | None, train: Cameras, count: int) -> Points:
    """Return `count` points for a dry run: those given, and others anywhere among the cameras."""
    own = points or Points(np.zeros((0, 3)), np.zeros((0, 3), np.float32))
    missing = max(0, count - len(own))
    places = train.positions if not len(own) else own.positions
    low = places.min(axis=0)
    high = places.max(axis=0)
    others = np.random.default_rng(0).uniform(low, high + np.ptp(places), (missing, 3))
    shades = np.full((missing, 3), 0.5, np.float32)
    return Points(np.concatenate([own.positions, others]), np.concatenate([own.colors, shades]))


def choose_count(train: Cameras, size: int | None, sparse: int, say: Say) -> int:
    """Return the Gaussians of a scene that starts from photos alone, to two digits, and say so.

    A Gaussian of SH degree 3 has 59 numbers, as many as 20 pixels. One per 100 pixels of the training photos
    has five times as many equations as unknowns. There are at most 100,000, which take about ten minutes on
    two cores, or as many as sparse points.

    Args:
        train: training views.
        size: longer side of the photos in pixels, if they are larger.
    """
    cameras = train.resized(size)
    small = train.resized(_PHOTO_SIDE)
    shares = [
        _measure_shown_share(small, view) for view in evenly_spaced(len(small), _SAMPLED_PHOTOS)
    ]
    pixels = float(cameras.pixels.sum()) * float(np.mean(shares))
    most = max(_MOST_USUAL_COUNT, sparse)
    found = max(1, int(float(f"{min(pixels / _PIXELS_PER_GAUSSIAN, most):.2g}")))
    photos = plural(len(cameras), "photo")
    say(
        f"{plural(found, 'Gaussian')}, one per {pixels / found:.0f} pixels of {photos}; a count changes it"
    )
    return found


def _measure_shown_share(cameras: Cameras, view: int) -> float:
    """Return the share of a view's pixels that show something; 1 without a photo."""
    if cameras.image_paths[view] is None:
        return 1.0
    image, mask = load_photo(cameras, view, None)
    shown = image[..., 3] > 0.5 if image.shape[2] == 4 else np.ones(image.shape[:2], bool)
    return float((shown if mask is None else shown & mask).mean())


def keep_seen_points(scene: Source, train: Cameras) -> Source:
    """Return points without those that fewer than two training views see, if the file says who sees them."""
    if scene.format != "points3d":
        return scene
    import g2ard.io.points3d as points3d

    placed = Source(scene.path)
    chosen = scene.through

    def through(stream: PointStream) -> PointStream:
        seen = points3d.Stream(stream.path, train.names)
        return chosen(seen) if chosen else seen

    placed.through = through
    return placed


def colored_source(scene: Source, train: Cameras, *, planned: bool) -> Source:
    """Return a point cloud without colours with those of training photos, block by block."""
    found = Source(scene.path, None, [other.path for other in scene.others])
    chosen = scene.through

    def through(stream: PointStream) -> PointStream:
        stream = chosen(stream) if chosen else stream
        bare = stream.channels != 3 and any(train.image_paths)
        return stream if not bare else ColoredStream(stream, train, planned=planned)

    found.through = through
    return found


def is_sparse_file(scene: Source, views: Views) -> bool:
    """Return whether points are those of `find_sparse_file`."""
    file = find_sparse_file(views)
    given = (scene.kind == "views" and find_sparse_file(scene.path)) or scene.path
    return file is not None and real_path(given) == real_path(file)


def read_sparse_points(
    file: Path | None, say: Say = unsaid, train: Cameras | None = None
) -> Cloud | None:
    """Read the points of `find_sparse_file`; return None, and say why, if no point is readable.

    With training views, points that these do not see are skipped.
    """
    try:
        if file is None:
            return None
        source = Source(file)
        seen = source if train is None else keep_seen_points(source, train)
        cloud = seen.cloud(bare=True).whole()
    except G2ardError as error:
        say(f"warning: no starting points from photos: {error}")
        return None
    if len(cloud.points):
        return cloud
    say(f"warning: no starting points from photos: {file}: has no points")
    return None


def find_sparse_file(views: Views) -> Path | None:
    """Return the file of points of a COLMAP model, of a gsplat run's, of a transforms.json's `ply_file_path`,
    or the input.ply beside INRIA's cameras.json, which may not exist; None for other views."""
    import g2ard.io.colmap as colmap
    import g2ard.io.gsplat_run as gsplat_run
    import g2ard.io.transforms as transforms

    given = views.path if isinstance(views, ViewFiles) else views
    if not isinstance(given, str | Path):
        return None
    path = Path(given)
    found = file_format(path)
    if found == "gsplat_run":
        data = gsplat_run.data_of(path)
        return data and colmap.points_file(data)
    if found == "colmap":
        return colmap.points_file(path)
    if found == "inria":
        file = (path if path.is_dir() else path.parent) / "input.ply"
        return file if file.is_file() else None
    if found != "transforms":
        return None
    file = path if path.is_file() else next(iter(transforms.files_of(path)))
    listed = read_json(file).get("ply_file_path")
    return Finder(file.parent).photo(str(listed)) if listed else None
