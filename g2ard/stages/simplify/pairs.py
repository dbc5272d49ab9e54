"""The methods `default` and `fast` ("pairwise" in the core): merging weighted by visibility, then fitting
opacities."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

import g2ard._core as _core
from g2ard.arrays import Float32, Mask, Values
from g2ard.errors import InputError
from g2ard.progress import Progress, counter
from g2ard.rendering.recolour import recoloured
from g2ard.rendering.visibility import SampledVisibility
from g2ard.scene.prepared import MAX_OPACITY, PreparedScene
from g2ard.scene.regions import in_any
from g2ard.scene.splats import DRAWN_LOGIT, Splats
from g2ard.stages.simplify.config import Default, Pairs

_OPACITY_FIT_EXPONENT = 1 / 4
"""Exponent of the ratio of wanted to current visibility: ½ fits the given views by up to 0.1 dB better, and
others by up to 0.7 dB worse (decision 0009)."""

_OPACITY_FIT_LIMITS = (0.5, 2.0)
"""Limits of that ratio."""

_OPACITY_FIT_FLOOR = 0.05
"""Share of the mean added to both sides of the ratio, so that hardly visible rows stay unchanged."""

MANY = 20
"""Mean number of members from which `default` fits colours: fewer share about one colour, and a fit to some
views loses in others as much as it gains (decision 0009)."""

DRAWN_OPACITY = float(1 / (1 + np.exp(-DRAWN_LOGIT)))
"""Least α that renderers draw."""


VisibilitySource = Callable[[Splats], SampledVisibility]
"""Function scene → visibility, such as `g2ard.rendering.visibility.visibility_source` returns."""


def rows_of(visibility: SampledVisibility, count: int, finite: Mask | slice) -> SampledVisibility:
    for name in ("weight", "pixel_size"):
        shape = getattr(visibility, name).shape
        if shape != (count,):
            raise InputError(f"visibility.{name}: expected shape ({count},), got {shape}")
    weight, pixel = (
        np.asarray(a, np.float32)[finite] for a in (visibility.weight, visibility.pixel_size)
    )
    return SampledVisibility(np.ascontiguousarray(weight), np.ascontiguousarray(pixel))


def emphasised(scene: Splats, visibility: SampledVisibility, config: Pairs) -> SampledVisibility:
    """Emphasise the regions to keep, as if views were √keep_times times closer.

    Inside them, weights are multiplied by keep_times and pixel sizes divided by √keep_times.
    """
    if not config.keep_region:
        return visibility
    inside = in_any(scene, config.keep_region)
    times = np.where(inside, np.float32(config.keep_times), np.float32(1))
    pixel_size = (visibility.pixel_size / np.sqrt(times)).astype(np.float32)
    return SampledVisibility(visibility.weight * times, pixel_size)


def merge(
    scene: PreparedScene,
    budget: int,
    visibility: SampledVisibility | None,
    protected: Mask | None,
    config: Pairs,
    progress: Progress,
) -> dict[str, Any]:
    """Merge by `default` or `fast`; `visibility` has one row per Gaussian of the scene."""
    config = config.resolved(antialiased=scene.antialiased, ratio=len(scene) / budget)
    progress("simplify", 0, 0)
    return _core.simplify_pairwise(
        scene.core,
        config.rounds(len(scene), budget),
        config,
        protected=protected,
        visibility=None if visibility is None else emphasised(scene, visibility, config),
        progress=counter(progress, "simplify"),
    )


def merge_and_fit(
    scene: PreparedScene,
    budget: int,
    source: VisibilitySource,
    protected: Mask | None,
    config: Pairs,
    progress: Progress,
) -> dict[str, Any]:
    """Merge by visibility, then fit each merged Gaussian's opacity so that views see as much of it as of its
    members. `default` also fits colours if Gaussians join many members, and `source` has `views`."""
    visibility = rows_of(source(scene), len(scene), slice(None))
    out = merge(scene, budget, visibility, protected, config, progress)
    merged = splats_of(scene, out)
    parents = out["parents"]
    order = scene.core.order  # sums in this order do not depend on the order of the scene's rows
    row = parents[order]
    weight = visibility.weight[order]
    kept = row >= 0
    members = np.bincount(row[kept], minlength=len(merged))
    wanted = np.bincount(row[kept], weight[kept], len(merged))
    weight = source(merged).weight
    progress("opacities", 0, 0)
    fitted = fit_opacities(merged, members, wanted, weight, wanted.mean())
    changed = fitted.logit_opacities != merged.logit_opacities
    changed |= (fitted.scales != merged.scales).any(axis=1)
    views = getattr(source, "views", None)
    if views is not None and isinstance(config, Default) and len(scene) >= MANY * budget:
        fitted = recoloured(scene.take(order), fitted, views, progress)
    return {
        **out,
        "sh": np.concatenate([fitted.sh0, fitted.shN], axis=1),
        "scales": fitted.scales,
        "logit_opacities": fitted.logit_opacities,
        "fitted": int(np.count_nonzero(changed)),
        "unseen": int(np.count_nonzero((visibility.weight == 0) & (parents >= 0))),
    }


def fit_opacities(
    scene: Splats, members: Values, wanted: Values, now: Values, mean: float
) -> Splats:
    """Fit opacities so that views see about as much of each row as of its members.

    α is multiplied by ratio^¼, with the ratio limited to 0.5–2, because neighbours share a deficit and other
    views need less. Excess over α = 0.99 goes to the area of the two longer axes. A floor of 5 % of the mean
    keeps hardly visible rows unchanged. Rows that did not merge, or that would no longer be drawn, are kept.

    Args:
        scene: M merged Gaussians.
        members: (M,) number of Gaussians merged into each.
        wanted: (M,) Σ αT² of those Gaussians; `now` that of the merged ones.
        mean: mean of `wanted`, for tiles over all of them.
    """
    if mean <= 0:  # no view sees anything
        return scene
    floor = _OPACITY_FIT_FLOOR * mean
    ratio = (wanted + floor) / np.maximum(now + floor, np.finfo(float).tiny)
    factor = np.clip(ratio, *_OPACITY_FIT_LIMITS) ** _OPACITY_FIT_EXPONENT
    alpha = scene.opacities.astype(np.float64)
    aimed = alpha * factor
    limited = np.minimum(aimed, np.maximum(alpha, MAX_OPACITY))
    vanishes = limited < DRAWN_OPACITY
    vanishes &= alpha >= DRAWN_OPACITY
    kept = vanishes | (members < 2)
    kept |= ~np.isfinite(factor)
    kept |= alpha <= 0
    fitted = np.where(kept, alpha, limited)
    growth = aimed / np.maximum(fitted, 1e-30)
    growth[kept | (fitted <= 0)] = 1.0
    changed = fitted != alpha
    logits = np.log(np.maximum(fitted, 1e-30)) - np.log1p(-np.minimum(fitted, 1 - 1e-9))
    logits = np.where(changed, logits, scene.logit_opacities)
    shortest = np.argmin(scene.scales, axis=1)
    grown = growth[:, None] > 1
    grown = grown & (np.arange(3) != shortest[:, None])
    scales = np.where(grown, scene.scales * np.sqrt(growth)[:, None], scene.scales)
    return replace(
        scene,
        logit_opacities=logits.astype(np.float32),
        scales=scales.astype(np.float32),
    )


def splats_of(like: Splats, out: dict[str, Any]) -> Splats:
    sh: Float32 = out["sh"]
    return Splats(
        out["means"].astype(like.means.dtype, copy=False),
        out["quats"],
        out["scales"],
        out["logit_opacities"],
        np.ascontiguousarray(sh[:, :1]),
        np.ascontiguousarray(sh[:, 1:]),
        like.offset,
        like.render_model,
        like.up,
        like.axes,
    )
