"""Checks whether given or found views show a scene."""

from collections.abc import Sequence

import numpy as np

from g2ard.arrays import Float, Values
from g2ard.config.choices import Colour, colour_text, is_made
from g2ard.errors import InputError
from g2ard.io import find_views, read_view_set
from g2ard.io.photos import measure_traits
from g2ard.io.splits import split_mask
from g2ard.jobs.inputs import GivenViews, Views
from g2ard.progress import Say, plural, unsaid
from g2ard.rendering.renderer import Renderer
from g2ard.rendering.targets import Photos, mask_of
from g2ard.scene.cameras import Cameras, unseeing
from g2ard.scene.samples import evenly_spaced
from g2ard.scene.splats import Splats

_VIEW_SIDE = 800
"""Longer side in pixels, as in a generated pool."""

_SIGHT_SAMPLE = 4096
_SEEING_CAMERA_SHARE = 0.5
"""Share of cameras that must see the scene for found views to be used."""
_COMPARED_PHOTOS = 15
"""Number of photos compared with the scene."""
_COMPARED_SIDE = 160
"""Longer side of compared photos in pixels."""
_UNLIKE = 0.4
"""Correlation of render and photo below which they are considered unrelated. Medians: fox and caliterra with
their own scenes (2,000 Gaussians, 20 steps) 0.86 and 0.50, plush with its own 0.98, with turned poses 0.30.
"""
_SHOWN_SHARE = 0.05
"""Share of a photo that the scene must cover for a comparison."""
_OWN_SHARE = 0.75
"""Share of the compared photos that the own photo of a view must beat: chance gives a half, a scene of these
photos all. Plush, caliterra, fox, chair and a city, as lifted points or at a twentieth of them: at least 0.95
with their own photos; seven scenes with the photos of others: at most 0.74 if five views or more see them."""
_FEW_GAUSSIANS = 1000
"""Gaussians below which a scene shows too little to be sure."""
_FEW_OWN_SHARE = 0.6
"""Share that is enough for a warning of such a scene. Eight draws of 250 to 500 points of a city: 0.6 or more
for five of them with their own photos."""
_BACKGROUND_SLACK = 4 / 255
"""Difference of two background colours that matters."""
_BLIND_VIEWS_SHARE = 0.1
"""Share of given views that may see nothing of the scene without a warning."""


def take_or_find_views(
    given: GivenViews, splats: Splats, splits: Sequence[str] = ()
) -> tuple[Views | None, bool]:
    """Return given views, or those found beside a scene, and whether they were found; None to generate some.

    Views are found by `g2ard.io.find_views`, and must see the scene.

    Args:
        splits: splits of found views that must not be empty.
    """
    if given.views is not None:
        return None if is_made(given.views) else given.views, False
    path = None if given.beside is None else find_views(given.beside)
    if path is None:
        return None, False
    say = given.say
    try:
        found = read_view_set(path, unpictured=True)
        for split in splits:
            split_mask(path, found.cameras.names, split, stated=found.splits)
    except InputError as error:
        say(f"views beside the scene are not used: {error}")
        return None, False
    count = len(found.cameras)
    seeing = int(found.cameras.facing(sample_opaque_points(splats)).sum())
    if seeing < _SEEING_CAMERA_SHARE * count:
        say(
            f"views beside the scene are not used: {path}: {seeing} of {plural(count, 'camera')} see it"
        )
        return None, False
    cameras = plural(count, "camera")
    idle = "" if given.up is None else "; --up turns generated views only"
    say(
        f"views: {cameras} of {path} (found beside the scene{idle}; --views made for a pool of its own)"
    )
    return path, True


def warn_of_sight(splats: Splats, cameras: Cameras, say: Say) -> None:
    """Warn if more than a tenth of the given views see nothing of the scene."""
    blind = int((~cameras.facing(sample_opaque_points(splats))).sum())
    if blind > _BLIND_VIEWS_SHARE * len(cameras):
        say(
            f"warning: {blind} of {plural(len(cameras), 'view')} see nothing of the scene; check that "
            "both use the same coordinates (`g2ard info` shows the extent of each)"
        )


def check_sight(splats: Splats, cameras: Cameras, say: Say = unsaid) -> None:
    """Reject views that contain no Gaussian's centre; otherwise warn like `warn_of_sight`."""
    if not cameras.facing(splats.positions).any():
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
    """Reject photos that show something other than the scene, unless `insisted`; warn if they look unlike it.

    A scene of few Gaussians is weak evidence, so that the photos are only rejected if they clearly differ.

    Where the scene is drawn, brightness must correlate with the photo of the same view better than with
    those of other views. The comparison with other views leaves out what all photos share.

    Args:
        renders: whether generated views could replace the photos, for the hint.
    """

    pictured = np.flatnonzero([path is not None for path in cameras.image_paths])
    tried = evenly_spaced(len(pictured), _COMPARED_PHOTOS, floor=True)
    photos = Photos(cameras.take(pictured[tried]).resized(_COMPARED_SIDE), background=background)
    own, beaten = _compare_photos(splats, photos, background)
    likeness = float(np.median(own)) if own else 0.0
    if likeness >= _UNLIKE or not len(photos.cameras):
        return
    found = (
        f"correlation {likeness:.2f}" if own else f"it covers less than {_SHOWN_SHARE:.0%} of them"
    )
    least = _OWN_SHARE if len(splats) >= _FEW_GAUSSIANS else _FEW_OWN_SHARE
    if not insisted and (not own or (beaten and np.mean(beaten) < least)):
        raise InputError(
            f"the photos do not show the scene ({found}): they probably show another scene, or their poses "
            "use other coordinates",
            hint=("{views=made} needs no photos, " if renders else "")
            + "{photos=True} uses these anyway",
        )
    say(
        f"warning: the scene does not look like the photos ({found}); check the views with "
        "`g2ard render --views`" + (", or give --views made" if renders else "")
    )


def _compare_photos(
    splats: Splats, targets: Photos, background: Colour
) -> tuple[list[float], list[float]]:
    """Return per view that the scene covers enough the correlation of brightness with its own small photo,
    and the share of the others whose correlation is lower, which is empty for a single photo."""
    renderer = Renderer(splats, background=background)
    images = [targets[view].mean(axis=2) for view in range(len(targets.cameras))]
    own = []
    beaten = []
    for view, image in enumerate(images):
        drawn = renderer.render(targets.cameras[view])
        mask = mask_of(targets, view)
        seen = drawn.alpha > 0.5 if mask is None else (drawn.alpha > 0.5) & mask
        if seen.mean() <= _SHOWN_SHARE:
            continue
        alpha = drawn.alpha[seen]
        rendered = drawn.image[seen].mean(axis=1) / alpha - (1 / alpha - 1) * np.mean(background)
        height, width = image.shape
        rows, columns = np.nonzero(seen)
        found = [
            _correlate(
                rendered, other[rows * len(other) // height, columns * other.shape[1] // width]
            )
            for other in images
        ]
        own.append(found[view])
        others = np.delete(found, view)
        if len(others):
            beaten.append(float(np.mean(others < found[view])))
    return own, beaten


def _correlate(image: Values, photo: Values) -> float:
    """Return the correlation of (N,) values."""
    centred = [values - values.mean() for values in (image, photo)]
    scale = np.linalg.norm(centred[0]) * np.linalg.norm(centred[1])
    return float(centred[0] @ centred[1] / scale) if scale > 0 else 0.0


def propose_background(cameras: Cameras, background: Colour, given: bool, say: Say) -> None:
    """Say which background fits the photos if they have alpha, or a border of another colour.

    Args:
        given: whether it was chosen rather than the default.
    """
    pairs = zip(cameras.image_paths, cameras.mask_paths, strict=True)
    photos = [photo for photo, mask in pairs if photo is not None and mask != photo]
    traits = measure_traits(photos)
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


def size_like_pool(cameras: Cameras) -> Cameras:
    """Resize found cameras without photos to a generated pool's size.

    INRIA's file states the size of the full photos, which its trainer had shrunk.
    """
    return cameras if any(cameras.image_paths) else cameras.resized(_VIEW_SIDE)


def sample_opaque_points(splats: Splats) -> Float:
    """Return (K, 3) world means of a sample of the Gaussians of opacity 0.5 or more, otherwise of all."""
    opaque = np.flatnonzero(splats.opacities >= 0.5)
    rows = opaque if len(opaque) else np.arange(len(splats))
    sample = rows[evenly_spaced(len(rows), _SIGHT_SAMPLE, floor=True)]
    return splats.means[sample].astype(np.float64) + splats.offset
