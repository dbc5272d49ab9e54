"""Starting poses for photos without one: pool poses whose small renders are most similar to the photo."""

from dataclasses import replace

import numpy as np

from g2ard.progress import Progress, silent
from g2ard.rendering.renderer import Renderer
from g2ard.scene.cameras import Camera, Cameras
from g2ard.stages.register.config import RegisterConfig
from g2ard.stages.register.grey import band_passed, grey_of, shift_between
from g2ard.stages.register.pose import Float, rotation_of


def small_render(renderer: Renderer, camera: Camera, config: RegisterConfig) -> Float:
    """Render (H, W) band-passed grey, 0 where alpha is too low."""
    out = renderer.render(camera)
    grey = band_passed(grey_of(np.clip(out.image, 0, 1)))
    return np.where(out.alpha >= config.min_alpha, grey, 0.0)


def turned(viewmat: Float, render: Float, photo: Float, K: Float) -> tuple[Float, float, float]:
    """Rotate a pose by the shift s of its `small_render` onto the photo's band-passed grey, with K of both:
    ω = (−s_v/f_y, s_u/f_x, 0).

    Returns:
        The (4, 4) pose with the same centre, the likeness after the shift (`shift_between`), and |s|.
    """
    right, down, likeness = shift_between(render, photo)
    turn = np.eye(4)
    turn[:3, :3] = rotation_of([-down / K[1, 1], right / K[0, 0], 0])
    return turn @ viewmat, likeness, float(np.hypot(right, down))


class PoolRenders:
    """Renders of a pool's poses with a photo's intrinsics, cached per intrinsics."""

    def __init__(
        self, renderer: Renderer, pool: Cameras, config: RegisterConfig, progress: Progress = silent
    ) -> None:
        self._renderer, self.pool, self._config, self._progress = renderer, pool, config, progress
        self._kept: dict[bytes, list[Float]] = {}

    def ranked(self, camera: Camera, grey: Float) -> tuple[list[tuple[int, Float]], int]:
        """Return indices by decreasing similarity with the poses rotated onto the photo, and the new renders.

        `camera` and `grey` are the photo at `pool_size`. Ties go by index.
        """
        key = camera.K.tobytes() + bytes(str((camera.width, camera.height)), "ascii")
        renders = 0
        if key not in self._kept:
            self._kept[key], renders = [], len(self.pool)
            for view in self.pool.viewmats:
                drawn = small_render(self._renderer, replace(camera, viewmat=view), self._config)
                self._kept[key].append(drawn)
                self._progress("pool", len(self._kept[key]), renders)
        photo = band_passed(grey)
        similar = [
            turned(view, render, photo, camera.K)
            for view, render in zip(self.pool.viewmats, self._kept[key], strict=True)
        ]
        order = np.argsort([-likeness for _, likeness, _ in similar], kind="stable").tolist()
        return [(at, similar[at][0]) for at in order], renders
