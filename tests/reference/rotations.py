"""Rotations and covariances from quaternions w x y z of any length, in float64."""

import numpy as np


def rotations(quats: np.ndarray) -> np.ndarray:
    """Return (..., 3, 3) matrices of (..., 4) quaternions."""
    quats = np.asarray(quats, np.float64)
    w, x, y, z = np.moveaxis(quats / np.linalg.norm(quats, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def covariances(quats: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Return (N, 3, 3) covariances of Gaussians with these standard deviations."""
    frames = rotations(quats) * scales[:, None].astype(np.float64)
    return frames @ frames.swapaxes(1, 2)
