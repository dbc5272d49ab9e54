"""Reading and writing views of any format."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from g2ard.config.checks import check_type, checks_arguments
from g2ard.config.choices import ViewFormat
from g2ard.errors import InputError, OutputError
from g2ard.io.atomic import atomic_folder, atomic_output, check_output
from g2ard.io.detect import file_format, reader, run_views
from g2ard.io.paths import about
from g2ard.io.signs import explained
from g2ard.progress import plural

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from g2ard.config.choices import Alpha
    from g2ard.io.types import ViewFiles, ViewSet
    from g2ard.scene.cameras import Cameras


_OFF_CENTRE = 0.5  # distance in pixels of a principal point from the middle that is worth a note


def view_format(path: Path, given: ViewFormat | None = None) -> ViewFormat:
    """Return the format of an output path: the given one, or that of its name.

    >>> [view_format(Path(name)) for name in ("poses.json", "a/cameras.json", "transforms_1.json", "model")]
    ['g2ard', 'inria', 'nerfstudio', 'colmap']
    """
    suffix = path.suffix.lower()
    name = path.name.lower()
    if given is None and suffix == "":
        return "colmap"
    expected = ".json"
    where = ".json, or as a folder for COLMAP"
    if given == "colmap":
        expected = ""
        where = "a folder"
    if suffix != expected:
        raise OutputError(f"views are written as {where}", path=path)
    if given is not None:
        return given
    if name == "cameras.json":
        return "inria"
    if name.startswith("transforms"):
        return "nerfstudio"
    return "g2ard"


def lost_views(
    cameras: Cameras,
    format: ViewFormat,
    splits: Sequence[str | None],
    weighted: bool,
) -> list[str]:
    """Describe what a format cannot hold of views."""
    from g2ard.scene.cameras import USUAL

    if format == "g2ard":
        return []
    inria = format == "inria"
    nerfstudio = format == "nerfstudio"
    sizes = zip(cameras.widths, cameras.heights, strict=True)
    middle = [(width / 2, height / 2) for width, height in sizes]
    beside = abs(cameras.Ks[:, :2, 2] - middle).max(axis=1)
    off = int((beside > _OFF_CENTRE).sum())
    coefficients = cameras.distortions
    if not inria:
        coefficients = coefficients[:, 4:]  # k3
    bent = int(coefficients.any(axis=1).sum())
    photos = sum(lens is not None for lens in cameras.lenses)
    kinds = sum(kind != USUAL for kind in cameras.kinds)
    lost = [
        (inria and off, f"{plural(off, 'principal point')} beside the image's middle"),
        (inria and bent, f"lens distortion of {plural(bent, 'view')}"),
        (format == "colmap" and bent, f"k3 of the lens distortion of {plural(bent, 'view')}"),
        (not nerfstudio and not {*splits} <= {None, "train"}, "splits"),
        (photos, f"photos of {plural(photos, 'view')} that other lenses took"),
        (kinds, f"the kinds of {plural(kinds, 'view')}"),
        (weighted, "sampling weights"),
    ]
    return [text for count, text in lost if count]


def check_views_output(
    path: str | Path,
    overwrite: bool = False,
    format: ViewFormat | None = None,
) -> Path:
    """Raise the `OutputError` that `write_views` would raise, before any work."""
    folder = view_format(Path(path), format) == "colmap"
    return check_output(path, overwrite, folder=folder)


@checks_arguments
def read_views(
    path: str | Path,
    *,
    images: str | Path | None = None,
    split: str = "all",
) -> Cameras:
    """Read views.

    Args:
        path: a COLMAP folder (or its images_4), a transforms.json or its folder, a nerfstudio, gsplat or
            INRIA run, LLFF's poses_bounds.npy, a Polycam capture, a laser scan with photos (.e57), or a
            .json written by g2ard.
        images: folder of the photos, if they have moved.
        split: "train", "test", or "all"; see `g2ard.io.splits.split_mask`.

    Returns:
        The views in OpenCV axes, sorted by name for COLMAP, otherwise in file order. Views whose photo is
        missing are skipped, unless all photos are missing.

    Raises:
        InputError: the file is missing or damaged, or has no views in the split.

    >>> import tempfile, g2ard
    >>> path = Path(tempfile.mkdtemp()) / "views.json"
    >>> around = [g2ard.Camera.facing([4, y, 0], [0, 0, 0], name=f"view_{y}") for y in range(8)]
    >>> g2ard.save_views(path, g2ard.Cameras.of(around))
    >>> g2ard.load_views(path), g2ard.load_views(path, split="test").names
    (Cameras(8 views), ('view_0',))
    """
    return read_view_set(path, images=images, split=split).cameras


@explained
def read_view_set(
    path: str | Path | ViewFiles,
    *,
    images: str | Path | None = None,
    split: str = "all",
    unpictured: bool = False,
    alpha: Alpha = "composite",
) -> ViewSet:
    """Read views with their splits, weights and notes.

    Args:
        path: as for `read_views`, or `ViewFiles`, whose `images` and `alpha` then count.
        unpictured: whether to keep views without photos among others.
        alpha: "mask" makes a photo with alpha and without a mask its own mask.
    """
    from g2ard.io.frames import drop_unpictured, make_view_set, use_alpha_as_masks
    from g2ard.io.splits import split_mask
    from g2ard.io.types import ViewFiles

    given = path
    if not isinstance(given, ViewFiles):
        given = ViewFiles(Path(given), Path(images) if images else None, alpha)
    path = run_views(given.path)
    module = reader(path, file_format(path), "views")
    if given.images is not None and not given.images.is_dir():
        raise InputError("no such folder of photos", path=given.images)
    with about(path):  # also for an invalid name of a photo, or a folder that cannot be read
        views = make_view_set(module.read(replace(given, path=path)))
    if not unpictured:
        views = drop_unpictured(views)
    if given.alpha == "mask":
        views = use_alpha_as_masks(views)
    mask = split_mask(path, views.cameras.names, split, stated=views.splits)
    return views.take(mask)


@checks_arguments
def write_views(
    path: str | Path,
    cameras: Cameras,
    *,
    splits: Sequence[str | None] = (),
    weights: ArrayLike | None = None,
    format: ViewFormat | None = None,
    overwrite: bool = False,
) -> None:
    """Write views as g2ard's .json, which `read_views` restores to the same bits, or for other programs.

    Args:
        path: the .json to write, or a folder for COLMAP; photo paths are stored relative to it.
        cameras: C views.
        splits: "train", "test" or None per view, or ().
        weights: (C,) sampling weights, NaN for views without one, or None.
        format: "g2ard", "inria", "nerfstudio" or "colmap" (text). None decides by name: cameras.json is
            INRIA's, transforms*.json nerfstudio's, a name without suffix a COLMAP project.
        overwrite: whether to replace an existing file.

    Warns:
        UserWarning: the format cannot hold something of the views.

    Raises:
        OutputError: the file exists, cannot be written, or is not a .json.
        InputError: there are no views, or `splits` or `weights` have another length.

    >>> import tempfile, g2ard
    >>> folder = Path(tempfile.mkdtemp())
    >>> views = g2ard.Cameras.of([g2ard.Camera.facing([0, -3, 0], [0, 0, 0], name="front")])
    >>> g2ard.save_views(folder / "views.json", views, splits=["train"])
    >>> g2ard.save_views(folder / "transforms.json", views, splits=["train"])  # for nerfstudio
    """
    import g2ard.io.colmap as colmap
    import g2ard.io.g2ard_views as views
    import g2ard.io.inria as inria
    import g2ard.io.transforms as transforms
    from g2ard.scene.cameras import Cameras

    check_type("cameras", cameras, Cameras)
    path = Path(path)
    kind = view_format(path, format)
    if not len(cameras):
        raise InputError("not written: there are no views", path=path)
    output = atomic_output
    if kind == "colmap":
        output = atomic_folder
        texts = colmap.texts_of(cameras)
    elif kind == "inria":
        texts = {"": inria.text_of(cameras)}
    elif kind == "nerfstudio":
        texts = {"": transforms.text_of(path, cameras, splits)}
    else:
        texts = {"": views.text_of(path, cameras, splits, weights)}
    with output(path, overwrite) as temporary:
        for name, text in texts.items():
            file = temporary / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text, encoding="utf-8")
    lost = lost_views(cameras, kind, splits, weights is not None)
    if lost:
        warnings.warn(f"{path}: without {', '.join(lost)}", stacklevel=3)  # past `checks_arguments`
