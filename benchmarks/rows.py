"""Row format of all benchmarks: flat columns in a CSV that later runs extend."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from g2ard.errors import InputError
from g2ard.io.atomic import atomic_output

__all__ = ["COLUMNS", "Row", "read_rows", "rounded", "shown", "write_rows"]

Row = dict[str, Any]
"""Column → value; columns that do not apply are missing."""


class Column(NamedTuple):
    """A column: its type, its format in tables ("" for text, None if hidden) and its meaning."""

    type: Callable[[str], Any]
    form: str | None
    meaning: str


COLUMNS: dict[str, Column] = {
    "study": Column(str, None, "the study's name"),
    "scene": Column(str, "", "the scene's name"),
    "prior": Column(str, None, "given, lift or trained"),
    "ratio": Column(float, "g", "prior over compact"),
    "method": Column(str, "", "the method's name"),
    "matched": Column(str, "", "steps, seconds or released; none: a teacher's row, the prior as it is"),
    "amount": Column(float, "g", "how many steps or seconds"),
    "variant": Column(str, "", "what a study of recovery compares"),
    "pool": Column(str, "", "biased or even"),
    "arm": Column(str, "", "policy of selection; +weights draws by weight, pool is all candidates"),
    "percent": Column(float, "g", "chosen views as a share of the pool"),
    "format": Column(str, "", "file format, or another program's"),
    "matcher": Column(str, "", "see RegisterConfig"),
    "start": Column(str, "", "kind of start of a registration"),
    "isa": Column(str, "", "instruction set, or adapter"),
    "threads": Column(int, "d", "number of threads"),
    "copies": Column(int, "d", "of the scene, all but one out of view"),
    "boxes": Column(int, "d", "of a kd tree that the scene is drawn in"),
    "seed": Column(int, "d", "seed of the cell"),
    "draw": Column(int, None, "which of several random subsets"),
    "split": Column(str, "", "which views were scored"),
    "views_kind": Column(str, "", "what was scored on: pool, near, standing or anywhere"),
    "scale": Column(float, "g", "multiple of the views' size at which they were scored"),
    "against": Column(str, None, "photos, teacher, or either; figures of different ones never compare"),
    "submethod": Column(str, None, "method and budget in one word, in recorded rows"),
    "input_count": Column(int, None, "Gaussians before"),
    "budget": Column(int, None, "Gaussians requested"),
    "count": Column(int, ",", "Gaussians of the result"),
    "width": Column(int, None, "of the view, pixels"),
    "height": Column(int, None, "of the view, pixels"),
    "candidates": Column(int, None, "views in the pool"),
    "k": Column(int, None, "views chosen"),
    "step": Column(int, "d", "of the recovery in progress"),
    "seconds": Column(float, ".1f", "by the clock: recovery so far; with reduction where time is matched"),
    "bytes": Column(int, ",", "of the file; of float32 arrays where nothing is written"),
    "psnr": Column(float, ".2f", "mean over the views, dB"),
    "psnr_worst": Column(float, ".2f", "of the worst view, dB"),
    "ssim": Column(float, ".4f", "mean over the views"),
    "edge_psnr": Column(float, ".2f", "PSNR of the images' gradients, mean over the views, dB"),
    "lpips_vgg": Column(float, ".4f", "mean over the views"),
    "lpips_alex": Column(float, ".4f", "mean over the views"),
    "luma_drift": Column(float, None, "mean of |mean luma of the render − the target's|, in recorded rows"),
    "lost": Column(float, ".2f", "dB that the format alone takes: PSNR of the .ply less this"),
    "delta_psnr": Column(float, "+.2f", "PSNR less the teacher's on the same views, dB"),
    "drift95": Column(float, ".2f", "of the last recovery, in thicknesses of its anchors"),
    "needle": Column(float, ".2%", "share of needles"),
    "rank_p1": Column(float, None, "first percentile of effective ranks"),
    "reg_share": Column(float, None, "share of recovery's time that regularisers took"),
    "skipped": Column(int, None, "steps of single Gaussians skipped as not finite"),
    "psnr_in": Column(float, ".2f", "mean over unseen views spread over the pool's extent, dB"),
    "ssim_in": Column(float, None, "the same"),
    "psnr_out": Column(float, ".2f", "mean over views outside the pool's distribution, dB"),
    "ssim_out": Column(float, None, "the same"),
    "psnr_crowd": Column(float, None, "mean over unseen views where a biased pool is crowded, dB"),
    "views": Column(int, None, "how many the means are of"),
    "black": Column(int, None, "how many more came out black, and are not in the means (`tab:geobase`, †)"),
    "dropped": Column(int, None, "training views that are scored on, and were not trained on"),
    "steps": Column(int, "d", "optimiser steps taken"),
    "photos": Column(int, "d", "photos to register"),
    "registered": Column(int, "d", "of them"),
    "uncertain": Column(int, "d", "of them"),
    "start_position": Column(float, ".3g", "median error of the starts: cm, or scene units"),
    "start_rotation": Column(float, ".3g", "median error of the starts, degrees"),
    "position": Column(float, ".3g", "median error of the registered"),
    "rotation": Column(float, ".3g", "median error of the registered"),
    "worst": Column(float, ".3g", "largest error of position of the registered"),
    "start_10": Column(float, ".0%", "share of all photos that start within 10 cm, 5°"),
    "start_5": Column(float, None, "the same, 5 cm, 5°"),
    "found_10": Column(float, ".0%", "share of all photos registered within 10 cm, 5°"),
    "found_5": Column(float, ".0%", "the same, 5 cm, 5°"),
    "reduce_cpu_s": Column(float, None, "user + system seconds of all reductions, whole processes"),
    "reduce_wall_s": Column(float, None, "by the clock, without start and files; another program's whole"),
    "reduce_peak_mb": Column(float, None, "of the largest"),
    "recover_cpu_s": Column(float, None, "of all recoveries, whole processes"),
    "recover_wall_s": Column(float, None, "of their loops alone, which is what a limit in seconds counts"),
    "recover_peak_mb": Column(float, None, "of the largest"),
    "select_cpu_s": Column(float, None, "of the selection of views"),
    "select_peak_mb": Column(float, None, "of the selection of views"),
    "adapt_cpu_s": Column(float, None, "of the adaptation"),
    "adapt_peak_mb": Column(float, None, "of the adaptation"),
    "cpu_s": Column(float, ".1f", "user + system seconds: the whole command; matched: all but adaptation"),
    "wall_s": Column(float, ".1f", "by the clock, start and files included"),
    "peak_mb": Column(float, ".0f", "largest resident size, 10⁶ bytes"),
    "targets_s": Column(float, ".1f", "seconds of rendering the training images"),
    "simplify_s": Column(float, None, "seconds of simplification before a recovery"),
    "recover_s": Column(float, ".1f", "seconds of recovery, choice of rates included"),
    "score_s": Column(float, ".1f", "seconds of scoring"),
    "steps_per_s": Column(float, ".1f", "optimiser steps per second of recovery"),
    "final": Column(int, None, "1 for a result, 0 on the way"),
    "gaussians": Column(int, None, "recovered"),
    "pixels": Column(int, None, "longer side of the views"),
    "contributing": Column(int, None, "(pixel, Gaussian) pairs with α ≥ 1/255 in front of a stopped pixel"),
    "total_ms": Column(float, ".1f", "a recovery step, the fastest of the repeats"),
    "image_ms": Column(float, ".1f", "an image, the fastest of the repeats"),
    "whole_ms": Column(float, ".1f", "an image of the whole scene, mean over the views"),
    "boxes_ms": Column(float, ".1f", "the same in boxes, with the test which are skipped"),
    "drawn_share": Column(float, ".3f", "of a view's boxes, the share that is not skipped"),
    "rows_per_gaussian": Column(float, ".2f", "boxes that a Gaussian is handed to"),
    "largest_error": Column(float, ".2g", "of a colour, against the whole scene's image"),
    "project_ms": Column(float, ".2f", "of a step on a GPU: the projection"),
    "sort_ms": Column(float, ".2f", "the same: sorting by depth and by tile"),
    "draw_ms": Column(float, ".2f", "the same: the image"),
    "loss_ms": Column(float, ".2f", "the same: loss and its gradient by pixel"),
    "backward_ms": Column(float, ".2f", "the same: gradients by pair of splat and tile"),
    "update_ms": Column(float, ".2f", "the same: gradients by Gaussian, and Adam"),
    "pictures": Column(str, None, "folder of the views' pictures, within the run's"),
    "version": Column(str, None, "of the method's program"),
    "machine": Column(str, None, "processor and cores"),
    "error": Column(str, "", "why there are no figures"),
    "cell": Column(str, None, "fingerprint of all that the figures depend on"),
}  # fmt: skip

_MINOR = ("edge_psnr", "psnr_worst", "seconds", "cpu_s", "steps", "count", "bytes")
"""Columns that a brief table drops first if it is too wide."""

_SURVEY = {
    "submethod": "Submethod",
    "psnr": "PSNR",
    "ssim": "SSIM",
    "lpips_vgg": "LPIPS",
    "bytes": "Size [Bytes]",
    "count": "#Gaussians",
}
"""Column names of the 3DGS compression survey, as some recorded rows have them."""


def read_rows(path: Path) -> list[Row]:
    """Read the rows of a CSV, which may lack columns or not exist."""
    if not path.exists():
        return []
    names = {survey: name for name, survey in _SURVEY.items()}
    with path.open(newline="", encoding="utf-8") as file:
        lines = csv.DictReader(file)
        unknown = [name for name in lines.fieldnames or () if names.get(name, name) not in COLUMNS]
        if unknown or not lines.fieldnames:
            raise InputError(f"{path}: has other columns than a benchmark's: {', '.join(unknown)}")
        try:
            return [
                {names.get(k, k): COLUMNS[names.get(k, k)].type(v) for k, v in line.items() if v}
                for line in lines
            ]
        except (TypeError, ValueError):
            raise InputError(f"{path}: line {lines.line_num}: not a row of a benchmark") from None


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Write rows atomically."""
    present = {name for row in rows for name in row}
    names = [name for name in COLUMNS if name in present]
    with (
        atomic_output(path, overwrite=True) as temporary,
        temporary.open("w", newline="", encoding="utf-8") as file,
    ):
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(names)
        writer.writerows([_text(row.get(name)) for name in names] for row in rows)


def rounded(row: Mapping[str, Any]) -> Row:
    """Round a row as writing and reading it would: six digits, no empty columns."""
    texts = {name: _text(value) for name, value in row.items()}
    return {name: COLUMNS[name].type(text) for name, text in texts.items() if text}


def _text(value: Any) -> str:
    return "" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)


def shown(rows: Iterable[Row], width: int | None = None) -> tuple[list[str], list[list[str]]]:
    """Return columns and cells of a table of rows.

    Args:
        rows: rows to show.
        width: characters of a brief table, without columns that are the same in all rows, except the first
            column. If it is still too wide, columns of `_MINOR` are dropped as well.
    """
    rows = list(rows)
    names = [
        n
        for n, column in COLUMNS.items()
        if column.form is not None and any(n in row for row in rows)
    ]
    if width is not None and len(rows) > 1:
        names = [n for i, n in enumerate(names) if i == 0 or len({row.get(n) for row in rows}) > 1]
    cells = {
        n: [format(row[n], COLUMNS[n].form or "") if n in row else "" for row in rows]
        for n in names
    }
    for minor in _MINOR:
        needed = sum(3 + max(map(len, [n, *column])) for n, column in cells.items()) + 1
        if width is not None and needed > width:
            cells.pop(minor, None)
    return list(cells), [list(row) for row in zip(*cells.values(), strict=True)]
