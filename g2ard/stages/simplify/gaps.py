"""Gaps in surfaces: light that a simplified scene lets through and the dense one does not."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from g2ard.arrays import Float32
from g2ard.progress import Say
from g2ard.rendering.renderer import Renderer, settings_for
from g2ard.scene.cameras import Camera, Cameras
from g2ard.scene.samples import take_evenly
from g2ard.scene.splats import Splats
from g2ard.system.threads import in_threads

_GAPS = 0.02
"""Least share of opacity lost that shows as gaps."""

_VIEWS = 8
"""Views in which coverage is measured."""

_PIXELS = 400
"""Longer side of these views in pixels."""

_OPAQUE = 0.9
"""Least opacity of a pixel that counts as opaque."""

RECOVERED_GAPS = "keep more Gaussians, or recover longer (--schedule best)"
"""Advice about gaps that recovery left."""


def some_views(cameras: Cameras) -> Cameras:
    """Return the views in which gaps are measured."""
    return take_evenly(cameras, _VIEWS).resized(_PIXELS)


def light_lost(dense: Splats, result: Splats, views: Iterable[Camera]) -> tuple[float, float]:
    """Sum the light that a result lets through in pixels where the dense scene is opaque.

    Returns:
        The light that they let through though the dense scene stops it, and all that the dense scene stops
        there.
    """
    settings = settings_for(dense.means, antialiased=dense.antialiased)
    before, after = (Renderer(scene, settings=settings) for scene in (dense, result))

    def lost(view: Camera) -> tuple[float, float]:
        return let_through(before.render(view).alpha, after.render(view).alpha)

    through = opaque = 0.0
    for misses, stops in in_threads(lost, list(views)):
        through = through + misses
        opaque = opaque + stops
    return through, opaque


def let_through(stopped: Float32, now: Float32) -> tuple[float, float]:
    """Return what `light_lost` sums, of one view.

    Args:
        stopped, now: (H, W) alpha of the dense scene and of the result.
    """
    there = stopped > _OPAQUE
    misses = np.maximum(stopped - now, 0)[there]
    return float(misses.sum(dtype=np.float64)), float(stopped[there].sum(dtype=np.float64))


def opacity_lost(dense: Splats, result: Splats, cameras: Cameras) -> float:
    """Return the share of the light that the dense scene's opaque pixels stop but the result lets through.

    Measured in up to eight of the views, at up to 400 pixels.

    >>> from g2ard.scene.cameras import Camera
    >>> rng = np.random.default_rng(0)
    >>> ball = rng.normal(size=(900, 3))
    >>> ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    >>> scene = Splats.create(ball, scales=np.full((900, 3), 0.1), logit_opacities=np.full(900, 4))
    >>> views = Cameras.of([Camera.facing([0, -3, 0], [0, 0, 0], width=64, height=48)])
    >>> opacity_lost(scene, scene, views), opacity_lost(scene, scene.take(range(90)), views) > 0.02
    (0.0, True)
    """
    lost, opaque = light_lost(dense, result, some_views(cameras))
    return lost / opaque if opaque else 0.0


def gaps_line(lost: float | None, hint: str) -> str | None:
    """Return a warning if a result lets light through where the dense scene did not, otherwise None.

    Args:
        lost: share of the light of opaque pixels.

    >>> gaps_line(0.031, "keep more Gaussians")
    'gaps: surfaces let 3.1 % of the light through that they stopped before; keep more Gaussians'
    >>> gaps_line(0.001, "keep more Gaussians")
    """
    if lost is None or lost < _GAPS:
        return None
    return f"gaps: surfaces let {100 * lost:.1f} % of the light through that they stopped before; {hint}"


def say_gaps(
    lost: float | None,
    say: Say,
    hint: str = "keep more Gaussians, or close them by recovery (g2ard distill)",
) -> None:
    """Warn of gaps, see `gaps_line`; `lost` is the `opacity_lost` of a report."""
    if line := gaps_line(lost, hint):
        say(line)
