"""Direct alignment: the pose at which a render explains a photo, up to gain and bias.

The photo P and the render R at camera_from_world T satisfy P(x) = g·R(x) + b. Moving the camera to exp(ξ)T
moves the image of the point X (in the camera's axes) by ∂π/∂X · (v + ω × X), so to first order

P − g·R − b = −∇I · ∂π/∂X · [I | −[X]ₓ] · ξ,

where ∇I is the mean of g·∇R and ∇P (efficient second-order minimisation: Malis 2004; Benhimane and Malis
2004). ξ and the changes of g and b are solved together with Tukey's weights, then the scene is rendered
again.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from g2ard import _core
from g2ard.rendering.renderer import Rendered, Renderer
from g2ard.scene.cameras import Camera
from g2ard.stages.register.config import RegisterConfig
from g2ard.stages.register.grey import blurred, gradient
from g2ard.stages.register.pose import Float, moved

Mask = NDArray[np.bool_]

_DAMPING = 1e-6
"""Relative damping added to the diagonal of the normal equations."""
_STEP_HALVINGS = 3
_COARSE_STILL_FACTOR = 10
"""Factor on `still` for all levels but the finest."""


class Level(NamedTuple):
    """A photo at one size: (H, W) float64 blurred grey, its gradients, and the mask of valid pixels."""

    grey: Float
    right: Float
    down: Float
    mask: Mask


class Shot(NamedTuple):
    """A render prepared for alignment.

    Args:
        grey: (H, W) float64, blurred like the photo.
        depth: (H, W) float64 scene units, the expected depth; 1 outside the mask.
        mask: (H, W) True where it is opaque enough and not next to a depth edge.
    """

    grey: Float
    depth: Float
    mask: Mask


@dataclass(frozen=True, eq=False)
class Normal:
    """Weighted normal equations H·δ = y of δ = (v, ω, Δg, Δb).

    Args:
        matrix: (8, 8).
        right: (8,).
        scale: σ of the residuals, from their median absolute deviation.
        cost: mean of Tukey's ρ(r/σ) over valid pixels, in [0, 1].
        weights: Σ w.
    """

    matrix: Float
    right: Float
    scale: float
    cost: float
    weights: float


@dataclass(frozen=True, eq=False)
class Aligned:
    """Result of alignment.

    Args:
        viewmat: (4, 4) camera_from_world.
        covariance: (6, 6) of ξ = (v, ω) around the result, in the camera's axes: (JᵀWJ)⁻¹·σ²·`correlated`
            with gain and bias marginalised; None if the photo does not determine the pose.
        overlap: share of valid pixels.
        steps: number of renders at all levels.
        depth: median depth of valid pixels, scene units.
    """

    viewmat: Float
    gain: float
    bias: float
    covariance: Float | None
    overlap: float
    steps: int
    depth: float


def level_of(grey: Float, mask: Mask | None = None) -> Level:
    """Prepare a grey photo as a level; `mask` (H, W) marks valid pixels, None means all."""
    soft = blurred(grey)
    return Level(soft, *gradient(soft), np.ones(grey.shape, bool) if mask is None else mask)


def shot_of(out: Rendered, config: RegisterConfig) -> Shot:
    """Convert a render to a `Shot`."""
    return Shot(*_core.shot(out.image, out.alpha, out.depth, config.min_alpha, config.max_edge))


def normal_equations(
    photo: Level, shot: Shot, K: Float, gain: float, bias: float, scale: float | None = None
) -> Normal:
    """Compute the weighted normal equations of one step, and the cost before it.

    `scale` is σ of the residuals; None estimates it. Results do not depend on the number of threads.
    """
    matrix, target, *rest = _core.normal_equations(photo, shot, _lens(K), (gain, bias), scale)
    return Normal(np.array(matrix), np.array(target), *rest)


def moves(shot: Shot, K: Float, xi: Float) -> float:
    """Return the root mean square motion, in pixels, of the valid pixels under ξ."""
    return _core.flow(shot, _lens(K), xi.tolist())


def _lens(K: Float) -> tuple[float, float, float, float]:
    return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])


def align(
    renderer: Renderer, start: Float, pyramid: list[tuple[Camera, Level]], config: RegisterConfig
) -> Aligned | None:
    """Align a photo, coarse to fine, from a pose; return None if too few pixels are valid there.

    The pyramid's cameras state size and K of each level; their poses are ignored.
    """
    state = Aligned(np.asarray(start, np.float64), 1.0, 0.0, None, 0.0, 0, 0.0)
    for number, (camera, photo) in enumerate(pyramid):
        last = number == len(pyramid) - 1
        still = config.still if last else _COARSE_STILL_FACTOR * config.still
        aligned = _align_level(renderer, state, camera, photo, config, still, fresh=number == 0)
        if aligned is None:
            return None
        state = aligned
    return state


def _align_level(
    renderer: Renderer,
    state: Aligned,
    camera: Camera,
    photo: Level,
    config: RegisterConfig,
    enough: float,
    *,
    fresh: bool,
) -> Aligned | None:
    """Run Gauss–Newton at one size.

    A step that raises the cost is halved. The level ends when that fails, or when a step moves the image by
    fewer pixels than `enough`.
    """

    def shot_at(viewmat: Float) -> Shot:
        return shot_of(renderer.render(replace(camera, viewmat=viewmat)), config)

    def overlaps(shot: Shot) -> bool:
        return (photo.mask & shot.mask).mean() >= config.min_overlap

    pose, gain, bias, taken = state.viewmat, state.gain, state.bias, state.steps + 1
    shot = shot_at(pose)
    if not overlaps(shot):
        return None
    if fresh:
        gain, bias = _light(photo, shot)
    normal = normal_equations(photo, shot, camera.K, gain, bias)
    scale = normal.scale
    for _ in range(config.iterations):
        step = _solved(normal)
        better = False
        for _ in range(_STEP_HALVINGS + 1):
            if step is None:
                break
            trial = moved(pose, step[:6])
            seen = shot_at(trial)
            taken += 1
            if overlaps(seen):
                light = gain + step[6], bias + step[7]
                after = normal_equations(photo, seen, camera.K, *light, scale)
                if light[0] > 0 and after.cost < normal.cost:
                    better = True
                    break
            step = step / 2
        if not better or step is None:
            break
        still = moves(shot, camera.K, step[:6]) < enough
        pose, shot, normal, (gain, bias) = trial, seen, after, light
        if still:
            break
    final = normal_equations(photo, shot, camera.K, gain, bias)
    covariance = inverse(final.matrix)
    counted = photo.mask & shot.mask
    return Aligned(
        pose,
        gain,
        bias,
        None if covariance is None else covariance[:6, :6] * (final.scale**2 * config.correlated),
        float(counted.mean()),
        taken,
        float(np.median(shot.depth[counted])),
    )


def _light(photo: Level, shot: Shot) -> tuple[float, float]:
    """Return the gain and bias that match the render's mean and spread to the photo's, without alignment."""
    mask = photo.mask & shot.mask
    a, b = shot.grey[mask], photo.grey[mask]
    spread = float(a.std())
    gain = float(np.clip(b.std() / spread, 0.1, 10)) if spread > 1e-6 else 1.0
    return gain, float(b.mean() - gain * a.mean())


def _solved(normal: Normal) -> Float | None:
    """Solve the normal equations with unit diagonal scaling; return None if an unknown is undetermined."""
    if (unit_scaled := _unit_scaled(normal.matrix)) is None:
        return None
    scaled, unit = unit_scaled
    return unit * np.linalg.solve(scaled + _DAMPING * np.eye(8), unit * normal.right)


def inverse(matrix: Float) -> Float | None:
    """Invert a symmetric matrix with unit diagonal scaling; return None if it is singular."""
    if (unit_scaled := _unit_scaled(matrix)) is None:
        return None
    scaled, unit = unit_scaled
    if np.linalg.eigvalsh(scaled)[0] < 1e-12:
        return None
    return np.asarray(np.linalg.inv(scaled) * unit[:, None] * unit[None, :])


def _unit_scaled(matrix: Float) -> tuple[Float, Float] | None:
    """Return D·M·D with a diagonal of ones, and the diagonal of D; None if an unknown is undetermined."""
    diagonal = np.diag(matrix)
    if not (np.isfinite(matrix).all() and (diagonal > 0).all()):
        return None
    unit = 1 / np.sqrt(diagonal)
    return matrix * unit[:, None] * unit[None, :], unit
