"""Images and visibility of a scene that is drawn box by box, front to back.

A pair of a Gaussian and a pixel belongs to the box that holds the point of the pixel's ray at the
Gaussian's depth. Along each ray this point passes through the boxes of a kd tree in the order in which the
tree is walked from the camera. Boxes drawn in that order therefore blend all pairs in the order of the
whole scene. Each box continues where those in front of it stopped. So the image has the whole scene's
bits, unless Gaussians of equal depth stand in another order of rows.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import g2ard._core as _core
from g2ard.config.choices import BLACK
from g2ard.errors import require
from g2ard.rendering.renderer import RasterSettings, Rendered, Renderer, corners_of, view_of
from g2ard.scene.cameras import Camera, Cameras
from g2ard.scene.kdtree import KdTree
from g2ard.scene.prepared import as_prepared
from g2ard.scene.splats import Splats

_Floats = NDArray[np.float32]

FAINT = 1 / 255
"""Light in front of a box below which it adds less than a step of an 8-bit image."""


_ANY_DEPTH = RasterSettings(antialiased=False, near=float(np.finfo(np.float32).tiny))
"""Settings for what depends on rays alone."""


@dataclass(frozen=True, eq=False)
class Canvas:
    """A view's image so far: the boxes in front are drawn, a background is not. Arrays are drawn on in place.

    Args:
        camera: the view, world coordinates.
        color: (H, W, 3) float32, Σ αT·c.
        light: (H, W) float32, the light that is left, negative where the pixel has stopped.
        depth: (H, W) float32, Σ αT·z, scene units; None unless requested.
        median: (H, W) float32, depth of the splat at which the light falls below one half, scene units, 0 as
            long as it does not; None unless requested.
    """

    camera: Camera
    color: _Floats
    light: _Floats
    depth: _Floats | None = None
    median: _Floats | None = None

    @classmethod
    def blank(cls, camera: Camera, *, depths: bool = False) -> Canvas:
        """Return a canvas of a view on which nothing is drawn; `depths` adds depth and median depth."""
        size = camera.height, camera.width
        planes = [np.zeros(size, np.float32) for _ in range(2 * depths)]
        return cls(camera, np.zeros((*size, 3), np.float32), np.ones(size, np.float32), *planes)

    def draw(self, renderer: Renderer, box: NDArray[np.float64]) -> None:
        """Draw a box of a scene behind what is drawn.

        Args:
            renderer: of the box's own Gaussians and those of others that are `reaching` it. All boxes share
                one offset and the settings, with a near plane.
            box: (2, 3) low and high corners, world coordinates, infinite where it is open.
        """
        renderer.draw(self.camera, box, self.color, self.light, self.depth, self.median)

    def light_on(self, box: NDArray[np.float64]) -> float:
        """Return the most light left in pixels whose rays meet a box, without those that have stopped.

        A box with 0 adds nothing. Boxes with less than `FAINT` add less than that to any pixel, all together.
        """
        view = view_of(Cameras.of([self.camera]), 0, _ANY_DEPTH)
        return _core.light_on(self.light, view, _ANY_DEPTH, corners_of(box))

    def finished(self, background: Sequence[float] = BLACK) -> Rendered:
        """Return the image in front of a background, RGB in [0, 1], like `Renderer.render`."""
        left = np.abs(self.light)
        image = self.color + left[..., None] * np.asarray(background, np.float32)
        depth = np.zeros_like(left) if self.depth is None else self.depth
        return Rendered(image, 1 - left, depth, self.median)


class BoxVisibility:
    """Contribution of a box's Gaussians to views, Σ αT²; add up those of a Gaussian that reaches several."""

    def __init__(self, splats: Splats) -> None:
        scene = as_prepared(splats)
        self._offset = scene.offset
        self._sums = _core.VisibilityAccumulator(scene.core)

    def add(self, camera: Camera, light: _Floats, box: NDArray[np.float64], settings: RasterSettings) -> None:
        """Add a view whose boxes in front were added.

        Args:
            camera: the view, world coordinates.
            light: (H, W) float32, the light in front of the box; becomes that behind it. A pixel with at most
                1e-4 has stopped.
            box: (2, 3) low and high corners, world coordinates.
            settings: conventions with a near plane and `antialiased`, the same for all boxes.
        """
        view = view_of(Cameras.of([camera]).recentred(self._offset), 0, settings)
        self._sums.add_box(view, settings, corners_of(box - self._offset), light)

    def by_row(self) -> tuple[_Floats, _Floats]:
        """Return (N,) Σ αT², and the (N,) smallest size of a pixel, which does not depend on boxes."""
        return self._sums.by_row()


def front_to_back(tree: KdTree, position: NDArray[np.float64]) -> list[int]:
    """Return the leaves of a tree, by number, in the order in which rays from a position pass them.

    >>> front_to_back(KdTree(0, 1.0, KdTree(), KdTree()), np.array([3.0, 0, 0]))
    [1, 0]
    """
    return list(_walk(tree, position, 0))


def _walk(tree: KdTree, position: NDArray[np.float64], first: int) -> Iterator[int]:
    if not (tree.below and tree.above):
        yield first
        return
    halves = [(tree.below, first), (tree.above, first + tree.below.leaves)]
    if position[tree.axis] >= tree.at:
        halves.reverse()
    for half, number in halves:
        yield from _walk(half, position, number)


def reaching(splats: Splats, cameras: Cameras, box: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return (N,) which Gaussians may have a pixel in a box, at α ≥ 1/255, in some view: all that it needs.

    Args:
        splats: the scene, with float32 means.
        cameras: the views, world coordinates.
        box: (2, 3) low and high corners, world coordinates.
    """
    require("splats", splats, splats.means.dtype == np.float32, "means in float32")
    here = cameras.recentred(splats.offset)
    views = [view_of(here, i, _ANY_DEPTH) for i in range(len(here))]
    largest = np.ascontiguousarray(splats.scales.max(axis=1))
    return _core.reaching(splats.means, largest, splats.opacities, views, corners_of(box - splats.offset))
