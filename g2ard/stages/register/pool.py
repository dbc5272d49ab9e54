"""Starts for photos without a pose: the poses of a pool whose small renders look most like the photo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from g2ard.cameras import Camera, Cameras
from g2ard.stages.register.config import RegisterConfig
from g2ard.stages.register.grey import band_passed, grey_of, zncc
from g2ard.stages.render import Renderer

__all__ = ["PoolRenders"]

Float = NDArray[np.float64]
_Small = list[tuple[Float, NDArray[np.bool_]]]


class PoolRenders:
    """Renders of a pool's poses through the lens of a photo, kept for photos of the same lens.

    Args:
        renderer: of the scene.
        pool: C poses; their own K and size do not count.
        config: `pool_size`, `min_alpha` and `min_overlap` of `RegisterConfig`.
    """

    def __init__(self, renderer: Renderer, pool: Cameras, config: RegisterConfig) -> None:
        self._renderer, self.pool, self._config = renderer, pool, config
        self._kept: dict[bytes, _Small] = {}

    def ranked(self, camera: Camera, grey: Float) -> tuple[list[int], int]:
        """Poses from the likest on, by ZNCC of band-passed grey; and how many renders that took.

        Args:
            camera: the photo's, at `pool_size`.
            grey: (H, W) of the photo at that size.

        Poses of which too little is opaque come last; ties go by index.
        """
        key = camera.K.tobytes() + bytes(str((camera.width, camera.height)), "ascii")
        renders = 0
        if key not in self._kept:
            self._kept[key] = [self._small(replace(camera, viewmat=view)) for view in self.pool.viewmats]
            renders = len(self.pool)
        photo = band_passed(grey)
        scores = [
            zncc(image, photo, mask) if mask.mean() >= self._config.min_overlap else -1.0
            for image, mask in self._kept[key]
        ]
        return np.argsort(-np.array(scores), kind="stable").tolist(), renders

    def _small(self, camera: Camera) -> tuple[Float, NDArray[np.bool_]]:
        out = self._renderer.render(camera)
        return band_passed(grey_of(np.clip(out.image, 0, 1))), out.alpha >= self._config.min_alpha
