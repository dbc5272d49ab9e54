"""Study of the time of a recovery step on the CPU."""

from __future__ import annotations

import timeit
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

import g2ard._core as _core
from benchmarks.rows import Row
from benchmarks.study import Cell, SceneSpec, Study, key
from benchmarks.workspace import Workspace
from g2ard.errors import InputError
from g2ard.progress import plural
from g2ard.rendering.renderer import RasterSettings, arrays_of, view_of
from g2ard.scene.cameras import Cameras, look_at
from g2ard.scene.splats import Splats
from g2ard.stages.recover.config import Rates
from g2ard.stages.recover.engine import Photometric
from g2ard.system import devices

__all__ = ["GPU", "Raster", "built_in_view", "copied_behind", "drawn", "timed_step"]

GPU = "gpu: "
"""Prefix of an adapter's name among instruction sets."""


@dataclass(frozen=True)
class Raster(Study):
    """A study of `_core.Trainer`'s speed on seeded subsets of a scene, in a view of the whole scene.

    Args:
        methods: "best" instruction set, or "all" of them.
        counts: Gaussians drawn from the scene.
        image: width and height of the view, for scenes without views.
        threads: thread counts; 0 means the current one.
        copies: how often the drawn Gaussians stand in the scene; all but one are behind the view.
        repeats: timed steps; the fastest is recorded.
    """

    METHODS: ClassVar[Mapping[str, Any]] = {"best": "best", "all": "all"}

    counts: tuple[int, ...] = key((20_000, 100_000, 300_000), least=1, axis=True)
    image: tuple[int, int] = key((640, 480), least=1)
    threads: tuple[int, ...] = key((0,), least=0, axis=True)
    copies: tuple[int, ...] = key((1,), least=1, axis=True)
    repeats: int = key(15, least=1)

    def cells(self, scene: SceneSpec, work: Path) -> Iterator[Cell]:
        """Yield a cell per count, instruction set and number of threads."""
        place = Workspace(work, self, scene)
        isas = _core.instruction_sets()[: None if "all" in self.methods else 1]
        for count in self.counts:
            for isa in isas:
                for threads in self.threads:
                    many = threads or _core.num_threads()
                    for copies in self.copies:
                        names = {"count": count, "isa": isa, "threads": many, "copies": copies}
                        yield Cell(names, partial(self._measured, place, count, isa, many, copies))

    def _measured(
        self, place: Workspace, count: int, isa: str, threads: int, copies: int
    ) -> list[Row]:
        before = _core.num_threads()
        try:
            _core.set_num_threads(threads)
            splats = place.splats
            view = place.train_cameras if place.scene.train else built_in_view(splats, *self.image)
            shown = drawn(splats, count, seed=self.seeds[0])
            return [timed_step(copied_behind(shown, view, copies), view, isa, self.repeats)]
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
        raise InputError(
            f"the scene has {plural(len(splats), 'Gaussian')}, expected at least {count:,}"
        )
    rows = np.sort(np.random.default_rng(seed).permutation(len(splats))[:count])
    taken = splats.take(rows).with_sh_degree(3)
    return replace(taken, scales=taken.scales * np.float32(np.sqrt(len(splats) / count)))


def copied_behind(splats: Splats, cameras: Cameras, copies: int) -> Splats:
    """Return the scene and copies of it behind the first view, in a row that the view does not see."""
    size = float(np.ptp(splats.means, axis=0).max())
    here = cameras.positions[0] - splats.offset
    back = -cameras.viewmats[0, 2, :3]
    away = float(np.linalg.norm(splats.means - here, axis=1).max())
    shifts = [back * (away + (1 + k) * 2 * size) for k in range(copies - 1)]
    rows = np.tile(np.arange(len(splats)), copies)
    moves = np.concatenate([np.tile(shift, (len(splats), 1)) for shift in [np.zeros(3), *shifts]])
    taken = splats.take(rows)
    return replace(taken, means=(taken.means + moves).astype(np.float32))


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


def timed_step(splats: Splats, cameras: Cameras, isa: str | None, repeats: int) -> Row:
    """Time a recovery step in the first view, by an instruction set or on the device in use.

    Raises:
        InputError: the device failed.
    """
    settings = RasterSettings(antialiased=False)
    arrays, view = arrays_of(splats), view_of(cameras.recentred(splats.offset), 0, settings)
    width, height = view[2]
    rendered, *_ = _core.Rasterizer(isa).forward(arrays, view, settings, [0.0, 0.0, 0.0], 0)
    target = np.ascontiguousarray(rendered[::-1])
    trainer = _core.Trainer(
        arrays, Photometric(settings, (0.0, 0.0, 0.0), 0.2), splats.scales.max(1), isa
    )
    still = Rates(*[0.0] * 6)  # rates of 0 keep the scene
    rasterizer = _core.Rasterizer(isa)
    images = timeit.repeat(
        lambda: rasterizer.image(arrays, view, settings, [0.0, 0.0, 0.0]), number=1, repeat=repeats
    )
    steps = timeit.repeat(lambda: trainer.step(view, target, still), number=1, repeat=repeats)
    if notes := devices.notes():
        raise InputError(notes[0])
    return {
        "width": width,
        "height": height,
        "total_ms": 1e3 * min(steps),
        "image_ms": 1e3 * min(images),
        "contributing": int(_core.accumulate(arrays, [view], settings)["hits"].sum()),
    }
