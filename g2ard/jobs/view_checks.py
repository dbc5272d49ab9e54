"""Checks whether given or found views show a scene."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from g2ard.config.choices import Colour
from g2ard.errors import InputError
from g2ard.io import find_views, read_view_set
from g2ard.io.splits import split_mask
from g2ard.progress import Say, plural, unsaid
from g2ard.rendering.targets import Photos
from g2ard.scene.cameras import Cameras, unseeing
from g2ard.scene.samples import evenly_spaced
from g2ard.scene.splats import Splats

_VIEW_SIDE = 800
"""Longer side in pixels, as in a generated pool."""

_SIGHT_SAMPLE = 4096
_SEEING_CAMERA_SHARE = 0.5
"""Share of cameras that must see the scene for found views to be used."""
_COMPARED_PHOTOS, _COMPARED_SIDE = 15, 160
"""Number of photos compared with the scene, and their longer side in pixels."""
_SHOWN_SHARE = 0.05
"""Share of a photo that the scene must cover for a comparison."""
_UNRELATED_CORRELATION = 0.2
"""Correlation below which photos show something else, or have poses in other coordinates.

Plush, caliterra, fox and chair have 0.52 to 0.92 with their own photos, and at most 0.18 with the others',
as lifted points or as 2,000 Gaussians after 20 steps. Playbot, paljassaare and guitar have at most 0.12."""
_BACKGROUND_SLACK = 4 / 255
"""Difference of two background colours that matters."""
_BLIND_VIEWS_SHARE = 0.1
"""Share of given views that may see nothing of the scene without a warning."""


def found_views(
    scene: str | Path, splats: Splats, splits: Sequence[str], say: Say = unsaid, *, turned: bool = False
) -> Path | None:
    """Find views beside a scene (`g2ard.io.find_views`) that see it.

    Args:
        splits: splits that must not be empty.
        turned: whether an up direction was given, which found views do not need.

    Returns:
        A path for `load_views`, or None.
    """
    path = find_views(scene)
    if path is None:
        return None
    try:
        views = read_view_set(path, unpictured=True)
        for split in splits:
            split_mask(path, views.cameras.names, split, stated=views.splits)
    except InputError as error:
        say(f"views beside the scene are not used: {error}")
        return None
    count = len(views.cameras)
    seeing = int(views.cameras.facing(opaque_points(splats)).sum())
    if seeing < _SEEING_CAMERA_SHARE * count:
        say(f"views beside the scene are not used: {path}: {seeing} of {plural(count, 'camera')} see it")
        return None
    cameras = plural(count, "camera")
    idle = "; --up turns generated views only" if turned else ""
    say(f"views: {cameras} of {path} (found beside the scene{idle}; --views made for a pool of its own)")
    return path


def warn_of_sight(splats: Splats, cameras: Cameras, say: Say) -> None:
    """Warn if more than a tenth of the given views see nothing of the scene."""
    blind = int((~cameras.facing(opaque_points(splats))).sum())
    if blind > _BLIND_VIEWS_SHARE * len(cameras):
        say(
            f"warning: {blind} of {plural(len(cameras), 'view')} see nothing of the scene; check that "
            "both use the same coordinates (`g2ard info` shows the extent of each)"
        )


def check_sight(splats: Splats, cameras: Cameras, say: Say = unsaid) -> None:
    """Reject views that contain no Gaussian's centre; otherwise warn like `warn_of_sight`."""
    if not cameras.facing(splats.means + splats.offset).any():
        raise InputError(unseeing(cameras, "the scene"))
    warn_of_sight(splats, cameras, say)


def check_photos(
    splats: Splats,
    cameras: Cameras,
    background: Colour,
    say: Say,
    *,
    insisted: bool = False,
    renders: bool = False,
) -> None:
    """Reject photos that show nothing of the scene, unless `insisted`; warn if they look unlike it.

    The measure is the correlation of brightness where the scene is, as the median over a few small photos.

    Args:
        renders: whether generated views could replace the photos, for the hint.
    """
    from g2ard.jobs.causes import UNLIKE, compared, correlation

    pictured = np.flatnonzero([path is not None for path in cameras.image_paths])
    tried = evenly_spaced(len(pictured), _COMPARED_PHOTOS, floor=True)
    photos = Photos(cameras.take(pictured[tried]).resized(_COMPARED_SIDE), background=background)
    views = compared(splats, photos, range(len(tried)), background)
    alike = []
    for alpha, image, photo in views:
        seen = alpha > 0.5  # a sky behind scanned points would be unlike the background
        if seen.mean() > _SHOWN_SHARE:
            alike.append(correlation(image[seen], photo[seen]))
    likeness = float(np.median(alike)) if alike else 1.0
    if likeness < _UNRELATED_CORRELATION and not insisted:
        raise InputError(
            f"the photos do not show the scene (correlation {likeness:.2f}): they probably show "
            "another scene, or their poses use other coordinates",
            hint=("{views=made} needs no photos, " if renders else "") + "{photos=True} uses these anyway",
        )
    if likeness < UNLIKE:
        say(
            f"warning: the scene does not look like the photos (correlation {likeness:.2f}); check "
            "the views with `g2ard render --views`" + (", or give --views made" if renders else "")
        )


def propose_background(cameras: Cameras, background: Colour, given: bool, say: Say) -> None:
    """Say which background fits the photos if they have alpha, or a border of another colour.

    Args:
        given: whether it was chosen rather than the default.
    """
    from g2ard.io.images import colour_text, photo_traits

    pairs = zip(cameras.image_paths, cameras.mask_paths, strict=True)
    photos = [photo for photo, mask in pairs if photo is not None and mask != photo]
    traits = photo_traits(photos)
    used = colour_text(background)
    if traits.alpha and not given:
        say(
            f"note: {plural(traits.alpha, 'photo')} with alpha, composited over {used}, the default; most "
            "published scores use --background white"
        )
    border = traits.border
    if (
        border is not None
        and max(abs(a - b) for a, b in zip(border, background, strict=True)) > _BACKGROUND_SLACK
    ):
        fitting = colour_text(border)
        say(
            f"note: the photos have a constant border of {fitting}, but the background is {used}; if the "
            f"scene ends there, give --background {fitting}"
        )


def as_pool(cameras: Cameras) -> Cameras:
    """Resize found cameras without photos to a generated pool's size.

    INRIA's file states the size of the full photos, which its trainer had shrunk.
    """
    return cameras if any(cameras.image_paths) else cameras.resized(_VIEW_SIDE)


def opaque_points(splats: Splats) -> NDArray[np.float64]:
    """Return (K, 3) world means of a sample of the Gaussians of opacity 0.5 or more, otherwise of all."""
    opaque = np.flatnonzero(splats.opacities >= 0.5)
    rows = opaque if len(opaque) else np.arange(len(splats))
    sample = rows[evenly_spaced(len(rows), _SIGHT_SAMPLE, floor=True)]
    return splats.means[sample].astype(np.float64) + splats.offset
