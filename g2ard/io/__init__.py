"""Files: Gaussian scenes, coloured clouds and views, read and written by extension or by content.

| reads | from |
|---|---|
| `read_splats`, `read_scene` | 3DGS .ply, .compressed.ply, SOG folder or .sog, .spz, .glb, .splat |
| `read_points`, `read_cloud` | .ply, .las, .laz, COLMAP points3D |
| `read_views`, `read_view_set` | COLMAP, transforms.json, INRIA's, nerfstudio, gsplat, Cambridge, g2ard's |

`find_views` looks for the cameras that trainers leave beside a scene.

The short forms return the data; the long ones also say what was noticed (`Note`). Nothing heavy is imported
until a function is called.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from g2ard.io.atomic import atomic_folder, atomic_output, check_output
from g2ard.io.detect import kind
from g2ard.io.find import find_views

if TYPE_CHECKING:
    from collections.abc import Sequence
    from types import ModuleType

    from numpy.typing import ArrayLike

    from g2ard.io.point_stream import PointStream
    from g2ard.io.stream import SceneStream
    from g2ard.io.types import Cloud, Note, Points, Scene, ViewSet
    from g2ard.scene.cameras import Cameras
    from g2ard.scene.splats import Splats

__all__ = [
    "Cloud",
    "Note",
    "Points",
    "Scene",
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
    if name in ("Cloud", "Note", "Points", "Scene", "ViewSet"):
        from g2ard.io import types

        return getattr(types, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def read_splats(path: str | Path) -> Splats:
    """Read a Gaussian scene; `read_scene` also says what was noticed.

    Args:
        path: .ply (3DGS), .compressed.ply, .sog or a SOG folder, .spz, .glb, .splat; or a folder that
            `distill` or `ingest` wrote.

    Returns:
        The scene: linear scales, logit opacities, means relative to `offset`.

    Raises:
        InputError: the file is absent, broken, truncated, not a scene, or has no finite row; the message
            names the file and what is wrong.

    >>> import tempfile
    >>> from g2ard.scene.splats import Splats
    >>> path = Path(tempfile.mkdtemp()) / "two.ply"
    >>> write_splats(path, Splats.create([[0, 0, 0], [1, 0, 0]], scales=[[1, 1, 1], [1, 2, 3]]))
    >>> read_splats(path).scales.round(5).tolist()
    [[1.0, 1.0, 1.0], [1.0, 2.0, 3.0]]
    """
    return read_scene(path).splats


def read_scene(path: str | Path) -> Scene:
    """Read a Gaussian scene and what was noticed on the way: rows dropped, values clamped, extra properties.

    Args:
        path: as for `read_splats`.

    Returns:
        A `Scene` of splats and notes.

    Raises:
        InputError: as for `read_splats`.
    """
    from importlib import import_module

    path, found = check_scene(path)
    return import_module(f"g2ard.io.{found}").read(path)


def open_stream(path: str | Path | Sequence[str | Path]) -> SceneStream:
    """Open a scene, or several as one, to be read block by block.

    Args:
        path: a scene in any format that `read_scene` reads, or several. A .ply, .compressed.ply or .splat is
            held a block at a time, a SOG a chunk at a time, tiles one at a time, other formats as a whole.
            Several scenes get the offset of the first and the highest of their SH degrees.

    Raises:
        InputError: nothing is there, or its header is broken.
    """
    from importlib import import_module

    from g2ard.errors import InputError
    from g2ard.io.stream import JoinedScenes, PartsStream, file_identity

    if not isinstance(path, str | Path):
        streams = [open_stream(part) for part in path]
        if not streams:
            raise InputError("no scene was given")
        return streams[0] if len(streams) == 1 else JoinedScenes(streams)
    path, found = check_scene(path)
    module = import_module(f"g2ard.io.{found}")
    if hasattr(module, "stream"):
        stream: SceneStream = module.stream(path)
        return stream
    scene: Scene = module.read(path)
    splats = scene.splats
    parts = [len(splats)], lambda _: splats, splats.sh_degree, splats.offset
    return PartsStream(path, *parts, file_identity([path]), scene.notes)


def check_scene(path: str | Path) -> tuple[Path, str]:
    """Refuse what `read_scene` would refuse for its kind, before any work; damage is found by reading.

    Returns:
        The scene's file or folder, and its format.

    Raises:
        InputError: nothing is there, or it is no Gaussian scene.
    """
    from g2ard.errors import InputError
    from g2ard.io.detect import KINDS, file_format, run_scene

    path = run_scene(path)
    found = file_format(path)
    if KINDS[found] != "splats":
        words = {
            "cloud_ply": "a point cloud (no f_dc, scale, rot)",
            "las": "a point cloud",
            "views": "g2ard's views",
        }
        what = words.get(found, found)
        is_cloud = KINDS[found] == "points"
        hint = "`g2ard lift` makes a scene of it" if is_cloud else "name the scene's own file"
        raise InputError(f"a Gaussian scene is needed, this is {what}", path=path, hint=hint)
    return path, found


def _named(path: str | Path, suffixes: tuple[str, ...], rule: str) -> Path:
    """`path`, if its name ends in one of `suffixes`."""
    from g2ard.errors import OutputError

    path = Path(path)
    if path.suffix.lower() not in suffixes:
        raise OutputError(rule, path=path)
    return path


def check_scene_output(path: str | Path, overwrite: bool = False) -> Path:
    """As `check_output`, for a scene: its format must be one that `write_splats` knows.

    Raises:
        OutputError: as `write_splats` would, before the work rather than after it.
    """
    from g2ard.io.scene_formats import scene_format

    if scene_format(path).function == "write_folder":
        check_output(Path(path).parent, overwrite, folder=True)
        return Path(path)
    return check_output(path, overwrite)


def check_views_output(path: str | Path, overwrite: bool = False) -> Path:
    """As `check_output`, for views: their format must be one that `write_views` knows.

    Raises:
        OutputError: as `write_views` would, before the work rather than after it.
    """
    return check_output(_named(path, (".json",), "views are written as .json"), overwrite)


def write_splats(path: str | Path, splats: Splats, *, overwrite: bool = False, **options: Any) -> None:
    """Write a Gaussian scene, whole or not at all.

    Args:
        path: .ply (3DGS), .compressed.ply, .sog, .spz, .glb (KHR_gaussian_splatting) or .splat, in any case;
            NAME/meta.json for a SOG folder. What each holds: `docs/formats.md`.
        splats: the scene.
        overwrite: whether an existing file may be replaced.
        **options: of the format; `normals=True` adds nx ny nz to a .ply, `spz_version=4` writes that version
            of .spz rather than 3.

    Raises:
        OutputError: the file exists, its folder is absent or not writable, or the extension is no format that
            g2ard writes, or has no such option.
        InputError: the scene is empty, has a value that is not finite, or one that the format cannot hold.
        MissingDependencyError: .spz of version 4 before Python 3.14 without `pip install backports.zstd`.
    """
    from importlib import import_module

    from g2ard.io.scene_formats import check_options

    found = check_options(path, options)
    writer = getattr(import_module(f"g2ard.io.{found.module}"), found.function)
    writer(Path(path), splats, overwrite=overwrite, **options)


def read_points(path: str | Path) -> Points:
    """Read a coloured cloud; `read_cloud` also says what was noticed.

    Args:
        path: .ply with x y z red green blue, .las, .laz, COLMAP's points3D.bin or .txt, or a COLMAP folder.

    Returns:
        Positions in float64, world units; colours in [0, 1].

    Raises:
        InputError: the file is absent, broken, has no colour, or no finite point.
        MissingDependencyError: .las or .laz without `pip install g2ard[las]`.
    """
    return read_cloud(path).points


def read_cloud(path: str | Path) -> Cloud:
    """Read a coloured cloud and what was noticed on the way.

    Args:
        path: as for `read_points`.

    Returns:
        A `Cloud` of points and notes.

    Raises:
        InputError: as for `read_points`.
        MissingDependencyError: as for `read_points`.
    """
    path, module = _cloud_reader(path)
    cloud: Cloud = module.read(path)
    return cloud


def _cloud_reader(path: str | Path) -> tuple[Path, ModuleType]:
    """Return the path of a cloud and the module that reads it."""
    from importlib import import_module

    from g2ard.errors import InputError
    from g2ard.io.detect import file_format

    path, found = Path(path), file_format(path)
    modules = {"cloud_ply": "cloud_ply", "las": "las", "points3d": "points3d", "colmap": "points3d"}
    if found not in modules:
        scene = kind(path) == "splats"
        what = "a Gaussian scene" if scene else found
        hint = "it is ready for `simplify` and `distill`" if scene else "name the cloud's own file"
        raise InputError(f"a coloured point cloud is needed, this is {what}", path=path, hint=hint)
    return path, import_module(f"g2ard.io.{modules[found]}")


def open_point_stream(path: str | Path | Sequence[str | Path]) -> PointStream:
    """Open a coloured cloud, or several as one, to be read block by block.

    Args:
        path: a cloud in any format that `read_cloud` reads, or several. A .ply, .las or .laz is held a block
            at a time, other formats as a whole. Several clouds get the offset of the first.

    Raises:
        InputError: nothing is there, or its header is broken.
        MissingDependencyError: .las or .laz without `pip install g2ard[las]`.
    """
    from g2ard.errors import InputError
    from g2ard.io.point_stream import JoinedClouds, WholeCloud

    if not isinstance(path, str | Path):
        streams = [open_point_stream(part) for part in path]
        if not streams:
            raise InputError("no cloud was given")
        return streams[0] if len(streams) == 1 else JoinedClouds(streams)
    path, module = _cloud_reader(path)
    if hasattr(module, "stream"):
        stream: PointStream = module.stream(path)
        return stream
    return WholeCloud(path, module.read(path))


def write_points(path: str | Path, points: Points, *, overwrite: bool = False) -> None:
    """Write a coloured cloud as .ply (float64 positions, 8-bit colours), whole or not at all.

    Args:
        path: the .ply to write.
        points: the cloud.
        overwrite: whether an existing file may be replaced.

    Raises:
        OutputError: it exists, cannot be written, or is not a .ply.
        InputError: the cloud is empty or has a value that is not finite.
    """
    from g2ard.errors import OutputError
    from g2ard.io import cloud_ply

    path = Path(path)
    if path.suffix.lower() != ".ply":
        raise OutputError("clouds are written as .ply", path=path)
    cloud_ply.write(path, points, overwrite=overwrite)


def read_views(path: str | Path, *, images: str | Path | None = None, split: str = "all") -> Cameras:
    """Read views; `read_view_set` also says what was noticed, and per view its split and weight.

    Args:
        path: a COLMAP folder (or its images_4), a transforms.json or its folder, a Cambridge Landmarks
            scene, or a .json that g2ard wrote.
        images: the folder of the photos, where they are not where the file says.
        split: "train", "test", or "all"; see `g2ard.scene.splits.split_mask`.

    Returns:
        The views in OpenCV axes, COLMAP's sorted by name, others in file order. Views whose photo is
        missing are left out, unless none has one.

    Raises:
        InputError: the file is absent, broken or holds no views, or the split has none.
    """
    return read_view_set(path, images=images, split=split).cameras


def read_view_set(
    path: str | Path,
    *,
    images: str | Path | None = None,
    split: str = "all",
    unpictured: bool = False,
) -> ViewSet:
    """Read views and what their file says beside the cameras.

    Args:
        path: as for `read_views`.
        images: as for `read_views`.
        split: as for `read_views`.
        unpictured: keep views without a photo beside those with one; else they are left out, and counted.

    Returns:
        A `ViewSet` of cameras, notes, splits and weights.

    Raises:
        InputError: as for `read_views`.
    """
    from importlib import import_module

    from g2ard.errors import InputError
    from g2ard.io.detect import KINDS, file_format, run_views
    from g2ard.io.photos import pictured
    from g2ard.scene.splits import split_mask

    path = run_views(path)
    found = file_format(path)
    if KINDS[found] != "views":
        what = "a Gaussian scene" if KINDS[found] == "splats" else "a cloud"
        raise InputError(
            f"views are needed (a COLMAP folder, transforms.json, g2ard's .json), this is {what}", path=path
        )
    if images is not None and not Path(images).is_dir():
        raise InputError(f"{images}: no such folder of photos")
    try:
        views = import_module(f"g2ard.io.{found}").read(path, Path(images) if images else None)
    except OSError as error:  # a photo's name that no file system takes, a folder that may not be read
        raise InputError(error.strerror or str(error), path=path) from error
    views = views if unpictured else pictured(views)
    return views.take(split_mask(path, views.cameras.names, split, stated=views.splits))


def write_views(
    path: str | Path,
    cameras: Cameras,
    *,
    splits: Sequence[str | None] = (),
    weights: ArrayLike | None = None,
    overwrite: bool = False,
) -> None:
    """Write views as g2ard's own .json, which `read_views` gives back bit by bit.

    Args:
        path: the .json to write; photos are named relative to it.
        cameras: C views.
        splits: per view "train", "test" or None; () for none.
        weights: (C,) how often each view should be drawn, NaN where a view states none; None for none.
        overwrite: whether an existing file may be replaced.

    Raises:
        OutputError: it exists, cannot be written, or is not a .json.
        InputError: no views, or splits or weights of another length.
    """
    from g2ard.io import views

    path = Path(path)
    _named(path, (".json",), "views are written as .json")
    views.write(path, cameras, splits=splits, weights=weights, overwrite=overwrite)
