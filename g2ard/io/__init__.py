"""File formats: Gaussian scenes, coloured point clouds and views, chosen by extension or content.

| reads | from |
|---|---|
| `read_splats`, `read_scene` | .ply (3DGS), .compressed.ply, SOG, .spz, .glb, .splat, .ksplat, OpenUSD |
| `read_points`, `read_cloud` | .ply, .las, .laz, COLMAP points3D |
| `read_views`, `read_view_set` | COLMAP, transforms.json, trainers' cameras, data sets, g2ard's own |

The first function of each row returns data; the second also returns notes about the file (`Note`).
`find_views` finds the cameras that trainers leave beside a scene. Readers are imported on first use.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from g2ard.errors import InputError, OutputError
from g2ard.io.atomic import atomic_folder, atomic_output, check_output
from g2ard.io.detect import KINDS, file_format, find_views, kind, run_scene, run_views
from g2ard.io.scene_formats import check_options, lost_in, scene_format

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike

    from g2ard.config.choices import Alpha, RenderModel, ViewFormat
    from g2ard.io.point_stream import PointStream
    from g2ard.io.stream import SceneStream
    from g2ard.io.types import Cloud, Note, Points, Scene, ViewFiles, ViewSet
    from g2ard.scene.cameras import Cameras
    from g2ard.scene.splats import Splats

__all__ = [
    "Cloud",
    "Note",
    "Points",
    "Scene",
    "ViewFiles",
    "ViewSet",
    "atomic_folder",
    "atomic_output",
    "check_output",
    "check_scene",
    "check_scene_output",
    "check_views_output",
    "find_views",
    "kind",
    "open_point_stream",
    "open_stream",
    "read_cloud",
    "read_points",
    "read_scene",
    "read_splats",
    "read_view_set",
    "read_views",
    "write_points",
    "write_splats",
    "write_views",
]


def __getattr__(name: str) -> Any:
    if name in ("Cloud", "Note", "Points", "Scene", "ViewFiles", "ViewSet"):
        from g2ard.io import types

        return getattr(types, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def read_splats(path: str | Path, *, render_model: RenderModel | None = None) -> Splats:
    """Read a Gaussian scene.

    Args:
        path: .ply (3DGS), .compressed.ply, .sog or a SOG folder, .spz, .glb, .splat, .ksplat, OpenUSD
            (.usda, .usdc); or a folder written by `distill` or `ingest`.
        render_model: "classic" or "antialiased"; None means what the file says, classic if it says nothing.

    Returns:
        The scene: linear scales, logit opacities, means relative to `offset`.

    Raises:
        InputError: the file is missing, damaged, not a scene, or has no finite row.

    >>> import tempfile, g2ard
    >>> path = Path(tempfile.mkdtemp()) / "two.ply"
    >>> g2ard.save(path, g2ard.Splats.create([[0, 0, 0], [1, 0, 0]], scales=[[1, 1, 1], [1, 2, 3]]))
    >>> g2ard.load(path).scales.round(5).tolist()
    [[1.0, 1.0, 1.0], [1.0, 2.0, 3.0]]
    """
    return read_scene(path, render_model=render_model).splats


def read_scene(path: str | Path, *, render_model: RenderModel | None = None) -> Scene:
    """Read a Gaussian scene with notes on dropped rows, clamped values and ignored properties."""
    path, found = check_scene(path)
    module = import_module(f"g2ard.io.{found}")
    scene: Scene = module.Stream(path).whole() if hasattr(module, "Stream") else module.read(path)
    if render_model is None:
        return scene
    return replace(scene, splats=replace(scene.splats, render_model=render_model))


def open_stream(
    path: str | Path | Sequence[str | Path], *, render_model: RenderModel | None = None
) -> SceneStream:
    """Open a scene, or several as one, for reading in blocks.

    Memory holds one block of a .ply, .compressed.ply or .splat, one chunk of a SOG, one tile, or the whole
    file of other formats. Several scenes get the offset of the first and the highest of their SH degrees;
    their render models must agree. `render_model` overrides what files say.
    """
    from g2ard.io.paths import file_identity
    from g2ard.io.stream import JoinedScenes, PartsStream

    if not isinstance(path, str | Path):
        streams = [open_stream(part, render_model=render_model) for part in path]
        if not streams:
            raise InputError("no scene given")
        return streams[0] if len(streams) == 1 else JoinedScenes(streams)
    path, found = check_scene(path)
    module = import_module(f"g2ard.io.{found}")
    if hasattr(module, "Stream"):
        stream: SceneStream = module.Stream(path)
    else:
        scene: Scene = module.read(path)
        splats = scene.splats
        parts = [len(splats)], lambda _: splats, splats.sh_degree, splats.offset
        stream = PartsStream(path, *parts, file_identity([path]), scene.notes, splats.render_model)
    stream.render_model = render_model or stream.render_model
    return stream


def check_scene(path: str | Path) -> tuple[Path, str]:
    """Return a scene's file or folder and its format; raise an `InputError` if it is not a scene."""
    path = run_scene(path)
    found = file_format(path)
    if KINDS[found] != "splats":
        is_cloud = KINDS[found] == "points"
        what = "a point cloud (no f_dc, scale, rot)" if is_cloud else found
        hint = "`g2ard lift` turns it into a scene" if is_cloud else "give the scene's file"
        raise InputError(f"expected a Gaussian scene, found {what}", path=path, hint=hint)
    return path, found


def check_scene_output(path: str | Path, overwrite: bool = False) -> Path:
    """Raise the `OutputError` that `write_splats` would raise, before any work."""
    if scene_format(path).function == "write_folder":
        check_output(Path(path).parent, overwrite, folder=True)
        return Path(path)
    return check_output(path, overwrite)


def check_views_output(path: str | Path, overwrite: bool = False, format: ViewFormat | None = None) -> Path:
    """Raise the `OutputError` that `write_views` would raise, before any work."""
    from g2ard.io.camera_files import view_format

    return check_output(path, overwrite, folder=view_format(Path(path), format) == "colmap")


def write_splats(path: str | Path, splats: Splats, *, overwrite: bool = False, **options: Any) -> None:
    """Write a Gaussian scene atomically.

    Args:
        path: .ply (3DGS), .compressed.ply, .sog, .spz, .glb (KHR_gaussian_splatting), .splat, .usda,
            .usdc; NAME/meta.json for a SOG folder.
        splats: the scene.
        overwrite: whether to replace an existing file.
        **options: format options: `normals=True` adds nx ny nz to a .ply; `spz_version=4` writes .spz
            version 4 instead of 3, and with it `axes="RFU"` stores right-forward-up instead of
            right-up-back; `compress="spz"` writes an SPZ inside of a .glb.

    Warns:
        UserWarning: an antialiased scene in a format that cannot say so (.glb, .splat, OpenUSD).

    Raises:
        OutputError: the file exists or cannot be written, or the extension or an option is unsupported.
        InputError: the scene is empty, has a non-finite value, or one that the format cannot store.
        MissingDependencyError: .spz of version 4 before Python 3.14 without `pip install backports.zstd`.

    >>> import tempfile, g2ard
    >>> path = Path(tempfile.mkdtemp()) / "one.sog"
    >>> g2ard.save(path, g2ard.Splats.create([[0, 0, 0]], scales=[[1, 2, 3]]))
    >>> len(g2ard.load(path))
    1
    """
    found = check_options(path, options)
    writer = getattr(import_module(f"g2ard.io.{found.module}"), found.function)
    writer(Path(path), splats, overwrite=overwrite, **options)
    for note in lost_in(path, splats, **options):
        warnings.warn(f"{path}: {note}", stacklevel=2)


def read_points(path: str | Path) -> Points:
    """Read a coloured point cloud.

    Args:
        path: .ply with x y z red green blue, .las, .laz, COLMAP's points3D.bin or .txt, or a COLMAP folder.

    Returns:
        Positions in float64, world units; colours in [0, 1].

    Raises:
        InputError: the file is missing, damaged, has no colours, or no finite point.
        MissingDependencyError: .las or .laz without `pip install g2ard[las]`.
    """
    return read_cloud(path).points


def read_cloud(path: str | Path) -> Cloud:
    """Read a coloured point cloud with notes on the file."""
    return open_point_stream(path).whole()


def open_point_stream(path: str | Path | Sequence[str | Path]) -> PointStream:
    """Open a coloured point cloud, or several as one, for reading in blocks.

    Memory holds one block of a .ply, .las or .laz, or the whole file of other formats. Several clouds get
    the offset of the first.
    """
    from g2ard.io.point_stream import JoinedClouds

    if not isinstance(path, str | Path):
        streams = [open_point_stream(part) for part in path]
        if not streams:
            raise InputError("no point cloud given")
        return streams[0] if len(streams) == 1 else JoinedClouds(streams)
    path, found = Path(path), file_format(path)
    modules = {"cloud_ply": "cloud_ply", "las": "las", "points3d": "points3d", "colmap": "points3d"}
    if found not in modules:
        scene = kind(path) == "splats"
        what = "a Gaussian scene" if scene else found
        hint = "run `simplify` or `distill` on it" if scene else "give the point cloud's file"
        raise InputError(f"expected a coloured point cloud, found {what}", path=path, hint=hint)
    stream: PointStream = import_module(f"g2ard.io.{modules[found]}").Stream(path)
    return stream


def write_points(path: str | Path, points: Points, *, overwrite: bool = False) -> None:
    """Write a coloured point cloud as .ply (float64 positions, 8-bit colours) atomically."""
    from g2ard.io import cloud_ply

    path = Path(path)
    if path.suffix.lower() != ".ply":
        raise OutputError("point clouds are written as .ply", path=path)
    cloud_ply.write(path, points, overwrite=overwrite)


def read_views(path: str | Path, *, images: str | Path | None = None, split: str = "all") -> Cameras:
    """Read views.

    Args:
        path: a COLMAP folder (or its images_4), a transforms.json or its folder, a nerfstudio, gsplat or
            INRIA run, LLFF's poses_bounds.npy, a Polycam capture, a Cambridge Landmarks scene, or a
            .json written by g2ard.
        images: folder of the photos, if they have moved.
        split: "train", "test", or "all"; see `g2ard.io.splits.split_mask`.

    Returns:
        The views in OpenCV axes, sorted by name for COLMAP, otherwise in file order. Views whose photo is
        missing are skipped, unless all photos are missing.

    Raises:
        InputError: the file is missing or damaged, or has no views in the split.
    """
    return read_view_set(path, images=images, split=split).cameras


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
        images: as for `read_views`.
        split: as for `read_views`.
        unpictured: whether to keep views without photos among others.
        alpha: "mask" makes a photo with alpha and without a mask its own mask.
    """
    from g2ard.io.photos import alpha_as_masks, pictured
    from g2ard.io.splits import split_mask
    from g2ard.io.types import ViewFiles

    if not isinstance(path, ViewFiles):
        path = ViewFiles(Path(path), Path(images) if images else None, alpha)
    images, alpha, path = path.images, path.alpha, run_views(path.path)
    found = file_format(path)
    if KINDS[found] != "views":
        what = "a Gaussian scene" if KINDS[found] == "splats" else "a point cloud"
        raise InputError(
            f"expected views (a COLMAP folder, transforms.json, g2ard's .json), found {what}", path=path
        )
    if images is not None and not images.is_dir():
        raise InputError("no such folder of photos", path=images)
    try:
        views = import_module(f"g2ard.io.{found}").read(path, images)
    except OSError as error:  # invalid photo name, unreadable folder
        raise InputError(error.strerror or str(error), path=path) from error
    views = views if unpictured else pictured(views)
    views = alpha_as_masks(views) if alpha == "mask" else views
    return views.take(split_mask(path, views.cameras.names, split, stated=views.splits))


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
    """
    from g2ard.io import camera_files, views

    path = Path(path)
    kind = camera_files.view_format(path, format)
    if kind == "g2ard":
        views.write(path, cameras, splits=splits, weights=weights, overwrite=overwrite)
        return
    if not len(cameras):
        raise InputError("not written: there are no views", path=path)
    if kind == "colmap":
        with atomic_folder(path, overwrite) as temporary:
            camera_files.write_colmap(temporary, cameras)
    else:
        with atomic_output(path, overwrite) as temporary:
            if kind == "inria":
                camera_files.write_inria(temporary, cameras)
            else:
                camera_files.write_nerfstudio(temporary, cameras, path, splits)
    if lost := camera_files.lost_views(cameras, kind, splits, weights is not None):
        warnings.warn(f"{path}: without {', '.join(lost)}", stacklevel=2)
