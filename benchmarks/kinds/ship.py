"""Study of file formats: size against PSNR on held-out views, by format and ratio."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, ClassVar

from benchmarks.process import measured, splat_transform
from benchmarks.rows import Row
from benchmarks.score import figures, score
from benchmarks.study import Cell, SceneSpec, Study
from benchmarks.workspace import Workspace, reduced
from g2ard import io
from g2ard.io.scene_formats import FORMATS
from g2ard.scene.splats import Splats

__all__ = ["PEER", "Ship"]

PEER = "splat-transform sog"


@dataclass(frozen=True)
class Ship(Study):
    """A study of formats: each scene is reduced, written, read back and scored against the dense scene.

    Args:
        methods: formats, or "splat-transform sog" for the SOG of that program.
    """

    METHODS: ClassVar[Mapping[str, Any]] = {name: name for name in (*FORMATS, PEER)}

    def cells(self, scene: SceneSpec, work: Path) -> Iterator[Cell]:
        """Yield a cell per ratio and format; .ply comes first, since `lost` is relative to it."""
        place = Workspace(work, self, scene)
        small = cache(lambda ratio: reduced(place.splats, ratio, place.train_cameras))
        for ratio in self.ratios:
            for name in dict.fromkeys(["ply", *self.methods]):
                names = {"ratio": ratio, "format": name}
                yield Cell(names, partial(self._measured, place, partial(small, ratio), name))

    def derived(self, rows: list[Row]) -> list[Row]:
        """Add the loss of each format: the PSNR of the .ply minus its own."""
        plain = {
            (row["scene"], row["ratio"], row["views_kind"]): row["psnr"]
            for row in rows
            if row["format"] == "ply" and "psnr" in row
        }
        return [
            {**row, "lost": plain[place] - row["psnr"]}
            if "psnr" in row and (place := (row["scene"], row["ratio"], row["views_kind"])) in plain
            else row
            for row in rows
        ]

    def _measured(self, place: Workspace, small: partial[Splats], name: str) -> Iterator[Row]:
        splats = small()
        with tempfile.TemporaryDirectory(prefix="g2ard-ship-") as folder:
            path = Path(folder) / ("scene.sog" if name == PEER else f"scene.{name}")
            seconds = self._write(path, splats, name)
            back = io.read_splats(path)
            size = path.stat().st_size
        for kind, targets in place.kinds_of_views.items():
            row = {"views_kind": kind, "count": len(splats), "bytes": size, "cpu_s": seconds}
            yield {**row, **figures(score(back, targets, place.scene.background))}

    def _write(self, path: Path, splats: Splats, name: str) -> float:
        """Write a file and return the CPU seconds; for splat-transform they include reading the .ply."""
        if name != PEER:
            began = time.process_time()
            io.write_splats(path, splats)
            return time.process_time() - began
        source = path.with_name("source.ply")
        io.write_splats(source, splats)
        return measured(splat_transform(str(source), str(path)), path.with_name("log")).cpu_s
