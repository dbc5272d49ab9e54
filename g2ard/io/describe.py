"""Figures of a file, for `g2ard info`."""

from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from g2ard.arrays import Values
from g2ard.config.choices import colour_text
from g2ard.io import Source, read_view_set
from g2ard.io.detect import run_scene
from g2ard.io.jsonfile import Json
from g2ard.io.photos import measure_traits
from g2ard.io.sog import chunks_of
from g2ard.io.splits import splits_of
from g2ard.io.types import Note, Points, ViewFiles, ViewSet
from g2ard.progress import plural
from g2ard.scene.cameras import Cameras
from g2ard.scene.shape import elongation
from g2ard.scene.splats import Splats

_QUANTILES = (0, 1, 25, 50, 75, 99, 100)


def describe(given: str | Path | ViewFiles, more: Callable[[Splats], Json] | None = None) -> Json:
    """Summarise a scene, point cloud or views.

    Args:
        more: further figures of a scene.

    Returns:
        `path`, `kind`, `format`, `bytes`, `count`, `extent` {min, max, robust_min, robust_max: the 1st and
        99th percentiles} and `notes` [{code, count, text}]. Scenes add `sh_degree`, `render_model`, `odd`,
        and `opacity`, `largest_scale`, `smallest_scale`, `elongation` as quantiles by percentage. Point
        clouds add `color`, views `photos`, `sizes`, `fov_degrees`, `splits`. Point clouds and tiles of a map
        add its `map_system`, point clouds `metres_per_unit` (None if the file does not state it).
    """
    source = Source(str(given))
    path = source.path
    if source.kind == "splats":
        splats = source.whole()
        notes = source.notes
        figures = _splats(splats)
        if more is not None:
            figures |= more(splats)
    elif source.kind == "points":
        cloud = source.cloud().whole()
        notes = cloud.notes
        figures = _points(cloud.points)
    else:
        views = read_view_set(given)
        views = replace(views, splits=splits_of(path, views.cameras.names, views.splits))
        notes = (*views.notes, *_photo_notes(views.cameras))
        figures = _views(views)
    system = source.map_system
    if system is not None:
        figures["map_system"] = system
    if source.kind == "points":
        figures["metres_per_unit"] = source.metres_per_unit
    return {
        "path": str(path),
        "kind": source.kind,
        "format": source.format,
        "bytes": bytes_of(path),
        **figures,
        "notes": [asdict(note) for note in notes],
    }


def bytes_of(path: Path) -> int:
    """Return the size on disk: only the chunks that are read of a SOG folder, only the scene of a run."""
    path = run_scene(path)
    folders = chunks_of(path) or [path]
    files = list[Path]()
    for folder in folders:
        if folder.is_dir():
            files += folder.rglob("*")
        else:
            files.append(folder)
    return sum(file.stat().st_size for file in files if file.is_file())


def _quantiles(values: Values) -> dict[str, float]:
    values_at = np.percentile(values.astype(float), _QUANTILES)
    return {str(q): float(v) for q, v in zip(_QUANTILES, values_at, strict=True)}


def _extent(positions: Values) -> dict[str, list[float]]:
    ends = np.percentile(positions, (0, 100, 1, 99), axis=0).tolist()
    return dict(zip(("min", "max", "robust_min", "robust_max"), ends, strict=True))


def _splats(splats: Splats) -> Json:
    scales = np.sort(splats.scales, axis=1)
    opacities = splats.opacities
    means = np.ascontiguousarray(splats.means)
    unique = len(np.unique(means.view(f"V{3 * means.itemsize}")))
    return {
        "count": len(splats),
        "sh_degree": splats.sh_degree,
        "render_model": splats.render_model,
        "bytes_as_ply": splats.nbytes,
        "offset": splats.offset.tolist(),
        "extent": _extent(splats.positions),
        "opacity": _quantiles(opacities),
        "largest_scale": _quantiles(scales[:, 2]),
        "smallest_scale": _quantiles(scales[:, 0]),
        "elongation": _quantiles(elongation(scales)),
        "odd": {
            "opacity_below_0.005": int(np.count_nonzero(opacities < 0.005)),
            "opacity_above_0.99": int(np.count_nonzero(opacities > 0.99)),
            "elongation_above_100": int(np.count_nonzero(scales[:, 2] > 100 * scales[:, 1])),
            "same_position_as_another": len(splats) - unique,
        },
    }


def _points(points: Points) -> Json:
    return {
        "count": len(points),
        "extent": _extent(points.positions),
        "color": {
            "mean": points.colors.mean(0, dtype=float).tolist(),
            "min": points.colors.min(0).tolist(),
            "max": points.colors.max(0).tolist(),
        },
    }


def _views(views: ViewSet) -> Json:
    cameras = views.cameras
    pixels = zip(cameras.widths, cameras.heights, strict=True)
    sizes = Counter(f"{width}×{height}" for width, height in pixels)
    across = 2 * np.arctan(cameras.widths / (2 * cameras.Ks[:, 0, 0]))
    return {
        "count": len(cameras),
        "photos": sum(path is not None for path in cameras.image_paths),
        "sizes": dict(sizes.most_common()),
        "fov_degrees": _quantiles(np.degrees(across)),
        "distorted": int(cameras.distortions.any(1).sum()),
        "splits": dict(Counter(filter(None, views.splits))),
        "extent": _extent(cameras.positions),
    }


def _photo_notes(cameras: Cameras) -> list[Note]:
    photos = [photo for photo in cameras.image_paths if photo is not None]
    traits = measure_traits(photos)
    notes = []
    if traits.alpha:
        text = f"{plural(traits.alpha, 'photo')} of {len(photos)} have alpha (see --background and --alpha)"
        notes.append(Note("alpha", traits.alpha, text))
    if traits.border is not None:
        text = f"the photos have a constant border colour: {colour_text(traits.border)} (see --background)"
        notes.append(Note("constant_border", len(photos), text))
    if len(traits.sizes) > 1:
        size = max(traits.sizes, key=traits.sizes.__getitem__)
        width, height = size
        most = traits.sizes[size]
        others = sum(traits.sizes.values()) - most
        text = f"{plural(most, 'photo')} of {width}×{height} pixels, {others} of other sizes"
        notes.append(Note("mixed_sizes", others, text))
    return notes
