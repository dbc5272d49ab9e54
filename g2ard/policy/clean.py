"""What no picture of a scene needs, by looks from a pool of poses of its own."""

from __future__ import annotations

from typing import TYPE_CHECKING

from g2ard.progress import Progress, Say, plural, silent, unsaid

if TYPE_CHECKING:
    from g2ard.scene.cameras import Cameras
    from g2ard.scene.splats import Splats
    from g2ard.stages.clean import Cleaning

__all__ = ["clutter_seen"]

_VIEWS, _SIDE = 96, 400
"""Looks at a scene, and their longer side, pixels."""
_ROWS = 100_000
"""Gaussians that they are planned on."""
_NEAR = 0.25
"""Looks that step nearer, as a share of the others."""


def clutter_seen(
    splats: Splats,
    kinds: tuple[str, ...] | None = None,
    *,
    seed: int = 0,
    progress: Progress = silent,
    say: Say = unsaid,
) -> tuple[Cleaning, Cameras]:
    """What can go, and the views it was found by; a line says how many of each kind.

    Args:
        splats: the scene.
        kinds: looked for; None for all of `g2ard.stages.clean.KINDS`.
        seed: of the poses.
        progress: told of planning and looks.
        say: told what was found.

    Raises:
        InputError: an unknown kind, or a scene with no room for poses.
    """
    from g2ard.poses import plan_pool
    from g2ard.rendering.visibility import visibility
    from g2ard.stages.clean import KINDS, find_clutter, within_reach

    kinds = kinds or KINDS
    pool = plan_pool(splats, _VIEWS, seed=seed, rows=_ROWS, near=_NEAR, looks=True, progress=progress)
    cameras = pool.cameras.resized(_SIDE)
    seen = visibility(splats, cameras, progress)
    pixels = int((cameras.widths.astype(int) * cameras.heights).sum())
    found = find_clutter(splats, seen, within_reach(splats, cameras, progress), pixels, kinds)
    parts = [f"{count:,} {name}" for name, count in found.counts.items() if name in kinds]
    gone = len(splats) - int(found.keep.sum())
    say(f"{gone:,} of {plural(len(splats), 'Gaussian')} can go: {', '.join(parts)}")
    return found, cameras
