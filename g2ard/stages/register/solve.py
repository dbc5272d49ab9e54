"""Poses from matches: render pixels lifted by depth, then PnP.

A match (u, v) ↔ (u', v') of photo and render assigns to the photo's pixel the 3D point that the render shows
at (u', v'), from its median depth. LO-RANSAC over P3P gives a pose, refined by min Σ ρ(|π(T X) − u|²) with
Cauchy's ρ; both by pycolmap. A render at the new pose is more similar to the photo, so this is repeated until
the pose converges.
"""

from dataclasses import dataclass

import numpy as np

from g2ard.arrays import Float, Float32, Mask
from g2ard.rendering.renderer import Rendered, Renderer
from g2ard.scene.cameras import Camera
from g2ard.stages.register.align import focal_alone, focal_prior, zoomed
from g2ard.stages.register.config import RegisterConfig
from g2ard.stages.register.matchers import Matcher
from g2ard.stages.register.pose import moved

_LEAST_MATCHES = 6
"""Least matches and inliers for a pose; three determine it, the rest confirm it."""
_SIGMA_OF_MAD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
_LEAST_MATCH_SIGMA = 0.02
"""Least σ of a match, pixels."""
_FOCAL_STEPS = 20
"""Most Gauss–Newton steps of pose and focal length."""
_MOST_ZOOM = 0.1
"""Largest change of the logarithm of the focal length in one step."""
_STILL_PIXELS = 0.3
"""Root mean square motion in pixels below which passes stop; about a keypoint's error."""


@dataclass(frozen=True, eq=False)
class Solved:
    """A pose from matches.

    Args:
        viewmat: (4, 4) camera_from_world.
        matches: number of matches with known depth.
        spread: share of the image's 4 × 4 cells with an inlier.
        reprojection: median reprojection error of the inliers, pixels.
        information: (7, 7) inverse covariance of (v, ω, φ), camera axes, without a prior; see `information`.
        depth: median depth of the inliers, scene units.
        pixels: (inliers, 2) pixels of the photo.
        seen: (inliers, 2) pixels of the last render.
        zoom: estimated over given focal length.
        focal_sigma: σ of the prior of log `zoom`, wider than the config's if matches contradict that.
        alone: the matches' `focal_alone`.
    """

    viewmat: Float
    matches: int
    inliers: int
    spread: float
    reprojection: float
    information: Float
    depth: float
    passes: int
    pixels: Float
    seen: Float
    zoom: float
    focal_sigma: float
    alone: tuple[float, float]


def solve(
    renderer: Renderer,
    start: Float,
    camera: Camera,
    photo: Float32,
    mask: Mask,
    match: Matcher,
    config: RegisterConfig,
    passes: int,
) -> Solved | None:
    """Match, lift and solve from a starting pose, then repeat from the result, in at most `passes` renders.

    `camera` states the photo's size and K. Returns the last pass that gave a pose, or None.
    """
    solution = None
    for number in range(passes):
        there = zoomed(camera, 1.0, start)
        if solution is not None:
            there = zoomed(camera, solution.zoom, solution.viewmat)
        out = renderer.render(there, median=True)
        uv, seen = match(photo, np.clip(out.image, 0, 1))
        counts = _look_up(mask, uv)
        uv = uv[counts]
        seen = seen[counts]
        points, known = lifted(out, there, seen, config)
        after = solve_pnp(there, uv[known], points[known], config)
        if after is None:
            break
        T, inlying = after
        of = uv[known][inlying]
        at = seen[known][inlying]
        X = points[known][inlying]
        found, prior, data, alone = with_focal(
            zoomed(there, 1.0, T),
            camera.K[0, 0],
            of,
            X,
            config,
        )
        T = found.viewmat
        K = found.K
        pixels = _project(T, K, X)
        shift = pixels - _project(there.viewmat, there.K, X)
        cells = np.floor(4 * of / [camera.width, camera.height]).clip(0, 3) @ [1, 4]
        distance = np.linalg.norm(pixels - of, axis=1)
        solution = Solved(
            viewmat=T,
            matches=int(known.sum()),
            inliers=len(of),
            spread=len(np.unique(cells)) / 16,
            reprojection=float(np.median(distance)),
            information=data,
            depth=float(np.median(X @ T[2, :3] + T[2, 3])),
            passes=number + 1,
            pixels=of,
            seen=at,
            zoom=float(K[0, 0] / camera.K[0, 0]),
            focal_sigma=prior,
            alone=alone,
        )
        if np.sqrt((shift**2).sum(1).mean()) < _STILL_PIXELS:
            break
    return solution


def _look_up(image: Mask, uv: Float) -> Mask:
    height, width = image.shape
    column, row = np.floor(uv).astype(int).T
    return image[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]


def lifted(
    out: Rendered,
    camera: Camera,
    uv: Float,
    config: RegisterConfig,
) -> tuple[Float, Mask]:
    """Lift render pixels to 3D points.

    The median depth is interpolated between the four pixels around (u, v). It is known if all four have a
    depth, enough alpha (`min_alpha`), and differ by at most `max_edge`. The expected depth would lie between
    foreground and background. Returns (M, 3) world coordinates, and the (M,) mask of known ones.
    """
    assert out.median is not None
    height, width = out.alpha.shape
    x, y = (uv - 0.5).T
    left = np.floor(x).astype(int).clip(0, max(width - 2, 0))
    top = np.floor(y).astype(int).clip(0, max(height - 2, 0))
    right = np.minimum(left + 1, width - 1)
    down = np.minimum(top + 1, height - 1)
    a = np.clip(x - left, 0, 1)
    b = np.clip(y - top, 0, 1)
    share = np.stack(
        [
            (1 - a) * (1 - b),
            a * (1 - b),
            (1 - a) * b,
            a * b,
        ]
    )
    cells = (top, left), (top, right), (down, left), (down, right)
    depths = np.stack([out.median[cell].astype(np.float64) for cell in cells])
    alpha = np.stack([out.alpha[cell].astype(np.float64) for cell in cells]).min(0)
    nearest = depths.min(0)
    known = nearest > 0
    known &= alpha >= config.min_alpha
    known &= depths.max(0) - nearest <= config.max_edge * nearest
    (fx, _, cx), (_, fy, cy), _ = camera.K
    z = (share * depths).sum(0)
    x = (uv[:, 0] - cx) / fx * z
    y = (uv[:, 1] - cy) / fy * z
    seen = np.stack([x, y, z], 1)
    rotation = camera.viewmat[:3, :3]
    from_eye = seen - camera.viewmat[:3, 3]
    return np.einsum("mi,ij->mj", from_eye, rotation, optimize=False), known


def solve_pnp(
    camera: Camera,
    uv: Float,
    points: Float,
    config: RegisterConfig,
) -> tuple[Float, Mask] | None:
    """Solve PnP for (M, 2) pixels of (M, 3) points; return pose and inlier mask, or None with too few."""
    import pycolmap

    if len(uv) < _LEAST_MATCHES:
        return None
    K = camera.K
    lens = pycolmap.Camera(
        model="PINHOLE",
        width=camera.width,
        height=camera.height,
        params=[K[0, 0], K[1, 1], K[0, 2], K[1, 2]],
    )
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = config.max_reprojection
    options.ransac.random_seed = 0
    options.ransac.num_threads = 1
    refinement = pycolmap.AbsolutePoseRefinementOptions()
    refinement.gradient_tolerance = 1e-8
    middle = np.median(points, 0)
    answer = pycolmap.estimate_and_refine_absolute_pose(
        uv, points - middle, lens, options, refinement
    )
    if answer is None or int(answer["num_inliers"]) < _LEAST_MATCHES:
        return None
    T = np.eye(4)
    T[:3] = answer["cam_from_world"].matrix()
    U, _, Vt = np.linalg.svd(T[:3, :3])
    T[:3, :3] = U @ Vt
    T[:3, 3] -= T[:3, :3] @ middle
    if np.isfinite(T).all():
        return (T, np.asarray(answer["inlier_mask"], bool))
    return None


def with_focal(
    camera: Camera,
    given: float,
    uv: Float,
    points: Float,
    config: RegisterConfig,
) -> tuple[Camera, float, Float, tuple[float, float]]:
    """Refine pose and focal length on (M, 2) pixels of (M, 3) points, with a prior at `given` pixels.

    Returns the camera, σ of the prior, which is wider where the matches contradict `focal_sigma`, the
    matches' information, and `focal_alone`.
    """
    prior = config.focal_sigma
    for _ in range(2):
        here = camera
        for _ in range(_FOCAL_STEPS):
            data, right = information(here.viewmat, here.K, uv, points)
            data = data / config.alike
            right = right / config.alike
            zoom = here.K[0, 0] / given
            alone = focal_alone(data, right, zoom)
            both = data.copy()
            both[6, 6] += 1 / prior**2
            right[6] -= float(np.log(zoom)) / prior**2
            # scaled to a unit diagonal, because lengths and angles have different units
            unit = 1 / np.sqrt(np.maximum(np.diag(both), 1e-30))
            scaled = both * unit[:, None] * unit
            covariance = np.linalg.pinv(scaled) * unit[:, None] * unit
            step = covariance @ right
            further = float(np.exp(np.clip(step[6], -_MOST_ZOOM, _MOST_ZOOM)))
            here = zoomed(here, further, moved(here.viewmat, step[:6]))
            if (np.abs(step) < 1e-3 * np.sqrt(np.diag(covariance))).all():
                break
        wider = focal_prior(alone, prior)
        if wider == prior:
            break
        prior = wider
    before = _project(camera.viewmat, camera.K, points) - uv
    after = _project(here.viewmat, here.K, points) - uv
    most = np.median(np.abs(before)) + config.max_reprojection
    if not np.median(np.abs(after)) < most:  # diverged
        data, _ = information(camera.viewmat, camera.K, uv, points)
        return camera, config.focal_sigma, data / config.alike, alone
    return here, prior, data, alone


def information(
    T: Float,
    K: Float,
    uv: Float,
    points: Float,
) -> tuple[Float, Float]:
    """Return the (7, 7) JᵀWJ/σ² and the (7,) JᵀWr/σ² of r = u − π(exp(ξ) T X) with focal lengths f·exp(φ).

    J = (∂π/∂X·[I | −[X]ₓ], (f_x X/Z, f_y Y/Z)). W is Cauchy's weight 1/(1 + r²/σ²), with σ from the median
    absolute deviation of the residuals.
    """
    X = points @ T[:3, :3].T + T[:3, 3]
    depth = X[:, 2]
    x = X[:, 0] / depth
    y = X[:, 1] / depth
    none = np.zeros(len(X))
    right = np.stack(
        [
            1 / depth,
            none,
            -x / depth,
            -x * y,
            1 + x * x,
            -y,
            x,
        ]
    )
    down = np.stack(
        [
            none,
            1 / depth,
            -y / depth,
            -1 - y * y,
            x * y,
            x,
            y,
        ]
    )
    J = np.concatenate([right * K[0, 0], down * K[1, 1]], 1)
    residual = uv - _project(T, K, points)
    deviation = float(np.median(np.abs(residual)))
    sigma = max(_LEAST_MATCH_SIGMA, _SIGMA_OF_MAD * deviation)
    weight = 1 / (1 + (residual**2).sum(1) / sigma**2)
    weighted = J * (np.concatenate([weight, weight]) / sigma**2)
    squares = np.einsum("in,jn->ij", weighted, J, optimize=False)
    return squares, weighted @ residual.T.ravel()


def _project(T: Float, K: Float, points: Float) -> Float:
    """Project (M, 3) world points to (M, 2) pixels."""
    X = points @ T[:3, :3].T + T[:3, 3]
    return X[:, :2] / X[:, 2:] * [K[0, 0], K[1, 1]] + K[:2, 2]
