"""Naive float64 twin of direct alignment's normal equations: pixel by pixel, chain rule by matrices."""

import numpy as np


def cross(x):  # type: ignore[no-untyped-def]
    return np.array([[0, -x[2], x[1]], [x[2], 0, -x[0]], [-x[1], x[0], 0]])


def pixel_row(u, v, depth, K, gradient):  # type: ignore[no-untyped-def]
    """∇I · (∂π/∂X · [I | −[X]ₓ], change by the focal length's logarithm) of the pixel with centre (u, v)."""
    X = depth * (np.linalg.inv(K) @ np.array([u, v, 1.0]))
    x, y, z = X
    projection = np.array(
        [[K[0, 0] / z, 0, -K[0, 0] * x / z**2], [0, K[1, 1] / z, -K[1, 1] * y / z**2]]
    )
    motion = np.hstack([np.eye(3), -cross(X)])
    zoom = [u - K[0, 2], v - K[1, 2]]
    return np.asarray(gradient) @ np.column_stack([projection @ motion, zoom])


def image_rows(depth, K, gradients):  # type: ignore[no-untyped-def]
    """(7, H, W) of `pixel_row` for an image and its gradients (right, down)."""
    out = np.zeros((7, *depth.shape))
    for i, j in np.ndindex(*depth.shape):
        out[:, i, j] = pixel_row(j + 0.5, i + 0.5, depth[i, j], K, [g[i, j] for g in gradients])
    return out


def flow(depth, mask, K, xi):  # type: ignore[no-untyped-def]
    """Root of the mean square of how far ξ moves pixels."""
    one, none = np.ones(depth.shape), np.zeros(depth.shape)
    moves = [np.tensordot(xi, image_rows(depth, K, g), 1)[mask] for g in ((one, none), (none, one))]
    return float(np.sqrt((moves[0] ** 2 + moves[1] ** 2).mean()))


def shot(image, alpha, depth, min_alpha, max_edge):  # type: ignore[no-untyped-def]
    """(grey, depth, mask) of a render, pixel by pixel."""
    height, width = alpha.shape
    opaque = alpha >= min_alpha
    z = np.where(opaque, depth.astype(float) / np.maximum(alpha, 1e-6), 1.0)
    mask = opaque & (z > 0)
    for i, j in np.argwhere(mask):
        for y, x in ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)):
            if 0 <= y < height and 0 <= x < width:
                mask[i, j] &= abs(z[i, j] - z[y, x]) <= max_edge * min(z[i, j], z[y, x])
    grey = np.clip(image.astype(float), 0, 1) @ [0.299, 0.587, 0.114]
    taps = np.outer([1, 4, 6, 4, 1], [1, 4, 6, 4, 1]) / 256
    pad = np.pad(grey, 2, mode="edge")
    soft = [[(pad[i : i + 5, j : j + 5] * taps).sum() for j in range(width)] for i in range(height)]
    return np.array(soft), np.where(mask, z, 1.0), mask


def normal_equations(photo, shot, K, gain, bias, scale, tukey=4.685):  # type: ignore[no-untyped-def]
    """Sums over pixels: matrix (9, 9), right side (9,), mean cost and the sum of weights."""
    matrix, right, costs, weights = np.zeros((9, 9)), np.zeros(9), [], 0.0
    rows, columns = photo.grey.shape
    down, across = np.gradient(shot.grey)
    for i in range(rows):
        for j in range(columns):
            if not (photo.mask[i, j] and shot.mask[i, j]):
                continue
            r = photo.grey[i, j] - gain * shot.grey[i, j] - bias
            s = abs(r) / (tukey * scale)
            w = (1 - s * s) ** 2 if s < 1 else 0.0
            costs.append(1 - (1 - s * s) ** 3 if s < 1 else 1.0)
            mean = (
                (gain * across[i, j] + photo.right[i, j]) / 2,
                (gain * down[i, j] + photo.down[i, j]) / 2,
            )
            moves = pixel_row(j + 0.5, i + 0.5, shot.depth[i, j], K, mean)
            row = np.concatenate([-moves, [shot.grey[i, j], 1.0]])
            matrix += w * np.outer(row, row)
            right += w * row * r
            weights += w
    return matrix, right, float(np.mean(costs)), weights


def local_zncc(a, b, mask, side, flat=1e-4):  # type: ignore[no-untyped-def]
    """Median of ZNCC over whole windows in which b has contrast, window by window."""
    found = []
    for i in range(a.shape[0] - side + 1):
        for j in range(a.shape[1] - side + 1):
            at = np.s_[i : i + side, j : j + side]
            if not mask[at].all() or b[at].var() <= flat:
                continue
            x, y = a[at] - a[at].mean(), b[at] - b[at].mean()
            scale = np.sqrt((x * x).sum() * (y * y).sum())
            found.append((x * y).sum() / scale if scale > 1e-9 * side * side else 0.0)
    return float(np.median(found)) if found else 0.0
