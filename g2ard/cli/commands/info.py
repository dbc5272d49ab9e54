"""`g2ard info`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from g2ard.cli.frame import Run, command


@command("info", example="g2ard info scene.ply --json -")
def info(
    run: Run,
    path: Annotated[
        Path, typer.Argument(metavar="SCENE|CLOUD|VIEWS", help="A Gaussian scene, a coloured cloud or views.")
    ],
) -> None:
    """Show what is in a file: counts, extents, SH degree, opacities, scales, odd values."""
    from g2ard.io.describe import describe

    figures = describe(path)
    rows = _rows(figures)
    if run.json == "-":
        run.console.table(str(path), ["", ""], rows)
    elif not run.console.quiet:
        _print(str(path), rows)
    run.result(figures)


def _print(title: str, rows: list[list[str]]) -> None:
    """The table is this command's data, so it goes to stdout."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, title_justify="left", show_header=False)
    for row in rows:
        table.add_row(*row)
    Console().print(table, markup=False, highlight=False)


def _rows(figures: dict[str, Any]) -> list[list[str]]:
    unit = {"splats": "Gaussians", "points": "points", "views": "views"}[figures["kind"]]
    rows = [["format", figures["format"]], [unit, f"{figures['count']:,}"], ["size", _size(figures["bytes"])]]
    if figures["kind"] == "splats":
        rows.append(["bytes a Gaussian", f"{figures['bytes'] / figures['count']:.1f}"])
        rows.append(["SH degree", str(figures["sh_degree"])])
    if any(figures.get("offset", ())):
        rows.append(["offset", _vector(figures["offset"])])
    extent = figures["extent"]
    rows.append(["extent", f"{_vector(extent['min'])} … {_vector(extent['max'])}"])
    rows.append(["1 % to 99 %", f"{_vector(extent['robust_min'])} … {_vector(extent['robust_max'])}"])
    for key in ("opacity", "largest_scale", "smallest_scale", "elongation", "fov_degrees"):
        if key in figures:
            quantiles = figures[key]
            label = f"{key.replace('_', ' ')} ({' '.join(quantiles)} %)"
            rows.append([label, "  ".join(f"{value:.3g}" for value in quantiles.values())])
    if "color" in figures:
        rows.append(["mean colour", _vector(figures["color"]["mean"])])
    rows += [[key, f"{figures[key]:,}"] for key in ("photos", "distorted") if key in figures]
    for key in ("sizes", "splits", "odd"):
        rows += [[name.replace("_", " "), f"{count:,}"] for name, count in figures.get(key, {}).items()]
    return rows + [["noticed", note["text"]] for note in figures["notes"]]


def _vector(values: list[float]) -> str:
    return "(" + ", ".join(f"{value:,.7g}" for value in values) + ")"


def _size(count: int) -> str:
    return f"{count / 1e6:,.1f} MB" if count >= 1e5 else f"{count:,} bytes"
