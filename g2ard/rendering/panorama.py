"""Panoramas of a scene: equirectangular images, resampled from pinhole renders of the faces of a cube."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from g2ard.io.images import resized
from g2ard.scene.cameras import Camera, Cameras
from g2ard.scene.lenses import FACES, panorama_rays, photo_of

_FINER = 2
"""Pixels of a face, and samples, along a side of a pixel in the panorama's middle."""
_MARGIN = 2
"""Pixels of a face beyond its edges, so that every sample lies between pixels."""
_BAND = 64
"""Rows of a panorama sampled together."""

_Floats = NDArray[np.float32]


def stations(cameras: Cameras) -> Cameras:
    """Return one view per photo: those that were resampled from one photo become a view in its axes.

    >>> [view.name for view in stations(Cameras.of([Camera.facing([0, -2, 0], [0, 0, 0])]))]
    ['view']
    """
    found: dict[str, Camera] = {}
    for view in cameras:
        if view.lens is None:
            found[view.name] = view
            continue
        viewmat = np.eye(4)
        viewmat[:3] = np.array(view.lens.turn).reshape(3, 3) @ view.viewmat[:3]
        name = photo_of(view.name)
        found.setdefault(name, Camera(viewmat, view.K, view.width, view.height, name))
    return Cameras.of(found.values())


def panorama(
    shown: Callable[[Camera], tuple[_Floats, _Floats, _Floats]], camera: Camera, width: int
) -> tuple[_Floats, _Floats, _Floats]:
    """Render all directions around a camera.

    Args:
        shown: renders a pinhole view as image, alpha and depth.
        camera: its pose: the panorama's middle looks along z, its top is against y.
        width: pixels, even; the height is half of it.

    Returns:
        (H, W, 3) image, (H, W) alpha, and (H, W) alpha times the expected distance from the camera.
    """
    half = _FINER * width / (2 * np.pi)  # as many pixels per radian in the middle of a face
    side = 2 * (int(np.ceil(half)) + _MARGIN)
    K = np.array([[half, 0, side / 2], [0, half, side / 2], [0, 0, 1]])
    v, u = np.mgrid[0:side, 0:side] + 0.5
    reach = np.sqrt(((u - side / 2) ** 2 + (v - side / 2) ** 2) / half**2 + 1).astype(np.float32)
    pictures = []
    for turn in FACES.values():
        viewmat = np.eye(4)
        viewmat[:3] = turn.T @ camera.viewmat[:3]
        image, alpha, depth = shown(Camera(viewmat, K, side, side))
        pictures.append(np.dstack([image, alpha, depth * reach]).reshape(side * side, 5))
    height = width // 2
    out = np.empty((height, width, 5), np.float32)
    for top in range(0, height, _BAND):
        bottom = min(top + _BAND, height)
        rows = slice(_FINER * top, _FINER * bottom)
        rays = panorama_rays(_FINER * width, _FINER * height, rows)
        fine = np.empty((len(rays), 5), np.float32)
        local = np.stack([rays @ turn for turn in FACES.values()])
        face = local[..., 2].argmax(axis=0)
        for number, picture in enumerate(pictures):
            here = np.flatnonzero(face == number)
            x, y, z = local[number, here].T
            fine[here] = _sampled(picture, side, half * x / z + side / 2, half * y / z + side / 2)
        fine_rows = fine.reshape(rows.stop - rows.start, _FINER * width, 5)
        out[top:bottom] = resized(fine_rows, (width, bottom - top))
    return np.ascontiguousarray(out[..., :3]), out[..., 3].copy(), out[..., 4].copy()


def _sampled(
    picture: _Floats, side: int, u: NDArray[np.float64], v: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Sample a square picture, (side², C), bilinearly at pixels u, v."""
    left, above = np.floor(u - 0.5).astype(int), np.floor(v - 0.5).astype(int)
    right = (u - 0.5 - left)[:, None].astype(np.float32)
    down = (v - 0.5 - above)[:, None].astype(np.float32)
    at = above * side + left
    top = picture[at] * (1 - right) + picture[at + 1] * right
    bottom = picture[at + side] * (1 - right) + picture[at + side + 1] * right
    return top * (1 - down) + bottom * down
