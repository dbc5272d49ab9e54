"""Simplification to an exact budget: rounds of drop, merge and trim (section 3.2 of the paper)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

import g2ard._core as _core
from g2ard.arrays import Int, Mask
from g2ard.errors import InputError, require
from g2ard.io.reports import LEFT_OUT, Report
from g2ard.progress import Progress, counter, plural, silent
from g2ard.rendering.visibility import SampledVisibility
from g2ard.scene.prepared import finite_rows_of, with_some_opacity
from g2ard.scene.splats import DRAWN_LOGIT, Splats, unit_quats
from g2ard.stages.simplify.config import Pairs, SimplifyConfig
from g2ard.stages.simplify.gaps import opacity_lost
from g2ard.stages.simplify.pairs import (
    VisibilitySource,
    merge,
    merge_and_fit,
    rows_of,
    splats_of,
)
from g2ard.system.shown import Shown


@dataclass(frozen=True)
class SimplifyRound(Report):
    """Report of one round: before − dropped − merged − trimmed = after.

    Args:
        dropped: dropped for low opacity.
        trimmed: trimmed for low priority.
        cells: `paper`: number of locality cells; 0 if none were needed.
        refused: `paper`: groups rejected, by guard.
        skipped_alone: `paper`: rows alone in their cell and colour bin.
        undone_groups: `paper`: merges undone to reach the budget.
        clamped_opacities: `paper`: merged rows whose α was limited to 0.99.
    """

    before: int
    dropped: int
    merged: int
    trimmed: int
    after: int
    cells: int | None = field(default=None, metadata=LEFT_OUT)
    refused: dict[str, int] | None = field(default=None, metadata=LEFT_OUT)
    skipped_alone: int | None = field(default=None, metadata=LEFT_OUT)
    undone_groups: int | None = field(default=None, metadata=LEFT_OUT)
    clamped_opacities: int | None = field(default=None, metadata=LEFT_OUT)


@dataclass(frozen=True)
class SimplifyReport(Report):
    """Report of a simplification.

    Args:
        merged_members: input rows that share an output row.
        protected: flagged output rows.
        nonfinite_rows: input rows dropped because they are not finite.
        infinite_logits: infinite logits, taken as α = 0 or 1.
        clamped_opacities: merged rows whose α was limited to 0.99, losing what `surface_depth` does not keep.
        opacity_lost: share of the light that the scene's opaque pixels stop but the result lets through, if
            it was measured.
        fitted: rows whose opacity (or area, at full opacity) was fitted to visibility.
        unseen: kept input rows that no view sees; None without views.
        faded: merged rows with α < 1/255 although a member's was not.
        skipped: `alone`: unmerged rows; `sh_bands`: bands of zeros, not computed; for `paper`, `coverages`:
            groups already rejected by the cheaper guard, and rounds that needed no `binnings` or `trims`.
        seconds: in the pipeline, time of the stage including visibility.
        tiles: rows of each tile, for a scene in tiles; `fitted` and `faded` are not counted there.
    """

    input_count: int
    output_count: int
    merged_members: int
    rounds: tuple[SimplifyRound, ...]
    protected: int
    nonfinite_rows: int
    infinite_logits: int
    clamped_opacities: int
    fitted: int
    unseen: int | None
    faded: int
    skipped: dict[str, int]
    opacity_lost: float | None = field(default=None, metadata=LEFT_OUT)
    seconds: float | None = field(default=None, metadata=LEFT_OUT)
    tiles: list[int] | None = field(default=None, metadata=LEFT_OUT)


_DEFAULTS = SimplifyConfig()


@dataclass(frozen=True, eq=False)
class Simplified(Shown):
    """Result of simplification.

    Args:
        splats: exactly `budget` Gaussians, in an order that depends only on the scene's content. Their
            geometry serves as recovery's anchors.
        parents: (N,) int64, output row of each input row; −1 if it was dropped or trimmed.
        protected: (M,) bool, whether any of the rows merged into a Gaussian is protected.
        report: figures of the simplification.
    """

    splats: Splats
    parents: Int
    protected: Mask
    report: SimplifyReport

    def __repr__(self) -> str:
        return f"Simplified({len(self.parents):,} → {plural(len(self.splats), 'Gaussian')})"


def simplify(
    splats: Splats,
    budget: int,
    *,
    method: str | None = None,
    visibility: SampledVisibility | VisibilitySource | None = None,
    protected: Mask | None = None,
    final_budget: int | None = None,
    gaps: bool = False,
    config: SimplifyConfig = _DEFAULTS,
    progress: Progress = silent,
) -> Simplified:
    """Reduce a scene to exactly `budget` Gaussians.

    `default` minimises the error in the image. Down to a multiple of the budget it merges along Morton order,
    cheapest first. Then it merges the cheapest pairs of neighbours, in rounds in which each cluster merges at
    most once. Mean, covariance and SH are averaged by mass, and the mass *as rendered* m = α·A is conserved,
    with A = √tr adj(Σ + e²I) and e the renderer's blur. The cost of a merge is the squared error of its
    projections times its visibility. Without `visibility` no cameras are needed. If `visibility` is a
    function, opacities are finally fitted to what the views see, and if it has `views` and 20 or more rows
    join on average, colours too.

    `fast` merges only along Morton order, on two lattices in turn, without a neighbour graph.

    `paper` works in rounds that keep 75 %. Each drops α < 0.01, merges cell × colour-bin groups by moment
    matching if the affine-energy and surface-coverage guards pass, down to the round's count, and trims the
    rest by π = −log(1 − α)·A·(1 + λ_h·p) (eq. `importance`). Every round has about one cell per Gaussian of
    the final budget (`docs/g2ard-and-the-paper.md` has our reading).

    Rows below the method's least α are dropped first, unless the budget needs them. The result does not
    depend on the order of the rows, the unit, or the number of threads.

    Args:
        splats: the scene. Infinite logits mean α = 0 or 1, scales are limited to e⁴³; rows with other
            non-finite values are dropped and counted.
        budget: Gaussians to keep, at most those of the scene.
        method: turns the config into this method's.
        visibility: for `default` and `fast`: visibility of each Gaussian (`g2ard.rendering.visibility`), or a
            function scene → visibility, also called on the result to fit its opacities.
        protected: (N,) bool flags to inherit. If None, `paper` computes them; the other methods do not use
            them.
        final_budget: for `paper`: N_S, if this call is one round on the way to a smaller count; it sets the
            size of cells. None means `budget`.
        gaps: measure the opacity lost in the views of `visibility`, if it has the attribute `views`.
        progress: called with the number of Gaussians removed.

    Raises:
        InputError: a budget below 1 or above the count of finite rows, or arrays of another length.

    >>> rng = np.random.default_rng(0)
    >>> scene = Splats.create(rng.normal(size=(1000, 3)), scales=np.full((1000, 3), 0.1))
    >>> small = simplify(scene, 100)
    >>> len(small.splats), small.parents.shape, int(small.parents.max())
    (100, (1000,), 99)
    """
    config = config.turned(method)
    scene, finite = finite_rows_of(splats)
    require("budget", budget, budget >= 1, "at least 1")
    require("budget", budget, budget <= len(scene), f"at most {len(scene)} (the scene's Gaussians)")
    if protected is not None:
        protected = np.asarray(protected)
        fits = protected.dtype == np.bool_ and protected.shape == (len(splats),)
        given = f"{protected.dtype} {protected.shape}"
        require("protected", given, fits, f"bool of shape ({len(splats)},)")
        protected = np.ascontiguousarray(protected[finite])
    if not (scene.opacities >= (config.resolved().min_opacity or 0.0)).any():
        scene = with_some_opacity(scene)
        config = replace(config, min_opacity=0.0)
    if not isinstance(config, Pairs):
        out = _core.simplify_paper(
            scene.core,
            config.rounds(len(scene), budget),
            final_budget or budget,
            config.resolved(),
            protected=protected,
            progress=counter(progress, "simplify"),
        )
    elif config.keep_region and visibility is None:
        raise InputError("needs views; `fast` uses only given ones", parameter="keep_region")
    elif callable(visibility):
        out = merge_and_fit(scene, budget, visibility, protected, config, progress)
    else:
        if visibility is None:
            seen = None
        else:
            seen = rows_of(visibility, len(splats), finite)
        out = merge(scene, budget, seen, protected, config, progress)
    views = getattr(visibility, "views", None)
    lost = None
    if gaps and views is not None and budget < len(scene):
        progress("gaps", 0, 0)
        dense = scene.with_sh_degree(0).take(scene.core.order)  # ties in depth go by row
        lost = opacity_lost(dense, splats_of(scene, out), views)
        progress("gaps", 1, 1)
    return _finish(splats, finite, out, lost)


def _finish(
    splats: Splats, finite: Mask | slice, out: dict[str, Any], lost: float | None
) -> Simplified:
    parents = np.full(len(splats), -1, np.int64)
    parents[finite] = out["parents"]
    small = splats_of(splats, out).with_sh_degree(splats.sh_degree)
    small = replace(small, quats=unit_quats(small.quats))  # unmerged rows keep their quaternions
    kept = int(np.count_nonzero(parents >= 0))
    members = np.bincount(parents[parents >= 0], minlength=len(small))
    alone = int(np.count_nonzero(members == 1))
    del members
    protected: Mask = out["protected"]
    report = SimplifyReport(
        input_count=len(splats),
        output_count=len(small),
        merged_members=kept - alone,
        rounds=tuple(SimplifyRound.of(r) for r in out["rounds"]),
        protected=int(np.count_nonzero(protected)),
        nonfinite_rows=0
        if isinstance(finite, slice)
        else len(splats) - int(np.count_nonzero(finite)),
        infinite_logits=out["infinite_logits"],
        clamped_opacities=out["clamped_opacities"],
        fitted=out.get("fitted", 0),
        unseen=out.get("unseen"),
        faded=_count_faded(splats, small, parents),
        skipped={
            "alone": alone,
            "sh_bands": splats.sh_degree - math.isqrt(out["sh"].shape[1]) + 1,
            **_count_spared(out["rounds"]),
        },
        opacity_lost=lost,
    )
    return Simplified(small, parents, protected, report)


def _count_faded(splats: Splats, small: Splats, parents: Int) -> int:
    """Count merged rows too faint to draw although a member was drawn: distant floaters whose mass is spread
    too thin."""
    faint = small.logit_opacities < DRAWN_LOGIT
    if not faint.any():
        return 0
    drawn = np.zeros(len(small), bool)
    drawn[parents[(parents >= 0) & (splats.logit_opacities >= DRAWN_LOGIT)]] = True
    return int(np.count_nonzero(faint & drawn))


def _count_spared(rounds: list[dict[str, Any]]) -> dict[str, int]:
    """Count work that the paper's rounds skipped."""
    if not rounds or "cells" not in rounds[0]:
        return {}
    return {
        "coverages": sum(r["refused"]["energy"] for r in rounds),
        "binnings": sum(r["cells"] == 0 for r in rounds),
        "trims": sum(r["trimmed"] == 0 for r in rounds),
    }
