"""Appearance from new images: a change of all colours, and blending per Gaussian."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from g2ard.rendering.renderer import Renderer
from g2ard.rendering.targets import Targets, mask_of
from g2ard.rendering.visibility import visibility
from g2ard.scene.cameras import Cameras
from g2ard.scene.samples import evenly_spaced
from g2ard.scene.splats import SH_C0, Splats

_FITTED_VIEWS = 16
"""Number of evenly spaced targets used to fit the change of colours."""
_FITTED_PIXELS = 20_000
"""Most pixels used per target."""
_NO_CHANGE_WEIGHT = 1e-5
"""Weight of no change, as a share of the pixels, for colours that the scene lacks."""
_VISIBILITY_SIDE = 300
"""Longer side in pixels of the renders that measure visibility."""
_HALF_SEEN_WEIGHT = 10.0
"""Σ αT over these renders at which a view counts as half."""


@dataclass(frozen=True, eq=False)
class ColourChange:
    """Affine change of all colours of a scene: c → matrix·c + shift.

    Args:
        gain: gain in dB on the pixels it was fitted to.
    """

    matrix: NDArray[np.float64]
    shift: NDArray[np.float64]
    gain: float


def colour_change(splats: Splats, targets: Targets, background: tuple[float, float, float]) -> ColourChange:
    """Fit the affine colour map (exposure, white balance) from a scene's renders to images.

    A pixel is C + (1 − A)·background, C = Σ αT·c and A = Σ αT, and matrix·C + A·shift + (1 − A)·background
    after the map: linear least squares with twelve unknowns and a small weight on no change.

    Args:
        targets: images; masked pixels are ignored.
        background: RGB behind the scene, which stays unchanged.
    """
    cameras = targets.cameras
    behind = np.asarray(background)
    normal, right = np.zeros((4, 4)), np.zeros((4, 3))
    before = pixels = 0.0
    renderer = Renderer(splats, background=background)
    for view in evenly_spaced(len(cameras), _FITTED_VIEWS):
        rendered = renderer.render(cameras[view])
        image, mask = targets[view], mask_of(targets, view)
        counts = np.ones(image.shape[:2], bool) if mask is None else mask
        rows = np.flatnonzero(counts)[:: max(1, int(counts.sum()) // _FITTED_PIXELS)]
        alpha = rendered.alpha.reshape(-1, 1)[rows].astype(np.float64)
        beyond = (1 - alpha) * behind
        own = rendered.image.reshape(-1, 3)[rows] - beyond
        missing = image.reshape(-1, 3)[rows] - beyond - own
        features = np.hstack([own, alpha])
        normal += features.T @ features
        right += features.T @ missing
        before += float((missing**2).sum())
        pixels += len(rows)
    change = np.linalg.solve(normal + _NO_CHANGE_WEIGHT * pixels * np.eye(4), right)
    # |y − Xb|² = |y|² − 2 bᵀXᵀy + bᵀXᵀXb
    after = before - 2 * float((change * right).sum()) + float((change * (normal @ change)).sum())
    tiny = np.finfo(np.float64).tiny
    gain = 10 * float(np.log10(max(before, tiny) / max(after, tiny)))
    return ColourChange(np.eye(3) + change[:3].T, change[3], gain)


def recoloured(splats: Splats, change: ColourChange) -> Splats:
    """Change the colours of a scene: all bands by the matrix, the base also by the shift."""
    matrix = change.matrix.astype(np.float32)
    rest = (change.matrix.sum(1) * 0.5 + change.shift - 0.5) / SH_C0
    base = splats.sh0 @ matrix.T + rest.astype(np.float32)
    return replace(splats, sh0=base, shN=splats.shN @ matrix.T)


def views_seeing(splats: Splats, cameras: Cameras) -> NDArray[np.float64]:
    """Return (N,) the number of views that see each Gaussian; each counts w/(w + 10), w = Σ αT in a small
    render."""
    small = cameras.resized(_VISIBILITY_SIDE)
    out = np.zeros(len(splats))
    for view in range(len(small)):
        weight = visibility(splats, small.take([view])).weight
        out += weight / (weight + _HALF_SEEN_WEIGHT)
    return out


def blended_appearance(start: Splats, fitted: Splats, share: NDArray[np.float64]) -> Splats:
    """Interpolate colours and opacity logits from `start` to `fitted` by the (N,) `share`."""
    s = share.astype(np.float32)

    def between(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float32]:
        return a + s.reshape(-1, *[1] * (a.ndim - 1)) * (b - a)

    return replace(
        fitted,
        sh0=between(start.sh0, fitted.sh0),
        shN=between(start.shN, fitted.shN),
        logit_opacities=between(start.logit_opacities, fitted.logit_opacities),
    )
