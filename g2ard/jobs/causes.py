"""Likely causes of a poor recovery, by cheap checks."""

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from g2ard.config.choices import Colour
from g2ard.io.images import colour_text, photo_traits
from g2ard.progress import Say, plural
from g2ard.rendering.metrics import psnr
from g2ard.rendering.renderer import Renderer
from g2ard.rendering.targets import Targets, against_of, mask_of
from g2ard.scene.cameras import Cameras
from g2ard.scene.samples import evenly_spaced
from g2ard.scene.splats import Splats
from g2ard.stages.recover.report import RecoverReport
from g2ard.stages.recover.sizes import typical_share

Floats = NDArray[np.floating]

_POOR_PSNR, _OVERFIT_GAP = 20.0, 3.0
"""PSNR in held-out views below which a result is poor, and by which it may lie below the training views', dB.
"""

_CHECKED_PHOTOS = 5
UNLIKE = 0.4
"""Correlation of render and photo below which they are considered unrelated. Medians: fox and caliterra with
their own scenes (2,000 Gaussians, 20 steps) 0.86 and 0.50, plush with its own 0.98, with turned poses 0.30.
"""
_POSE_CORRELATION, _BRIGHTNESS_CORRELATION = 0.75, 0.5
"""Correlations below which a poor result that had enough steps fits no poses, and above which brightness is
compared. Fox and chair with poses in wrong axes or order: 0.58 and 0.70."""

_EXPOSURE_GAIN = 2.0
"""Gain in dB from fitting a photo's brightness that shows another exposure."""

_BACKGROUND_DIFFERENCE, _BACKGROUND_ERROR_SHARE = 0.1, 0.5
"""Difference of the photos' colour from the background, at their border or where the result is empty, and the
share of the error there, that show a wrong background."""

_LOSS_STILL_FALLING = 0.1
"""Share by which the loss may fall from the fourth to the last fifth of a recovery that had enough steps."""

_COARSE_GAUSSIAN_SHARE = 0.01
"""Typical standard deviation of a Gaussian, as a share of the image, that shows too few Gaussians."""

_FAR_CAMERA_DISTANCES = 2.0
"""Distance of held-out cameras to the next training camera, in distances between training cameras."""


_GAPS = 0.02
"""Least share of opacity lost that shows as gaps."""


def say_gaps(lost: float | None, say: Say) -> None:
    """Warn if a simplified scene lets light through where the dense one did not.

    Args:
        lost: `opacity_lost` of its report.

    >>> say_gaps(0.031, print)  # doctest: +ELLIPSIS
    gaps: surfaces let 3.1 % of the light through that they stopped before; ...
    >>> say_gaps(0.001, print)
    """
    if lost is not None and lost >= _GAPS:
        say(
            f"gaps: surfaces let {100 * lost:.1f} % of the light through that they stopped before; keep more "
            "Gaussians, or close them by recovery (g2ard distill)"
        )


def likely_causes(
    splats: Splats,
    held_out: Targets,
    trained: Cameras,
    recovery: RecoverReport,
    scored: float,
    background: Colour,
) -> list[str]:
    """Return lines that name likely causes of a poor result, or no lines if the result is fine.

    A result is poor if it scores below 20 dB in held-out views, or more than 3 dB below the training views.

    Args:
        held_out: the held-out views of the training views' kind.
        scored: mean PSNR in the held-out views, dB.
    """
    gap = recovery.psnr.after - scored
    if scored >= _POOR_PSNR and gap <= _OVERFIT_GAP:
        return []
    what = f"held-out views score {gap:.1f} dB less than training views"
    if scored < _POOR_PSNR:
        what = f"the result scores only {scored:.1f} dB in held-out views"
    alike, causes = _of_photos(splats, held_out, background)
    if not causes:
        learned = gap <= _OVERFIT_GAP and recovery.steps >= 2 * len(trained)
        causes = [_poses(alike)] if learned and alike < _POSE_CORRELATION else []
        causes += (
            _of_budget(splats, trained, recovery, fits=gap > _OVERFIT_GAP) if scored < _POOR_PSNR else []
        )
        causes += _of_views(splats, held_out.cameras, trained) if gap > _OVERFIT_GAP else []
    if not causes:
        return [f"{what}, and no usual cause was found; see troubleshooting in the documentation"]
    return [f"{what}; likely causes:", *(f"  - {cause}" for cause in causes)]


def _of_photos(splats: Splats, held_out: Targets, background: Colour) -> tuple[float, list[str]]:
    """Check background, poses and exposure in a few held-out photos.

    Returns:
        The median correlation of renders and photos, 1 without photos, and at most one cause.
    """
    views = [v for v in range(len(held_out.cameras)) if against_of(held_out, v) == "photo"]
    views = [views[i] for i in evenly_spaced(len(views), _CHECKED_PHOTOS, floor=True)]
    alike, gains, seen_through, errors = [], [], [], []
    for alpha, image, photo in compared(splats, held_out, views, background):
        alike.append(correlation(image.mean(axis=1), photo.mean(axis=1)))
        gains.append(psnr(_exposed(image, photo)[None], photo[None]) - psnr(image[None], photo[None]))
        empty, error = alpha < 0.5, np.square(image - photo).sum(axis=1)
        errors.append(float(error[empty].sum() / max(float(error.sum()), 1e-12)))
        seen_through.append(photo[empty])
    if not alike:
        return 1.0, []
    median_correlation = float(np.median(alike))
    shown = photo_traits([path for v in views if (path := held_out.cameras.image_paths[v])]).border
    if shown is None and np.median(errors) > _BACKGROUND_ERROR_SHARE:
        shown = _one_colour(np.concatenate(seen_through))
    if shown is not None and np.abs(np.subtract(shown, background)).max() > _BACKGROUND_DIFFERENCE:
        return median_correlation, [
            f"background: the photos show {colour_text(shown)} around the scene, not "
            f"{colour_text(background)} (--background)"
        ]
    if median_correlation < UNLIKE:
        return median_correlation, [_poses(median_correlation)]
    if median_correlation > _BRIGHTNESS_CORRELATION and np.median(gains) > _EXPOSURE_GAIN:
        return median_correlation, [
            f"exposure: fitting each photo's brightness would gain {np.median(gains):.1f} dB; give an "
            "exposure.json, or photos of equal exposure"
        ]
    return median_correlation, []


def compared(
    splats: Splats, targets: Targets, views: Iterable[int], background: Colour
) -> Iterator[tuple[Floats, Floats, Floats]]:
    """Yield alpha (N,), render and target (N, 3) of the pixels that count, of each view that has any."""
    renderer = Renderer(splats, background=background)
    for view in views:
        mask, drawn = mask_of(targets, view), renderer.render(targets.cameras[view])
        counted = np.ones(drawn.alpha.shape, bool) if mask is None else mask
        if counted.any():
            yield drawn.alpha[counted], np.clip(drawn.image, 0, 1)[counted], targets[view][counted]


def _poses(alike: float) -> str:
    return (
        f"poses: renders look unlike the photos (correlation {alike:.2f}); check the axes and order of the "
        "poses, and that a given scene shares their coordinates (`g2ard render --views`)"
    )


def _one_colour(pixels: Floats) -> Colour | None:
    """Return the colour of most of (N, 3) pixels, rounded; None if they differ."""
    colour = np.median(pixels, axis=0)
    if (np.abs(pixels - colour).max(axis=1) <= _BACKGROUND_DIFFERENCE).mean() < 0.5:
        return None
    red, green, blue = colour.round(2).tolist()
    return red, green, blue


def correlation(image: Floats, photo: Floats) -> float:
    """Return the correlation of (N,) values."""
    centred = [values - values.mean() for values in (image, photo)]
    scale = np.linalg.norm(centred[0]) * np.linalg.norm(centred[1])
    return float(centred[0] @ centred[1] / scale) if scale > 0 else 0.0


def _exposed(image: Floats, photo: Floats) -> Floats:
    """Return (N, 3) pixels of a render with the gain and offset per channel that fit the photo best."""
    mean, goal = image.mean(axis=0), photo.mean(axis=0)
    varies = np.maximum(np.square(image - mean).mean(axis=0), 1e-12)
    gain = ((image - mean) * (photo - goal)).mean(axis=0) / varies
    return np.clip(gain * (image - mean) + goal, 0, 1)


def _of_budget(splats: Splats, trained: Cameras, recovery: RecoverReport, *, fits: bool) -> list[str]:
    """Check whether there were enough steps and, unless training views fit better, Gaussians."""
    causes, fifths = [], [part.mean() for part in np.array_split(recovery.loss, 5) if len(part)]
    if recovery.steps < 2 * len(trained):
        views = plural(len(trained), "view")
        causes.append(f"too few steps: {recovery.steps:,} for {views}; raise --steps")
    elif len(fifths) == 5 and (fall := 1 - fifths[4] / fifths[3]) > _LOSS_STILL_FALLING:
        causes.append(f"too few steps: the loss still fell by {fall:.0%} in the last fifth; raise --steps")
    if not fits and (share := typical_share(splats, trained)) > _COARSE_GAUSSIAN_SHARE:
        causes.append(
            f"too few Gaussians: the standard deviation of a typical one is {share:.1%} of the image's side; "
            "raise -n or lower -r"
        )
    return causes


def _of_views(splats: Splats, held_out: Cameras, trained: Cameras) -> list[str]:
    """Check whether the training views can determine the held-out ones."""
    away = np.linalg.norm(trained.positions[:, None] - trained.positions, axis=2)
    np.fill_diagonal(away, np.inf)
    usual = float(np.median(away.min(axis=1))) if len(trained) > 1 else 0.0
    tested = np.linalg.norm(held_out.positions[:, None] - trained.positions, axis=2).min(axis=1)
    if usual > 0 and (ratio := float(np.median(tested)) / usual) > _FAR_CAMERA_DISTANCES:
        return [f"views: held-out cameras are {ratio:.1f} times as far from training cameras as these from "
                "each other; train on views between"]  # fmt: skip
    return [
        f"too few views for {plural(len(splats), 'Gaussian')}: {len(trained)} for training; give more views, "
        "or lower -n"
    ]
