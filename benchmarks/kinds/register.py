"""Study of photo registration against maps of several sizes, from known starts."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from benchmarks.rows import Row
from benchmarks.runner import Cell
from benchmarks.study import SceneSpec, Study, key
from benchmarks.workspace import Workspace, reduced
from g2ard.config.choices import Keep
from g2ard.config.paths import changed
from g2ard.config.presets import GS_CPR
from g2ard.errors import InputError
from g2ard.io import read_view_set
from g2ard.jobs.register import photos_of, poses_for
from g2ard.rendering.renderer import Renderer
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats
from g2ard.stages.register import RegisterConfig, register
from g2ard.stages.register.pose import rotation_of
from g2ard.stages.register.report import Accuracy, summarize

__all__ = ["STARTS", "Register", "displaced"]

STARTS: dict[str, tuple[float, float] | None] = {
    "A": (0.01, 0.4),
    "B": (0.05, 5.0),
    "C": (0.15, 15.0),
    "D": None,
    "given": None,
}
"""Errors of starts: share of the view's median depth, and degrees. D starts from a pool of other views, given
from the scene's `starts`."""
_NEAR, _NEARER = 1, 0
"""Indices of 10 cm/5° and 5 cm/5° in the report's recalls."""


@dataclass(frozen=True)
class Register(Study):
    """A study of registration. The test split of the scene's `train` is registered, the rest is the pool.

    Args:
        methods: matchers: auto, sift, direct, MODULE:FUNCTION.
        ratios: ratios of maps simplified without recovery; 1 is the original map.
        seeds: seeds of the starts.
        starts: names of `STARTS`.
        protocol: "g2ard", or "gs-cpr" as `g2ard register --protocol gs-cpr`: one pass of matches, and photos
            without a pose count where they start.
        metres_per_unit: scale of the scene, for errors in cm and recalls.
    """

    METHODS: ClassVar[Mapping[str, Any]] = {name: name for name in ("auto", "sift", "direct")}

    starts: tuple[str, ...] = key(("A", "B", "C", "D"), choices=tuple(STARTS), axis=True)
    protocol: str = key("g2ard", choices=("g2ard", "gs-cpr"))
    metres_per_unit: float | None = key(None, least=1e-9)

    def cells(self, scene: SceneSpec, work: Path) -> Iterator[Cell]:
        """Yield a cell per ratio, matcher, start and seed; the pool (D) has no seeds."""
        if scene.train is None:
            raise InputError(f"scene {scene.name}: needs photos with true poses; give --views")
        if "given" in self.starts and scene.starts is None:
            raise InputError(f"scene {scene.name}: start `given` needs the scene's `starts`")
        place, views = Workspace(work, self, scene), self.folder / scene.train
        given = None if scene.starts is None else self.folder / scene.starts
        pool = cache(lambda: read_view_set(views, split="train", unpictured=True).cameras)
        photos = cache(lambda: photos_of(views, split="test", say=lambda text: None))
        small = cache(lambda ratio: reduced(place.splats, ratio, pool()))
        for ratio in self.ratios:
            for matcher in self.methods:
                for name in self.starts:
                    for seed in self.seeds if STARTS[name] else self.seeds[:1]:
                        names = {"ratio": ratio, "matcher": matcher, "start": name, "seed": seed}
                        yield Cell(
                            names, partial(self._measured, partial(small, ratio), photos, pool, given, names)
                        )

    def _measured(
        self,
        small: partial[Splats],
        photos_: Callable[[], Cameras],
        pool: Callable[[], Cameras],
        given: Path | None,
        names: dict[str, object],
    ) -> list[Row]:
        splats, photos, off = small(), photos_(), STARTS[str(names["start"])]
        truth = dict(zip(photos.names, photos.viewmats, strict=True))
        starts: dict[str, NDArray[np.float64]] | None = None
        if names["start"] == "given":
            assert given is not None
            starts = poses_for(given, photos.names)
        elif off is not None:
            seed = 1000 * int(str(names["seed"]))
            starts = {
                photo: displaced(pose, off[0] * depth, off[1], seed + i)
                for i, ((photo, pose), depth) in enumerate(
                    zip(truth.items(), _depths(splats, photos), strict=True)
                )
            }
        config = RegisterConfig(size=self.size or 1000, matcher=str(names["matcher"]))
        keep: Keep = "registered"
        if self.protocol == "gs-cpr":
            config, keep = changed(config, GS_CPR), "all"
        began = time.perf_counter()
        found = register(
            splats,
            photos,
            starts=starts,
            pool=None if starts else pool(),
            truth=truth,
            config=config,
            keep=keep,
        )
        seconds = (time.perf_counter() - began) / len(photos)
        metres = self.metres_per_unit
        summary = summarize(found.report.photos, keep=keep, true=len(truth), metres_per_unit=metres)
        assert summary.start is not None
        assert summary.found is not None
        scale = 1.0 if metres is None else 100 * metres
        start, reached = _figures(summary.start, scale), _figures(summary.found, scale)
        return [
            {
                "count": len(splats),
                "bytes": len(splats) * 4 * (14 + 3 * ((splats.sh_degree + 1) ** 2 - 1)),
                "photos": len(photos),
                "registered": summary.registered,
                "uncertain": summary.uncertain,
                **{f"start_{name}": value for name, value in start.items() if name != "worst"},
                **{name: reached[name] for name in ("position", "rotation", "worst")},
                **{f"found_{name}": reached[name] for name in ("10", "5")},
                "seconds": seconds,
            }
        ]


def displaced(
    viewmat: NDArray[np.float64], distance: float, degrees: float, seed: int
) -> NDArray[np.float64]:
    """Return a (4, 4) pose moved by `distance` in a random direction and turned about a random axis."""
    v, w = np.random.default_rng(seed).normal(size=(2, 3))
    R = viewmat[:3, :3]
    centre = -R.T @ viewmat[:3, 3] + distance * v / np.linalg.norm(v)
    out = np.eye(4)
    out[:3, :3] = rotation_of(np.radians(degrees) * w / np.linalg.norm(w)) @ R
    out[:3, 3] = -out[:3, :3] @ centre
    return out


def _depths(splats: Splats, views: Cameras) -> list[float]:
    """Return the median depth of each view over opaque pixels, or 1 without any."""
    renderer, out = Renderer(splats), []
    for view in views.resized(250):
        depth = renderer.render(view, median=True).median
        assert depth is not None
        out.append(float(np.median(depth[depth > 0])) if (depth > 0).any() else 1.0)
    return out


def _figures(accuracy: Accuracy, scale: float) -> dict[str, float | None]:
    """Return median position and rotation, worst position, and shares within 10 cm and 5 cm."""
    shares = [accuracy.recalls[i].share if accuracy.recalls else None for i in (_NEAR, _NEARER)]
    out: dict[str, float | None] = dict(zip(("10", "5"), shares, strict=True))
    if accuracy.median is None or accuracy.worst is None:
        return {**out, "position": None, "rotation": None, "worst": None}
    median, worst = accuracy.median, accuracy.worst.position
    return {**out, "position": median.position * scale, "rotation": median.rotation, "worst": worst * scale}
