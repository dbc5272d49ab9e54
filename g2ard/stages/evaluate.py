"""Scores of a scene's renders against the targets, and the scene's size."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np

from g2ard.arrays import Float32
from g2ard.config.checks import checks_arguments
from g2ard.config.choices import BLACK, Colour
from g2ard.errors import InputError
from g2ard.io.images import as_saved
from g2ard.io.reports import Report
from g2ard.progress import Progress, plural, silent
from g2ard.rendering.exposure import rendered
from g2ard.rendering.metrics import METRICS, Lpips, lost_detail
from g2ard.rendering.renderer import RasterSettings, Renderer
from g2ard.rendering.targets import Targets, against_of, checked_targets, fill, mask_of, scored_in
from g2ard.scene.cameras import USUAL
from g2ard.scene.splats import HasSplats, Splats, scene_of
from g2ard.system.threads import in_threads


@dataclass(frozen=True)
class Scores(Report):
    """Scores by `g2ard.rendering.metrics.METRICS`, of a view or means over views; NaN where not measured.

    Args:
        psnr: PSNR, dB.
        ssim: SSIM, in [−1, 1].
        edge_psnr: PSNR of gradients, dB.
        detail: correlation of gradients, in [−1, 1].
    """

    psnr: float
    ssim: float = math.nan
    edge_psnr: float = math.nan
    detail: float = math.nan

    @property
    def scores(self) -> dict[str, float]:
        """Scores by name."""
        return {name: getattr(self, name) for name in METRICS}

    @classmethod
    def mean(
        cls, scores: Sequence[Scores], average: Callable[[Any], Any] = np.mean, **further: Any
    ) -> Self:
        """Return the means of several scores, with further fields."""
        means = {}
        for name in METRICS:
            values = [getattr(each, name) for each in scores]
            means[name] = float(average(values))
        return cls(**means, **further)


@dataclass(frozen=True, kw_only=True)
class ViewScore(Scores):
    """Scores of one view.

    Args:
        name: the view's name.
        lpips: LPIPS by network; empty without weights.
        against: "photo" or "teacher" if the targets say so.
        kind: kind of view (`Cameras.kinds`).
        size: width and height of the images in pixels.
        lost: visibility of the detail that the worst regions lack.
    """

    name: str
    lpips: Mapping[str, float] = field(default_factory=dict)
    against: str | None = None
    kind: str = USUAL
    size: tuple[int, int] = (0, 0)
    lost: float = math.nan


@dataclass(frozen=True, kw_only=True)
class Means(Scores):
    """Mean scores over views.

    Args:
        scored_in: number, kind and size of the views, such as "7 photos, 800×600 px".
    """

    scored_in: str


@dataclass(frozen=True, kw_only=True)
class Evaluation(Means):
    """Scores of a scene, means over a set of views.

    Args:
        count: number of Gaussians.
        bytes: size as float32 arrays, as in a .ply.
        views: one score per view, in camera order.
    """

    count: int
    bytes: int
    views: tuple[ViewScore, ...]

    def __repr__(self) -> str:
        scores = f"PSNR {self.psnr:.2f} dB, SSIM {self.ssim:.4f}"
        return f"Evaluation({plural(self.count, 'Gaussian')}, {self.scored_in}: {scores})"

    @property
    def lpips(self) -> dict[str, float]:
        """Mean of the views' LPIPS, by network."""
        return {
            net: float(np.mean([v.lpips[net] for v in self.views])) for net in self.views[0].lpips
        }

    @property
    def means(self) -> Means:
        """Means of the scores, and where they were measured."""
        return Means(**self.scores, scored_in=self.scored_in)

    def as_dict(self) -> dict[str, Any]:
        """Return the content of `g2ard evaluate --json`."""
        views = []
        for view in self.views:
            entry = {"name": view.name, "size": list(view.size), **view.scores, "lost": view.lost}
            if view.against:
                entry["against"] = view.against
            if view.kind != USUAL:
                entry["kind"] = view.kind
            views.append(entry)
        return {
            "count": self.count,
            "bytes": self.bytes,
            **self.scores,
            "lpips": self.lpips or None,
            "scored_in": self.scored_in,
            "views": views,
        }


@checks_arguments
def evaluate(
    splats: Splats | HasSplats,
    targets: Targets,
    *,
    background: Colour = BLACK,
    lpips: Mapping[str, Lpips] | None = None,
    settings: RasterSettings | None = None,
    eight_bit: bool = False,
    progress: Progress = silent,
    stage: str = "evaluate",
    watch: Callable[[int, ViewScore, Float32], None] | None = None,
) -> Evaluation:
    """Render every view of `targets` and score it.

    PSNR = −10·log₁₀ of the mean squared difference over pixels and channels, in dB, at most 100; SSIM (Wang
    et al. 2004) has an 11×11 Gaussian window, σ 1.5, zero-padded, values in 0–1; the PSNR of gradients is
    that of differences between neighbouring pixels, and detail their correlation, for thin structures. `lost`
    of a view is the visibility of the detail that its worst regions lack: above 1 people see the loss.
    Renders are clamped to [0, 1] without 8-bit rounding, unless `eight_bit` is set. If a photo has a mask,
    only masked pixels count.

    Args:
        splats: the scene, or a result that holds one; cameras are in world coordinates, including its offset.
        targets: photos or teacher renders; scores against the two are not comparable. With
            `g2ard.rendering.targets.Exposed` scores are measured after a fit of exposures.
        background: RGB in [0, 1] behind the scene.
        lpips: networks to score with, from `g2ard.rendering.metrics.load_lpips`.
        settings: the renderer's conventions; None means gsplat's. Teacher renders have their own, see
            `g2ard.rendering.targets.TeacherRenders`.
        eight_bit: round renders and targets to multiples of 1/255, as in evaluations from saved PNGs.
        progress: called after each view.
        stage: stage name for progress.
        watch: called with each view's row, score and render.

    Returns:
        One `ViewScore` per view, and their means.

    Raises:
        InputError: a photo cannot be read, or its mask leaves no pixel.

    >>> import numpy as np
    >>> import g2ard
    >>> rng = np.random.default_rng(0)
    >>> scene = Splats.create(rng.normal(size=(500, 3)), scales=np.full((500, 3), 0.1))
    >>> views = g2ard.make_pool(scene, 4, size=(64, 48))
    >>> scores = evaluate(scene.take(range(250)), g2ard.TeacherRenders(scene, views))
    >>> len(scores.views), 0 < scores.ssim < 1 < scores.psnr < 100
    (4, True)
    """
    splats = scene_of(splats)
    targets = checked_targets(targets)
    cameras = targets.cameras
    fill(targets, progress)
    renderer = Renderer(splats, background=background, settings=settings)

    def score(view: int) -> tuple[ViewScore, Float32 | None]:
        name = cameras.names[view]
        image = rendered(renderer, targets, view)
        target = targets[view]
        if eight_bit:
            image = as_saved(image)
            target = as_saved(target)
        perceived = {net: model(image, target) for net, model in (lpips or {}).items()}
        mask = mask_of(targets, view)
        if mask is not None and not mask.any():
            raise InputError(f"({name}) has no valid pixel", index=view, item="view")
        found = ViewScore(
            **{score: metric.measure(image, target, mask) for score, metric in METRICS.items()},
            name=name,
            lpips=perceived,
            against=against_of(targets, view),
            kind=cameras.kinds[view],
            size=(int(cameras.widths[view]), int(cameras.heights[view])),
            lost=lost_detail(image, target, mask),
        )
        return found, None if watch is None else image

    scores: list[ViewScore] = []
    progress(stage, 0, len(cameras))
    for view, (done, image) in enumerate(in_threads(score, range(len(cameras)))):
        scores.append(done)
        if watch is not None and image is not None:
            watch(view, done, image)
        progress(stage, len(scores), len(cameras))
    where = scored_in(targets)
    return Evaluation.mean(
        scores, count=len(splats), bytes=splats.nbytes, views=tuple(scores), scored_in=where
    )
