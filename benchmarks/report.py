"""A bench's report: error against time and count, then the views that came out worst."""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from benchmarks.definition import Definition, Matched
from benchmarks.run import cells_of
from benchmarks.run_rows import Row
from benchmarks.simplify import machine
from g2ard import __version__
from g2ard.report.charts import Point, chart, pareto
from g2ard.report.page import COLORS, Comparison, Page, Shown, legend

__all__ = ["write_report"]

_VIEWS = 3
_MARKS = ("steps", "seconds", "released", "none")
_COLUMNS = (
    "method",
    "matched",
    "Gaussians",
    "MB",
    "PSNR",
    "SSIM",
    "LPIPS (VGG)",
    "LPIPS (Alex)",
    "drift95",
    "needle",
    "luma drift",
    "reduce CPU s",
    "recover CPU s",
    "seconds",
    "peak MB",
)


def write_report(folder: Path, definitions: Sequence[Definition], rows: Sequence[Row]) -> None:
    """Write `folder`/report.html: one file, no network.

    Args:
        folder: of the run, with its cells/ and images/.
        definitions: the studies, in the order of the page.
        rows: as `bench_run` returns them.
    """
    page = Page("g2ard bench", f"g2ard {__version__} on {machine()}")
    page.paragraph(
        "PSNR and SSIM on views that no method has used. Step-matched cells took the same number of "
        "optimiser steps, time-matched ones the same seconds for reduction and recovery together; where "
        "reduction alone took longer there was no recovery. Figures against photos and against a teacher's "
        "renders are never in one chart."
    )
    for definition in definitions:
        _study(page, folder, definition, [row for row in rows if row.study == definition.name])
    page.write(folder / "report.html")


def _study(page: Page, folder: Path, definition: Definition, rows: Sequence[Row]) -> None:
    page.heading(definition.title or definition.name)
    if definition.differences:
        page.paragraph("Differs from the paper:")
        page.items(definition.differences)
    names = [method.name for method in definition.methods]
    kinds = [kind for kind in _MARKS if any(row.matched == kind for row in rows)]
    page.html(legend(names, [_kind_label(kind) for kind in kinds]))
    for row in rows:
        if row.error:
            matched = Matched(row.matched, row.amount).label
            page.paragraph(f"Failed: {row.scene} {row.ratio:g}× {row.method} ({matched}): {row.error}")
    for line in _notes(folder, definition, rows):
        page.paragraph(line)
    whole = [row for row in rows if not row.error]

    def place(row: Row) -> tuple[str, str, str]:
        return row.scene, row.split, row.against

    for (scene, split, against), members in groupby(sorted(whole, key=place), place):
        group = list(members)
        page.heading(f"{scene}: {group[0].views} {split} views against {_against(against)}", 3)
        _charts(page, group, names)
        _table(page, group, names)
        _views(page, folder, definition, scene, split, group)


def _notes(folder: Path, definition: Definition, rows: Sequence[Row]) -> list[str]:
    """What was left out: training views that are scored on, and renders that came out black."""
    lines = []
    for scene in definition.scenes:
        cells = [cell for cell in cells_of([definition]) if cell.scene.name == scene.name]
        paths = [folder / "cells" / f"{cell.key}.json" for cell in cells]
        dropped = max(
            (json.loads(p.read_text(encoding="utf-8")).get("dropped", 0) for p in paths if p.exists()),
            default=0,
        )
        if dropped:
            lines.append(
                f"{scene.name}: {dropped} views to train on are scored on: they were not trained on."
            )
    lines += [
        f"{row.scene} {row.ratio:g}× {row.method} ({Matched(row.matched, row.amount).label}): {row.black} of "
        f"{row.black + (row.views or 0)} {row.split} renders are all black, and left out of its means."
        for row in rows
        if row.black
    ]
    return lines


def _against(against: str) -> str:
    named = {"photos": "the photos", "teacher": "the teacher's renders"}
    return named.get(against, "photos, and the teacher's renders where there is none")


def _kind_label(kind: str) -> str:
    named = {
        "steps": "step-matched",
        "seconds": "time-matched",
        "released": "as released",
        "none": "as it is",
    }
    return named[kind]


def _charts(page: Page, rows: Sequence[Row], names: Sequence[str]) -> None:
    charts = []
    rows = [row for row in rows if row.matched != "none"]
    for ratio in sorted({row.ratio for row in rows}):
        points = [_point(row, row.cpu_s or 0.0, names) for row in rows if row.ratio == ratio]
        best = {id(point) for point in pareto(points)}
        points = [Point(p.x, p.y, p.series, p.mark, p.text, p.label if id(p) in best else "") for p in points]
        svg = chart(
            points, x_label="CPU seconds, reduction and recovery", y_label="PSNR, dB", log=True, front=True
        )
        charts.append((f"{ratio:g}×: error against time; dashed: the Pareto front", svg))
    if len({row.ratio for row in rows}) > 1:
        for matched in dict.fromkeys((row.matched, row.amount) for row in rows):
            points = [
                _point(row, row.count or 0, names)
                for row in rows
                if (row.matched, row.amount) == matched and row.seed == rows[0].seed
            ]
            svg = chart(points, x_label="Gaussians", y_label="PSNR, dB", log=True, joined=True)
            charts.append((f"Error against count, {Matched(*matched).label}", svg))
    page.charts(charts)


def _point(row: Row, x: float, names: Sequence[str]) -> Point:
    text = (
        f"{row.method}, {Matched(row.matched, row.amount).label}: {row.psnr:.2f} dB, {row.ssim:.4f}, "
        f"{row.count:,} Gaussians, {row.cpu_s:.1f} CPU s"
    )
    series = names.index(row.method) % len(COLORS) if row.method in names else 0
    return Point(x, row.psnr or 0.0, series, _MARKS.index(row.matched), text, row.method)


def _table(page: Page, rows: Sequence[Row], names: Sequence[str]) -> None:
    """Ratio by ratio and budget by budget, so that what stands together is comparable."""

    def place(row: Row) -> tuple[float, str, float]:
        return row.ratio, row.matched, row.amount

    teachers = [row for row in rows if row.matched == "none"]
    others = [row for row in rows if row.matched != "none"]
    columns = _COLUMNS + (("ΔPSNR",) if teachers else ())
    if not others:
        page.table(columns, [_cells(row)[: len(columns)] for row in teachers], set())
    for (ratio, matched, amount), members in groupby(sorted(others, key=place), place):
        group = sorted(members, key=lambda row: -(row.psnr or 0))
        best = {
            (int(np.argmax([getattr(row, name) or 0.0 for row in group])), column)
            for column, name in ((4, "psnr"), (5, "ssim"))
        }
        page.html(f'<p class="sub">{ratio:g}×, {Matched(matched, amount).label}</p>')
        for line in _over_seeds(group):
            page.paragraph(line)
        cells = [_cells(row)[: len(columns)] for row in [*group, *teachers]]
        page.table(columns, cells, best)


def _over_seeds(rows: Sequence[Row]) -> list[str]:
    """Mean ± standard deviation (n − 1) of PSNR and SSIM of each method that was run with several seeds."""
    lines = []
    for method in dict.fromkeys(row.method for row in rows):
        runs = [row for row in rows if row.method == method and row.psnr is not None and row.ssim is not None]
        if len(runs) > 1:
            psnr, ssim = (np.array([getattr(row, name) for row in runs]) for name in ("psnr", "ssim"))
            lines.append(
                f"{method}, {len(runs)} seeds: {psnr.mean():.2f} ± {psnr.std(ddof=1):.2f} dB, "
                f"SSIM {ssim.mean():.4f} ± {ssim.std(ddof=1):.4f}"
            )
    return lines


def _cells(row: Row) -> list[str]:
    def figure(value: float | None, form: str) -> str:
        return "–" if value is None else format(value, form)

    overran = row.matched == "seconds" and not row.steps
    return [
        row.method + (f" (seed {row.seed})" if row.seed else "") + ("†" if row.black else ""),
        Matched(row.matched, row.amount).label,
        f"{row.count:,}",
        f"{(row.bytes or 0) / 1e6:.2f}",
        figure(row.psnr, ".2f"),
        figure(row.ssim, ".4f"),
        figure(row.lpips_vgg, ".4f"),
        figure(row.lpips_alex, ".4f"),
        figure(row.drift95, ".1f"),
        figure(row.needle, ".1%"),
        figure(row.luma_drift, ".4f"),
        figure(row.reduce_cpu_s, ".1f"),
        figure(row.recover_cpu_s, ".1f"),
        figure(row.seconds, ".1f") + (" (reduction alone)" if overran else ""),
        figure(max(row.reduce_peak_mb or 0.0, row.recover_peak_mb or 0.0), ".0f"),
        figure(row.delta_psnr, "+.2f"),
    ]


def _views(
    page: Page, folder: Path, definition: Definition, scene: str, split: str, rows: Sequence[Row]
) -> None:
    """The worst pictured views of the first method, at its first budget, for every ratio."""
    for ratio in sorted({row.ratio for row in rows if row.matched != "none"}):
        cells = _cell_files(folder, definition, scene, ratio)
        if not cells:
            continue
        _, ours = cells[0]
        pictured = sorted(int(p.stem) for p in _pictures(folder, cells[0], split).glob("*.jpg"))
        if not pictured:
            continue
        ranked = sorted(pictured, key=lambda view: ours["views"][split][view]["psnr"])
        count = len(ours["views"][split])
        among = "" if len(pictured) == count else f" (of {len(pictured)} pictured, of {count})"
        page.heading(f"{scene} at {ratio:g}×: worst views first{among}", 4)
        for view in ranked[:_VIEWS]:
            target = _read(folder / "images" / ours["scene_key"] / split / f"{view}.jpg")
            shown = [
                Shown(
                    name,
                    _read(_pictures(folder, (name, cell), split) / f"{view}.jpg"),
                    f"{cell['views'][split][view]['psnr']:.2f} dB",
                )
                for name, cell in cells
                if split in cell["views"]
            ]
            page.comparison(Comparison(ours["views"][split][view]["name"], target, shown))


def _cell_files(
    folder: Path, definition: Definition, scene: str, ratio: float
) -> list[tuple[str, dict[str, Any]]]:
    """Per method, the first of its cells that has pictures."""
    found: dict[str, dict[str, Any]] = {}
    for cell in cells_of([definition]):
        if (cell.scene.name, cell.ratio) != (scene, ratio) or cell.method.name in found:
            continue
        path = folder / "cells" / f"{cell.key}.json"
        content = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {"views": {}}
        if content["views"]:
            found[cell.method.name] = {**content, "key": cell.key}
    return list(found.items())


def _pictures(folder: Path, cell: tuple[str, dict[str, Any]], split: str) -> Path:
    return folder / "images" / str(cell[1]["key"]) / split


def _read(path: Path) -> np.ndarray[Any, Any]:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))
