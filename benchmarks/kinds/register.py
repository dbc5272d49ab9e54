"""Study of photo registration against maps of several sizes, from known starts."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
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
from g2ard.rendering.renderer import Renderer
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats
from g2ard.stages.register import PhotoReport, PoseError, RegisterConfig, pose_error, register
from g2ard.stages.register.pose import rotation_of
from g2ard.stages.register.report import KEPT

__all__ = ["STARTS", "Register", "displaced", "figures", "result_errors"]

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
_RECALLS = {"10": 0.10, "5": 0.05}
"""Name → limit in metres of a recall, within `_RECALL_DEGREES`."""
_RECALL_DEGREES = 5.0

GS_CPR: dict[str, Any] = {
    "register.refine": "none",
    "register.passes": 1,
    "register.min_inliers": 6,
    "register.fallback": False,
    "register.focal_sigma": 1e-6,
}
"""The protocol of GS-CPR: one pass of feature matching, without a fallback."""


@dataclass(frozen=True)
class Register(Study):
    """A study of registration. The test split of the scene's `train` is registered, the rest is the pool.

    Args:
        methods: matchers: auto, sift, direct, MODULE:FUNCTION.
        ratios: ratios of maps simplified without recovery; 1 is the original map.
        seeds: seeds of the starts.
        starts: names of `STARTS`.
        protocol: "g2ard", or "gs-cpr" for `GS_CPR`, in which photos without a pose count where they start.
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

    def _measured(
        self, site: _Site, ratio: float, matcher: str, start: str, seed: int
    ) -> list[Row]:
        splats, photos = site.maps(ratio), site.photos
        starts = site.starts_of(start, seed, splats)
        config = RegisterConfig(size=self.size or 1000, matcher=matcher)
        keep: Keep = "registered"
        if self.protocol == "gs-cpr":
            config, keep = changed(config, GS_CPR), "all"
        pool = None if starts else site.pool
        began = time.perf_counter()
        found = register(splats, photos, starts=starts, pool=pool, config=config, keep=keep)
        seconds = (time.perf_counter() - began) / len(photos)
        rows = found.report.photos
        given = starts or dict(zip(site.pool.names, site.pool.viewmats, strict=True))
        kept = [row for row in rows if row.status in KEPT[keep]]
        total, metres = len(photos), self.metres_per_unit
        before = figures(start_errors(rows, given, site.truth), total, metres)
        reached = figures(result_errors(kept, site.truth), total, metres)
        return [
            {
                "count": len(splats),
                "bytes": splats.nbytes,
                "photos": total,
                "registered": found.report.count("registered"),
                "uncertain": found.report.count("uncertain"),
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


def start_errors(rows: Sequence[PhotoReport], starts: Poses, truth: Poses) -> list[PoseError]:
    """Return the errors of the poses that photos started from, by the names of the poses."""
    return [PoseError(*pose_error(starts[row.start], truth[row.name])) for row in rows if row.start]


def result_errors(rows: Sequence[PhotoReport], truth: Poses) -> list[PoseError]:
    """Return the errors of the poses that were found."""
    poses = [(row.name, np.array(row.camera_from_world)) for row in rows if row.camera_from_world]
    return [PoseError(*pose_error(pose, truth[name])) for name, pose in poses]


def figures(
    errors: Sequence[PoseError], total: int, metres: float | None
) -> dict[str, float | None]:
    """Return median position and rotation, worst position, and the shares of all photos within limits.

    Positions are in cm if `metres`, the scale of the scene, is known. Photos without a pose count as missed.
    """
    values = np.array([(error.position, error.rotation) for error in errors]).reshape(-1, 2)
    shares: dict[str, float | None] = dict.fromkeys(_RECALLS)
    for name, limit in _RECALLS.items() if metres is not None else ():
        within = (values[:, 0] * metres <= limit) & (values[:, 1] <= _RECALL_DEGREES)
        shares[name] = int(within.sum()) / total
    if not len(values):
        return {**shares, "position": None, "rotation": None, "worst": None}
    scale = 1.0 if metres is None else 100 * metres
    position, rotation = np.median(values, 0).tolist()
    worst = float(values[:, 0].max())
    return {**shares, "position": position * scale, "rotation": rotation, "worst": worst * scale}
