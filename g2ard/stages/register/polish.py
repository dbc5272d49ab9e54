"""Polishing: refinement of a pose by the exact gradient of renders, with features as a prior.

    E(T, g, b) = Σ ρ((P − g·R(T) − b)/σ)/κ + ½ ξᵀ Λ ξ,   T = exp(ξ) T_f

ρ is Tukey's function, P and R the blurred grey of photo and render, κ the `correlated` of `RegisterConfig`,
and Λ the information of the features' pose T_f (0 without features). Direct alignment assumes one surface per
pixel; this gradient goes through the rasteriser (`Renderer.pose_gradient`). Steps are Levenberg–Marquardt
with alignment's matrix as the Hessian.
"""

from dataclasses import dataclass, replace

import numpy as np

from g2ard.rendering.renderer import Renderer
from g2ard.scene.cameras import Camera
from g2ard.stages.register.align import (
    TUKEY,
    Aligned,
    Level,
    Shot,
    inverse,
    moves,
    normal_equations,
    shot_of,
)
from g2ard.stages.register.config import RegisterConfig
from g2ard.stages.register.grey import LUMA, blurred_back
from g2ard.stages.register.pose import Float, motion_between, moved
from g2ard.stages.register.solve import Solved

_DAMPING = 1e-3, 10.0
"""Initial damping, and its factor: multiplied after a step that raises the cost, divided otherwise."""
_MOVED = np.array([0, 1, 2, 3, 4, 5, 7, 8])
"""Unknowns that steps change: all but the focal length."""
_LEAST_DAMPING = 1e-6
_MOST_DAMPING = 1e3


@dataclass(frozen=True, eq=False)
class Point:
    """E at one pose and light, with gradient and Hessian over (v, ω, g, b)."""

    at: Aligned
    energy: float
    slope: Float
    hessian: Float
    shot: Shot


class Energy:
    """E of one photo; σ and the pixel count are fixed at the first evaluation."""

    def __init__(
        self, renderer: Renderer, camera: Camera, photo: Level, prior: Solved | None, config: RegisterConfig
    ) -> None:
        self._renderer, self._camera, self._photo = renderer, camera, photo
        self._prior, self._config = prior, config
        self._scale: float | None = None
        self._focal = 1 / (prior.focal_sigma if prior else config.focal_sigma) ** 2
        self._pixels = 0
        self.renders = 0

    def at(self, viewmat: Float, gain: float, bias: float) -> Point | None:
        """Evaluate E; return None if too few pixels are valid."""
        camera, photo, config = replace(self._camera, viewmat=viewmat), self._photo, self._config
        out = self._renderer.render(camera)
        self.renders += 1
        shot = shot_of(out, config)
        counted = photo.mask & shot.mask
        if counted.mean() < config.min_overlap:
            return None
        normal = normal_equations(photo, shot, camera.K, gain, bias, self._scale)
        if self._scale is None:
            self._scale, self._pixels = normal.scale, int(counted.sum())
        share = (photo.grey - gain * shot.grey - bias) / self._scale
        tukey = np.maximum(0.0, 1 - (share / TUKEY) ** 2) ** 2 * share
        by_residual = np.where(counted, tukey, 0.0) / (self._scale * config.correlated)
        by_grey = blurred_back(-gain * by_residual)
        unclipped = (out.image > 0) & (out.image < 1)
        by_colour = np.where(unclipped, by_grey[..., None] * LUMA, 0.0).astype(np.float32)
        by_light = -normal.right[7:] / (normal.scale**2 * config.correlated)
        slope = np.concatenate([self._renderer.pose_gradient(by_colour), by_light])
        hessian = normal.matrix / (normal.scale**2 * config.correlated)
        energy = normal.cost * self._pixels * TUKEY**2 / 6 / config.correlated
        if self._prior is not None:
            xi = motion_between(self._prior.viewmat, viewmat)
            by_motion = self._prior.information[:6, :6] @ xi  # for small ξ
            energy, slope[:6] = energy + float(xi @ by_motion) / 2, slope[:6] + by_motion
            hessian[:7, :7] += self._prior.information
        hessian[6, 6] += self._focal
        depth, covariance = float(np.median(shot.depth[counted])), inverse(hessian)
        covariance = None if covariance is None else covariance[:7, :7]
        overlap = float(counted.mean())
        aligned = Aligned(viewmat, gain, bias, covariance, overlap, self.renders, depth)
        return Point(aligned, energy, slope, hessian[_MOVED][:, _MOVED], shot)


def polish(
    renderer: Renderer,
    start: Aligned,
    camera: Camera,
    photo: Level,
    prior: Solved | None,
    config: RegisterConfig,
) -> Aligned | None:
    """Minimise E from a pose and its light; return None if too few pixels are valid.

    `camera` states the size of `photo`, and its K with the focal length of the start; `iterations` and
    `still` of the config end the search.
    """
    energy = Energy(renderer, camera, photo, prior, config)
    here = energy.at(start.viewmat, start.gain, start.bias)
    damping = _DAMPING[0]
    for _ in range(config.iterations):
        if here is None:
            return None
        unit = 1 / np.sqrt(np.maximum(np.diag(here.hessian), 1e-30))
        scaled = here.hessian * unit[:, None] * unit[None, :] + damping * np.eye(8)
        step = -unit * np.linalg.solve(scaled, unit * here.slope)
        pose, light = moved(here.at.viewmat, step[:6]), (here.at.gain + step[6], here.at.bias + step[7])
        after = energy.at(pose, *light)
        still = moves(here.shot, camera.K, np.append(step[:6], 0.0)) < config.still
        if after is not None and light[0] > 0 and after.energy < here.energy:
            here, damping = after, max(damping / _DAMPING[1], _LEAST_DAMPING)
        else:
            damping *= _DAMPING[1]
        if still or damping > _MOST_DAMPING:
            break
    return None if here is None else replace(here.at, steps=energy.renders, zoom=start.zoom)
