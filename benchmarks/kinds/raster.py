"""Study of a recovery step's passes against the machine's measured limits."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from benchmarks.rows import Row
from benchmarks.runner import Cell
from benchmarks.study import SceneSpec, Study, key
from benchmarks.workspace import Workspace
from g2ard import _core
from g2ard.errors import InputError
from g2ard.progress import plural
from g2ard.rendering.renderer import RasterSettings, arrays_of, view_of
from g2ard.scene.cameras import Cameras, look_at
from g2ard.scene.splats import Splats
from g2ard.stages.recover.engine import Photometric
from g2ard.stages.recover.schedule import Rates

__all__ = ["Raster", "built_in_view", "drawn"]

FLOPS_FORWARD, FLOPS_BACKWARD = 36, 55
"""Operations per contributing pixel–Gaussian pair, counted by hand (an FMA is two)."""


@dataclass(frozen=True)
class Raster(Study):
    """A study of `_core.Trainer`'s speed on seeded subsets of a scene, in a view of the whole scene.

    Args:
        methods: "best" instruction set, or "all" of them.
        counts: Gaussians drawn from the scene.
        image: width and height of the view, for scenes without views.
        threads: thread counts; 0 means the current one.
        repeats: timed steps; the fastest is recorded.
    """

    METHODS: ClassVar[Mapping[str, Any]] = {"best": "best", "all": "all"}

    counts: tuple[int, ...] = key((20_000, 100_000, 300_000), least=1, axis=True)
    image: tuple[int, int] = key((640, 480), least=1)
    threads: tuple[int, ...] = key((0,), least=0, axis=True)
    repeats: int = key(15, least=1)

    def cells(self, scene: SceneSpec, work: Path) -> Iterator[Cell]:
        """Yield a cell per count, instruction set and number of threads."""
        place = Workspace(work, self, scene)
        isas = _core.instruction_sets()
        for count in self.counts:
            for isa in isas if "all" in self.methods else isas[:1]:
                for threads in self.threads:
                    many = threads or _core.num_threads()
                    names = {"count": count, "isa": isa, "threads": many}
                    yield Cell(names, partial(self._measured, place, count, isa, many))

    def _measured(self, place: Workspace, count: int, isa: str, threads: int) -> list[Row]:
        before = _core.num_threads()
        try:
            _core.set_num_threads(threads)
            splats = place.splats
            view = place.train_cameras if place.scene.train else built_in_view(splats, *self.image)
            return [_row(drawn(splats, count, seed=self.seeds[0]), view, isa, self.repeats)]
        finally:
            _core.set_num_threads(before)


def drawn(splats: Splats, count: int, *, seed: int = 0) -> Splats:
    """Return a random subset of SH degree 3, with scales × √(N/n) to cover the same area.

    >>> s = Splats.create(np.zeros((100, 3)), scales=np.ones((100, 3)))
    >>> small = drawn(s, 25)
    >>> len(small), float(small.scales[0, 0]), small.sh_degree
    (25, 2.0, 3)
    """
    if not 1 <= count <= len(splats):
        raise InputError(f"the scene has {plural(len(splats), 'Gaussian')}, expected at least {count:,}")
    rows = np.sort(np.random.default_rng(seed).permutation(len(splats))[:count])
    taken = splats.take(rows).with_sh_degree(3)
    return replace(taken, scales=taken.scales * np.float32(np.sqrt(len(splats) / count)))


def built_in_view(splats: Splats, width: int, height: int) -> Cameras:
    """Return one view of the whole scene, 50° wide, from twice its radius and 25° above; up is −y."""
    means = splats.means.astype(np.float64) + splats.offset
    centre = np.median(means, axis=0)
    radius = float(np.percentile(np.linalg.norm(means - centre, axis=1), 95)) or 1.0
    angle = np.radians(25.0)
    away = np.array([np.cos(angle) * np.cos(0.7), -np.sin(angle), np.cos(angle) * np.sin(0.7)])
    focal = 0.5 * width / np.tan(np.radians(25.0))
    K = [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]
    pose = look_at(centre + 2 * radius * away, centre, up=(0, -1, 0))
    return Cameras.from_lists([pose], [K], [(width, height)], ["built-in"])


def _row(splats: Splats, cameras: Cameras, isa: str, repeats: int) -> Row:
    settings = RasterSettings(antialiased=False)
    arrays, view = arrays_of(splats), view_of(cameras.recentred(splats.offset), 0, settings)
    width, height = view[2]
    rasterizer = _core.Rasterizer(isa)
    target, _, _, _ = rasterizer.forward(arrays, view, settings, [0.0, 0.0, 0.0], 0)
    counts = rasterizer.counts()
    contributing = int(_core.accumulate(arrays, [view], settings)["hits"].sum())
    trainer = _core.Trainer(arrays, Photometric(settings, (0.0, 0.0, 0.0), 0.2), splats.scales.max(1), isa)
    limits = _core.machine_limits()
    passes = _milliseconds(trainer, view, np.ascontiguousarray(target[::-1]), repeats)
    memory, again = trainer.memory(), _core.machine_limits()
    flops_rate, bandwidth = max(limits[0], again[0]), max(limits[1], again[1])
    flops_ms = 1e-6 * contributing * (FLOPS_FORWARD + FLOPS_BACKWARD) / flops_rate
    bytes_ms = 1e-6 * _bytes(splats, counts, width * height) / bandwidth
    return {
        "width": width,
        "height": height,
        **passes,
        "total_ms": sum(passes.values()),
        "pairs": counts["pairs"],
        "contributing": contributing,
        "limit_flops_ms": flops_ms,
        "limit_bytes_ms": bytes_ms,
        "limit_share": max(flops_ms, bytes_ms) / (passes["forward_ms"] + passes["backward_ms"]),
        "fma_gflops": flops_rate,
        "read_gb_s": bandwidth,
        "gaussian_bytes": memory["gaussians"] / len(splats),
        "image_bytes": memory["images"],
    }


def _milliseconds(trainer: Any, view: Any, target: Any, repeats: int) -> dict[str, float]:
    """Return the best times of a step's passes; Adam's is what a step adds to the gradients' gathering."""
    rehearsals, steps = [], []
    for _ in range(repeats):
        trainer.gradients_only(view, target)
        rehearsals.append(trainer.passes())
        trainer.step(view, target, Rates(*[0.0] * 6))  # rates of 0 keep the scene
        steps.append(trainer.passes())
    fastest = min(rehearsals, key=lambda p: sum(p.values()))
    gather = min(p["gather"] for p in rehearsals)
    return {
        "forward_ms": 1e3 * sum(fastest[name] for name in ("project", "sort", "bin", "forward")),
        "backward_ms": 1e3 * (fastest["backward"] + fastest["gather"]),
        "loss_ms": 1e3 * min(p["loss"] for p in rehearsals),
        "adam_ms": 1e3 * max(0.0, min(p["gather"] for p in steps) - gather),
    }


def _bytes(splats: Splats, counts: dict[str, int], pixels: int) -> int:
    """Return the minimum memory traffic of a forward and a backward pass, bytes.

    Parameters of visible rows are read twice and gradients written once. Each pair reads its splat twice, and
    writes and reads ten sums. Each pixel has five values each way.
    """
    rows = 3 * 4 * (14 + 3 * splats.shN.shape[1]) * counts["visible"]
    return rows + counts["pairs"] * (2 * 8 + 2 * 64 + 2 * 40) + 2 * 4 * pixels * (3 + 1 + 1)
