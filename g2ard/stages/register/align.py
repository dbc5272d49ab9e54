"""Direct alignment: the pose at which a render explains a photo, up to gain and bias.

The photo P and the render R at camera_from_world T satisfy P(x) = g·R(x) + b. Moving the camera to exp(ξ)T
moves the image of the point X (in the camera's axes) by ∂π/∂X · (v + ω × X), so to first order

P − g·R − b = −∇I · (∂π/∂X · [I | −[X]ₓ] · ξ + (f_x X/Z, f_y Y/Z) · φ),

where ∇I is the mean of g·∇R and ∇P (efficient second-order minimisation: Malis 2004; Benhimane and Malis
2004), and φ changes the logarithm of the focal length, whose given value has a prior of `focal_sigma`. ξ, φ
and the changes of g and b are solved together with Tukey's weights, then the scene is rendered again.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

import g2ard._core as _core
from g2ard.arrays import Float, Mask
from g2ard.rendering.renderer import Rendered, Renderer
from g2ard.scene.cameras import Camera
from g2ard.stages.register.config import RegisterConfig
from g2ard.stages.register.grey import blurred, gradient
from g2ard.stages.register.pose import moved

_TUKEY = 4.685
"""Tukey's constant, as in the normal equations' weights."""
_DAMPING = 1e-6
"""Relative damping added to the diagonal of the normal equations."""
_STEP_HALVINGS = 3
_CONTRADICTED = 3.0
"""Deviations of the focal length from its prior, in joint σ, beyond which the prior is widened."""
_FARTHEST = 1e9
"""Largest entry of a pose that is rendered."""
_WIDEST = 0.3
"""Largest σ of that prior."""
_REPEATED_LEVELS = 2
"""Finest levels that are aligned again with a wider prior."""
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
    """Weighted normal equations H·δ = y of δ = (v, ω, φ, Δg, Δb).

    Args:
        matrix: (9, 9).
        right: (9,).
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
        covariance: (7, 7) of (v, ω, φ) around the result, in the camera's axes: (JᵀWJ/(σ²·`correlated`) +
            prior)⁻¹ with gain and bias marginalised; None if the photo does not determine the pose.
        overlap: share of valid pixels.
        steps: number of renders at all levels.
        depth: median depth of valid pixels, scene units.
        zoom: estimated over given focal length.
        alone: see `focal_alone`.
    """

    viewmat: Float
    gain: float
    bias: float
    covariance: Float | None
    overlap: float
    steps: int
    depth: float
    zoom: float = 1.0
    alone: tuple[float, float] = (0.0, np.inf)


def level_of(grey: Float, mask: Mask | None = None) -> Level:
    """Prepare a grey photo as a level; `mask` (H, W) marks valid pixels, None means all."""
    soft = blurred(grey)
    return Level(
        soft,
        *gradient(soft),
        np.ones(grey.shape, bool) if mask is None else mask,
    )


def shot_of(out: Rendered, config: RegisterConfig) -> Shot:
    """Convert a render to a `Shot`."""
    return Shot(*_core.shot(out.image, out.alpha, out.depth, config.min_alpha, config.max_edge))


def normal_equations(
    photo: Level,
    shot: Shot,
    K: Float,
    gain: float,
    bias: float,
    scale: float | None = None,
) -> Normal:
    """Compute the weighted normal equations of one step, and the cost before it.

    `scale` is σ of the residuals; None estimates it. Results do not depend on the number of threads.
    """
    matrix, target, *rest = _core.normal_equations(photo, shot, _list_lens(K), (gain, bias), scale)
    return Normal(
        np.array(matrix),
        np.array(target),
        *rest,
    )


def moves(shot: Shot, K: Float, xi: Float) -> float:
    """Return the root mean square motion, in pixels, of the valid pixels under (v, ω, φ)."""
    return _core.flow(shot, _list_lens(K), xi.tolist())


def zoomed(camera: Camera, zoom: float, viewmat: Float) -> Camera:
    """Return the camera at a pose with its focal lengths multiplied by `zoom`."""
    return replace(
        camera,
        K=camera.K
        * np.array(
            [
                [zoom, 1, 1],
                [1, zoom, 1],
                [1, 1, 1],
            ]
        ),
        viewmat=viewmat,
    )


def focal_alone(matrix: Float, right: Float, zoom: float) -> tuple[float, float]:
    """Return φ = log of the focal length over the given one, and its σ, by the data without the prior.

    `matrix` and `right` are information about changes of (v, ω, φ, …) where it is log `zoom`.
    """
    covariance = inverse(matrix)
    if covariance is None:
        return 0.0, float("inf")
    return float(np.log(zoom) + covariance[6] @ right), float(np.sqrt(covariance[6, 6]))


def focal_prior(alone: tuple[float, float], prior: float) -> float:
    """Return σ of a prior of φ that `focal_alone` does not contradict: `prior`, or a wider one."""
    off = abs(alone[0])
    if off > _CONTRADICTED * np.hypot(alone[1], prior):
        return min(off, _WIDEST)
    return prior


def _list_lens(K: Float) -> tuple[float, float, float, float]:
    return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])


def align(
    renderer: Renderer,
    start: Float,
    pyramid: list[tuple[Camera, Level]],
    config: RegisterConfig,
    zoom: float = 1.0,
    focal_sigma: float | None = None,
) -> Aligned | None:
    """Align a photo, coarse to fine, from a pose; return None if too few pixels are valid there.

    The pyramid's cameras state size and given K of each level; their poses are ignored. `focal_sigma` is that
    of the config by default.
    """
    state = Aligned(
        viewmat=np.asarray(start, np.float64),
        gain=1.0,
        bias=0.0,
        covariance=None,
        overlap=0.0,
        steps=0,
        depth=0.0,
        zoom=zoom,
    )
    if focal_sigma is not None:
        return _align_levels(renderer, state, pyramid, config, focal_sigma)
    prior = config.focal_sigma
    aligned = _align_levels(renderer, state, pyramid, config, prior)
    if aligned is None or aligned.covariance is None:
        return aligned
    wider = focal_prior(aligned.alone, prior)
    if wider == prior:
        return aligned
    again = _align_levels(renderer, aligned, pyramid[-_REPEATED_LEVELS:], config, wider)
    return aligned if again is None else again


def _align_levels(
    renderer: Renderer,
    state: Aligned,
    pyramid: list[tuple[Camera, Level]],
    config: RegisterConfig,
    prior: float,
) -> Aligned | None:
    for number, (camera, photo) in enumerate(pyramid):
        last = number == len(pyramid) - 1
        if last:
            still = config.still
        else:
            still = _COARSE_STILL_FACTOR * config.still
        aligned = _align_level(
            renderer, state, camera, photo, config, prior, still, fresh=number == 0
        )
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
    prior: float,
    enough: float,
    *,
    fresh: bool,
) -> Aligned | None:
    """Run Gauss–Newton at one size.

    A step that raises the cost is halved. The level ends when that fails, or when a step moves the image by
    fewer pixels than `enough`.
    """

    def seen(viewmat: Float, zoom: float) -> tuple[Camera, Shot] | None:
        if not (np.abs(viewmat) < _FARTHEST).all():
            return None
        there = zoomed(camera, zoom, viewmat)
        shot = shot_of(renderer.render(there), config)
        if (photo.mask & shot.mask).mean() >= config.min_overlap:
            return (there, shot)
        return None

    def equations(
        view: tuple[Camera, Shot], light: tuple[float, float], scale: float | None = None
    ) -> Normal:
        there, shot = view
        normal = normal_equations(photo, shot, there.K, *light, scale)
        pixels = int((photo.mask & shot.mask).sum())
        return with_prior(
            normal, pixels, float(np.log(there.K[0, 0] / camera.K[0, 0])), prior, config
        )

    pose = state.viewmat
    zoom = state.zoom
    light = (state.gain, state.bias)
    taken = state.steps + 1
    view = seen(pose, zoom)
    if view is None:
        return None
    if fresh:
        light = _match_light(photo, view[1])
    normal = equations(view, light)
    scale = normal.scale
    for _ in range(config.iterations):
        step = _solve(normal)
        better = False
        for _ in range(_STEP_HALVINGS + 1):
            if step is None:
                break
            trial = moved(pose, step[:6])
            focal = zoom * float(np.exp(np.clip(step[6], -_WIDEST, _WIDEST)))
            there = seen(trial, focal)
            taken += 1
            if there is not None:
                lit = light[0] + step[7], light[1] + step[8]
                after = equations(there, lit, scale)
                if lit[0] > 0 and after.cost < normal.cost:
                    better = True
                    break
            step = step / 2
        if not better or step is None or there is None:
            break
        still = moves(view[1], view[0].K, step[:7]) < enough
        pose = trial
        zoom = focal
        view = there
        normal = after
        light = lit
        if still:
            break
    last_camera, shot = view
    final = equations(view, light)
    covariance = inverse(final.matrix)
    if covariance is not None:
        covariance = covariance[:7, :7] * (final.scale**2 * config.correlated)
    plain = normal_equations(photo, shot, last_camera.K, *light)
    variance = plain.scale**2 * config.correlated
    counted = photo.mask & shot.mask
    return Aligned(
        pose,
        *light,
        covariance,
        float(counted.mean()),
        taken,
        float(np.median(shot.depth[counted])),
        zoom,
        focal_alone(
            plain.matrix / variance,
            plain.right / variance,
            zoom,
        ),
    )


def with_prior(
    normal: Normal,
    pixels: int,
    zoom: float,
    sigma: float,
    config: RegisterConfig,
) -> Normal:
    """Add the prior of the logarithm of the focal length, `zoom` ~ N(0, `sigma`²), to equations and cost."""
    weight = normal.scale**2 * config.correlated / sigma**2
    matrix = normal.matrix.copy()
    right = normal.right.copy()
    matrix[6, 6] += weight
    right[6] -= weight * zoom
    penalty = 3 * config.correlated * (zoom / sigma / _TUKEY) ** 2 / pixels
    return replace(normal, matrix=matrix, right=right, cost=normal.cost + penalty)


def _match_light(photo: Level, shot: Shot) -> tuple[float, float]:
    """Return the gain and bias that match the render's mean and spread to the photo's, without alignment."""
    mask = photo.mask & shot.mask
    a = shot.grey[mask]
    b = photo.grey[mask]
    spread = float(a.std())
    if spread > 1e-6:
        gain = float(np.clip(b.std() / spread, 0.1, 10))
    else:
        gain = 1.0
    return gain, float(b.mean() - gain * a.mean())


def _solve(normal: Normal) -> Float | None:
    """Solve the normal equations with unit diagonal scaling; return None if an unknown is undetermined."""
    unit_scaled = _scale_to_unit(normal.matrix)
    if unit_scaled is None:
        return None
    scaled, unit = unit_scaled
    damped = scaled + _DAMPING * np.eye(len(unit))
    return unit * np.linalg.solve(damped, unit * normal.right)


def inverse(matrix: Float) -> Float | None:
    """Invert a symmetric matrix with unit diagonal scaling; return None if it is singular."""
    unit_scaled = _scale_to_unit(matrix)
    if unit_scaled is None:
        return None
    scaled, unit = unit_scaled
    if np.linalg.eigvalsh(scaled)[0] < 1e-12:
        return None
    return np.asarray(np.linalg.inv(scaled) * unit[:, None] * unit[None, :])


def _scale_to_unit(matrix: Float) -> tuple[Float, Float] | None:
    """Return D·M·D with a diagonal of ones, and the diagonal of D; None if an unknown is undetermined."""
    diagonal = np.diag(matrix)
    if not (np.isfinite(matrix).all() and (diagonal > 0).all()):
        return None
    unit = 1 / np.sqrt(diagonal)
    return matrix * unit[:, None] * unit[None, :], unit
