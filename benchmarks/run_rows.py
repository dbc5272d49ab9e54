"""Rows of `bench run`, and the CSV they are kept in."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from g2ard.errors import InputError
from g2ard.io.atomic import atomic_output

__all__ = ["Row", "read_rows", "with_deltas", "write_csv"]

_LATER = ("select_cpu_s", "select_peak_mb", "adapt_peak_mb", "black", "delta_psnr")
"""Columns that files from before they came lack."""

_SURVEY = {
    "submethod": "Submethod",
    "psnr": "PSNR",
    "ssim": "SSIM",
    "lpips_vgg": "LPIPS",
    "bytes": "Size [Bytes]",
    "count": "#Gaussians",
}
"""Columns that bear the 3DGS compression survey's names, so that its plots take the file as it is."""


@dataclass(frozen=True)
class Row:
    """One cell's figures on one set of views; a line of the CSV.

    Args:
        study: the definition's name.
        scene: the scene's.
        prior: given, lift or trained.
        method: the method's name.
        ratio: prior over compact.
        matched: "steps", "seconds" or "released"; "none" of a teacher's row, the prior as it is.
        amount: how many of them.
        seed: of the cell.
        split: which views were scored.
        against: "photos", "teacher", or "either" of the two; figures of different ones never compare.
        submethod: method and budget in one word.
        input_count: Gaussians before.
        budget: Gaussians asked for.
        count: Gaussians of the result.
        bytes: of the result as float32 arrays, the form a .ply holds.
        psnr: mean over the views, dB.
        ssim: the same.
        lpips_vgg: the same; None without weights.
        lpips_alex: the same.
        luma_drift: mean of |mean luma of the render − the target's|.
        drift95: of the last recovery, in thicknesses of its anchors; 0 without one.
        needle: share of needles.
        views: how many the means are of.
        steps: optimiser steps taken, those that led to a shared start included.
        reduce_cpu_s: user + system seconds of all reductions, each a whole process.
        reduce_wall_s: by the clock, without a program's start and its files: in one process there is one
            start however many the rounds. A rival program's whole.
        reduce_peak_mb: of the largest.
        recover_cpu_s: of all recoveries, whole processes.
        recover_wall_s: of their loops alone, which is what a limit in seconds counts.
        recover_peak_mb: of the largest.
        select_cpu_s: of the selection of views, a whole process; None without one.
        select_peak_mb: its.
        adapt_cpu_s: of the adaptation, the same.
        adapt_peak_mb: its.
        cpu_s: of selection, reductions and recoveries.
        seconds: the selection's, reduce_wall_s and recover_wall_s; above `amount` where reduction alone
            took longer, and nothing was recovered.
        version: of g2ard.
        machine: processor and cores.
        error: why there are no figures; "" if there are.
        black: how many more came out black, and are left out of the means (`tab:geobase`, †).
        delta_psnr: PSNR less the teacher's on the same views, dB (`tab:s_mip360`); None without its row.
    """

    study: str
    scene: str
    prior: str
    method: str
    ratio: float
    matched: str
    amount: float
    seed: int
    split: str
    against: str
    submethod: str = ""
    input_count: int | None = None
    budget: int | None = None
    count: int | None = None
    bytes: int | None = None
    psnr: float | None = None
    ssim: float | None = None
    lpips_vgg: float | None = None
    lpips_alex: float | None = None
    luma_drift: float | None = None
    drift95: float | None = None
    needle: float | None = None
    views: int | None = None
    steps: int | None = None
    reduce_cpu_s: float | None = None
    reduce_wall_s: float | None = None
    reduce_peak_mb: float | None = None
    recover_cpu_s: float | None = None
    recover_wall_s: float | None = None
    recover_peak_mb: float | None = None
    select_cpu_s: float | None = None
    select_peak_mb: float | None = None
    adapt_cpu_s: float | None = None
    adapt_peak_mb: float | None = None
    cpu_s: float | None = None
    seconds: float | None = None
    version: str = ""
    machine: str = ""
    error: str = ""
    black: int | None = None
    delta_psnr: float | None = None


def with_deltas(rows: Sequence[Row]) -> list[Row]:
    """The rows, each with its distance from the teacher's row of its study, scene, prior and split."""

    def place(row: Row) -> tuple[str, str, str, str]:
        return row.study, row.scene, row.prior, row.split

    teachers = {place(row): row.psnr for row in rows if row.matched == "none" and not row.error}

    def delta(row: Row) -> float | None:
        teacher = teachers.get(place(row))
        return None if teacher is None or row.psnr is None or row.matched == "none" else row.psnr - teacher

    return [replace(row, delta_psnr=delta(row)) for row in rows]


def read_rows(path: Path) -> list[Row]:
    """The rows of a run's rows.csv.

    Raises:
        InputError: it is not one that `bench_run` wrote.
    """
    types = {f.name: str(f.type) for f in fields(Row)}
    names = {_SURVEY.get(name, name): name for name in types}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            lines = csv.DictReader(file)
            held = set(lines.fieldnames or ())
            if not set(names) - set(_LATER) <= held <= set(names):
                raise InputError(f"{path}: not a CSV of `python -m benchmarks run`")
            return [Row(**{names[k]: _typed(v, types[names[k]]) for k, v in line.items()}) for line in lines]
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: not a CSV of `python -m benchmarks run`: {error}") from None


def _typed(text: str, kind: str) -> Any:
    if kind == "str":
        return text
    if not text:
        return None
    return int(text) if kind.startswith("int") else float(text)


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Write rows, whole or not at all."""
    with (
        atomic_output(path, overwrite=True) as temporary,
        temporary.open("w", newline="", encoding="utf-8") as file,
    ):
        names = [f.name for f in fields(Row)]
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([_SURVEY.get(name, name) for name in names])
        for row in rows:
            values = [getattr(row, name) for name in names]
            writer.writerow(["" if v is None else f"{v:.6g}" if isinstance(v, float) else v for v in values])
