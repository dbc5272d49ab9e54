"""Lift coloured points to a geometric prior of surface-aligned discs, without training.

Distil *from* this prior, with photos as targets; rendered as it is, it looks flat (10 dB in the paper).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, cast

import numpy as np
from numpy.typing import ArrayLike

import g2ard._core as _core
from g2ard.arrays import Float, Rows
from g2ard.config.checks import Within, checks_arguments
from g2ard.config.choices import NAMED_AXES, Axes, AxesName
from g2ard.config.schema import Settings
from g2ard.errors import InputError, require
from g2ard.poses.site import Site
from g2ard.progress import Progress, counter, plural, silent
from g2ard.scene.reproducible import merge_equal, middle
from g2ard.scene.splats import SH_C0, Splats, unit_colors
from g2ard.scene.transform import up_in

_FAR_FROM_ORIGIN = 32_752.0
"""Distance from the origin, in units, beyond which a scene gets an offset."""

_GUESSED_BY = 20_000
"""Points that tell which axis is up, if the format does not."""

_ISOLATED = 20.0  # size of an isolated point's disc over the usual one

_CORE = _core.defaults()["lift"]
"""Defaults of the Rust core, which are the paper's."""


@dataclass(frozen=True)
class LiftConfig(Settings):
    """Constants of `lift`, for callers that keep them together: `lift(points, colors, **vars(config))`."""

    neighbors: Annotated[int, Within("[3, inf)")] = _CORE["neighbors"]
    spread: float = _CORE["spread"]
    normal_ratio: float = _CORE["normal_ratio"]
    max_anisotropy: float = _CORE["max_anisotropy"]
    opacity: float = 0.5


@checks_arguments
def lift(
    points: ArrayLike,
    colors: ArrayLike,
    *,
    neighbors: int = LiftConfig.neighbors,
    spread: float = LiftConfig.spread,
    normal_ratio: float = LiftConfig.normal_ratio,
    max_anisotropy: float = LiftConfig.max_anisotropy,
    opacity: float = LiftConfig.opacity,
    axes: AxesName = "RDF",
    progress: Progress = silent,
) -> Splats:
    """Turn each coloured point into a flat disc (supplement, "Dense Prior Construction").

    A PCA of the point and its nearest neighbours gives two tangents and the normal. With the
    neighbourhood's variances λ₁ ≥ λ₂ along the tangents, s₁ = spread·√λ₁,
    s₂ = max(spread·√λ₂, s₁/max_anisotropy) and the normal scale s₃ = normal_ratio·√(s₁s₂), in the points'
    unit. Where neighbours lie on a line, as along a scanner's rings, lines are thinned until a neighbourhood
    spans the surface, which gives the normal; the distance of the next lines on both sides gives the scale
    across the line. Points of one position are merged into one with their mean colour.

    Args:
        points: (N, 3), any unit and origin; pass float64 to keep map coordinates exact.
        colors: (N, 3) in [0, 1], or uint8 or uint16, which are divided by their largest value.
        neighbors: number of neighbours for the PCA (10 in the paper).
        spread: tangential scale over the neighbourhood's standard deviation (not stated in the paper).
        normal_ratio: normal over tangential scale (0.1 in the paper).
        max_anisotropy: largest ratio of the tangential scales (4 in the paper, to avoid needles).
        opacity: opacity of every disc, in (0, 1) (0.5 in the paper).
        axes: axes of the points' coordinates: "z-up" for scans and maps, so that files of the scene stand
            upright in viewers.
        progress: called with the number of points done.

    Returns:
        Discs of SH degree 0, one per position, in the order of the points; points that are not finite are
        skipped. Means are float32, relative to `offset`, which is the median point if float32 cannot hold the
        coordinates and 0 otherwise.

    Raises:
        InputError: mismatched shapes, no finite point, a colour outside [0, 1], or a parameter out of range.

    >>> grid = np.stack(np.meshgrid(range(8), range(8), [0]), -1).reshape(-1, 3)
    >>> discs = lift(grid + [5.4e6, 0, 0], np.full((64, 3), 0.5))
    >>> len(discs), float(discs.offset[0]), bool((discs.scales[:, 2] < discs.scales[:, 1]).all())
    (64, 5400003.0, True)
    """
    config = LiftConfig(neighbors, spread, normal_ratio, max_anisotropy, opacity)
    found: Axes = NAMED_AXES.get(axes) or cast("Axes", axes)
    return in_axes(lift_rows(points, colors, config, progress)[0], found)


def in_axes(splats: Splats, axes: Axes) -> Splats:
    """Return a scene whose coordinates are stated to have these axes."""
    if axes == "RDF":
        return splats
    return replace(splats, axes=axes)


def guessed_axes(positions: Float, progress: Progress = silent) -> Axes:
    """Guess the axes of points by their ground: z up, y up, or those of photos, y down."""
    some = positions[:: max(1, len(positions) // _GUESSED_BY)]
    discs, _ = lift_rows(some, np.full(some.shape, 0.5), LiftConfig(), progress)
    try:
        up = Site.of(discs, None, _GUESSED_BY).vertical.axis
    except InputError:  # nothing to see
        return "RDF"
    systems: tuple[Axes, ...] = ("RDF", "RFU", "RUB")
    return max(systems, key=lambda name: float(up @ up_in(name)))


def lift_rows(
    points: ArrayLike,
    colors: ArrayLike,
    config: LiftConfig,
    progress: Progress = silent,
    *,
    merge: bool = True,
) -> tuple[Splats, Rows]:
    """Lift points as `lift` does; also return the row of each disc's point, ascending.

    With `merge` false, points of one position become a disc each.
    """
    opacity = config.opacity
    xyz = np.ascontiguousarray(points, np.float64)
    rgb = unit_colors(colors)
    require("points", xyz.shape, xyz.ndim == 2 and xyz.shape[1] == 3, "shape (N, 3)")
    require("colors", rgb.shape, rgb.shape == xyz.shape, f"shape {xyz.shape}")
    require("opacity", opacity, 0 < opacity < 1, "a number between 0 and 1")
    finite = np.isfinite(xyz).all(1) & np.isfinite(rgb).all(1)
    if not finite.any():
        raise InputError(f"none of the {len(xyz)} points is finite", parameter="points")
    rows = np.flatnonzero(finite)
    if not finite.all():
        xyz = xyz[finite]
        rgb = rgb[finite]
    origin = middle(xyz)
    centered = xyz - origin
    if merge:
        firsts, rgb = merge_equal(centered, rgb)
        xyz = xyz[firsts]
        centered = centered[firsts]
        rows = rows[firsts]
    progress("lift", 0, len(xyz))
    quats, scales = _core.lift_points(xyz - _choose_anchor(xyz), config, counter(progress, "lift"))
    n = len(centered)
    step = np.spacing(np.float32(np.abs(xyz).max()))
    # Other programs ignore offsets, and some keep positions in half floats, which end at 65,504.
    near = step <= 0.01 * np.median(scales[:, 0]) and np.abs(origin).max() <= _FAR_FROM_ORIGIN
    splats = Splats.create(
        (xyz if near else centered).astype(np.float32),
        quats=quats,
        scales=scales,
        logit_opacities=np.full(n, np.log(opacity / (1 - opacity))),
        sh0=((rgb - 0.5) / SH_C0)[:, None],
        offset=np.zeros(3) if near else origin,
    )
    return splats, rows


def isolated(splats: Splats) -> str | None:
    """Say how many discs are much larger than most, since their points are far from others."""
    sizes = splats.scales.max(axis=1)
    usual = float(np.median(sizes))
    count = int(np.count_nonzero(sizes > _ISOLATED * usual))
    if not count:
        return None
    text = f"became discs of up to {sizes.max() / usual:,.0f} times the usual size"
    return f"{plural(count, 'isolated point')} {text}; remove strays first, as with CloudCompare's SOR filter"


def _choose_anchor(points: Float) -> Float:
    """Return a point amid others, a multiple of a power of two that is larger than the cells of lines.

    So cells are the same in tiles as in the whole cloud.
    """
    low, high = np.percentile(points, (1, 99), axis=0, method="lower")
    step = np.exp2(np.frexp(np.max(high - low) or 1.0)[1] - 2)
    anchor: Float = np.rint(low / step) * step
    return anchor
