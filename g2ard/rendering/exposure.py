"""Gain and offset per channel between renders and photos whose exposure or white balance differs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from g2ard.arrays import Float, Float32, Mask
from g2ard.io.reports import Report
from g2ard.rendering.renderer import Renderer
from g2ard.rendering.targets import Exposed, Targets, against_of, alpha_of, mask_of
from g2ard.scene.samples import evenly_spaced
from g2ard.scene.splats import Splats
from g2ard.system.threads import in_threads

_PRIOR = (1e-3, 1e-2)
"""Weights of gain 1 and offset 0 against the pixels of a photo; a flat photo is explained by its gain."""
_LEAST_GAIN = 0.05
_SATURATED = 253.5 / 255
"""Value from which a pixel may have been brighter than its photo can tell."""
_BLACK = 1.5 / 255
_EXPLAINED_SHARE = 1 / 3
"""Share of the squared error that gains and offsets must explain for photos to count as different, 1.8 dB."""
_LEAST_STOPS = 0.15
"""Least root mean square of the brightness of grey, in stops, for the same. Colours that depend on direction
explain as much of a small error, but with little more than half of these stops."""
_COMPARED_VIEWS = 64
"""Most photos compared for that."""

Background = Sequence[float]


@dataclass(frozen=True)
class Exposure(Report):
    """Exposures estimated for photos, relative to their mean.

    Args:
        gain, offset: least and largest, over photos and channels.
        photos: gain and offset of red, green and blue by name of the view.
    """

    gain: tuple[float, float]
    offset: tuple[float, float]
    photos: dict[str, list[list[float]]]

    @classmethod
    def over(cls, exposures: Float, targets: Targets) -> Exposure:
        """Describe the exposures of the views that have a photo."""
        names = targets.cameras.names
        rows = [view for view in range(len(names)) if against_of(targets, view) == "photo"]
        gains, offsets = np.moveaxis(exposures[rows], 2, 0)
        gain = float(gains.min()), float(gains.max())
        offset = float(offsets.min()), float(offsets.max())
        return cls(gain, offset, {names[row]: exposures[row].tolist() for row in rows})

    def __str__(self) -> str:
        (dark, bright), (low, high) = self.gain, self.offset
        return (
            f"the photos differ in exposure: gains of {dark:.2f} to {bright:.2f} and offsets of {low:.2f} to "
            f"{high:.2f} per photo and channel were estimated and undone; scores are after the best such fit"
        )


@dataclass(frozen=True, eq=False)
class Moments:
    """Sums over the pixels of a photo, from which the error of any gain and offset follows.

    Args:
        normal: (3, 2, 2) of a channel's render and alpha.
        right: (3, 2) of these with photo − render.
        total: (3,) of (photo − render)².
        pixels: number of pixels.
    """

    normal: Float
    right: Float
    total: Float
    pixels: int

    def fit(self) -> Float:
        """Return (3, 2), gain and offset of each channel: photo ≈ gain·render + offset·alpha."""
        prior = np.diag(_PRIOR) * max(1, self.pixels)
        found = np.linalg.solve(self.normal + prior, self.right[..., None])[..., 0]
        found += [1.0, 0.0]
        return np.maximum(found, [_LEAST_GAIN, -np.inf])

    def error(self, exposure: Float) -> float:
        """Return the squared error that (3, 2) gains and offsets leave."""
        change = exposure - [1.0, 0.0]
        squares = np.einsum("ci,cij,cj->c", change, self.normal, change)
        products = (change * self.right).sum(1)
        return float((self.total - 2 * products + squares).sum())


def _find_backdrop(alpha: Float32 | None, background: Background) -> Float32 | float:
    """Return what of an image is background behind a photo with alpha."""
    if alpha is None:
        return 0.0
    return (1 - alpha[..., None]) * np.asarray(background, np.float32)


def _compare_moments(
    image: Float32,
    targets: Targets,
    view: int,
    background: Background,
) -> Moments:
    """Compare a render, not clipped, with a photo where neither too bright nor too dark to tell."""
    photo = targets[view]
    alpha = alpha_of(targets, view)
    beyond = _find_backdrop(alpha, background)
    mask = mask_of(targets, view)
    counts = ((photo > _BLACK) & (photo < _SATURATED)).astype(np.float64)
    if mask is not None:
        counts *= mask[..., None]
    own = (image - beyond).astype(np.float64)
    missing = photo - beyond - own
    if alpha is None:
        cover = np.ones((1, 1, 1))
    else:
        cover = alpha[..., None].astype(np.float64)

    def total(values: Float) -> Float:
        return (counts * values).sum((0, 1))

    mixed = total(own * cover)
    normal = np.array(
        [
            [total(own**2), mixed],
            [mixed, total(cover**2)],
        ]
    ).transpose(2, 0, 1)
    right = np.stack([total(own * missing), total(cover * missing)], 1)
    return Moments(
        normal,
        right,
        total(missing**2),
        int(counts.sum(dtype=np.int64)) // 3,
    )


def rendered(renderer: Renderer, targets: Targets, view: int) -> Float32:
    """Render a view of targets, clipped to [0, 1]; with `Exposed` targets, after the gain and offset of each
    channel that fit it best to its photo."""
    if not isinstance(targets, Exposed) or against_of(targets, view) != "photo":
        return renderer.clipped(targets.cameras[view])
    image = renderer.image(targets.cameras[view])
    background = renderer.background
    exposure = _compare_moments(image, targets, view, background).fit()
    gain, offset = exposure.T.astype(np.float32)
    alpha = alpha_of(targets, view)
    beyond = _find_backdrop(alpha, background)
    cover = np.float32(1) if alpha is None else alpha[..., None]
    return np.clip((image - beyond) * gain + offset * cover + beyond, 0, 1)


def unexposed(
    targets: Targets,
    view: int,
    exposure: Float,
    background: Background,
) -> tuple[Float32, Mask | None]:
    """Return a photo as the mean exposure would have made it, and its mask.

    Pixels that a brighter exposure saturated do not count.
    """
    photo = targets[view]
    mask = mask_of(targets, view)
    alpha = alpha_of(targets, view)
    gain, offset = exposure.T.astype(np.float32)
    beyond = _find_backdrop(alpha, background)
    cover = np.float32(1) if alpha is None else alpha[..., None]
    lost = ((photo >= _SATURATED) & (gain > 1)).any(2)
    if alpha is not None:
        lost &= alpha > 0
    if lost.any():
        if mask is None:
            mask = ~lost
        else:
            mask = mask & ~lost
    made = np.ascontiguousarray((photo - beyond - offset * cover) / gain + beyond, np.float32)
    if mask is not None:
        made[~mask] = 0
    return made, mask


def exposures_of(
    splats: Splats,
    targets: Targets,
    background: Background,
    *,
    decided: bool = False,
) -> Float | None:
    """Estimate the exposures of photos against a scene: (C, 3, 2), gain and offset by view and channel.

    Their mean is gain 1 (of logarithms) and offset 0, so that the scene gets the photos' mean exposure. Views
    without a photo have exactly these. Colours do not depend on direction here, because higher SH bands soon
    hold the exposures of the photos.

    Returns None if exposures explain too little of the error beyond what one exposure of all explains, unless
    `decided`.
    """
    count = len(targets.cameras)
    photos = [view for view in range(count) if against_of(targets, view) == "photo"]
    if len(photos) < 2:
        return None
    renderer = Renderer(splats.with_sh_degree(0), background=background)

    def moments(view: int) -> Moments:
        image = renderer.image(targets.cameras[view])
        return _compare_moments(image, targets, view, background)

    if not decided:
        some = [photos[i] for i in evenly_spaced(len(photos), _COMPARED_VIEWS)]
        compared = list(in_threads(moments, some))
        fits = np.array([each.fit() for each in compared])
        common = _find_common(fits)
        before = sum(each.error(common) for each in compared)
        after = sum(each.error(fit) for each, fit in zip(compared, fits, strict=True))
        if after >= (1 - _EXPLAINED_SHARE) * before:
            return None
        relative = _relate(fits, list(range(len(fits))), len(fits))
        grey = relative @ [0.5, 1.0]
        stops = np.log2(np.maximum(grey, 1e-3) / 0.5)
        if np.sqrt((stops**2).mean()) < _LEAST_STOPS:
            return None
        if len(some) == len(photos):
            return _relate(fits, photos, count)
    fits = np.array([each.fit() for each in in_threads(moments, photos)])
    return _relate(fits, photos, count)


def _find_common(fits: Float) -> Float:
    """Return the (3, 2) exposure that all have in common."""
    gains = fits[..., 0]
    offsets = fits[..., 1]
    gain = np.exp(np.log(gains).mean(0))
    offset = gain * offsets.mean(0) / gains.mean(0)
    return np.stack([gain, offset], 1)


def _relate(fits: Float, rows: list[int], count: int) -> Float:
    """Return the exposures of all views relative to what those of photos have in common."""
    gain, offset = _find_common(fits).T
    made = np.tile([1.0, 0.0], (count, 3, 1))
    gains = fits[..., 0] / gain
    made[rows, :, 0] = gains
    made[rows, :, 1] = fits[..., 1] - gains * offset
    return made
