"""Choose by small renders how far merged Gaussians widen where α ≤ 0.99 cannot hold their mass.

A surface of one layer, such as a lifted point cloud, needs wide Gaussians to stay closed. In a trained scene
the same growth only blurs, because other layers are behind each gap. Mass cannot tell the two apart, an image
can.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from g2ard.progress import Say
from g2ard.rendering.renderer import RasterSettings, Renderer, settings_for
from g2ard.scene.cameras import Camera, Cameras
from g2ard.scene.samples import evenly_spaced
from g2ard.scene.splats import Splats
from g2ard.system.threads import in_threads

_GAPS = 0.02
"""Least share of opacity lost that shows as gaps."""
_GAP_VIEWS, _GAP_PIXELS = 8, 400
"""Views in which it is measured, and their longer side."""
RECOVERED_GAPS = "keep more Gaussians, or recover longer (--schedule best)"
"""Advice about gaps that recovery left."""

GROWTHS = (1.25, 1.6, 2.0, 2.5, 3.2, 4.0)
"""Growths to choose from; the first is for what recovery improves afterwards, and for planning."""

_VIEWS = 12
"""Most views that are compared."""

_SIDE, _FOV, _DISTANCE = 256, 44.0, 2.2
"""Width of views from outside, pixels, their field of view, degrees, and distance in radii of the scene."""

_LARGEST_RADIUS = 1e11
"""Radius up to which cameras are accepted."""

_GOLDEN = (1 + 5**0.5) / 2
_AXES = np.array([[0, 1, _GOLDEN], [1, _GOLDEN, 0], [_GOLDEN, 0, 1]]) / np.hypot(1, _GOLDEN)
"""Three axes of an icosahedron, each seen from both sides by `outside_views`."""

_OPAQUE = 0.9
"""Least opacity of a pixel that counts as opaque."""

_LEAST_ERROR = 1e-9
"""Added to squared errors of images, whose logarithms are compared."""


def widened(scene: Splats, needed: NDArray[np.float32], growth: float) -> Splats:
    """Widen merged rows from the first of `GROWTHS` to what they need, at most `growth`."""
    needed = needed.astype(np.float64)
    area = np.clip(needed, 1, growth) / np.clip(needed, 1, GROWTHS[0])
    longer = np.arange(3) != np.argmin(scene.scales, axis=1)[:, None]
    scales = np.where(longer, scene.scales * np.sqrt(area)[:, None], scene.scales)
    return replace(scene, scales=scales.astype(np.float32))


def best_growth(error: Callable[[float], float]) -> float:
    """Return the growth from which the next one is no better."""
    best, least = GROWTHS[0], error(GROWTHS[0])
    for growth in GROWTHS[1:]:
        if (now := error(growth)) >= least:
            break
        best, least = growth, now
    return best


def outside_views(scene: Splats) -> list[Camera]:
    """Return six views of a scene from outside, or none if float64 cannot hold them."""
    means = scene.means.astype(np.float64)
    low, high = np.quantile(means, [0.01, 0.99], axis=0)
    middle = (low + high) / 2 + scene.offset
    radius = float(np.linalg.norm(high - low) / 2 + np.median(scene.scales.max(axis=1)))
    if not 1e-9 * np.abs(middle).max() < radius < _LARGEST_RADIUS:
        return []
    return [
        Camera.facing(middle + side * _DISTANCE * radius * axis, middle, width=_SIDE, height=_SIDE, fov=_FOV)
        for axis in _AXES
        for side in (1, -1)
    ]


def some_views(cameras: Cameras) -> list[Camera]:
    return [cameras[i] for i in evenly_spaced(len(cameras), _VIEWS)]


@dataclass(frozen=True, eq=False)
class Renders:
    """Small renders of a dense scene, which simplified ones are compared to.

    Args:
        views: the views.
        settings: how all scenes are rendered.
        images: per view (H, W, 4) colours and opacity.
    """

    views: list[Camera]
    settings: RasterSettings
    images: list[NDArray[np.float32]]

    @classmethod
    def of(cls, scene: Splats, views: Iterable[Camera], settings: RasterSettings | None = None) -> Renders:
        if settings is None:
            settings = settings_for(scene.means, antialiased=scene.antialiased)
        views = list(views)
        renderer = Renderer(scene, settings=settings)
        return cls(views, settings, list(in_threads(lambda view: _image(renderer, view), views)))

    def compare(self, scene: Splats) -> tuple[float, float, float]:
        """Return the error of a simplified scene, and the light lost in pixels where the dense one is opaque.

        Opacity is a fourth channel of the error, so that gaps count before every background.

        Returns:
            The logarithms of the views' mean squared errors, summed over pixels; the light that opaque pixels
            let through though the dense scene stops it; and all that the dense scene stops there.
        """
        renderer = Renderer(scene, settings=self.settings)

        def differ(view: int) -> tuple[float, float, float]:
            image, dense = _image(renderer, self.views[view]), self.images[view]
            squared = np.square(np.subtract(image, dense, dtype=np.float64)).mean()
            error = dense[..., 0].size * float(np.log(squared + _LEAST_ERROR))
            there = dense[..., 3] > _OPAQUE
            lost = float(np.maximum(dense - image, 0)[there, 3].sum(dtype=np.float64))
            return error, lost, float(dense[there, 3].sum(dtype=np.float64))

        error = lost = opaque = 0.0
        for differs, misses, stops in in_threads(differ, range(len(self.views))):
            error, lost, opaque = error + differs, lost + misses, opaque + stops
        return error, lost, opaque

    def lost_in(self, scene: Splats) -> float:
        """Return the share of the light that opaque pixels stop but a simplified scene lets through."""
        _, lost, opaque = self.compare(scene)
        return lost / opaque if opaque else 0.0


def _image(renderer: Renderer, view: Camera) -> NDArray[np.float32]:
    one = renderer.render(view)
    return np.dstack([np.clip(one.image, 0, 1), one.alpha])


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
    some = cameras.take(evenly_spaced(len(cameras), _GAP_VIEWS)).resized(_GAP_PIXELS)
    return Renders.of(dense, some).lost_in(result)


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
