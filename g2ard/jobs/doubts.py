"""Warnings about views that do not show what a scene resolves, and about regions that lost too much."""

from __future__ import annotations

import numpy as np

from g2ard.arrays import Float
from g2ard.poses.votes import Votes
from g2ard.progress import plural
from g2ard.scene.cameras import Cameras
from g2ard.scene.reproducible import canonical_order, norms
from g2ard.scene.splats import Splats

_SAMPLE = 8192
"""Gaussians that represent a scene."""

_COARSE = 0.2
"""Share of the scene below a pixel in all views above which views are warned of."""

_UNFRAMED = 0.5
"""Share of the scene in no view above which views are warned of."""

_EMPTIED = 10.0
"""Factor on the requested reduction above which a region is warned of."""

_LEVELS = 3
"""Halvings that make regions."""

_REGION_ROWS = 400_000
"""Most Gaussians whose regions are counted."""

_FEWEST = 1024
"""Fewest Gaussians of a scene that has regions."""

_FAR = 0.05
"""Share of the Gaussians beyond a gap above which the scene has a sky or surroundings."""


def doubt_views(scene: Splats, cameras: Cameras) -> list[str]:
    """Return warnings about views that frame little, show it below a pixel, or stand outside a sky."""
    some = _sample_visible(scene)
    if len(some) < _FEWEST or not len(cameras):
        return []
    points = _find_points(some)
    sizes = _measure_sizes(some)
    framed, resolved = np.zeros((2, len(some)), bool)
    for view in cameras:
        depths = (points - view.position) @ view.viewmat[2, :3]
        rows = view.holds(points)
        framed |= rows
        resolved |= rows & (sizes * np.sqrt(view.K[0, 0] * view.K[1, 1]) >= depths)
    told = []
    seen = max(1, int(framed.sum()))
    unframed = 1 - float(framed.mean())
    coarse = 1 - float(resolved.sum()) / seen
    if unframed > _UNFRAMED:
        told.append(
            f"warning: {unframed:.0%} of the scene is in no view; --views of all of it would show it"
        )
    elif coarse > _COARSE:
        told.append(
            f"warning: {coarse:.0%} of the scene is smaller than a pixel in all views; nearer --views, or a "
            "larger --size, would show it"
        )
    votes = _cast_votes(scene, some)
    outside = norms(cameras.positions - votes.centre) > votes.horizon
    if outside.mean() > 0.5:
        told.append(
            f"warning: {int(outside.sum())} of {plural(len(cameras), 'view')} stand outside the sky, which "
            "hides the scene from them"
        )
    return told


def doubt_merging(scene: Splats, small: Splats, *, blind: bool) -> list[str]:
    """Return warnings about the result of a reduction, `blind` if it had no views."""
    if len(scene) < _FEWEST:
        return []
    votes = _cast_votes(scene, _sample_visible(scene))
    found = _doubt_regions(scene, small, votes)
    return found + _doubt_distances(votes) if blind else found


def _doubt_regions(scene: Splats, small: Splats, votes: Votes) -> list[str]:
    """Return a warning if an eighth of the scene, or what is near, lost ten times more than the whole."""
    every = max(1, len(scene) // _REGION_ROWS)
    before = _find_points(scene)[::every]
    after = _find_points(small)
    if len(before) < _FEWEST or not len(after):
        return []
    regions = [(before, after)]
    for _ in range(_LEVELS):
        regions = [half for region in regions for half in _halve_region(*region)]
    if np.isfinite(votes.radius):
        regions.append((_take_within(before, votes), _take_within(after, votes)))
    ratio = len(before) / len(after)
    factors = [len(old) / max(1, len(new)) / ratio for old, new in regions]
    emptied = [i for i, factor in enumerate(factors) if factor > _EMPTIED]
    if not emptied:
        return []
    largest = max(emptied, key=lambda i: len(regions[i][0]))
    old, new = regions[largest]
    middle = ", ".join(f"{value:.3g}" for value in np.median(old, axis=0))
    return [
        f"warning: a region around {middle} kept {len(new):,} of {every * len(old):,} Gaussians, "
        f"{factors[largest]:,.0f} times fewer than the whole; --views of it, or --keep-region, keeps more"
    ]


def _doubt_distances(votes: Votes) -> list[str]:
    """Return a warning if the scene has a sky or distant surroundings."""
    far = float(votes.weights[votes.distances > votes.radius].sum())
    if far <= _FAR:
        return []
    return [
        f"warning: {far:.0%} of the scene lies far beyond the rest; without views it is weighed by its size, "
        "so give --views, or use --method default"
    ]


def _sample_visible(scene: Splats) -> Splats:
    rows = scene.visible_rows()
    some = scene.take(rows[canonical_order(scene, rows, _SAMPLE)])
    return some.take(some.finite_rows())


def _find_points(scene: Splats) -> Float:
    points = scene.positions
    return points[np.isfinite(points).all(axis=1)]


def _measure_sizes(scene: Splats) -> Float:
    scales = np.sort(np.abs(scene.scales.astype(np.float64)), axis=1)
    return np.sqrt(scales[:, 1] * scales[:, 2])


def _cast_votes(scene: Splats, some: Splats) -> Votes:
    """Return the votes of a sample of a scene."""
    represents = len(scene) / max(1, len(some))
    return Votes.of(
        _find_points(some), _measure_sizes(some), some.opacities.astype(np.float64), represents
    )


def _take_within(points: Float, votes: Votes) -> Float:
    return points[norms(points - votes.centre) <= votes.radius]


def _halve_region(before: Float, after: Float) -> list[tuple[Float, Float]]:
    """Halve a region along its widest axis."""
    axis = int(np.argmax(np.ptp(before, axis=0)))
    cut = np.median(before[:, axis])
    return [
        (before[before[:, axis] <= cut], after[after[:, axis] <= cut]),
        (before[before[:, axis] > cut], after[after[:, axis] > cut]),
    ]
