"""Megabytes against decibels: what each format, and each ratio, costs and keeps."""

from __future__ import annotations

import subprocess
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks import rows as table
from benchmarks.process import check_measurable
from benchmarks.simplify import scene_label
from benchmarks.standing import standing_targets
from g2ard import io
from g2ard.errors import InputError
from g2ard.io.scene_formats import FORMATS
from g2ard.poses import make_pool
from g2ard.progress import Progress, silent
from g2ard.rendering.visibility import visibility_source
from g2ard.scene.splats import Splats
from g2ard.scene.targets import TeacherRenders
from g2ard.stages.evaluate import evaluate
from g2ard.stages.simplify import simplify

__all__ = ["PEER", "Cell", "bench_ship"]

PEER = "splat-transform sog"
_POOL, _HELD_OUT = 128, 8
_KINDS = ("pool", "near", "standing")


@dataclass(frozen=True)
class Cell:
    """One scene at one ratio in one format, seen from one kind of views.

    Args:
        scene: its name.
        ratio: of the dense scene's count to this one's.
        format: of `FORMATS`, or `PEER`.
        views_kind: "pool" (every 8th pose, which simplification did not look from), "near" or "standing".
        count: Gaussians.
        bytes: of the file.
        cpu_s: CPU seconds of writing it.
        psnr: dB against the dense scene.
        ssim: the same.
        lost: dB that the format alone takes: PSNR of the .ply of that count, less this.
        error: why there is nothing.
    """

    scene: str
    ratio: float
    format: str
    views_kind: str
    count: int = 0
    bytes: int = 0
    cpu_s: float = 0.0
    psnr: float = 0.0
    ssim: float = 0.0
    lost: float = 0.0
    error: str = ""


def bench_ship(
    scenes: Sequence[Path],
    csv_path: Path,
    *,
    ratios: Sequence[float] = (1, 10),
    formats: Sequence[str] = tuple(FORMATS),
    splat_transform: Path | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> list[Cell]:
    """Reduce each scene by each ratio, write it in each format, read that back and score it on unseen views.

    Args:
        scenes: anything `g2ard.io.read_scene` reads.
        csv_path: where the rows go; it is written anew.
        ratios: 1 is the scene as it is.
        formats: of `FORMATS`.
        splat_transform: its program, whose SOG of the same scenes is scored beside; None leaves it out.
        seed: of the pool.
        progress: told after each file.

    Raises:
        InputError: a scene cannot be read, an unknown format, or a ratio below 1.
        G2ardError: a peer is asked for where the system does not tell what a process took (Windows).
    """
    if splat_transform is not None:
        check_measurable()
    if unknown := [name for name in formats if name not in FORMATS]:
        raise InputError(f"formats: expected some of {', '.join(FORMATS)}, got {unknown[0]}")
    if not ratios or min(ratios) < 1:
        raise InputError(f"ratios: expected 1 or more, got {', '.join(f'{r:g}' for r in ratios)}")
    names = [*dict.fromkeys(["ply", *formats]), *([PEER] if splat_transform else [])]
    cells: list[Cell] = []
    total = len(scenes) * len(ratios) * len(names)
    for scene in scenes:
        splats = io.read_splats(scene)
        cameras = make_pool(splats, _POOL, seed=seed)
        held = np.arange(len(cameras)) % _HELD_OUT == 0
        targets = {"pool": TeacherRenders(splats, cameras.take(held), lazy=True)}
        targets |= standing_targets(splats, scene, seed)
        for ratio in ratios:
            small = _reduced(splats, ratio, visibility_source(cameras.take(~held)))
            plain: dict[str, float] = {}
            for name in names:
                cell = Cell(scene_label(scene), ratio, name, "", count=len(small))
                for made in _measured(cell, small, targets, splat_transform):
                    plain.setdefault(made.views_kind, made.psnr)
                    lost = plain[made.views_kind] - made.psnr if not made.error else 0.0
                    cells.append(replace(made, lost=lost))
                table.rewrite(csv_path, cells, Cell)
                progress("bench ship", len({(c.scene, c.ratio, c.format) for c in cells}), total, {})
    return cells


def _reduced(splats: Splats, ratio: float, look: object) -> Splats:
    budget = max(1, round(len(splats) / ratio))
    if budget == len(splats):
        return splats
    return simplify(splats, budget, visibility=look).splats  # type: ignore[arg-type]


def _measured(
    cell: Cell, splats: Splats, targets: dict[str, TeacherRenders], program: Path | None
) -> list[Cell]:
    """A row for each kind of views."""
    with tempfile.TemporaryDirectory(prefix="g2ard-ship-") as folder:
        path = Path(folder) / ("scene.sog" if cell.format == PEER else f"scene.{cell.format}")
        try:
            seconds = _write(path, splats, program if cell.format == PEER else None)
            back = io.read_splats(path)
        except (InputError, OSError, subprocess.CalledProcessError) as error:
            return [replace(cell, views_kind="pool", error=" ".join(str(error).split()))]
        size = path.stat().st_size
    out = []
    for kind in _KINDS:
        if kind in targets:
            score = evaluate(back, targets[kind])
            figures = {"bytes": size, "cpu_s": seconds, "psnr": score.psnr, "ssim": score.ssim}
            out.append(replace(cell, views_kind=kind, **figures))  # type: ignore[arg-type]
    return out


def _write(path: Path, splats: Splats, program: Path | None) -> float:
    """CPU seconds of writing, the peer's with what it takes to read the .ply."""
    if program is None:
        began = time.process_time()
        io.write_splats(path, splats)
        return time.process_time() - began
    import resource

    source = path.with_name("source.ply")
    io.write_splats(source, splats)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([program, "-q", "-w", "-g", "cpu", source, path], check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
