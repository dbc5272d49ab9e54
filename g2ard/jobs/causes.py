"""Likely causes of a poor recovery, by cheap checks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from g2ard.config.choices import Colour
from g2ard.progress import plural
from g2ard.rendering.metrics import psnr
from g2ard.rendering.renderer import Renderer
from g2ard.scene.cameras import Cameras
from g2ard.scene.images import colour_text
from g2ard.scene.splats import Splats
from g2ard.scene.targets import Targets, against_of, mask_of
from g2ard.stages.recover.report import RecoverReport
from g2ard.stages.recover.sizes import typical_share

Floats = NDArray[np.floating]

_LOW, _GAP = 20.0, 3.0
"""PSNR in held-out views below which a result is poor, and by which it may lie below the training views', dB.
"""

_VIEWS = 5
_UNLIKE, _ALIKE = 0.2, 0.5
"""Correlations of render and photo below which they are unrelated, and above which brightness is compared."""

_EXPOSED = 2.0
"""Gain in dB from fitting a photo's brightness that shows another exposure."""

_OTHER_COLOUR, _EMPTY_ERROR = 0.1, 0.5
"""Difference of the photos' colour from the background where the result is empty, and the share of the error
there, that show a wrong background."""

_FALLING = 0.1
"""Share by which the loss may fall from the fourth to the last fifth of a recovery that had enough steps."""

_COARSE = 0.01
"""Typical standard deviation of a Gaussian, as a share of the image, that shows too few Gaussians."""

_FAR = 2.0
"""Distance of held-out cameras to the next training camera, in distances between training cameras."""


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
    if scored >= _LOW and gap <= _GAP:
        return []
    causes = _of_photos(splats, held_out, background)
    if scored < _LOW:
        causes += _of_budget(splats, trained, recovery)
        what = f"the result scores only {scored:.1f} dB in held-out views"
    else:
        what = f"held-out views score {gap:.1f} dB less than training views"
    if gap > _GAP:
        causes += _of_views(splats, held_out.cameras, trained)
    if not causes:
        return [f"{what}, and no usual cause was found; see troubleshooting in the documentation"]
    return [f"{what}; likely causes:", *(f"  - {cause}" for cause in causes)]


def _of_photos(splats: Splats, held_out: Targets, background: Colour) -> list[str]:
    """Check poses, exposure and background in a few held-out photos."""
    views = [v for v in range(len(held_out.cameras)) if against_of(held_out, v) == "photo"]
    renderer = Renderer(splats, background=background)
    alike, gains, colours, errors = [], [], [], []
    for view in [views[i] for i in np.unique(np.linspace(0, len(views) - 1, _VIEWS).astype(int)) if views]:
        mask, drawn = mask_of(held_out, view), renderer.render(held_out.cameras[view])
        counted = np.ones(drawn.alpha.shape, bool) if mask is None else mask
        image, photo = np.clip(drawn.image, 0, 1)[counted], held_out[view][counted]
        alike.append(correlation(image, photo))
        gains.append(psnr(_exposed(image, photo)[None], photo[None]) - psnr(image[None], photo[None]))
        empty, error = drawn.alpha[counted] < 0.5, np.square(image - photo).sum(axis=1)
        errors.append(float(error[empty].sum() / max(float(error.sum()), 1e-12)))
        if empty.any():
            colours.append(np.median(photo[empty], axis=0))
    if not alike:
        return []
    causes = []
    if colours and np.median(errors) > _EMPTY_ERROR:
        colour = np.median(colours, axis=0)
        if np.abs(colour - background).max() > _OTHER_COLOUR:
            red, green, blue = colour.round(2).tolist()
            causes.append(
                f"background: {np.median(errors):.0%} of the error lies where the result is empty; photos "
                f"are {colour_text((red, green, blue))} there, not {colour_text(background)} (--background)"
            )
    found = float(np.median(alike))
    if found < _UNLIKE and not causes:
        causes.append(
            f"poses: renders do not look like the photos (correlation {found:.2f}); check that scene and "
            "views share coordinates (`g2ard render --views`)"
        )
    elif found > _ALIKE and np.median(gains) > _EXPOSED and not causes:
        causes.append(
            f"exposure: fitting each photo's brightness would gain {np.median(gains):.1f} dB; give an "
            "exposure.json, or photos of equal exposure"
        )
    return causes


def correlation(image: Floats, photo: Floats) -> float:
    """Return the correlation of the brightness of (N, 3) pixels."""
    centred = [pixels.mean(axis=1) - pixels.mean() for pixels in (image, photo)]
    scale = np.linalg.norm(centred[0]) * np.linalg.norm(centred[1])
    return float(centred[0] @ centred[1] / scale) if scale > 0 else 0.0


def _exposed(image: Floats, photo: Floats) -> Floats:
    """Return (N, 3) pixels of a render with the gain and offset per channel that fit the photo best."""
    mean, goal = image.mean(axis=0), photo.mean(axis=0)
    varies = np.maximum(np.square(image - mean).mean(axis=0), 1e-12)
    gain = ((image - mean) * (photo - goal)).mean(axis=0) / varies
    return np.clip(gain * (image - mean) + goal, 0, 1)


def _of_budget(splats: Splats, trained: Cameras, recovery: RecoverReport) -> list[str]:
    """Check whether there were enough steps and Gaussians."""
    causes, fifths = [], [part.mean() for part in np.array_split(recovery.loss, 5) if len(part)]
    if recovery.steps < 2 * len(trained):
        views = plural(len(trained), "view")
        causes.append(f"too few steps: {recovery.steps:,} for {views}; raise --steps")
    elif len(fifths) == 5 and (fall := 1 - fifths[4] / fifths[3]) > _FALLING:
        causes.append(f"too few steps: the loss still fell by {fall:.0%} in the last fifth; raise --steps")
    if (share := typical_share(splats, trained)) > _COARSE:
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
    if usual > 0 and (ratio := float(np.median(tested)) / usual) > _FAR:
        return [f"views: held-out cameras are {ratio:.1f} times as far from training cameras as these from "
                "each other; train on views between"]  # fmt: skip
    return [
        f"too few views for {plural(len(splats), 'Gaussian')}: {len(trained)} for training; give more views, "
        "or lower -n"
    ]
