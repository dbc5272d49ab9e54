"""Direct alignment: the pose at which a render explains a photo, up to a gain and a bias.

The photo P and the render R at camera_from_world T obey P(x) = g·R(x) + b. Moving the camera to exp(ξ)T moves
the image of the point X (in the camera's axes) by ∂π/∂X · (v + ω × X), so to first order
P − g·R − b = −∇I · ∂π/∂X · [I | −[X]ₓ] · ξ, with ∇I the mean of g·∇R and ∇P (efficient second-order
minimisation: Malis 2004; Benhimane and Malis 2004). ξ, the change of g and that of b are solved together,
under Tukey's weights; the scene is then rendered anew.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from g2ard import _core
from g2ard.rendering.renderer import Rendered, Renderer
from g2ard.scene.cameras import Camera
from g2ard.stages.register.config import RegisterConfig
from g2ard.stages.register.grey import blurred, gradient
from g2ard.stages.register.pose import moved

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

_DAMPING = 1e-6
"""Added to the normal equations' diagonal, relatively."""
_HALVINGS = 3
_COARSER = 10
"""`still` of every level but the finest: the next one looks more closely."""


@dataclass(frozen=True, eq=False)
class Level:
    """A photo at one size: (H, W) float64 grey, blurred; its gradients; its pixels that count."""

    grey: Float
    right: Float
    down: Float
    mask: Mask


@dataclass(frozen=True, eq=False)
class Shot:
    """A render as alignment needs it, at one pose.

    Args:
        grey: (H, W) float64, blurred as the photo is.
        depth: (H, W) float64 scene units, the expected depth; 1 where nothing counts.
        mask: (H, W) opaque enough, and not beside an edge of depth.
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
        scale: σ of the residuals, by their median absolute deviation.
        cost: mean of Tukey's ρ(r/σ) over the pixels that count, in [0, 1].
        weights: Σ w.
    """

    matrix: Float
    right: Float
    scale: float
    cost: float
    weights: float


@dataclass(frozen=True, eq=False)
class Aligned:
    """What alignment found.

    Args:
        viewmat: (4, 4) camera_from_world.
        gain: of the render's grey.
        bias: added to it.
        covariance: (6, 6) of ξ = (v, ω) about the result, in the camera's axes: (JᵀWJ)⁻¹·σ²·`correlated`,
            gain and bias marginalised; None where the photo does not determine the pose.
        overlap: share of the pixels that count.
        steps: renders at all levels.
        depth: median depth of what counts, scene units.
    """

    viewmat: Float
    gain: float
    bias: float
    covariance: Float | None
    overlap: float
    steps: int
    depth: float


def level_of(grey: Float, mask: Mask | None = None) -> Level:
    """A grey photo as a level; `mask` (H, W) is true where it counts, None everywhere."""
    soft = blurred(grey)
    return Level(soft, *gradient(soft), np.ones(grey.shape, bool) if mask is None else mask)


def shoot(renderer: Renderer, camera: Camera, config: RegisterConfig) -> Shot:
    """Render one view for alignment; see `Shot`."""
    return shot_of(renderer.render(camera), config)


def shot_of(out: Rendered, config: RegisterConfig) -> Shot:
    """A render for alignment; see `Shot`."""
    return Shot(*_core.shot(out.image, out.alpha, out.depth, config.min_alpha, config.max_edge))


def normal_equations(
    photo: Level, shot: Shot, K: Float, gain: float, bias: float, scale: float | None = None
) -> Normal:
    """Weighted normal equations of one step, and the cost before it.

    Args:
        photo: at a size.
        shot: the render at that size.
        K: (3, 3) pixels.
        gain: of the render.
        bias: added to it.
        scale: σ of the residuals; None finds it.

    Sums run over pixels in an order of their own: they do not depend on the number of threads.
    """
    of_photo = photo.grey, photo.right, photo.down, photo.mask
    matrix, target, *rest = _core.normal_equations(of_photo, _parts(shot), _lens(K), (gain, bias), scale)
    return Normal(np.array(matrix), np.array(target), *rest)


def moves(shot: Shot, K: Float, xi: Float) -> float:
    """Root of the mean square, in pixels, of how far ξ moves the pixels that count."""
    return _core.flow(_parts(shot), _lens(K), xi.tolist())


def _parts(shot: Shot) -> tuple[Float, Float, Mask]:
    return shot.grey, shot.depth, shot.mask


def _lens(K: Float) -> tuple[float, float, float, float]:
    return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])


def align(
    renderer: Renderer,
    start: Float,
    pyramid: list[tuple[Camera, Level]],
    config: RegisterConfig,
) -> Aligned | None:
    """Align a photo, coarse to fine, from a starting pose.

    Args:
        renderer: of the scene.
        start: (4, 4) camera_from_world.
        pyramid: the photo at each level: a camera with that size and K (its pose does not count), and the
            level.
        config: see `RegisterConfig`.

    Returns:
        An `Aligned`; None where too few pixels count at the start.
    """
    state = Aligned(np.asarray(start, np.float64), 1.0, 0.0, None, 0.0, 0, 0.0)
    for number, (camera, photo) in enumerate(pyramid):
        last = number == len(pyramid) - 1
        still = config.still if last else _COARSER * config.still
        found = _level(renderer, state, camera, photo, config, still, fresh=number == 0)
        if found is None:
            return None
        state = found
    return state


def _level(
    renderer: Renderer,
    state: Aligned,
    camera: Camera,
    photo: Level,
    config: RegisterConfig,
    enough: float,
    *,
    fresh: bool,
) -> Aligned | None:
    """Gauss–Newton at one size; a step that costs more is halved; the level ends where that fails, or where a
    step moves the image by fewer pixels than `enough`."""

    def shot_at(viewmat: Float) -> Shot:
        return shoot(renderer, replace(camera, viewmat=viewmat), config)

    def counts(shot: Shot) -> bool:
        return (photo.mask & shot.mask).mean() >= config.min_overlap

    pose, gain, bias, taken = state.viewmat, state.gain, state.bias, state.steps + 1
    shot = shot_at(pose)
    if not counts(shot):
        return None
    if fresh:
        gain, bias = _light(photo, shot)
    normal = normal_equations(photo, shot, camera.K, gain, bias)
    scale = normal.scale
    for _ in range(config.iterations):
        step = _solved(normal)
        better = False
        for _ in range(_HALVINGS + 1):
            if step is None:
                break
            trial = moved(pose, step[:6])
            seen = shot_at(trial)
            taken += 1
            if counts(seen):
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
    counted = photo.mask & shot.mask
    return Aligned(
        pose,
        gain,
        bias,
        _covariance(final, config.correlated),
        float(counted.mean()),
        taken,
        float(np.median(shot.depth[counted])),
    )


def _light(photo: Level, shot: Shot) -> tuple[float, float]:
    """Gain and bias that give the render the photo's mean and spread: images need not be aligned for it."""
    mask = photo.mask & shot.mask
    a, b = shot.grey[mask], photo.grey[mask]
    spread = float(a.std())
    gain = float(np.clip(b.std() / spread, 0.1, 10)) if spread > 1e-6 else 1.0
    return gain, float(b.mean() - gain * a.mean())


def _solved(normal: Normal) -> Float | None:
    """δ of the normal equations, each unknown scaled to a unit diagonal; None where one says nothing."""
    diagonal = np.diag(normal.matrix)
    if not (np.isfinite(normal.matrix).all() and (diagonal > 0).all()):
        return None
    unit = 1 / np.sqrt(diagonal)
    scaled = normal.matrix * unit[:, None] * unit[None, :] + _DAMPING * np.eye(8)
    return unit * np.linalg.solve(scaled, unit * normal.right)


def _covariance(normal: Normal, correlated: float) -> Float | None:
    found = inverse(normal.matrix)
    return None if found is None else found[:6, :6] * (normal.scale**2 * correlated)


def inverse(matrix: Float) -> Float | None:
    """Of a symmetric matrix, its unknowns scaled to a unit diagonal; None where it has none."""
    diagonal = np.diag(matrix)
    if not (np.isfinite(matrix).all() and (diagonal > 0).all()):
        return None
    unit = 1 / np.sqrt(diagonal)
    scaled = matrix * unit[:, None] * unit[None, :]
    if np.linalg.eigvalsh(scaled)[0] < 1e-12:
        return None
    return np.asarray(np.linalg.inv(scaled) * unit[:, None] * unit[None, :])
