"""`g2ard convert`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from g2ard import io
from g2ard.cli.frame import Run, command
from g2ard.cli.options import ShDegreeOption, numbers
from g2ard.config.choices import Axes, PlyLayout
from g2ard.errors import InputError, OutputError
from g2ard.io.scene_formats import FORMATS, check_options, scene_format, written_bytes

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from g2ard.scene.splats import Splats


@command("convert", example="g2ard convert room.ply tree.spz --box -2,-2,-2,2,2,2 both.sog", scenes=True)
def convert(
    run: Run,
    scenes: Annotated[
        list[Path],
        typer.Argument(
            metavar="SCENE… OUT",
            help="Scenes to read (several are merged), then the output unless -o is given.",
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="OUT",
            help="Output: .ply, .compressed.ply, .sog, .spz, .glb, .splat, .usda, .usdc or NAME/meta.json; "
            ".csv for a table of attributes.",
        ),
    ] = None,
    box: Annotated[
        str | None,
        typer.Option(metavar="X,Y,Z,X,Y,Z", help="Keep Gaussians between two corners, scene units."),
    ] = None,
    sphere: Annotated[
        str | None, typer.Option(metavar="X,Y,Z,R", help="Keep Gaussians within R of a point.")
    ] = None,
    invert: Annotated[
        bool, typer.Option("--invert", help="Keep what --box and --sphere would drop.")
    ] = False,
    where: Annotated[
        str | None,
        typer.Option(
            metavar="CONDITION",
            help="Keep Gaussians for which this holds, such as 'opacity > 0.05 and scale < 2'. Opacity, red, "
            "green and blue are 0 to 1; x, y, z, scale (the largest σ) and thickness (the smallest) are in "
            "scene units.",
        ),
    ] = None,
    transform: Annotated[
        str | None,
        typer.Option(
            metavar="FILE.json|NUMBERS",
            help="Then apply a 4×4 matrix (row-major) of uniform scale, rotation and translation.",
        ),
    ] = None,
    scale: Annotated[
        float | None, typer.Option(min=1e-9, help="Then scale about the origin by this factor.")
    ] = None,
    rotate: Annotated[
        str | None,
        typer.Option(metavar="X,Y,Z", help="Then rotate about the x, y and z axes in turn, degrees."),
    ] = None,
    translate: Annotated[
        str | None, typer.Option(metavar="X,Y,Z", help="Then move by this, scene units.")
    ] = None,
    recentre: Annotated[bool, typer.Option("--recentre", help="Drop the offset to map coordinates.")] = False,
    from_axes: Annotated[
        Axes | None,
        typer.Option(
            case_sensitive=False,
            metavar="NAME",
            help="Axes of the files' coordinates if not those of their format, such as RDF for .spz of "
            "splat-transform.",
        ),
    ] = None,
    to_axes: Annotated[
        Axes | None,
        typer.Option(
            case_sensitive=False,
            metavar="NAME",
            help="Store coordinates in these axes, such as RFU (right, forward, up); scenes are RDF.",
        ),
    ] = None,
    sh_degree: ShDegreeOption = None,
    layout: Annotated[
        PlyLayout | None,
        typer.Option(
            help="Write the .ply in INRIA's layout: normals and SH degree 3, 248 bytes per Gaussian."
        ),
    ] = None,
    spz_version: Annotated[
        int | None, typer.Option(min=2, max=4, help="Version of .spz files; 3 by default, 4 is smaller.")
    ] = None,
    compress: Annotated[
        Literal["spz"] | None, typer.Option(help="Write an SPZ inside of a .glb, for CesiumJS.")
    ] = None,
) -> None:
    """Convert scenes to another format or other axes, and merge, crop or move them."""
    import numpy as np

    from g2ard.io import table
    from g2ard.scene.attributes import Condition
    from g2ard.scene.transform import in_box, in_sphere, join, moving, with_axes
    from g2ard.scene.transform import transform as moved

    scenes, output = _parted(run, scenes, output)
    given = {"spz_version": spz_version, "compress": compress, "layout": layout}
    options: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    if invert and box is None and sphere is None:
        raise typer.BadParameter("--invert goes with --box or --sphere")
    if layout is not None and sh_degree not in (None, 3):
        raise typer.BadParameter("--layout inria has SH degree 3; leave --sh-degree out")
    condition = None
    if where is not None:
        with run.usage():
            condition = Condition(where)
    corners = None if box is None else numbers("--box", box, 6)
    ball = None if sphere is None else numbers("--sphere", sphere, 4)
    turn = None if rotate is None else numbers("--rotate", rotate, 3)
    shift = None if translate is None else numbers("--translate", translate, 3)
    matrix = None if transform is None else np.array(_matrix(transform))
    if any(given is not None for given in (scale, turn, shift)):
        matrix = moving(scale or 1, turn or (0, 0, 0), shift or (0, 0, 0)) @ (
            np.eye(4) if matrix is None else matrix
        )
    as_table = output.suffix.lower() == ".csv"
    _check_output(run, output, options)
    change = None if to_axes is None else _change_of_axes(output, to_axes, options)
    splats = join([_loaded(run, path, from_axes) for path in scenes])
    read = len(splats)
    kept_rows = np.ones(read, bool)
    if corners is not None:
        kept_rows &= in_box(splats, corners[:3], corners[3:])
    if ball is not None:
        kept_rows &= in_sphere(splats, ball[:3], ball[3])
    kept_rows ^= invert
    if condition is not None:
        kept_rows &= condition.of(splats)
    if not kept_rows.all():
        splats = splats.take(kept_rows)
    _check_left(splats, read)
    if matrix is not None:
        splats = moved(splats, matrix)
    if recentre:
        splats = replace(splats, offset=np.zeros(3))
    if sh_degree is not None:
        splats = splats.with_sh_degree(sh_degree)
    if change is not None:
        splats = with_axes(splats, change)
    if as_table:
        run.begin("write")
        table.write(output, splats, overwrite=run.overwrite)
    else:
        run.write(output, splats, compare=True, **options)
    size = written_bytes(output)
    kept = f"{len(splats):,}" if len(splats) == read else f"{len(splats):,} of {read:,}"
    what = "Gaussian" if kept == "1" else "Gaussians"
    run.say(f"{output}: {kept} {what}, {size / 1e6:.2f} MB, {size / len(splats):.1f} bytes each")
    run.result({"output": str(output), "input_count": read, "output_count": len(splats), "bytes": size})


def _parted(run: Run, paths: list[Path], output: Path | None) -> tuple[list[Path], Path]:
    """Return the scenes and the output, which is the last path unless -o is given."""
    if output is not None:
        return paths, output
    *scenes, output = paths
    if not scenes:
        raise typer.BadParameter("give an input and an output: SCENE… OUT, or SCENE… -o OUT")
    run.reads(scenes, output)
    return scenes, output


def _check_output(run: Run, output: Path, options: dict[str, Any]) -> None:
    """Check the output and the options of its format."""
    if output.suffix.lower() != ".csv":
        check_options(output, options)
        io.check_scene_output(output, run.overwrite)
        return
    if options:
        raise OutputError(f".csv has no option {next(iter(options))!r}", path=output)
    io.check_output(output, run.overwrite)


def _change_of_axes(output: Path, axes: Axes, options: dict[str, Any]) -> NDArray[np.float64] | None:
    """Return the change of axes before writing, None if the format's writer makes it."""
    from g2ard.scene.transform import change_of_axes

    found = None if output.suffix.lower() == ".csv" else scene_format(output)
    if found is None or found.axes is None:
        return change_of_axes("RDF", axes)
    if axes == found.axes:
        return None
    if "axes" not in found.options:
        raise InputError(
            f"{found.suffix} has {found.axes} axes by definition",
            path=output,
            hint="write .spz (version 4), which can name others, or .ply, .sog or .splat, which name none",
        )
    options["axes"] = axes
    if axes != "RDF":
        options.setdefault("spz_version", 4)
    return None


def _loaded(run: Run, path: Path, axes: Axes | None) -> Splats:
    """Read a scene whose file may store other axes than its format defines."""
    splats = run.load(path)
    if axes is None:
        return splats
    from g2ard.io import spz
    from g2ard.scene.transform import change_of_axes, with_axes

    path, name = io.check_scene(path)
    if name == "spz" and spz.names_axes(path):
        raise InputError("names its axes, which are followed", path=path, hint="leave {from_axes} out")
    defined = next((known.axes for known in FORMATS.values() if known.module == name and known.axes), "RDF")
    if axes == defined:
        return splats
    return with_axes(splats, change_of_axes(axes, "RDF") @ change_of_axes("RDF", defined))


def _check_left(splats: Splats, read: int) -> None:
    if not len(splats):
        raise InputError(
            f"--box, --sphere and --where keep none of {read:,} Gaussians; `g2ard info` shows the scene's "
            "extent, opacities and scales"
        )


def _matrix(given: str) -> list[list[float]]:
    """Read 16 numbers, or a JSON file with them, flat or in rows, bare or under "transform" or "matrix"."""
    path = Path(given)
    if path.suffix.lower() != ".json":
        flat = numbers("--transform", given, 16)
        return [flat[row : row + 4] for row in (0, 4, 8, 12)]
    from g2ard.io.jsonfile import read_any_json

    content = read_any_json(path)
    if isinstance(content, dict):
        content = content.get("transform", content.get("matrix"))
    try:
        rows = [content[at : at + 4] for at in (0, 4, 8, 12)] if len(content) == 16 else content
        matrix = [[float(value) for value in row] for row in rows]
    except (TypeError, ValueError) as error:
        raise InputError(f"expected a matrix of 4×4 numbers ({error})", path=path) from error
    if [len(row) for row in matrix] != [4] * 4:
        raise InputError("expected a matrix of 4×4 numbers", path=path)
    return matrix
