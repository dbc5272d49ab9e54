"""Rendering and visibility with the CPU rasteriser: numpy in, numpy out."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from g2ard import _core
from g2ard.cameras import Cameras
from g2ard.errors import InputError
from g2ard.progress import Progress, counter, silent
from g2ard.splats import Splats

__all__ = [
    "RasterSettings",
    "Rendered",
    "Seen",
    "Visibility",
    "arrays_of",
    "centred",
    "looker",
    "render",
    "settings_for",
    "visibility",
]

_Floats = NDArray[np.float32]
View = tuple[list[list[float]], list[float], tuple[int, int], float]
Choices = tuple[str, bool, float]


@dataclass(frozen=True)
class RasterSettings:
    """What the rasteriser's conventions leave open.

    Args:
        convention: "gsplat" (the default: what trainers of today use) or "inria" (also cuts every splat to
            the tiles its 3σ square touches).
        antialiased: opacity × √(det Σ₂ / det(Σ₂ + 0.3 I)), Mip-Splatting's factor; for scenes trained so.
        alpha_max: α is clipped here. 0.99 as in 3DGS; some trainers use 0.999.
        near: Gaussians nearer than this are left out, scene units; None means the convention's 0.01 or 0.2,
            and less in a small scene (`settings_for`). A sequence holds one distance per camera.

    Raises:
        InputError: a value out of range.

    >>> RasterSettings(convention="inria").near_of(0)
    0.2
    """

    convention: Literal["gsplat", "inria"] = "gsplat"
    antialiased: bool = False
    alpha_max: float = 0.99
    near: float | Sequence[float] | None = None

    def __post_init__(self) -> None:
        if self.convention not in ("gsplat", "inria"):
            raise InputError(f"convention: expected 'gsplat' or 'inria', got {self.convention!r}")
        if not 1 / 255 <= self.alpha_max < 1:
            raise InputError(f"alpha_max: expected a value in [1/255, 1), got {self.alpha_max}")

    def near_of(self, index: int) -> float:
        """The near plane of camera `index`."""
        if self.near is None:
            return 0.01 if self.convention == "gsplat" else 0.2
        if isinstance(self.near, (int, float)):
            return float(self.near)
        return float(self.near[index])

    @property
    def choices(self) -> Choices:
        """As `_core` takes them."""
        return self.convention, self.antialiased, self.alpha_max


def settings_for(means: NDArray[Any], settings: RasterSettings | None = None) -> RasterSettings:
    """`settings` whose near plane does not depend on how small a unit the scene is in.

    The conventions' near planes are lengths, made for scenes of some units. Where half of the Gaussians lie
    within r < ½ of their middle, the near plane is 2 r times the convention's.

    Args:
        means: (N, 3) scene units.
        settings: None means gsplat's convention. A near plane that is given stays.

    >>> import numpy as np
    >>> corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    >>> settings_for(corners).near_of(0), round(settings_for(corners / 1024).near_of(0), 9)
    (0.01, 1.6915e-05)
    """
    settings = settings or RasterSettings()
    if settings.near is not None or not len(means):
        return settings
    sample = means[:: -(-len(means) // _NEAR_SAMPLE)].astype(np.float64)
    radius = float(np.median(np.linalg.norm(sample - np.median(sample, axis=0), axis=1)))
    return replace(settings, near=settings.near_of(0) * min(1.0, 2 * radius or 1.0))


def view_of(cameras: Cameras, index: int, settings: RasterSettings) -> View:
    """One camera as `_core` takes it."""
    K = cameras.Ks[index]
    return (
        cameras.viewmats[index].tolist(),
        [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])],
        (int(cameras.widths[index]), int(cameras.heights[index])),
        settings.near_of(index),
    )


def arrays_of(splats: Splats) -> tuple[_Floats, _Floats, _Floats, _Floats, _Floats, _Floats]:
    """The six stored-form float32 arrays `_core` takes.

    Logits and logarithms are clamped to where float32 can follow them: opacity 255 of a byte decodes to +∞.
    """
    with np.errstate(divide="ignore"):
        log_scales = np.clip(splats.log_scales, -80, 40)
    logits = np.clip(splats.logit_opacities, -80, 80)
    arrays = (splats.means, splats.quats, log_scales, logits, splats.sh0, splats.shN)
    a, b, c, d, e, f = (np.ascontiguousarray(array, dtype=np.float32) for array in arrays)
    return a, b, c, d, e, f


def centred(splats: Splats, cameras: Cameras) -> tuple[Splats, Cameras]:
    """Both about a point that float32 means can be taken from: float64 means may be map coordinates."""
    cameras = cameras.recentred(splats.offset)
    if splats.means.dtype == np.float32 or not len(splats):
        return splats, cameras
    middle = np.median(splats.means, axis=0)
    return splats.recentred(splats.offset + middle), cameras.recentred(middle)


@dataclass(frozen=True, eq=False)
class Rendered:
    """One view.

    Args:
        image: (H, W, 3) float32, linear in the SH colours, ≥ 0, not clipped at 1.
        alpha: (H, W) float32 in [0, 1], how much of the background is hidden.
        depth: (H, W) float32, Σ αT·z: the expected depth *times* alpha; divide by alpha for a distance.
        median: (H, W) float32, depth of the splat behind which less than half the light is left, 0 if
            there is none; None unless asked for.
    """

    image: _Floats
    alpha: _Floats
    depth: _Floats
    median: _Floats | None = None


def render(
    splats: Splats,
    cameras: Cameras,
    index: int,
    *,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    settings: RasterSettings | None = None,
    median: bool = False,
) -> Rendered:
    """Render view `index`: C = Σᵢ cᵢ αᵢ Πⱼ<ᵢ (1 − αⱼ), front to back, in world coordinates.

    Args:
        splats: the scene, SH degree 0–3.
        cameras: the views; their Ks and sizes decide the image.
        index: which of them.
        background: RGB seen where the scene lets light through.
        settings: conventions; None means gsplat's.
        median: also return the median depth.

    Returns:
        The image, alpha and depth.

    Raises:
        InputError: an index out of range, a background that is not three numbers.

    >>> import numpy as np
    >>> from g2ard.cameras import Cameras, look_at
    >>> dot = Splats.create([[0, 0, 0]], scales=[[0.1] * 3], logit_opacities=[9])
    >>> K = [[50, 0, 16], [0, 50, 12], [0, 0, 1]]
    >>> views = Cameras.from_lists([look_at([0, -2, 0], [0, 0, 0])], [K], [(32, 24)], ["front"])
    >>> out = render(dot, views, 0, background=(1, 1, 1))
    >>> out.image.shape, bool(out.alpha[12, 16] > 0.9), out.image[0, 0].tolist()
    ((24, 32, 3), True, [1.0, 1.0, 1.0])
    """
    if not 0 <= index < len(cameras):
        raise InputError(f"view {index}: there are {len(cameras)} views")
    colour = [float(c) for c in background]
    if len(colour) != 3:
        raise InputError(f"background: expected 3 numbers, got {len(colour)}")
    splats, cameras = centred(splats, cameras)
    settings = settings_for(splats.means, settings)
    image, alpha, depth, mid = _core.Rasterizer().forward(
        arrays_of(splats), view_of(cameras, index, settings), settings.choices, colour, True, median
    )
    assert depth is not None
    return Rendered(image, alpha, depth, mid)


@dataclass(frozen=True, eq=False)
class Visibility:
    """What every Gaussian contributes to a set of views, summed over their pixels.

    Args:
        weight: (N,) float64, Σ αT: the light it sends to the cameras.
        transmittance: (N,) float64, Σ T over the pixels it touches.
        hits: (N,) uint64, pixels it touches (α ≥ 1/255, light left).
        dominant: (N,) uint64, pixels where no other Gaussian has a larger αT.
        peak: (N,) float32, its largest αT.
        pixel_size: (N,) float32, the smallest depth / focal length over the views whose image contains its
            mean: the size of a pixel there, scene units; ∞ where no view contains it.
    """

    weight: NDArray[np.float64]
    transmittance: NDArray[np.float64]
    hits: NDArray[np.uint64]
    dominant: NDArray[np.uint64]
    peak: _Floats
    pixel_size: _Floats


def visibility(
    splats: Splats,
    cameras: Cameras,
    progress: Progress = silent,
    *,
    settings: RasterSettings | None = None,
) -> Visibility:
    """Sum every Gaussian's contributions αT over all pixels of all views.

    The sums have a fixed order: the result does not depend on the number of threads.

    >>> import numpy as np
    >>> from g2ard.cameras import Cameras, look_at
    >>> pair = Splats.create([[0, 0, 0], [0, 9, 0]], scales=np.full((2, 3), 0.1), logit_opacities=[9, 9])
    >>> K = [[50, 0, 16], [0, 50, 12], [0, 0, 1]]
    >>> views = Cameras.from_lists([look_at([0, -2, 0], [0, 0, 0])], [K], [(32, 24)], ["front"])
    >>> seen = visibility(pair, views)
    >>> bool(seen.weight[0] > 30 * seen.weight[1]), np.round(seen.pixel_size.astype(float), 3).tolist()
    (True, [0.04, 0.22])
    """
    splats, cameras = centred(splats, cameras)
    settings = settings_for(splats.means, settings)
    views = [view_of(cameras, i, settings) for i in range(len(cameras))]
    sums: dict[str, Any] = _core.accumulate(
        arrays_of(splats), views, settings.choices, counter(progress, "visibility")
    )
    return Visibility(**sums)


@dataclass(frozen=True, eq=False)
class Seen:
    """What `looker` keeps of a visibility.

    Args:
        weight: (N,) float32, Σ αT.
        pixel_size: (N,) float32, that of the full image, scene units; ∞ where no view looks.
    """

    weight: _Floats
    pixel_size: _Floats


def looker(
    cameras: Cameras, *, views: int = 96, longest: int = 300, progress: Progress = silent
) -> Callable[[Splats], Seen]:
    """A function that tells what a few small renders see of a scene, as `g2ard.simplify.simplify` takes it.

    It looks from sixteen views at a time until the next sixteen find under 1 % more of the Gaussians: an
    object of half a million takes 32 views, a small one 80, a room all (`docs/decisions.md`). The first scene
    decides how many; for the later ones the views stay the same, so that the sums compare. What it tells
    depends on the scene's content alone, not on the order of its rows.

    Args:
        cameras: at most `views` of them are used, evenly spaced.
        views: the most.
        longest: longer side of the renders, pixels; `pixel_size` stays that of the full image.
        progress: told after each view.

    Returns:
        scene → `Seen`; the scene's arrays are C-contiguous and float32, but for its means.
    """
    sample = np.unique(np.linspace(0, len(cameras) - 1, min(views, len(cameras))).round().astype(int))
    full = cameras.take(sample)
    small = full.resized(longest)
    factor = np.float32((small.widths / full.widths).mean())
    apart = max(1, math.ceil(len(small) / _GLANCE))
    glances = [range(first, len(small), apart) for first in _spread(apart)]
    enough, settings = 0, RasterSettings()

    def look(scene: Splats) -> Seen:
        nonlocal enough, settings
        sums = _core.Look(scene)
        here = small.recentred(scene.offset)
        if not enough:  # a near plane in the scene's own unit
            distance = np.median(np.linalg.norm(here.positions - sums.origin, axis=1))
            settings = RasterSettings(near=_NEAR * float(distance) or None)
        seen = 0
        for number, glance in enumerate(glances, 1):
            views = [view_of(here, i, settings) for i in glance]
            before, seen = seen, sums.add(views, settings.choices, counter(progress, "visibility"))
            converged = number > 1 and seen - before < _CONVERGED * len(scene)
            cheap = number * _GLANCE * len(scene) < _CHEAP
            if number == enough or (not enough and converged and not cheap):
                break
        enough = number
        weight, pixel_size = sums.by_row()
        return Seen(weight, pixel_size * factor)

    return look


_GLANCE = 16
"""Views looked from at a time."""

_CHEAP = 6_000_000
"""Gaussians times views up to which looking on costs next to nothing."""

_NEAR_SAMPLE = 65_536
"""Gaussians, at most, that tell how large a scene is."""

_NEAR = 1e-3
"""Nearest depth that counts, over the median distance of the cameras from the scene's middle."""

_CONVERGED = 0.01
"""Glances that find a smaller share of the Gaussians for the first time are the last."""


def _spread(count: int) -> list[int]:
    """0 … count − 1, each far from those before.

    >>> _spread(6)
    [0, 3, 1, 4, 2, 5]
    """
    half = (count + 1) // 2
    return [i for pair in zip(range(half), range(half, half + half), strict=True) for i in pair if i < count]
