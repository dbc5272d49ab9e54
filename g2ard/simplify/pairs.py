"""The policies `default` and `fast`: stages of merging, with what views see looked at again in between."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from g2ard import _core
from g2ard.errors import InputError
from g2ard.progress import Progress, counter
from g2ard.simplify.config import SimplifyConfig, schedule
from g2ard.splats import Splats

__all__ = ["Seen", "Visibility", "merge", "rows_of", "splats_of"]

_LADDER = {"default": (3.0, 1), "fast": (1.0, 3)}
"""Down to how many times the budget rows merge along Morton order, and in how many steps. A stage before the
last does so all the way."""

_REFRESH = 0.3
"""Visibility is looked at again when the count has fallen to this share of what it was."""


class Seen(Protocol):
    """What views say of N Gaussians, such as `g2ard.render.visibility` returns."""

    @property
    def weight(self) -> NDArray[Any]:
        """(N,) Σ αT over the pixels of the views."""

    @property
    def pixel_size(self) -> NDArray[Any]:
        """(N,) the size of a pixel there, scene units; ∞ where no view looks."""


Visibility = Seen | Callable[[Splats], Seen]


@dataclass(frozen=True, eq=False)
class _Views:
    weight: NDArray[np.float32]
    pixel_size: NDArray[np.float32]


def rows_of(seen: Seen, count: int, finite: NDArray[np.bool_] | slice) -> _Views:
    for name in ("weight", "pixel_size"):
        shape = getattr(seen, name).shape
        if shape != (count,):
            raise InputError(f"visibility.{name}: expected shape ({count},), got {shape}")
    weight, pixel = (np.asarray(a, np.float32)[finite] for a in (seen.weight, seen.pixel_size))
    return _Views(np.ascontiguousarray(weight), np.ascontiguousarray(pixel))


def merge(
    scene: Splats,
    budget: int,
    method: str,
    visibility: Visibility | None,
    flags: NDArray[np.bool_] | None,
    config: SimplifyConfig,
    progress: Progress,
) -> dict[str, Any]:
    """One stage, or with a function of visibility as many as the refreshes it is worth."""
    start, stages = len(scene), _Stages()
    first = seen = None
    while True:
        staged = callable(visibility) and 2 * budget < _REFRESH * len(scene)  # else not worth it
        target = math.ceil(_REFRESH * len(scene)) if staged else budget
        seen = rows_of(visibility(scene), len(scene), slice(None)) if callable(visibility) else visibility
        first = seen if first is None else first
        ladder, steps = _LADDER[method]
        out = _core.simplify_pairwise(
            scene,
            schedule(len(scene), target, config.retention_of(method)),
            protected=flags,
            weight=None if seen is None else seen.weight,
            pixel_size=None if seen is None else seen.pixel_size,
            min_opacity=config.min_opacity_of(method),
            ladder=1.0 if staged else ladder,
            ladder_steps=steps,
            neighbors=config.neighbors,
            geometric=config.geometric_weight,
            dilation=config.dilation,
            pixel_scale=config.pixel_scale,
            growth=config.max_growth,
            progress=_shifted(counter(progress, "simplify"), start - len(scene), start - budget),
        )
        stages.add(out)
        scene = splats_of(scene, out)
        flags = None if flags is None else out["protected"]
        if target == budget:
            break
    if callable(visibility) and first is not None:
        out["scales"] = _resized(scene, stages.parents, first.weight, visibility(scene).weight)
    return {**out, **stages.clamped, "parents": stages.parents, "rounds": stages.rounds}


class _Stages:
    """What the stages did, as if they had been one."""

    def __init__(self) -> None:
        self.parents: NDArray[np.int64] = np.empty(0, np.int64)
        self.rounds: list[dict[str, int]] = []
        self.clamped = {"clamped_logits": 0, "clamped_opacities": 0}

    def add(self, out: dict[str, Any]) -> None:
        before, now = self.parents, out["parents"]
        self.parents = np.where(before < 0, -1, now[before]) if self.rounds else now
        self.rounds += out["rounds"]
        self.clamped = {key: count + out[key] for key, count in self.clamped.items()}


def _resized(
    scene: Splats, parents: NDArray[np.int64], wanted: NDArray[Any], now: NDArray[Any]
) -> NDArray[np.float32]:
    """Scales with which the views see of each row about what they saw of its members: Σ αT is conserved.

    The area of the two longer axes takes the square root of the ratio, for neighbours share what is missing;
    a floor of 5 % of the mean keeps what is hardly seen as it is.

    Args:
        scene: M merged Gaussians.
        parents: (N,) the row each of N Gaussians went to, or −1.
        wanted: (N,) Σ αT of the N.
        now: (M,) Σ αT of the M.
    """
    kept = parents >= 0
    members = np.bincount(parents[kept], minlength=len(scene))
    target = np.bincount(parents[kept], wanted[kept], len(scene))
    floor = 0.05 * target.mean()
    area = np.sqrt(np.clip((target + floor) / np.maximum(now + floor, np.finfo(float).tiny), 0.7, 1.4))
    area[(members < 2) | ~np.isfinite(area)] = 1.0
    shortest = np.arange(3) == np.argmin(scene.scales, axis=1)[:, None]
    return np.where(shortest, scene.scales, scene.scales * np.sqrt(area)[:, None]).astype(np.float32)


def _shifted(tell: Callable[[int, int], None], done: int, total: int) -> Callable[[int, int], None]:
    return lambda here, _: tell(done + here, total)


def splats_of(like: Splats, out: dict[str, Any]) -> Splats:
    sh: NDArray[np.float32] = out["sh"]
    return Splats(
        means=out["means"].astype(like.means.dtype, copy=False),
        quats=out["quats"],
        scales=out["scales"],
        logit_opacities=out["logit_opacities"],
        sh0=np.ascontiguousarray(sh[:, :1]),
        shN=np.ascontiguousarray(sh[:, 1:]),
        offset=like.offset,
    )
