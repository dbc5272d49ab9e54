"""Visibility by brute force: every Gaussian at every ray, in float64, with no culling and no image."""

import numpy as np

from reference.rotations import rotations


def median_depths(splats, viewmat, K, size, pixels):
    """(n,) depth at which less than half the light is left through pixel centres (n, 2); 0 where it never is.

    gsplat's conventions; `viewmat` is camera_from_world, world coordinates.
    """
    means = splats.means.astype(np.float64) + splats.offset
    x, y, z = (means @ viewmat[:3, :3].T + viewmat[:3, 3]).T
    ahead = np.flatnonzero(z > 0.01)
    order = ahead[np.argsort(z[ahead], kind="stable")]
    x, y, z = x[order], y[order], z[order]
    (fx, fy), (cx, cy) = np.diag(K)[:2], K[:2, 2]
    width, height = size
    u = np.clip(x / z, (-cx - 0.15 * width) / fx, (width - cx + 0.15 * width) / fx)
    v = np.clip(y / z, (-cy - 0.15 * height) / fy, (height - cy + 0.15 * height) / fy)
    zero = np.zeros_like(z)
    J = np.stack(
        [np.stack([fx / z, zero, -fx * u / z], -1), np.stack([zero, fy / z, -fy * v / z], -1)], 1
    )
    axes = rotations(splats.quats[order].astype(np.float64))
    half = J @ viewmat[:3, :3] @ axes * splats.scales[order].astype(np.float64)[:, None, :]
    cov = half @ half.transpose(0, 2, 1) + 0.3 * np.eye(2)
    inverse = np.linalg.inv(cov)
    opacity = splats.opacities[order].astype(np.float64)
    out = np.zeros(len(pixels))
    for i, (px, py) in enumerate(pixels):
        dx, dy = px - (fx * x / z + cx), py - (fy * y / z + cy)
        power = (
            0.5 * (inverse[:, 0, 0] * dx * dx + inverse[:, 1, 1] * dy * dy)
            + inverse[:, 0, 1] * dx * dy
        )
        alpha = np.minimum(opacity * np.exp(-power), 0.99)
        light = np.cumsum(np.log1p(-np.where(alpha < 1 / 255, 0.0, alpha)))
        past = np.searchsorted(-light, np.log(2), side="right")
        out[i] = z[past] if past < len(z) else 0.0
    return out


def agreement(splats, surface, cameras, seen, cells, tolerance):
    """(agreeing, kept, all) pairs of a view and one of `cells` that falls on its image.

    Kept are those around which neighbouring pixels' depths differ by less than 1 %.

    Args:
        splats: the scene.
        surface: `g2ard.stages.select.surface` of it.
        cameras: views in world coordinates.
        seen: `g2ard.stages.select.visible_cells` of both.
        cells: which cells to try.
        tolerance: share of the depth by which a visible cell may differ from it.
    """
    agree = kept = total = 0
    for i in range(len(cameras)):
        view, K = cameras.viewmats[i], cameras.Ks[i]
        size = int(cameras.widths[i]), int(cameras.heights[i])
        camera = (surface.centers[cells] + surface.origin) @ view[:3, :3].T + view[:3, 3]
        z = camera[:, 2]
        uv = (camera @ K.T)[:, :2] / np.where(z > 0.01, z, 1.0)[:, None]
        there = (z > 0.01) & (uv >= 0).all(1) & (uv < size).all(1)
        pixel = np.floor(uv[there]) + 0.5
        around = pixel[:, None] + [[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]]
        depth = median_depths(splats, view, K, size, around.reshape(-1, 2)).reshape(-1, 5)
        near, far = depth.min(1), depth.max(1)
        smooth = (far - near < 0.01 * np.maximum(near, 1e-300)) | (far == 0)
        z = z[there]
        want = (depth[:, 0] > 0) & (
            np.abs(z - depth[:, 0]) <= np.maximum(surface.size, tolerance * z)
        )
        got = np.isin(np.asarray(cells)[there], seen[1][slice(*seen[0][i : i + 2])])
        agree += int((want == got)[smooth].sum())
        kept, total = kept + int(smooth.sum()), total + len(z)
    return agree, kept, total
