"""How close a scene's renders come to the targets, and what the scene weighs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from g2ard.config.choices import BLACK, Colour
from g2ard.progress import Progress, silent
from g2ard.rendering.lpips import Lpips
from g2ard.rendering.metrics import psnr, ssim
from g2ard.scene.images import as_saved
from g2ard.scene.splats import Splats
from g2ard.scene.targets import Targets, against_of, mask_of

if TYPE_CHECKING:
    from g2ard.rendering.renderer import RasterSettings


@dataclass(frozen=True)
class ViewScore:
    """One view's figures: PSNR in dB, SSIM in [−1, 1], LPIPS by network, empty without weights; `against` is
    "photo" or "teacher" where the targets say so."""

    name: str
    psnr: float
    ssim: float
    lpips: Mapping[str, float] = field(default_factory=dict)
    against: str | None = None


@dataclass(frozen=True)
class Evaluation:
    """A scene's figures over some views.

    Args:
        count: Gaussians.
        bytes: of the scene as float32 arrays, the form a .ply holds.
        views: one score a view, in the cameras' order.
    """

    count: int
    bytes: int
    views: tuple[ViewScore, ...]

    @property
    def psnr(self) -> float:
        """Mean of the views' PSNR, in dB."""
        return float(np.mean([v.psnr for v in self.views]))

    @property
    def ssim(self) -> float:
        """Mean of the views' SSIM."""
        return float(np.mean([v.ssim for v in self.views]))

    @property
    def lpips(self) -> dict[str, float]:
        """Mean of the views' LPIPS, by network."""
        return {net: float(np.mean([v.lpips[net] for v in self.views])) for net in self.views[0].lpips}

    def as_dict(self) -> dict[str, Any]:
        """The keys of `g2ard evaluate --json`."""
        return {
            "count": self.count,
            "bytes": self.bytes,
            "psnr": self.psnr,
            "ssim": self.ssim,
            "lpips": self.lpips or None,
            "views": [
                {"name": v.name, "psnr": v.psnr, "ssim": v.ssim}
                | ({"against": v.against} if v.against else {})
                for v in self.views
            ],
        }


def evaluate(
    splats: Splats,
    targets: Targets,
    *,
    background: Colour = BLACK,
    lpips: Mapping[str, Lpips] | None = None,
    settings: RasterSettings | None = None,
    eight_bit: bool = False,
    progress: Progress = silent,
    stage: str = "evaluate",
) -> Evaluation:
    """Render every view of `targets` and score it.

    PSNR = −10·log₁₀ of the mean squared difference over pixels and channels, in dB, at most 100; SSIM (Wang
    et al. 2004) has an 11×11 Gaussian window, σ 1.5, zero-padded, values in 0–1. Renders are clamped to
    [0, 1] without 8-bit rounding, unless asked for. Where a photo has a mask, only its pixels count.

    Args:
        splats: the scene; its offset counts, cameras are in world coordinates.
        targets: photos or teacher renders; photo-relative and teacher-relative figures never mix.
        background: RGB in [0, 1] behind the scene.
        lpips: networks to score with as well, as `g2ard.rendering.lpips.load_lpips` finds them.
        settings: the renderer's conventions; None means gsplat's. A teacher's renders have their own, see
            `g2ard.scene.targets.TeacherRenders`.
        eight_bit: round renders and targets to multiples of 1/255, as evaluations from saved PNGs do.
        progress: told after each view.
        stage: the name progress is reported under.

    Returns:
        An `Evaluation`: one `ViewScore` a view, and their means.

    Raises:
        InputError: a photo cannot be read.
    """
    from g2ard.rendering.renderer import Renderer

    cameras = targets.cameras
    renderer = Renderer(splats, background=background, settings=settings)
    scores = []
    for view, name in enumerate(cameras.names):
        image, target = renderer.clipped(cameras[view]), targets[view]
        if eight_bit:
            image, target = as_saved(image), as_saved(target)
        perceived = {net: model(image, target) for net, model in (lpips or {}).items()}
        mask = mask_of(targets, view)
        figures = psnr(image, target, mask), ssim(image, target, mask)
        scores.append(ViewScore(name, *figures, perceived, against_of(targets, view)))
        progress(stage, view + 1, len(cameras))
    return Evaluation(len(splats), splats.nbytes, tuple(scores))
