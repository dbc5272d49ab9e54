"""Exposures of photos: affine colour transforms that trainers fit, undone in targets."""

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import InputError


def inverse_exposure(name: str, exposure: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the (3, 4) transform from the photo `name` to a render, from its exposure (render to photo)."""
    matrix = np.asarray(exposure, np.float64)
    if matrix.shape != (3, 4) or not np.isfinite(matrix).all() or abs(np.linalg.det(matrix[:, :3])) < 1e-6:
        raise InputError(f"exposure of {name}: expected an invertible 3×4 matrix")
    inverse = np.linalg.inv(matrix[:, :3])
    return np.hstack([inverse, -inverse @ matrix[:, 3:]]).astype(np.float32)
