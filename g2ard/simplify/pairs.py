"""The policies `default` and `fast`: stages of merging, with what views see looked at again in between."""

from __future__ import annotations

import itertools
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

__all__ = ["Seen", "Visibility", "merge", "merge_looking", "rows_of", "splats_of"]

_LADDER = {"default": (3.0, 1), "fast": (1.0, 2)}
"""Down to how many times the budget rows merge along Morton order, and in how many steps. A stage before the
last does so all the way."""

_BLIND = 1 / 3
"""How much of its weight the error of coverage has where nothing is known of what views see."""

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
    seen: Seen | None,
    flags: NDArray[np.bool_] | None,
    config: SimplifyConfig,
    tell: Callable[[int, int], None],
    *,
    stage: int = 0,
    last: bool = True,
) -> dict[str, Any]:
    """One stage of `default` or `fast`; `seen` has a row for each of the scene's."""
    ladder, steps = _LADDER[method]
    return _core.simplify_pairwise(
        scene,
        schedule(len(scene), budget, config.retention_of(method)),
        protected=flags,
        weight=None if seen is None else seen.weight,
        pixel_size=None if seen is None else seen.pixel_size,
        min_opacity=0.0 if stage else config.min_opacity_of(method),  # merged clusters are no chaff
        ladder=ladder if last else 1.0,
        ladder_steps=steps,
        neighbors=config.neighbors,
        geometric=config.geometric_weight * (_BLIND if seen is None else 1.0),
        dilation=config.dilation,
        pixel_scale=config.pixel_scale,
        growth=config.max_growth,
        progress=tell,
    )


def merge_looking(
    scene: Splats,
    budget: int,
    method: str,
    look: Callable[[Splats], Seen],
    flags: NDArray[np.bool_] | None,
    config: SimplifyConfig,
    progress: Progress,
) -> dict[str, Any]:
    """As many stages as the refreshes are worth; what they join is then made of its raw members."""
    whole, part = scene, flags
    tell = counter(progress, "simplify")
    first = seen = rows_of(look(scene), len(scene), slice(None))
    parents = np.arange(len(scene))
    rounds: list[dict[str, int]] = []
    for stage in itertools.count():
        last = 2 * budget >= _REFRESH * len(scene)  # else not worth it
        target = budget if last else math.ceil(_REFRESH * len(scene))
        shifted = _shifted(tell, len(whole) - len(scene), len(whole) - budget)
        out = merge(scene, target, method, seen, part, config, shifted, stage=stage, last=last)
        rounds += out["rounds"]
        parents = np.where(parents < 0, -1, out["parents"][parents])
        if last:
            break
        scene, part = splats_of(scene, out), None if part is None else out["protected"]
        seen = rows_of(look(scene), len(scene), slice(None))
    if stage:
        out = _core.simplify_pool(
            whole,
            parents,
            budget,
            protected=flags,
            weight=first.weight,
            pixel_size=first.pixel_size,
            dilation=config.dilation,
            pixel_scale=config.pixel_scale,
            growth=config.max_growth,
        )
    merged = splats_of(whole, out)
    order = _core.simplify_order(whole)  # sums round alike whatever the order of the rows
    scales = _resized(merged, parents[order], first.weight[order], look(merged).weight)
    resized = int(np.count_nonzero((scales != merged.scales).any(axis=1)))
    return {**out, "scales": scales, "parents": parents, "rounds": rounds, "resized": resized}


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
