"""Pages and the preview picture of a distillation, also of one in tiles."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from g2ard.config.choices import BLACK, Colour
from g2ard.errors import InputError
from g2ard.progress import plural
from g2ard.rendering.metrics import psnr
from g2ard.rendering.renderer import Renderer
from g2ard.report.charts import Point, chart
from g2ard.report.page import Comparison, Page, Shown, legend
from g2ard.report.window import Crop
from g2ard.scene.images import contact_sheet, to_bytes, write_png
from g2ard.scene.splats import Splats
from g2ard.scene.targets import Targets

_VIEWS = 6
_STRETCHES = 25
"""Segments of the loss curve, averaged because views differ more than steps."""

_PREVIEWED = 3
"""Rows of the preview picture."""

_STAGES = ("simplified", "recovered")


def distill_report(
    path: Path,
    title: str,
    scenes: Sequence[tuple[str, Splats]],
    targets: Targets,
    report: dict[str, Any],
    background: Colour = BLACK,
    *,
    told: Sequence[str] = (),
    crops: Sequence[Crop] = (),
) -> None:
    """Write the HTML page of one run: error against time and count, the loss, and views in order of error.

    Views with crops come first.

    Args:
        path: output file.
        title: title of the page.
        scenes: (name, scene) of `simplified` and `recovered`, as `report["scores"]` names them.
        targets: held-out photos or teacher renders.
        report: what `g2ard distill` writes as report.json.
        background: RGB behind the scenes.
        told: summary lines that the command prints.
        crops: regions to magnify; by default the worst regions of each view.

    Raises:
        InputError: a crop names a view that is not among the targets.
    """
    check_crops(crops, targets.cameras.names)
    against = report["against"]
    page = Page(title, f"{plural(len(targets.cameras), 'held-out view')} against {against}")
    scores, seconds = report["scores"], report["seconds"]
    names = [name for name, _ in scenes]
    took = [seconds["simplify"], seconds["simplify"] + seconds["recover"]]
    page.html(legend(names))
    page.charts([*_error_charts(scenes, scores, took), *_loss_charts(report["rounds"])])
    apart = report.get("apart")
    near = ["PSNR near", "SSIM near"] if apart else []
    page.table(
        ["scene", "Gaussians", "MB as .ply", "PSNR", "SSIM", *near, "seconds"],
        [
            [
                name,
                f"{len(splats):,}",
                f"{splats.nbytes / 1e6:.2f}",
                f"{scores[name]['psnr']:.2f}",
                f"{scores[name]['ssim']:.4f}",
                *([f"{apart[name]['psnr']:.2f}", f"{apart[name]['ssim']:.4f}"] if apart else []),
                f"{spent:.1f}",
            ]
            for (name, splats), spent in zip(scenes, took, strict=True)
        ],
        set(),
    )
    page.paragraph(
        f"From {plural(report['input_count'], 'Gaussian')} "
        f"({report['bytes']['input'] / 1e6:.2f} MB as .ply). Regularisers: {report['preset']}."
    )
    if apart:
        count = len(apart[names[-1]]["views"])
        page.paragraph(
            f"Near: {plural(count, 'view')} of another kind, nearer to the scene, not used for training."
        )
    for line in told:
        page.paragraph(line)
    page.heading("Worst views first")
    last = names[-1]
    figures = [view["psnr"] for view in scores[last]["views"]]
    asked = [targets.cameras.names.index(crop.view) for crop in crops if crop.view is not None]
    worst = map(int, np.argsort(figures, kind="stable")[:_VIEWS])
    renderers = [(name, Renderer(splats, background=background)) for name, splats in reversed(scenes)]
    for view in dict.fromkeys([*asked, *worst]):
        name = targets.cameras.names[view]
        windows = [crop.window for crop in crops if crop.view in (None, name)]
        shown = []
        for name, renderer in renderers:
            image = renderer.image(targets.cameras[view])
            shown.append(Shown(name, to_bytes(image), f"{scores[name]['views'][view]['psnr']:.2f} dB"))
        page.comparison(Comparison(targets.cameras.names[view], to_bytes(targets[view]), shown, windows))
    page.write(path)


def check_crops(crops: Sequence[Crop], names: Sequence[str]) -> None:
    """Reject crops of views that are not scored.

    Raises:
        InputError: a crop names another view.
    """
    for crop in crops:
        if crop.view is not None and crop.view not in names:
            few = ", ".join(names[:4]) + (", …" if len(names) > 4 else "")
            raise InputError(
                f"expected one of the {plural(len(names), 'scored view')} ({few}), got {crop.view}",
                parameter="crop",
            )


def _error_charts(
    scenes: Sequence[tuple[str, Splats]], scores: dict[str, Any], took: Sequence[float]
) -> list[tuple[str, str]]:
    def points(xs: Sequence[float]) -> list[Point]:
        return [
            Point(x, scores[name]["psnr"], i, 0, f"{name}: {scores[name]['psnr']:.2f} dB", name)
            for i, ((name, _), x) in enumerate(zip(scenes, xs, strict=True))
        ]

    over_time = chart(
        points([max(t, 1e-3) for t in took]), x_label="seconds", y_label="PSNR, dB", log=True, front=True
    )
    over_count = chart(
        points([len(splats) for _, splats in scenes]), x_label="Gaussians", y_label="PSNR, dB", log=True
    )
    return [("Error against time; dashed: the Pareto front", over_time), ("Error against count", over_count)]


def _loss_charts(rounds: Sequence[dict[str, Any]]) -> list[tuple[str, str]]:
    """Draw the loss of the last recovery."""
    runs = [run for entry in rounds for run in entry.get("recover", [])]
    if not runs or not runs[-1]["loss"]:
        return []
    steps = runs[-1]["steps"]
    parts = np.array_split(np.array(runs[-1]["loss"]), _STRETCHES)
    curve = [float(part.mean()) for part in parts if len(part)]
    points = [
        Point((k + 1) / len(curve) * steps, value, 1, 0, f"{value:.4f}") for k, value in enumerate(curve)
    ]
    return [("Loss of the last recovery", chart(points, x_label="step", y_label="loss", joined=True))]


def tiled_report(path: Path, title: str, report: dict[str, Any]) -> None:
    """Write the HTML page of a run in tiles.

    Args:
        path: output file.
        title: title of the page.
        report: content of report.json from `g2ard distill` in tiles.
    """
    scores, views = report["scores"], report["views"]
    unseen, tiles = plural(views["test"], "held-out view"), plural(len(scores["tiles"]), "tile")
    page = Page(title, f"{unseen} against teacher renders, in {tiles}")
    page.table(
        ["scene", "Gaussians", "PSNR"],
        [[stage, f"{report['output_count']:,}", f"{scores[stage]:.2f}"] for stage in _STAGES],
        set(),
    )
    page.paragraph(
        f"From {plural(report['input_count'], 'Gaussian')}, in {report['seconds']['total']:,.0f} s and "
        f"{scores['steps']:,} recovery steps of all tiles together; "
        f"{plural(views['train'], 'training view')}. "
        f"PSNR is over the {scores['pixels']:,} pixels owned by tiles."
    )
    shown = [tile for tile in scores["tiles"] if tile["pixels"]]
    page.html(legend(_STAGES))
    page.charts([("Error of each tile against its Gaussians", _tile_chart(shown))])
    page.heading("Tiles, worst first")
    page.table(
        ["tile", "Gaussians", "simplified, dB", "recovered, dB", "steps", "pixels"],
        [
            [
                str(tile["tile"]),
                f"{tile['count']:,}",
                *(f"{tile[stage]:.2f}" for stage in _STAGES),
                f"{tile['steps']:,}",
                f"{tile['pixels']:,}",
            ]
            for tile in sorted(shown, key=lambda tile: (tile["recovered"], tile["tile"]))
        ],
        set(),
    )
    if others := len(scores["tiles"]) - len(shown):
        page.paragraph(f"The {plural(others, 'other tile')} own no pixel in a held-out view.")
    page.write(path)


def _tile_chart(tiles: list[dict[str, Any]]) -> str:
    points = [
        Point(max(1, tile["count"]), tile[stage], i, 0, f"tile {tile['tile']}, {stage}: {tile[stage]:.2f} dB")
        for tile in tiles
        for i, stage in enumerate(_STAGES)
    ]
    return chart(points, x_label="Gaussians", y_label="PSNR, dB", log=True) if points else ""


def preview(
    path: Path,
    targets: Targets,
    scenes: list[tuple[str, Splats]],
    background: Colour = BLACK,
) -> None:
    """Write a PNG with a row for each of three evenly spaced views: target, then each scene with its PSNR.

    Args:
        path: output file.
        targets: photos or teacher renders with their cameras.
        scenes: (label, scene), left to right after the target.
        background: RGB behind the scenes.
    """
    count = len(targets.cameras)
    chosen = np.unique(np.linspace(0, count - 1, min(count, _PREVIEWED)).round().astype(int))
    rows, captions = [], []
    renderers = [Renderer(splats, background=background) for _, splats in scenes]
    for view in map(int, chosen):
        target = targets[view]
        images = [renderer.image(targets.cameras[view]) for renderer in renderers]
        rows.append([target, *(np.clip(image, 0, 1) for image in images)])
        scores = [
            f"{name} {psnr(image, target):.2f} dB"
            for (name, _), image in zip(scenes, rows[-1][1:], strict=True)
        ]
        captions.append(", ".join([targets.cameras.names[view], *scores]))
    labels = ["target", *(f"{name}: {plural(len(splats), 'Gaussian')}" for name, splats in scenes)]
    write_png(path, contact_sheet(rows, labels, row_labels=captions), overwrite=True)
