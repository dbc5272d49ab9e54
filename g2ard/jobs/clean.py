"""`g2ard.clean`: removing the clutter that generated views show, and splitting off the sky."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from g2ard.config.checks import checks_arguments
from g2ard.config.choices import RenderModel
from g2ard.errors import InputError, require
from g2ard.jobs.inputs import Scene, load_scene
from g2ard.jobs.run_views import find_pool_growth
from g2ard.pipeline.dense import Dense, InMemory
from g2ard.poses import plan_pool
from g2ard.progress import Progress, Say, plural, silent, unsaid
from g2ard.rendering.visibility import visibility
from g2ard.scene.cameras import Cameras
from g2ard.scene.regions import sky_mask
from g2ard.scene.splats import SH_C0, Splats, check_finite
from g2ard.stages.clean import FLOATING, KINDS, Cleaning, compare_depths, find_clutter
from g2ard.system.shown import Shown

CLUTTER_VIEWS = 96
"""Number of generated views for finding clutter."""
CLUTTER_SIDE = 400
"""Longer side of these views in pixels."""
_CLUTTER_ROWS = 100_000
"""Gaussians that those views are planned on."""
_CLUTTER_NEAR = 0.25
"""Share of nearer views among them."""

_LUMA = np.array([0.2126, 0.7152, 0.0722])
_SCENE_BRIGHTNESS_SHARE = 0.45
"""Share of the brightness taken from the scene, so that its shape stays visible."""


@dataclass(frozen=True, eq=False)
class Cleaned(Shown):
    """Scene with its clutter marked.

    Args:
        before: the scene, without its sky if that was split off.
        clutter: kind of clutter per Gaussian of `before`.
        sky: sky and far background, perhaps no Gaussians; None unless it was split off.
        cameras: the generated views; None if no kind was requested.
    """

    before: Splats
    clutter: Cleaning
    sky: Splats | None
    cameras: Cameras | None

    @property
    def splats(self) -> Splats:
        """The scene without clutter, perhaps no Gaussians."""
        return self.before.take(self.clutter.keep)

    def __repr__(self) -> str:
        return (
            f"Cleaned({int(self.clutter.keep.sum()):,} of {plural(len(self.before), 'Gaussian')})"
        )


@checks_arguments
def clean(
    scene: Scene,
    *,
    only: Sequence[str] | None = None,
    strength: float = 0.0,
    split_sky: bool = False,
    render_model: RenderModel | None = None,
    seed: int = 0,
    progress: Progress = silent,
    say: Say = unsaid,
) -> Cleaned:
    """Remove clutter from a trained scene, exactly like the command `g2ard clean`.

    Clutter is what no image of the scene needs: invisible Gaussians, giants, needles and floaters, and on
    request haze and streaks. Visibility is measured from generated views.

    Args:
        scene: the scene, or its path.
        only: kinds to remove: invisible, giant, needle, floater, haze and streak. None removes all, () none.
        strength: 0 to 1: haze and streaks are removed if they float in front of the surface in more than
            1 − `strength` of the views that see them; 0 removes none.
        split_sky: split off the sky and the far background first.
        render_model: overrides what the scene's file says.
        seed: seed of the generated views.
        progress: called during planning, visibility and depths.
        say: called with log messages.

    Returns:
        The scene without clutter, the kind of clutter per Gaussian, and the sky.

    Raises:
        InputError: an unreadable scene, an unknown kind, or haze or streaks without a strength.

    >>> import numpy as np
    >>> ball = np.random.default_rng(0).normal(size=(900, 3))
    >>> ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    >>> faint = np.where(np.arange(900) < 40, -9, 4)
    >>> done = clean(Splats.create(ball, scales=np.full((900, 3), 0.05), logit_opacities=faint))
    >>> len(done.splats), done.clutter.counts["invisible"]
    (860, 40)
    """
    kinds = choose_kinds(only, strength)
    splats = load_scene(scene, say, render_model)
    if kinds:
        check_finite(splats, "scene")
    sky = None
    if split_sky:
        far = sky_mask(splats)
        sky = splats.take(far)
        splats = splats.take(~far)
        say(
            f"sky: {plural(len(sky), 'Gaussian')}"
            if len(sky)
            else "sky: none found, so nothing is split off"
        )
    if not kinds:
        return Cleaned(splats, Cleaning(np.full(len(splats), -1, np.int8)), sky, None)
    cameras = _plan_views(splats, seed, progress)
    seen = visibility(splats, cameras, progress)
    pixels = int(cameras.pixels.sum())
    unoccluded, floating = compare_depths(
        splats, cameras, floating=bool(set(kinds) & set(FLOATING)), progress=progress
    )
    clutter = find_clutter(
        splats,
        seen,
        unoccluded,
        pixels,
        kinds,
        floating=floating,
        strength=strength,
        progress=progress,
    )
    _tell_clutter(
        clutter, seen.weight[~clutter.keep].sum() / max(seen.weight.sum(), 1e-30), kinds, say
    )
    return Cleaned(splats, clutter, sky, cameras)


def _plan_views(splats: Splats, seed: int, progress: Progress, represents: float = 1.0) -> Cameras:
    """Return generated views that show clutter; `represents` is that of `plan_pool`."""
    count = CLUTTER_VIEWS
    if represents > 1:
        count = round(count * find_pool_growth(represents * len(splats)))
    pool = plan_pool(
        splats,
        count,
        seed=seed,
        rows=_CLUTTER_ROWS,
        near=_CLUTTER_NEAR,
        represents=represents,
        progress=progress,
    )
    return pool.cameras.resized(CLUTTER_SIDE)


def _tell_clutter(clutter: Cleaning, light: float, kinds: Sequence[str], say: Say) -> None:
    parts = [f"{count:,} {name}" for name, count in clutter.counts.items() if name in kinds]
    gone = len(clutter.kind) - int(clutter.keep.sum())
    whole = plural(len(clutter.kind), "Gaussian")
    say(f"{gone:,} of {whole} are clutter, with {light:.1%} of the light: {', '.join(parts)}")


def remove_clutter(
    dense: Dense, *, seed: int = 0, progress: Progress = silent, say: Say = unsaid
) -> tuple[Dense, dict[str, int]]:
    """Return a dense scene without its clutter, and the number of Gaussians removed by kind."""
    from g2ard.tiles.dense import InTiles

    if isinstance(dense, InTiles):
        cameras = _plan_views(dense.sample, seed, progress, dense.total / len(dense.sample))
        rest, clutter, light = dense.without_clutter(cameras)
        _tell_clutter(clutter, light, choose_kinds(None, 0), say)
        return rest, clutter.counts
    if dense.total > len(dense.sample):  # in tiles that are only planned
        return dense, {}
    done = clean(dense.sample, seed=seed, progress=progress, say=say)
    return InMemory(done.splats), done.clutter.counts


def choose_kinds(only: Sequence[str] | None, strength: float) -> tuple[str, ...]:
    """Return the kinds of clutter to remove, after checking that they are known and have a strength."""
    require("strength", strength, 0 <= strength <= 1, "a number from 0 to 1")
    for kind in only or ():
        require("only", repr(kind), kind in KINDS, ", ".join(KINDS))
        if not strength and kind in FLOATING:
            raise InputError(
                f"{kind} needs a strength", parameter="only", hint="give {strength=0.5}"
            )
    return tuple(
        kind for kind in (KINDS if only is None else only) if strength or kind not in FLOATING
    )


def paint(splats: Splats, colors: ArrayLike) -> Splats:
    """Recolour a scene by (N, 3) colours in [0, 1], at SH degree 0, shaded by the luma of its own colours.

    >>> scene = Splats.create(np.zeros((2, 3)), scales=np.ones((2, 3)), sh0=np.full((2, 1, 3), 9.0))
    >>> paint(scene, [[1, 0, 0], [0, 0, 1]]).colors.round(3).tolist() == [[1, 0, 0], [0, 0, 1]]
    True
    """
    paint = np.asarray(colors, np.float64)
    require("colors", paint.shape, paint.shape == (len(splats), 3), f"shape ({len(splats)}, 3)")
    luma = np.clip(splats.colors.astype(np.float64) @ _LUMA, 0, 1)
    shaded = paint * (1 - _SCENE_BRIGHTNESS_SHARE + _SCENE_BRIGHTNESS_SHARE * luma[:, None])
    sh0 = np.ascontiguousarray(((shaded - 0.5) / SH_C0)[:, None], np.float32)
    return replace(splats, sh0=sh0, shN=np.zeros((len(splats), 0, 3), np.float32))
