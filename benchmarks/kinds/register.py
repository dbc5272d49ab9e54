"""Study of photo registration against maps of several sizes, from known starts."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from benchmarks.rows import Row
from benchmarks.study import Cell, SceneSpec, Study, key
from benchmarks.workspace import Workspace, reduced
from g2ard import io
from g2ard.config.choices import Keep
from g2ard.config.schema import changed
from g2ard.errors import InputError
from g2ard.jobs.register import photos_of, poses_for
from g2ard.pipeline.presets import GS_CPR
from g2ard.rendering.renderer import Renderer
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats
from g2ard.stages.register import RegisterConfig, register
from g2ard.stages.register.pose import rotation_of
from g2ard.stages.register.report import Accuracy, summarize

__all__ = ["STARTS", "Register", "displaced"]

Poses = dict[str, NDArray[np.float64]]

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
        site = _Site(work, self, scene)
        for ratio in self.ratios:
            for matcher in self.methods:
                for name in self.starts:
                    for seed in self.seeds if STARTS[name] else self.seeds[:1]:
                        names = {"ratio": ratio, "matcher": matcher, "start": name, "seed": seed}
                        yield Cell(names, partial(self._measured, site, ratio, matcher, name, seed))

    def _measured(self, site: _Site, ratio: float, matcher: str, start: str, seed: int) -> list[Row]:
        splats, photos = site.maps(ratio), site.photos
        starts = site.starts_of(start, seed, splats)
        config = RegisterConfig(size=self.size or 1000, matcher=matcher)
        keep: Keep = "registered"
        if self.protocol == "gs-cpr":
            config, keep = changed(config, GS_CPR), "all"
        pool = None if starts else site.pool
        began = time.perf_counter()
        found = register(splats, photos, starts=starts, pool=pool, truth=site.truth, config=config, keep=keep)
        seconds = (time.perf_counter() - began) / len(photos)
        metres = self.metres_per_unit
        summary = summarize(found.report.photos, keep=keep, true=len(photos), metres_per_unit=metres)
        assert summary.start is not None
        assert summary.found is not None
        scale = 1.0 if metres is None else 100 * metres
        before, reached = _figures(summary.start, scale), _figures(summary.found, scale)
        return [
            {
                "count": len(splats),
                "bytes": splats.nbytes,
                "photos": len(photos),
                "registered": summary.registered,
                "uncertain": summary.uncertain,
                **{f"start_{name}": value for name, value in before.items() if name != "worst"},
                **{name: reached[name] for name in ("position", "rotation", "worst")},
                **{f"found_{name}": reached[name] for name in ("10", "5")},
                "seconds": seconds,
            }
        ]


class _Site(Workspace):
    """Photos with true poses, the other views, and maps of several sizes."""

    @cached_property
    def photos(self) -> Cameras:
        """The test split of the scene's views."""
        return photos_of(self.place / str(self.scene.train), split="test", say=lambda text: None)

    @cached_property
    def pool(self) -> Cameras:
        """The training split."""
        views = self.place / str(self.scene.train)
        return io.read_view_set(views, split="train", unpictured=True).cameras

    @cached_property
    def maps(self) -> Callable[[float], Splats]:
        """Ratio → the map, each made once."""
        return cache(lambda ratio: reduced(self.splats, ratio, self.pool))

    @property
    def truth(self) -> Poses:
        """The true poses by photo."""
        return dict(zip(self.photos.names, self.photos.viewmats, strict=True))

    def starts_of(self, name: str, seed: int, splats: Splats) -> Poses | None:
        """Return the starts of a name of `STARTS`; None if they come from the pool."""
        if name == "given":
            return poses_for(self.place / str(self.scene.starts), self.photos.names)
        error = STARTS[name]
        if error is None:
            return None
        share, degrees = error
        depths = _depths(splats, self.photos)
        return {
            photo: displaced(pose, share * depth, degrees, 1000 * seed + i)
            for i, ((photo, pose), depth) in enumerate(zip(self.truth.items(), depths, strict=True))
        }


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
