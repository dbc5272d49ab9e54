"""`g2ard info`."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from g2ard.cli import options as opt
from g2ard.cli.command import command, describe_error
from g2ard.cli.run import Run
from g2ard.config.choices import Named
from g2ard.errors import InputError
from g2ard.io.detect import run_scene
from g2ard.progress import plural

if TYPE_CHECKING:
    from g2ard.io.types import ViewFiles
    from g2ard.scene.splats import Splats

_NO_DRIVER = "no graphics driver that speaks Vulkan, Metal or DirectX 12 was found"


@command("info", example="g2ard info scene.ply --json -", without=("seed", "threads", "device"))
def info(
    run: Run,
    paths: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="SCENE|CLOUD|VIEWS|RUN...",
            help="Scenes, coloured point clouds, views, or folders of `distill` runs.",
        ),
    ] = None,
    images: opt.ImagesOption = None,
    devices: Annotated[
        bool, typer.Option("--devices", help="List GPUs and which one --device would use.")
    ] = False,
) -> None:
    """Show what a file holds: counts, extents, SH degree, opacities, overdraw, invalid values.

    Files that cannot be read are reported and skipped; the exit status is then 1.
    """
    if bool(paths) == devices:
        raise typer.BadParameter("give a file, or --devices")
    if not paths:
        _list_devices(run)
        return
    from g2ard.io.types import ViewFiles

    found = []
    failed = []
    for path in paths:
        run.begin("read")
        try:
            figures, rows = _describe(ViewFiles(path, images))
            if images is not None and figures.get("kind") != "views":
                raise InputError("holds no views", path=path, hint="leave {images} out")
        except (InputError, OSError) as error:
            if len(paths) == 1:
                raise
            run.console.error(describe_error(error, run.flags))
            failed.append(str(path))
            continue
        _show(run, str(path), rows)
        found.append(figures)
    run.result(found[0] if len(paths) == 1 else {"files": found, "failed": failed})
    if failed:
        raise typer.Exit(1)


def _describe(given: ViewFiles) -> tuple[Named, list[list[str]]]:
    """Return a file's figures, with scores for a run, and the table rows that show them."""
    from g2ard.cli.run_folder import describe_stopped_run
    from g2ard.io.describe import describe
    from g2ard.io.jsonfile import read_json
    from g2ard.report.labels import RESULT

    path = given.path
    if (stopped := describe_stopped_run(path)) is not None:
        return stopped, _list_stopped(path, stopped)
    scene = run_scene(path)
    if scene == path:
        figures = describe(given, _measure_overdraw)
        if figures["kind"] == "views":
            from g2ard.jobs.start_points import find_sparse_file, read_sparse_points

            said: list[str] = []
            points = read_sparse_points(find_sparse_file(path), said.append)
            figures["sparse_points"] = 0 if points is None else len(points)
            for text in said:
                note = {"code": "no_points", "count": 1, "text": text.removeprefix("warning: ")}
                figures["notes"].append(note)
        return figures, _list_figures(figures)
    figures = describe(scene, _measure_overdraw)
    report = read_json(path / "report.json")
    against = report["against"]
    photos = report.get("photos")
    one = "point" if report.get("lifted") else "Gaussian"
    rows = [
        ["made from", plural(photos, "photo") if photos else plural(report["input_count"], one)]
    ]
    rows.append(["Gaussians per pixel, held-out", f"{report['overdraw']:.1f}"])
    words = {"simplified": "start" if photos else "simplified", "recovered": RESULT}
    size = f", {report['size']}" if "size" in report else ""
    scores = {}
    for name, found in report["scores"].items():
        scores[name] = {"psnr": found["psnr"], "ssim": found["ssim"]}
        score = f"{found['psnr']:.2f} dB, SSIM {found['ssim']:.4f}"
        rows.append([words[name], f"{score} against {against}{size}"])
    made_from = {"input_count": report["input_count"], "against": against}
    figures["run"] = {**made_from, "scores": scores, "overdraw": report["overdraw"]}
    return figures, [*_list_figures(figures), *rows]


def _measure_overdraw(splats: Splats) -> Named:
    from g2ard.jobs.close_up import close_up

    found = close_up(splats)
    return {} if found is None else {"close_overdraw": found}


def _list_stopped(path: Path, stopped: Named) -> list[list[str]]:
    rows = [["stopped run", ", ".join(stopped["kept"]) + " kept"]]
    if "config" in stopped:
        rows.append(["Gaussians", f"{stopped['input_count']:,} → {stopped['output_count']:,}"])
        scene, views = (stopped["config"].get(name) for name in ("scene", "views"))
        rows.append(["of", str(scene or views)])
    rows.append(["to continue", f"run the same command with --resume (-o {path})"])
    return rows


def _list_devices(run: Run) -> None:
    from g2ard.system import devices

    found = devices.adapters()
    real = next((a.name for a in found or () if a.kind != "cpu"), None)
    used = {"gpu": found[0].name if found else None, "auto": real}
    rows: list[list[str]] = []
    for a in found or ():
        rows += [
            [a.name, f"{a.kind}, {a.backend}, {a.driver}"],
            [
                "",
                f"buffers to {_format_size(a.max_buffer)}, bound {_format_size(a.max_binding)} at a time",
            ],
        ]
    if not found:
        why = "this build has no GPU kernels" if found is None else _NO_DRIVER
        rows.append(["none", why])
    rows.append(["--device cpu", "always available"])
    rows.append(["--device gpu", used["gpu"] or "the CPU"])
    probed = f"{real} for scenes of at least 200,000 rows, if a test run is correct and faster than the CPU"
    rows.append(["--device auto", probed if real else "the CPU"])
    _show(run, "What --device takes", rows)
    run.result({"adapters": [asdict(a) for a in found or ()], "used": {**used, "cpu": "CPU"}})


def _show(run: Run, title: str, rows: list[list[str]]) -> None:
    run.console.table(title, ["", ""], rows, stdout=run.json != "-")


def _list_figures(figures: Named) -> list[list[str]]:
    """Return the (label, text) rows of a table of what `describe` found; keys depend on the kind of file."""
    unit = {"splats": "Gaussians", "points": "points", "views": "views"}[figures["kind"]]
    rows = [
        ["format", figures["format"]],
        [unit, f"{figures['count']:,}"],
        ["size", _format_size(figures["bytes"])],
    ]
    if figures["kind"] == "splats":
        rows.append(["bytes per Gaussian", f"{figures['bytes'] / figures['count']:.1f}"])
        rows.append(["SH degree", str(figures["sh_degree"])])
        rows.append(["render model", figures["render_model"]])
    if any(figures.get("offset", ())):
        rows.append(["offset", _format_vector(figures["offset"], 3)])
    rows += _list_known(
        figures, {"map_system": ("map system", str), "metres_per_unit": ("unit", _name_unit)}
    )
    extent = figures["extent"]
    longest = max(high - low for low, high in zip(extent["min"], extent["max"], strict=True))
    digits = max(0, 3 - math.floor(math.log10(longest or 1)))
    low, high, near, far = (
        _format_vector(extent[name], digits) for name in ("min", "max", "robust_min", "robust_max")
    )
    rows += [["extent", f"{low} to {high}"], ["98 % of it", f"{near} to {far}"]]
    spreads = ("opacity", "largest_scale", "smallest_scale", "elongation")
    counts = ("photos", "distorted", "sparse_points")
    formats: _Formats = {
        **{key: (key.replace("_", " "), _describe_spread) for key in spreads},
        "fov_degrees": ("field of view", partial(_describe_spread, unit="°")),
        "close_overdraw": (
            "Gaussians per pixel, near",
            "{0[mean]:.0f}, at worst {0[worst]:.0f}".format,
        ),
        "color": ("mean colour", lambda color: _format_vector(color["mean"], 2)),
        **{key: (key.replace("_", " "), "{:,}".format) for key in counts},
    }
    rows += _list_known(figures, formats)
    for key in ("sizes", "splits", "odd"):
        rows += [
            [name.replace("_", " "), f"{count:,}"] for name, count in figures.get(key, {}).items()
        ]
    return rows + [["note", note["text"]] for note in figures["notes"]]


_Formats = dict[str, tuple[str, Callable[[Any], str]]]
"""Figure → its label, and what formats it."""


def _list_known(figures: Named, formats: _Formats) -> list[list[str]]:
    """Return the rows of the figures that are known, in the order of `formats`."""
    return [
        [label, write(figures[key])] for key, (label, write) in formats.items() if key in figures
    ]


def _describe_spread(quantiles: dict[str, float], unit: str = "") -> str:
    """Describe a distribution by its quantiles.

    >>> _describe_spread({"0": 0.001, "1": 0.01, "25": 0.1, "50": 0.25, "75": 0.5, "99": 0.9, "100": 1.0})
    'median 0.25, half from 0.1 to 0.5, all from 0.001 to 1'
    >>> _describe_spread(dict.fromkeys(("0", "1", "25", "50", "75", "99", "100"), 42.87), "°")
    '42.9°'
    """
    least, lower, median, upper, most = (
        f"{quantiles[at]:.3g}{unit}" for at in ("0", "25", "50", "75", "100")
    )
    if least == most:
        return median
    return f"median {median}, half from {lower} to {upper}, all from {least} to {most}"


def _name_unit(metres: float | None) -> str:
    """Name a unit of length.

    >>> _name_unit(1200 / 3937), _name_unit(None)
    ('US survey foot', 'not stated in the file')
    """
    if metres is None:
        return "not stated in the file"
    named = {1.0: "metre", 0.3048: "foot", 0.3048006: "US survey foot"}
    return named.get(round(metres, 7), f"{metres:g} m")


def _format_vector(values: list[float], digits: int) -> str:
    return "(" + ", ".join(f"{value:,.{digits}f}" for value in values) + ")"


def _format_size(count: int) -> str:
    return f"{count / 1e6:,.1f} MB" if count >= 1e5 else f"{count:,} bytes"
