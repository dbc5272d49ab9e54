"""HTML report of a run: charts, tables and the worst views."""

from __future__ import annotations

import json
from collections.abc import Sequence
from html import escape
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from benchmarks.process import machine
from benchmarks.rows import Row, shown
from benchmarks.study import Study
from g2ard import __version__
from g2ard.report.charts import COLORS, STYLE, Point, draw_chart, draw_legend, find_front
from g2ard.report.page import Page, Shown

__all__ = ["write_report"]

_VIEWS = 3
_METHODS = ("method", "variant", "arm", "format", "matcher", "isa")
"""Columns that name what a kind of study compares."""
_MARKS = {"steps": "●", "seconds": "◍", "released": "○"}
"""Marks of the dots in legends, by the way a cell is matched."""


def write_report(folder: Path, studies: Sequence[Study], rows: Sequence[Row]) -> None:
    """Write a self-contained `folder`/report.html.

    Args:
        folder: folder of the run, with its images/.
        studies: studies in the order of the page.
        rows: rows of `benchmarks.runner.run`.
    """
    page = Page("g2ard benchmarks", f"g2ard {__version__} on {machine()}")
    page.html(STYLE)
    page.paragraph(
        "PSNR and SSIM on views that no method has used. Step-matched cells took the same number of "
        "optimiser steps, time-matched ones the same seconds for reduction and recovery together. If "
        "reduction alone took longer, there was no recovery. Figures against photos and against a teacher's "
        "renders are never in one chart."
    )
    for study in studies:
        _study(page, folder, study, [row for row in rows if row["study"] == study.name])
    page.write(folder / "report.html")


def _study(page: Page, folder: Path, study: Study, rows: list[Row]) -> None:
    page.heading(study.title)
    if study.differs:
        page.paragraph("Differs from the paper:")
        page.html(f"<ul>{''.join(f'<li>{escape(line)}</li>' for line in study.differs)}</ul>")
    names = list(dict.fromkeys(map(_name, rows)))
    matched = {row.get("matched") for row in rows}
    page.html(
        draw_legend(names, [f"{mark} {kind}" for kind, mark in _MARKS.items() if kind in matched])
    )
    for line in dict.fromkeys(line for row in rows for line in _notes(row)):
        page.paragraph(line)
    summary = study.summary(rows)
    if summary is not None:
        page.paragraph(summary[0])
        page.table(summary[1], summary[2])

    def place(row: Row) -> tuple[str, str, str]:
        return (
            row["scene"],
            row.get("split", "") or row.get("views_kind", ""),
            row.get("against", ""),
        )

    whole = [row for row in rows if "error" not in row]
    for (scene, split, against), members in groupby(sorted(whole, key=place), place):
        group = list(members)
        views = f": {group[0]['views']} {split} views" if "views" in group[0] else ""
        page.heading(f"{scene}{views}{f' against {against}' if against else ''}", 3)
        if "psnr" in group[0]:
            page.html(_place_side_by_side(_charts(group, names)))
        for line in _over_seeds(group):
            page.paragraph(line)
        columns, cells = shown(row for row in group if row.get("final", 1))
        page.table(columns, cells, _best([row for row in group if row.get("final", 1)], columns))
        _views(page, folder, group)


def _place_side_by_side(charts: Sequence[tuple[str, str]]) -> str:
    """Return HTML of (caption, svg) charts side by side."""
    figures = (
        f"<figure>{svg}<figcaption>{escape(caption)}</figcaption></figure>"
        for caption, svg in charts
        if svg
    )
    return f'<div class="row">{"".join(figures)}</div>'


def _name(row: Row) -> str:
    return next((str(row[name]) for name in _METHODS if name in row), "")


def _label(row: Row) -> str:
    """Return a label for a row's cell."""
    parts = (row["scene"], f"{row['ratio']:g}×" if "ratio" in row else "", _name(row))
    matched = f"({row['matched']} {row.get('amount', 0):g})" if row.get("amount") else ""
    return " ".join(part for part in (*parts, matched) if part)


def _notes(row: Row) -> list[str]:
    """Return notes on a row: errors, unused views, black renders."""
    lines = []
    if "error" in row:
        lines.append(f"Failed: {_label(row)}: {row['error']}")
    if row.get("dropped"):
        dropped = f"{row['dropped']} views to train on are scored on: they were not trained on."
        lines.append(f"{row['scene']}: {dropped}")
    if row.get("black"):
        count = f"{row['black']} of {row['black'] + row['views']} {row.get('split', '')} renders are all black"
        lines.append(f"{_label(row)}: {count}, and not in its means.")
    return lines


def _charts(rows: Sequence[Row], names: Sequence[str]) -> list[tuple[str, str]]:
    charts = []
    rows = [row for row in rows if row.get("matched") != "none"]
    for ratio in sorted({row.get("ratio", 0.0) for row in rows}):
        points = [
            _point(row, row.get("cpu_s", 0.0), names)
            for row in rows
            if row.get("ratio", 0.0) == ratio
        ]
        best = {id(point) for point in find_front(points)}
        points = [
            Point(p.x, p.y, p.series, p.mark, p.text, p.label if id(p) in best else "")
            for p in points
        ]
        svg = draw_chart(points, x_label="CPU seconds", y_label="PSNR, dB", log=True, front=True)
        charts.append((f"{ratio:g}×: error against time; dashed: the Pareto front", svg))
    if len({row.get("ratio") for row in rows}) > 1:
        for matched in dict.fromkeys(
            (row.get("matched", ""), row.get("amount", 0.0)) for row in rows
        ):
            points = [
                _point(row, row["count"], names)
                for row in rows
                if (row.get("matched", ""), row.get("amount", 0.0)) == matched
                and row.get("seed") == rows[0].get("seed")
            ]
            svg = draw_chart(points, x_label="Gaussians", y_label="PSNR, dB", log=True, joined=True)
            charts.append((f"Error against count {matched[0]} {matched[1] or ''}", svg))
    return charts


def _point(row: Row, x: float, names: Sequence[str]) -> Point:
    text = f"{_label(row)}: {row['psnr']:.2f} dB, {row['ssim']:.4f}, {row['count']:,} Gaussians"
    series = names.index(_name(row)) % len(COLORS)
    mark = list(_MARKS).index(row["matched"]) if row.get("matched") in _MARKS else 0
    return Point(x, row["psnr"], series, mark, text, _name(row))


def _best(rows: Sequence[Row], columns: Sequence[str]) -> set[tuple[int, int]]:
    """Return the (row, column) of the best scores among comparable rows."""
    groups: dict[tuple[Any, ...], list[int]] = {}
    for number, row in enumerate(rows):
        if row.get("matched") != "none":
            groups.setdefault(tuple(row.get(n) for n in ("ratio", "matched", "amount")), []).append(
                number
            )
    return {
        (max(numbers, key=lambda n: rows[n].get(name, -np.inf)), columns.index(name))
        for numbers in groups.values()
        for name in ("psnr", "ssim")
        if name in columns and len(numbers) > 1
    }


def _over_seeds(rows: Sequence[Row]) -> list[str]:
    """Return mean ± standard deviation (n − 1) of PSNR and SSIM for cells with several seeds."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        if row.get("final", 1) and "psnr" in row:
            groups.setdefault(_label(row), []).append(row)
    lines = []
    for label, runs in groups.items():
        if len({row.get("seed") for row in runs}) > 1:
            psnr, ssim = (np.array([row[name] for row in runs]) for name in ("psnr", "ssim"))
            lines.append(
                f"{label}, {len(runs)} seeds: {psnr.mean():.2f} ± {psnr.std(ddof=1):.2f} dB, "
                f"SSIM {ssim.mean():.4f} ± {ssim.std(ddof=1):.4f}"
            )
    return lines


def _views(page: Page, folder: Path, rows: Sequence[Row]) -> None:
    """Show the views with the worst scores of the first method, for every ratio."""
    pictured = [row for row in rows if "pictures" in row and row["matched"] != "none"]
    for ratio in sorted({row["ratio"] for row in pictured}):
        first: dict[str, Row] = {}
        for row in pictured:
            if row["ratio"] == ratio:
                first.setdefault(_name(row), row)
        told = {
            name: json.loads((folder / row["pictures"] / "views.json").read_text(encoding="utf-8"))
            for name, row in first.items()
        }
        ours = next(iter(told.values()))
        there = sorted(int(path.stem) for path in (folder / ours["targets"]).glob("*.jpg"))
        page.heading(f"{pictured[0]['scene']} at {ratio:g}×: worst views first", 4)
        for view in sorted(there, key=lambda view: ours["views"][view]["psnr"])[:_VIEWS]:
            images = [
                Shown(
                    name,
                    _read(folder / first[name]["pictures"] / f"{view}.jpg"),
                    f"{views['views'][view]['psnr']:.2f} dB",
                )
                for name, views in told.items()
            ]
            target = _read(folder / ours["targets"] / f"{view}.jpg")
            page.comparison(ours["views"][view]["name"], target, images)


def _read(path: Path) -> np.ndarray[Any, Any]:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))
