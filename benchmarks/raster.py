"""How fast a recovery step is, pass by pass, and how near the machine's measured limit."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from g2ard import _core
from g2ard.errors import InputError
from g2ard.progress import Progress, plural, silent
from g2ard.rendering.renderer import RasterSettings, arrays_of, view_of
from g2ard.scene.cameras import Cameras, look_at
from g2ard.scene.splats import Splats
from g2ard.stages.recover.schedule import Rates

__all__ = ["RasterBench", "SceneFigures", "bench_raster", "built_in_view", "cpu_name", "drawn"]

FLOPS_FORWARD, FLOPS_BACKWARD = 36, 55
"""Per contributing pixel–Gaussian: what the formulae need, counted by hand (an FMA is two)."""


@dataclass(frozen=True)
class SceneFigures:
    """One scene, size, instruction set and number of threads.

    Args:
        ms: milliseconds of the best of the repeats: project, sort, bin, forward, backward (to the parameters'
            gradients), loss (L1 + SSIM, both ways), adam, total.
        pairs: (tile, Gaussian) pairs.
        contributing: (pixel, Gaussian) pairs with α ≥ 1/255 in front of a stopped pixel.
        limit_ms: flops over the measured FMA rate; bytes over the measured bandwidth.
        memory: bytes that a trainer's parameters, moments and buffers hold after a step: "gaussians" in what
            grows with them (their pairs too), "per_gaussian" that over their count, "images" in the rest.
        limit_share: the larger limit over project + sort + bin + forward + backward.
    """

    count: int
    width: int
    height: int
    isa: str
    threads: int
    ms: dict[str, float]
    pairs: int
    contributing: int
    gflops: float
    limit_ms: dict[str, float]
    memory: dict[str, float]
    limit_share: float


@dataclass(frozen=True)
class RasterBench:
    """All figures, and the machine they were measured on, in the same run."""

    scenes: tuple[SceneFigures, ...]
    machine: dict[str, Any]

    def as_dict(self) -> dict[str, Any]:
        """The JSON of `python -m benchmarks raster`."""
        return asdict(self)


def drawn(splats: Splats, count: int, *, seed: int = 0) -> Splats:
    """A seeded random subset with scales × √(N/n), so that it covers what the scene covers; SH padded to 3.

    >>> s = Splats.create(np.zeros((100, 3)), scales=np.ones((100, 3)))
    >>> small = drawn(s, 25)
    >>> len(small), float(small.scales[0, 0]), small.sh_degree
    (25, 2.0, 3)
    """
    if not 1 <= count <= len(splats):
        raise InputError(f"count: expected 1 to {len(splats)}, got {count}")
    rows = np.sort(np.random.default_rng(seed).permutation(len(splats))[:count])
    taken = splats.take(rows).with_sh_degree(3)
    return Splats(
        means=taken.means,
        quats=taken.quats,
        scales=taken.scales * np.float32(np.sqrt(len(splats) / count)),
        logit_opacities=taken.logit_opacities,
        sh0=taken.sh0,
        shN=taken.shN,
        offset=taken.offset,
    )


def built_in_view(splats: Splats, width: int, height: int) -> Cameras:
    """One view of the whole scene: from twice its radius, 25° above, 50° wide; up is −y, as in most 3DGS."""
    means = splats.means.astype(np.float64) + splats.offset
    centre = np.median(means, axis=0)
    radius = float(np.percentile(np.linalg.norm(means - centre, axis=1), 95)) or 1.0
    angle = np.radians(25.0)
    away = np.array([np.cos(angle) * np.cos(0.7), -np.sin(angle), np.cos(angle) * np.sin(0.7)])
    focal = 0.5 * width / np.tan(np.radians(25.0))
    K = [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]
    pose = look_at(centre + 2 * radius * away, centre, up=(0, -1, 0))
    return Cameras.from_lists([pose], [K], [(width, height)], ["built-in"])


def bench_raster(
    splats: Splats,
    cameras: Cameras | None = None,
    *,
    counts: Sequence[int] = (20_000, 100_000, 300_000),
    sizes: Sequence[tuple[int, int]] = ((640, 480),),
    isas: Sequence[str] | None = None,
    threads: Sequence[int] | None = None,
    repeats: int = 15,
    seed: int = 0,
    progress: Progress = silent,
) -> RasterBench:
    """Time whole recovery steps of `_core.Trainer` on seeded subsets of a scene.

    The machine's limits are measured beside every row, with the row's threads and the best instruction set.

    Args:
        splats: the scene the subsets are drawn from; counts beyond it are left out.
        cameras: its first view is used at its own size; None means `built_in_view` at each of `sizes`.
        counts: Gaussians.
        sizes: (width, height) of the built-in view.
        isas: instruction sets, None for the best one (`_core.instruction_sets()` names all).
        threads: thread counts, None for the current one.
        repeats: steps timed; the fastest counts.
        seed: of the draw.

    Returns:
        One row for each count × size × instruction set × thread count.

    Raises:
        InputError: no count fits the scene.
    """
    before = _core.num_threads()
    counts = [n for n in counts if n <= len(splats)]
    if not counts:
        raise InputError(f"counts: the scene has only {plural(len(splats), 'Gaussian')}")
    isas = isas or _core.instruction_sets()[:1]
    threads = threads or [before]
    rows: list[SceneFigures] = []
    best = (0.0, 0.0)
    total = len(counts) * len(isas) * len(threads) * (1 if cameras is not None else len(sizes))
    try:
        for count in counts:
            scene = drawn(splats, count, seed=seed)
            for view in [cameras] if cameras is not None else [built_in_view(splats, *s) for s in sizes]:
                for isa in isas:
                    for thread_count in threads:
                        _core.set_num_threads(thread_count)
                        row, limits = _measure(scene, view, isa, thread_count, repeats)
                        rows.append(row)
                        best = max(best[0], limits[0]), max(best[1], limits[1])
                        progress("bench raster", len(rows), total)
    finally:
        _core.set_num_threads(before)
    machine = {"cpu": cpu_name(), "fma_gflops": best[0], "read_gb_s": best[1]}
    return RasterBench(tuple(rows), machine)


def _measure(
    splats: Splats, cameras: Cameras, isa: str, threads: int, repeats: int
) -> tuple[SceneFigures, tuple[float, float]]:
    settings = RasterSettings()
    local = cameras.recentred(splats.offset)
    arrays, view = arrays_of(splats), view_of(local, 0, settings)
    width, height = view[2]
    rasterizer = _core.Rasterizer(isa)
    target, _, _, _ = rasterizer.forward(arrays, view, settings, [0.0, 0.0, 0.0], False)
    counts = rasterizer.counts()
    contributing = int(_core.accumulate(arrays, [view], settings)["hits"].sum())
    trainer = _core.Trainer(arrays, splats.scales.max(1), isa)
    step_input = (view, settings, [0.0, 0.0, 0.0], np.ascontiguousarray(target[::-1]), 0.2)
    limits = _core.machine_limits()
    rehearsals, steps = [], []
    for _ in range(repeats):
        trainer.gradients_only(*step_input)
        rehearsals.append(trainer.passes())
        trainer.step(*step_input, Rates(*[0.0] * 6))  # rates of 0: every repeat times the same scene
        steps.append(trainer.passes())
    memory = trainer.memory()
    again = _core.machine_limits()
    limits = max(limits[0], again[0]), max(limits[1], again[1])
    fastest = min(rehearsals, key=lambda p: sum(p.values()))
    ms = {name: 1e3 * fastest[name] for name in ("project", "sort", "bin", "forward")}
    ms["backward"] = 1e3 * (fastest["backward"] + fastest["gather"])
    raster = sum(ms.values())
    ms["loss"] = 1e3 * min(p["loss"] for p in rehearsals)
    gather = min(p["gather"] for p in rehearsals)
    ms["adam"] = 1e3 * max(0.0, min(p["gather"] for p in steps) - gather)
    ms["total"] = sum(ms.values())
    flops = contributing * (FLOPS_FORWARD + FLOPS_BACKWARD)
    limit_ms = {
        "flops": 1e-6 * flops / limits[0],
        "bytes": 1e-6 * _bytes(splats, counts, width * height) / limits[1],
    }
    figures = SceneFigures(
        count=len(splats),
        width=width,
        height=height,
        isa=isa,
        threads=threads,
        ms=ms,
        pairs=counts["pairs"],
        contributing=contributing,
        gflops=1e-6 * flops / (ms["forward"] + ms["backward"]),
        limit_ms=limit_ms,
        memory={**memory, "per_gaussian": memory["gaussians"] / len(splats)},
        limit_share=max(limit_ms.values()) / raster,
    )
    return figures, limits


def _bytes(splats: Splats, counts: dict[str, int], pixels: int) -> int:
    """What a forward and a backward pass cannot but move: visible rows' parameters in twice and gradients out
    once, each pair's splat in twice and its ten sums out and in, five values a pixel each way."""
    rows = 3 * 4 * (14 + 3 * splats.shN.shape[1]) * counts["visible"]
    return rows + counts["pairs"] * (2 * 8 + 2 * 64 + 2 * 40) + 2 * 4 * pixels * (3 + 1 + 1)


def cpu_name() -> str:
    """The processor's name, as its maker gives it where the system tells."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return platform.processor() or platform.machine()
    names = (line.split(":", 1)[1].strip() for line in text.splitlines() if line.startswith("model name"))
    return next(names, platform.machine())
