"""`g2ard convert`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal, cast

import typer

from g2ard.cli.command import command
from g2ard.cli.fields import ShDegreeOption
from g2ard.cli.options import numbers
from g2ard.cli.run import Run
from g2ard.cli.run_result import say_weight
from g2ard.config.choices import NAMED_AXES, Axes, AxesName, Named, PlyLayout, PointColor
from g2ard.errors import InputError, OutputError
from g2ard.io import Source
from g2ard.io.scene_formats import WRITTEN, SceneFormat, check_options, scene_format, written_bytes


@command(
    "convert",
    example="g2ard convert room.ply tree.spz --box -2,-2,-2,2,2,2 both.sog",
    scenes=True,
    without=("seed", "threads", "device"),
)
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
            help=f"Output: {WRITTEN} or NAME/meta.json; .csv for a table of attributes.",
        ),
    ] = None,
    box: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z,X,Y,Z", help="Keep Gaussians between two corners, scene units."
        ),
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
            help="Keep Gaussians for which this holds, such as 'opacity > 0.05 and largest_scale < 2'. "
            "Opacity, red, green and blue are 0 to 1; x, y, z, smallest_scale and largest_scale (standard "
            "deviations) are in scene units; elongation is the largest over the middle scale. Of "
            "point clouds, names are x, y, z, red, green, blue and the columns: 'classification == 2'.",
        ),
    ] = None,
    color: Annotated[
        PointColor | None,
        typer.Option(help="Colour points of clouds by their intensity, or by their class."),
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
        typer.Option(
            metavar="X,Y,Z", help="Then rotate about the x, y and z axes in turn, degrees."
        ),
    ] = None,
    translate: Annotated[
        str | None, typer.Option(metavar="X,Y,Z", help="Then move by this, scene units.")
    ] = None,
    recentre: Annotated[
        bool, typer.Option("--recentre", help="Drop the offset to map coordinates.")
    ] = False,
    from_axes: Annotated[
        AxesName | None,
        typer.Option(
            case_sensitive=False,
            metavar="NAME",
            help="Axes of the files' coordinates if not those of their format, such as RDF for .spz of "
            "splat-transform.",
        ),
    ] = None,
    to_axes: Annotated[
        AxesName | None,
        typer.Option(
            case_sensitive=False,
            metavar="NAME",
            help="Store coordinates y-up, z-up, or in axes such as RFU (right, forward, up); scenes are RDF.",
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
        int | None,
        typer.Option(min=2, max=4, help="Version of .spz files; 3 by default, 4 is smaller."),
    ] = None,
    compress: Annotated[
        Literal["spz"] | None, typer.Option(help="Write an SPZ inside of a .glb, for CesiumJS.")
    ] = None,
) -> None:
    """Convert scenes to another format or other axes, and merge, crop or move them.

    Point clouds are cropped and then lifted, as by `g2ard lift`.
    """
    from g2ard.io.scenes import write_table
    from g2ard.jobs.chosen_points import PointChoice
    from g2ard.jobs.convert import Changes, open_scenes, read_merged

    scenes, output = _part_paths(run, scenes, output)
    given = {"spz_version": spz_version, "compress": compress, "layout": layout}
    options: Named = {name: value for name, value in given.items() if value is not None}
    if layout is not None and sh_degree not in (None, 3):
        raise typer.BadParameter("--layout inria has SH degree 3; leave --sh-degree out")
    matrix = None if transform is None else _read_matrix(transform)
    opened = open_scenes(scenes, run.render_model)
    points = None
    corners = None if box is None else numbers("--box", box, 6)
    with run.usage():
        if isinstance(opened, Source):
            points = PointChoice(None if invert else corners, where, color)
            where = None
        elif color is not None:
            points = PointChoice(color=color)
        changes = Changes(
            box=corners,
            sphere=None if sphere is None else numbers("--sphere", sphere, 4),
            invert=invert,
            where=where,
            transform=matrix,
            scale=scale,
            rotate=None if rotate is None else numbers("--rotate", rotate, 3),
            translate=None if translate is None else numbers("--translate", translate, 3),
            recentre=recentre,
            to_axes=to_axes,
            sh_degree=sh_degree,
        )
    as_table = output.suffix.lower() == ".csv"
    _check_output(run, output, options)
    if to_axes is not None and not as_table and (defined := scene_format(output)).axes is not None:
        changes = replace(changes, to_axes=None)  # the format's writer makes the change
        options = _add_axes(
            options, defined, output, NAMED_AXES.get(to_axes) or cast("Axes", to_axes)
        )
    run.begin("read")
    whole = read_merged(opened, points, from_axes, **run.callbacks)
    splats = changes.apply(whole)
    read = len(whole)
    if as_table:
        run.begin("write")
        write_table(output, splats, overwrite=run.overwrite)
    else:
        run.write(output, splats, compare=True, **options)
    if isinstance(opened, Source) and not as_table:
        say_weight(run, opened.path, output, splats)
    size = written_bytes(output)
    kept = f"{len(splats):,}" if len(splats) == read else f"{len(splats):,} of {read:,}"
    what = "Gaussian" if kept == "1" else "Gaussians"
    run.say(f"{output}: {kept} {what}, {size / 1e6:.2f} MB, {size / len(splats):.1f} bytes each")
    run.result(
        {"output": str(output), "input_count": read, "output_count": len(splats), "bytes": size}
    )


def _part_paths(run: Run, paths: list[Path], output: Path | None) -> tuple[list[Path], Path]:
    """Return the scenes and the output, which is the last path unless -o is given."""
    if output is not None:
        return paths, output
    *scenes, output = paths
    if not scenes:
        raise typer.BadParameter("give an input and an output: SCENE… OUT, or SCENE… -o OUT")
    run.reads(scenes, output)
    return scenes, output


def _check_output(run: Run, output: Path, options: Named) -> None:
    """Check the output and the options of its format."""
    if output.suffix.lower() != ".csv":
        check_options(output, options)
        run.claim_scene("--output", output)
        return
    if options:
        raise OutputError(f".csv has no option {next(iter(options))!r}", path=output)
    run.claim_file("--output", output)


def _add_axes(options: Named, output_format: SceneFormat, output: Path, axes: Axes) -> Named:
    """Return the writer's options, with other axes than those that its format defines."""
    if axes == output_format.axes:
        return options
    if "axes" not in output_format.options:
        raise InputError(
            f"{output_format.suffix} has {output_format.axes} axes by definition",
            path=output,
            hint="write a .ply, which has none",
        )
    return {**({} if axes == "RDF" else {"spz_version": 4}), **options, "axes": axes}


def _read_matrix(given: str) -> list[list[float]]:
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
