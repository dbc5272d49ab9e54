"""Reading and writing Gaussian scenes and coloured point clouds of any format."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

from g2ard.config.checks import check_type, checks_arguments
from g2ard.errors import InputError, OutputError
from g2ard.io.atomic import atomic_output, check_output
from g2ard.io.paths import naming
from g2ard.io.scene_formats import Rounding, check_options, lost_in, scene_format
from g2ard.io.source import Source
from g2ard.progress import Progress, Say, silent

if TYPE_CHECKING:
    from collections.abc import Iterable

    from g2ard.config.choices import RenderModel
    from g2ard.io.types import Cloud, Note, Points
    from g2ard.scene.splats import HasSplats, Splats


@checks_arguments
def read_splats(path: str | Path, *, render_model: RenderModel | None = None) -> Splats:
    """Read a Gaussian scene.

    Args:
        path: a file or SOG folder of any format in `g2ard.io.detect.READERS`, or a folder written by
            `distill` or `ingest`.
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
    return Source(path, render_model).whole()


def read_back(path: str | Path, splats: Splats) -> Splats:
    """Read what was written of a scene, where the scene is even if the format cannot say so."""
    read = read_splats(path)
    writer = scene_format(path).writer()
    if hasattr(writer, "read_back"):
        read = writer.read_back(splats, read)
    return read


def check_scene_output(path: str | Path, overwrite: bool = False) -> Path:
    """Raise the `OutputError` that `write_splats` would raise, before any work."""
    if scene_format(path).function == "write_folder":
        check_output(Path(path).parent, overwrite, folder=True)
        return Path(path)
    return check_output(path, overwrite)


@checks_arguments
def write_splats(
    path: str | Path,
    splats: Splats | HasSplats,
    *,
    overwrite: bool = False,
    progress: Progress = silent,
    **options: Any,
) -> None:
    """Write a Gaussian scene atomically.

    Args:
        path: a file of a format in `g2ard.io.scene_formats.FORMATS`, or NAME/meta.json for a SOG folder.
        splats: the scene, or a result that holds one.
        overwrite: whether to replace an existing file.
        progress: called while a format that takes long is packed.
        **options: format options: `normals=True` adds nx ny nz to a .ply, and `layout="inria"` also pads it
            to SH degree 3; `spz_version=4` writes .spz version 4 instead of 3, and with it `axes="RFU"`
            stores right-forward-up instead of right-up-back; version 3 with `axes="RDF"` stores the
            coordinates of a .ply, as splat-transform and SuperSplat read .spz; `compress="spz"` writes an SPZ
            inside of a .glb.

    Warns:
        UserWarning: positions rounded by more than 1 % of a typical Gaussian's size, or at all if float64
            means far from the origin were moved to fit float32; an antialiased scene in a format that cannot
            say so (.glb, .splat, OpenUSD).

    Raises:
        OutputError: the file exists or cannot be written, or the extension or an option is unsupported.
        InputError: the scene is empty, has a non-finite value, or one that the format cannot store.
        MissingDependencyError: .spz of version 4 before Python 3.14 without backports.zstd.

    >>> import tempfile, g2ard
    >>> path = Path(tempfile.mkdtemp()) / "one.sog"
    >>> g2ard.save(path, g2ard.Splats.create([[0, 0, 0]], scales=[[1, 2, 3]]))
    >>> len(g2ard.load(path))
    1
    """
    from g2ard.scene.splats import scene_of

    notes = write_scene(
        path,
        scene_of(splats),
        overwrite=overwrite,
        progress=progress,
        **options,
    )
    tell(path, notes)


def write_scene(
    path: str | Path,
    splats: Splats,
    *,
    overwrite: bool = False,
    progress: Progress = silent,
    **options: Any,
) -> list[Note]:
    """Write a scene like `write_splats`, and return notes on what the file does not hold."""
    from g2ard.scene.splats import Splats

    check_type("splats", splats, Splats)
    output_format = check_options(path, options)
    check_scene_output(path, overwrite)
    writer = getattr(output_format.writer(), output_format.function)
    given: dict[str, Any] = {"overwrite": overwrite, **options}
    if output_format.tells:
        given["progress"] = progress
    with naming(path):
        error = writer(Path(path), splats, **given)
    moved = splats.narrowed().offset != splats.offset
    rounding = Rounding(far=bool(moved.any()))
    rounding.add(error, splats)
    return [*rounding.notes, *lost_in(path, splats, **options)]


def write_table(path: Path, splats: Splats, *, overwrite: bool = False) -> None:
    """Write a .csv, a header and a row per Gaussian: the columns of `g2ard.scene.attributes.columns`.

    Numbers have the digits that distinguish float32 values; positions with an offset those of float64.
    """
    import numpy as np

    from g2ard.io.sanitize import BLOCK
    from g2ard.scene.attributes import columns

    if not len(splats):
        raise InputError("not written: the scene has no Gaussians", path=path)
    with (
        atomic_output(path, overwrite) as temporary,
        temporary.open("w", encoding="ascii", newline="") as file,
    ):
        for at in range(0, len(splats), BLOCK):
            table = columns(splats.take(slice(at, at + BLOCK)))
            if at == 0:
                file.write(",".join(table) + "\r\n")
            far = splats.offset.any()
            digits = ["%.17g" if far and name in ("x", "y", "z") else "%.9g" for name in table]
            rows = np.column_stack([values.astype(float) for values in table.values()])
            np.savetxt(
                file,
                rows,
                fmt=digits,
                delimiter=",",
                newline="\r\n",
            )


def tell(path: str | Path, notes: Iterable[Note], say: Say | None = None) -> None:
    """Say what a written file does not hold, or warn of it if nobody listens.

    A public function calls this, so that warnings name its caller.
    """
    for note in notes:
        if say is None:
            warnings.warn(f"{path}: {note}", stacklevel=4)  # past `checks_arguments`
        else:
            say(f"note: {path}: {note}")


@checks_arguments
def read_points(path: str | Path) -> Points:
    """Read a coloured point cloud.

    Args:
        path: a file of any format in `g2ard.io.detect.READERS`, or a COLMAP folder.

    Returns:
        Positions in float64, world units; colours in [0, 1].

    Raises:
        InputError: the file is missing, damaged, has no colours, or no finite point.
        MissingDependencyError: .e57 without pye57.

    >>> import tempfile, g2ard
    >>> path = Path(tempfile.mkdtemp()) / "cloud.ply"
    >>> vertices = "property float x\\nproperty float y\\nproperty float z\\n"
    >>> colours = "property uchar red\\nproperty uchar green\\nproperty uchar blue\\nend_header\\n"
    >>> header = "ply\\nformat ascii 1.0\\nelement vertex 1\\n" + vertices + colours
    >>> _ = path.write_text(header + "1 2 3 255 0 51\\n")
    >>> points = g2ard.load_points(path)
    >>> points.positions.tolist(), points.colors.round(2).tolist()[0][:2]
    ([[1.0, 2.0, 3.0]], [1.0, 0.0])
    """
    return read_cloud(path).points


def read_cloud(path: str | Path, *, bare: bool = False) -> Cloud:
    """Read a coloured point cloud with notes on the file; a `bare` one may be black, without colours."""
    return Source(path).cloud(bare=bare).whole()


def write_points(
    path: str | Path,
    points: Points,
    *,
    overwrite: bool = False,
) -> None:
    """Write a coloured point cloud as .ply (float64 positions, 8-bit colours) atomically."""
    import g2ard.io.cloud_ply as cloud_ply

    path = Path(path)
    if path.suffix.lower() != ".ply":
        raise OutputError("point clouds are written as .ply", path=path)
    cloud_ply.write_blocks(path, len(points), [points], overwrite=overwrite)
