"""Fewer Gaussians at an exact budget: rounds of drop, merge and trim (section 3.2 of the paper)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from g2ard import _core
from g2ard.errors import InputError
from g2ard.progress import Progress, counter, silent
from g2ard.splats import Splats

__all__ = ["METHODS", "Seen", "Simplified", "SimplifyConfig", "flag", "schedule", "simplify"]

METHODS = ("default", "fast", "paper")
"""The policies."""

_RETENTION = {"default": 0.65, "fast": 0.65, "paper": 0.75}
_MIN_OPACITY = {"default": 0.004, "fast": 0.004, "paper": 0.01}
_LADDER = {"default": (3.0, 1), "fast": (1.0, 3)}
"""Down to how many times the budget rows merge along Morton order, and in how many steps."""

_REFRESH = 0.3
"""Visibility is looked at again when the count has fallen to this share of what it was."""

_FOLD = 0.05
"""A last cut smaller than this is folded into the round before."""


class Seen(Protocol):
    """What views say of N Gaussians, such as `g2ard.render.visibility` returns."""

    @property
    def weight(self) -> NDArray[Any]:
        """(N,) Σ αT over the pixels of the views."""

    @property
    def pixel_size(self) -> NDArray[Any]:
        """(N,) the size of a pixel there, scene units; ∞ where no view looks."""


Visibility = Seen | Callable[[Splats], Seen]


@dataclass(frozen=True)
class SimplifyConfig:
    """The constants of simplification: `paper`'s are the paper's (`tab:s_config`), the others measured.

    Args:
        retention: share of the Gaussians that a round keeps; None means the method's own, 0.75 in the paper,
            0.65 for the others (fewer rounds, as good).
        min_opacity: below this α a Gaussian is dropped; None means the method's own, 0.01 in the paper, 0.004
            (what no renderer draws) for the others.
        neighbors: `default`: nearest clusters that one may merge with. More lets far ones in: 16 is worse.
        geometric_weight: of `default` and `fast`: weight of the error of coverage beside that of colour.
        dilation: of `default` and `fast`: standard deviation of the blur that renderers add, in pixels
            (√0.3 would be all of it; 0.4 measured best).
        pixel_scale: of `default` and `fast` without views: the size of a pixel over the median of the largest
            scales.
        color_bin: `paper`: edge of the colour bins within a cell, in colour units (0–1).
        max_energy: `paper`: largest affine energy of a merged group, colour units squared.
        min_coverage: `paper`: least share of the members' footprint that the merged footprint covers.
        flag_threshold: ε_h, the affine residual of a cell above which its Gaussians are protected.
        protection: `paper`: λ_h, what a protected Gaussian's priority π is raised by.
    """

    retention: float | None = None
    min_opacity: float | None = None
    neighbors: int = 6
    geometric_weight: float = 0.03
    dilation: float = 0.4
    pixel_scale: float = 0.5
    color_bin: float = 0.25
    max_energy: float = 0.01
    min_coverage: float = 0.6
    flag_threshold: float = 0.01
    protection: float = 10.0

    def __post_init__(self) -> None:
        if self.retention is not None and not 0 < self.retention < 1:
            raise InputError(f"retention: expected a number between 0 and 1, got {self.retention}")
        if self.neighbors < 1:
            raise InputError(f"neighbors: expected at least 1, got {self.neighbors}")
        for name in ("color_bin", "pixel_scale"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"{name}: expected a positive number, got {value}")
        for name in (
            "min_opacity",
            "geometric_weight",
            "dilation",
            "max_energy",
            "min_coverage",
            "flag_threshold",
            "protection",
        ):
            value = getattr(self, name)
            if value is not None and not value >= 0:
                raise InputError(f"{name}: expected a number ≥ 0, got {value}")

    def retention_of(self, method: str) -> float:
        """The share a round of `method` keeps."""
        return _RETENTION[method] if self.retention is None else self.retention

    def min_opacity_of(self, method: str) -> float:
        """The α below which `method` drops."""
        return _MIN_OPACITY[method] if self.min_opacity is None else self.min_opacity


_DEFAULTS = SimplifyConfig()


@dataclass(frozen=True, eq=False)
class Simplified:
    """What simplification made.

    Args:
        splats: exactly the budget of Gaussians, in an order that only the scene's content decides. Their
            geometry is what recovery takes as anchors.
        parents: (N,) int64, the output row each input row went to; −1 if it was dropped or trimmed.
        protected: (M,) bool, flags inherited by OR from everything merged into the row.
        report: `input_count`, `output_count`, `rounds` (one dict each), `protected`, `nonfinite_rows`,
            `clamped_logits` (infinite ones), `clamped_opacities` (merged α that reached 0.99 and lost mass).
    """

    splats: Splats
    parents: NDArray[np.int64]
    protected: NDArray[np.bool_]
    report: dict[str, Any] = field(default_factory=dict)


def schedule(count: int, budget: int, retention: float = 0.75) -> list[int]:
    """Counts after each round: N_r = max(N_S, ⌈retention·N_{r−1}⌉), a last cut under 5 % folded in.

    >>> schedule(500_000, 50_000)
    [375000, 281250, 210938, 158204, 118653, 88990, 66743, 50000]
    >>> schedule(10, 10)
    []
    """
    rounds: list[int] = []
    while count > budget:
        count = max(budget, min(count - 1, math.ceil(retention * count)))
        if budget > (1 - _FOLD) * count:
            count = budget
        rounds.append(count)
    return rounds


def flag(
    splats: Splats, budget: int, *, config: SimplifyConfig = _DEFAULTS, progress: Progress = silent
) -> NDArray[np.bool_]:
    """Protection flags of a raw prior: p_i = 1[E_c(i) > ε_h] (eq. `frequency`).

    E_j is the mean squared leave-one-out residual of an affine colour predictor within cell j, over about
    `budget` cells; a cell of under 8 members borrows those of its face neighbours.

    Args:
        splats: the raw prior, never a recovered scene: fitting hides the residual.
        budget: the final count N_S, which sets the cell size.
        config: `flag_threshold` is read.
        progress: told when done.

    Returns:
        (N,) bool; False for rows that are not finite.

    Raises:
        InputError: no finite row, or a budget below 1.

    >>> plane = np.stack(np.meshgrid(range(20), range(20), [0]), -1).reshape(-1, 3)
    >>> noise = np.random.default_rng(0).normal(size=(400, 1, 3)) * (plane[:, :1, None] > 9)
    >>> scene = Splats.create(plane, scales=np.ones((400, 3)), sh0=noise)
    >>> flags = flag(scene, 40)
    >>> float(flags[plane[:, 0] < 8].mean()), float(flags[plane[:, 0] > 12].mean())
    (0.0, 1.0)
    """
    _check_budget(budget, None)
    scene, finite = _clean(splats)
    found = _core.simplify_flags(scene, budget, config.flag_threshold, progress=counter(progress, "flag"))
    flags = np.zeros(len(splats), bool)
    flags[finite] = found
    return flags


def simplify(
    splats: Splats,
    budget: int,
    *,
    method: str = "default",
    visibility: Visibility | None = None,
    protected: NDArray[np.bool_] | None = None,
    flag_budget: int | None = None,
    config: SimplifyConfig = _DEFAULTS,
    progress: Progress = silent,
) -> Simplified:
    """Reduce a scene to exactly `budget` Gaussians.

    `default` aims at the error in the image. Down to three times the budget it merges along Morton order,
    wherever that costs least; then, in rounds that lock what they merge, the cheapest pairs of neighbours
    become one. Mean, covariance and SH are averaged by mass, and mass m = α·A *as rendered* is conserved,
    with A = √tr adj(Σ + e²I) and e the blur of a renderer. A merge costs the squared error of its projections
    times how much of it the views see. Without `visibility` it needs no cameras at all.

    `fast` merges along Morton order all the way, on three lattices in turn: no graph of neighbours.

    `paper`: rounds of 75 %; each drops α < 0.01, merges cell × colour-bin groups by moment matching where the
    affine-energy and surface-coverage guards pass, and trims by π = −log(1 − α)·A·(1 + λ_h·p)
    (eq. `importance`).

    The result does not depend on the order of the rows, the unit, or the number of threads.

    Args:
        splats: the scene. Infinite logits mean α = 0 or 1; rows with other non-finite values are dropped
            and counted.
        budget: Gaussians to keep, at most as many as there are.
        method: the policy.
        visibility: for `default` and `fast`: what views see of each Gaussian (`g2ard.render.visibility`), or
            a function that finds it for a scene, asked again as the scene shrinks (+0.4 dB on small objects).
        protected: (N,) bool flags to inherit. With None, `paper` computes them (see `flag`), the others,
            which have no use for them, go without.
        flag_budget: the count that sets the flags' cell size, where this call is one round on the way to a
            smaller one; None means `budget`.
        config: the constants.
        progress: told of Gaussians shed, round by round.

    Returns:
        The scene, where each row went, the inherited flags and a report.

    Raises:
        InputError: a budget below 1 or above the count of finite rows, arrays of another length, or an
            unknown method.

    >>> rng = np.random.default_rng(0)
    >>> scene = Splats.create(rng.normal(size=(1000, 3)), scales=np.full((1000, 3), 0.1))
    >>> small = simplify(scene, 100)
    >>> len(small.splats), small.parents.shape, int(small.parents.max())
    (100, (1000,), 99)
    """
    if method not in METHODS:
        raise InputError(f"method: expected one of {', '.join(METHODS)}, got {method!r}")
    scene, finite = _clean(splats)
    _check_budget(budget, len(scene))
    flags = _check_flags(protected, len(splats))
    if flags is not None:
        flags = np.ascontiguousarray(flags[finite])
    if method == "paper":
        out = _paper(scene, budget, flags, flag_budget or budget, config, progress)
    else:
        if visibility is not None and not callable(visibility):
            visibility = _rows_of(visibility, len(splats), finite)
        out = _pairwise(scene, budget, method, visibility, flags, config, progress)
    return _simplified(splats, finite, out)


def _paper(
    scene: Splats,
    budget: int,
    flags: NDArray[np.bool_] | None,
    flag_budget: int,
    config: SimplifyConfig,
    progress: Progress,
) -> dict[str, Any]:
    return _core.simplify_paper(
        scene,
        schedule(len(scene), budget, config.retention_of("paper")),
        flag_budget,
        protected=flags,
        min_opacity=config.min_opacity_of("paper"),
        color_bin=config.color_bin,
        max_energy=config.max_energy,
        min_coverage=config.min_coverage,
        flag_threshold=config.flag_threshold,
        protection=config.protection,
        progress=counter(progress, "simplify"),
    )


@dataclass(frozen=True, eq=False)
class _Views:
    weight: NDArray[np.float32]
    pixel_size: NDArray[np.float32]


def _rows_of(seen: Seen, count: int, finite: NDArray[np.bool_] | slice) -> _Views:
    for name in ("weight", "pixel_size"):
        shape = getattr(seen, name).shape
        if shape != (count,):
            raise InputError(f"visibility.{name}: expected shape ({count},), got {shape}")
    weight, pixel = (np.asarray(a, np.float32)[finite] for a in (seen.weight, seen.pixel_size))
    return _Views(np.ascontiguousarray(weight), np.ascontiguousarray(pixel))


def _pairwise(
    scene: Splats,
    budget: int,
    method: str,
    visibility: Visibility | None,
    flags: NDArray[np.bool_] | None,
    config: SimplifyConfig,
    progress: Progress,
) -> dict[str, Any]:
    """One stage, or with a function of visibility as many as the refreshes it is worth."""
    start, parents, rounds = len(scene), None, []
    clamped = {"clamped_logits": 0, "clamped_opacities": 0}
    while True:
        staged = callable(visibility) and 2 * budget < _REFRESH * len(scene)  # else not worth it
        target = math.ceil(_REFRESH * len(scene)) if staged else budget
        seen = _rows_of(visibility(scene), len(scene), slice(None)) if callable(visibility) else visibility
        out = _core.simplify_pairwise(
            scene,
            schedule(len(scene), target, config.retention_of(method)),
            protected=flags,
            weight=None if seen is None else seen.weight,
            pixel_size=None if seen is None else seen.pixel_size,
            min_opacity=config.min_opacity_of(method),
            ladder=_LADDER[method][0],
            ladder_steps=_LADDER[method][1],
            neighbors=config.neighbors,
            geometric=config.geometric_weight,
            dilation=config.dilation,
            pixel_scale=config.pixel_scale,
            progress=_shifted(counter(progress, "simplify"), start - len(scene), start - budget),
        )
        rounds += out["rounds"]
        clamped = {key: count + out[key] for key, count in clamped.items()}
        parents = out["parents"] if parents is None else np.where(parents < 0, -1, out["parents"][parents])
        if target == budget:
            return {**out, **clamped, "parents": parents, "rounds": rounds}
        scene = _splats_of(scene, out)
        flags = None if flags is None else out["protected"]


def _shifted(tell: Callable[[int, int], None], done: int, total: int) -> Callable[[int, int], None]:
    return lambda here, _: tell(done + here, total)


def _check_budget(budget: int, count: int | None) -> None:
    if budget < 1:
        raise InputError(f"budget: expected at least 1, got {budget}")
    if count is not None and budget > count:
        raise InputError(f"budget: expected at most the {count} Gaussians there are, got {budget}")


def _check_flags(protected: NDArray[np.bool_] | None, count: int) -> NDArray[np.bool_] | None:
    if protected is None:
        return None
    flags = np.asarray(protected)
    if flags.dtype != np.bool_ or flags.shape != (count,):
        raise InputError(f"protected: expected bool of shape ({count},), got {flags.dtype} {flags.shape}")
    return flags


def _clean(splats: Splats) -> tuple[Splats, NDArray[np.bool_] | slice]:
    """The finite rows, C-contiguous, and which they are."""
    arrays = (splats.means, splats.quats, splats.scales, splats.sh0, splats.shN)
    everything = all(np.isfinite(a).all() for a in arrays) and not np.isnan(splats.logit_opacities).any()
    finite = np.ones(len(splats), bool) if everything else splats.finite_rows()
    if not finite.any():
        raise InputError(f"splats: none of {len(splats)} rows is finite")
    scene = splats if everything else splats.take(finite)
    kind = np.float64 if scene.means.dtype == np.float64 else np.float32
    scene = replace(
        scene,
        means=np.ascontiguousarray(scene.means, kind),
        quats=np.ascontiguousarray(scene.quats, np.float32),
        scales=np.ascontiguousarray(scene.scales, np.float32),
        logit_opacities=np.ascontiguousarray(scene.logit_opacities, np.float32),
        sh0=np.ascontiguousarray(scene.sh0, np.float32),
        shN=np.ascontiguousarray(scene.shN, np.float32),
    )
    return scene, slice(None) if everything else finite


def _splats_of(like: Splats, out: dict[str, Any]) -> Splats:
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


def _simplified(splats: Splats, finite: NDArray[np.bool_] | slice, out: dict[str, Any]) -> Simplified:
    parents = np.full(len(splats), -1, np.int64)
    parents[finite] = out["parents"]
    small = _splats_of(splats, out)
    protected: NDArray[np.bool_] = out["protected"]
    report = {
        "input_count": len(splats),
        "output_count": len(small),
        "rounds": out["rounds"],
        "protected": int(np.count_nonzero(protected)),
        "nonfinite_rows": 0 if isinstance(finite, slice) else len(splats) - int(np.count_nonzero(finite)),
        "clamped_logits": out["clamped_logits"],
        "clamped_opacities": out["clamped_opacities"],
    }
    return Simplified(small, parents, protected, report)
