"""Images of a scene that is drawn box by box, front to back.

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

import g2ard._core as _core
from g2ard.arrays import Float, Float32, Mask
from g2ard.config.choices import BLACK
from g2ard.errors import require
from g2ard.rendering.renderer import RasterSettings, Renderer, corners_of, view_of
from g2ard.scene.cameras import Camera, Cameras
from g2ard.scene.kdtree import KdTree
from g2ard.scene.splats import Splats

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
    """

    camera: Camera
    color: Float32
    light: Float32

    @classmethod
    def blank(cls, camera: Camera) -> Canvas:
        """Return a canvas of a view on which nothing is drawn."""
        size = camera.height, camera.width
        return cls(
            camera,
            np.zeros((*size, 3), np.float32),
            np.ones(size, np.float32),
        )

    def draw(self, renderer: Renderer, box: Float) -> None:
        """Draw a box of a scene behind what is drawn.

        Args:
            renderer: of the box's own Gaussians and those of others that are `reaching` it. All boxes share
                one offset and the settings, with a near plane.
            box: (2, 3) low and high corners, world coordinates, infinite where it is open.
        """
        renderer.draw(self.camera, box, self.color, self.light)

    def light_on(self, box: Float) -> float:
        """Return the most light left in pixels whose rays meet a box, without those that have stopped.

        A box with 0 adds nothing. Boxes with less than `FAINT` add less than that to any pixel, all together.
        """
        view = view_of(Cameras.of([self.camera]), 0, _ANY_DEPTH)
        return _core.light_on(self.light, view, _ANY_DEPTH, corners_of(box))

    def finished(self, background: Sequence[float] = BLACK) -> Float32:
        """Return the (H, W, 4) image in front of a background, RGB in [0, 1], and its alpha."""
        left = np.abs(self.light)[..., None]
        behind = left * np.asarray(background, np.float32)
        return np.dstack([self.color + behind, 1 - left])


def front_to_back(tree: KdTree, position: Float) -> list[int]:
    """Return the leaves of a tree, by number, in the order in which rays from a position pass them.

    >>> front_to_back(KdTree(0, 1.0, KdTree(), KdTree()), np.array([3.0, 0, 0]))
    [1, 0]
    """
    return list(_walk(tree, position, 0))


def _walk(tree: KdTree, position: Float, first: int) -> Iterator[int]:
    if not (tree.below and tree.above):
        yield first
        return
    halves = [
        (tree.below, first),
        (tree.above, first + tree.below.leaves),
    ]
    if position[tree.axis] >= tree.at:
        halves.reverse()
    for half, number in halves:
        yield from _walk(half, position, number)


def reaching(splats: Splats, cameras: Cameras, box: Float) -> Mask:
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
    return _core.reaching(
        splats.means, largest, splats.opacities, views, corners_of(box - splats.offset)
    )
