"""The report of a distillation in tiles: what all of them came to, then each, the worst first."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from g2ard.progress import plural
from g2ard.report.charts import Point, chart
from g2ard.report.page import Page, legend

__all__ = ["tiled_report"]

_STAGES = ("simplified", "recovered")


def tiled_report(path: Path, title: str, report: dict[str, Any]) -> None:
    """Write an HTML page about one run in tiles.

    Args:
        path: the file.
        title: of the page.
        report: what `g2ard distill` writes of a run in tiles as report.json.
    """
    scores, views = report["scores"], report["views"]
    unseen, tiles = plural(views["test"], "unseen view"), plural(len(scores["tiles"]), "tile")
    page = Page(title, f"{unseen} against teacher renders, in {tiles}")
    page.table(
        ["scene", "Gaussians", "PSNR"],
        [[stage, f"{report['output_count']:,}", f"{scores[stage]:.2f}"] for stage in _STAGES],
        set(),
    )
    page.paragraph(
        f"From {plural(report['input_count'], 'Gaussian')}, in {report['seconds']['total']:,.0f} s and "
        f"{scores['steps']:,} steps of recovery, those of all tiles summed; {plural(views['train'], 'view')} "
        f"to learn from. PSNR is over the {scores['pixels']:,} pixels that tiles own."
    )
    shown = [tile for tile in scores["tiles"] if tile["pixels"]]
    page.html(legend(_STAGES))
    page.charts([("Error of each tile against its Gaussians", _chart(shown))])
    page.heading("Tiles, the worst first")
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
        page.paragraph(f"No held-out view has a pixel that is owned by the {plural(others, 'other tile')}.")
    page.write(path)


def _chart(tiles: list[dict[str, Any]]) -> str:
    points = [
        Point(max(1, tile["count"]), tile[stage], i, 0, f"tile {tile['tile']}, {stage}: {tile[stage]:.2f} dB")
        for tile in tiles
        for i, stage in enumerate(_STAGES)
    ]
    return chart(points, x_label="Gaussians", y_label="PSNR, dB", log=True) if points else ""
