"""Checks whether views show a scene: those found beside it, and those that were given."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from g2ard.progress import Say, plural, unsaid

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from g2ard.scene.cameras import Cameras
    from g2ard.scene.splats import Splats

_SIDE = 800
"""Pixels of the longer side, as a pool has."""

_SAMPLE = 4096
_SEEING = 0.5
"""Share of the cameras that must see something of the scene, or they are another's."""
_LOOKED_AT, _SMALL = 5, 160
"""Photos that the scene is compared with, and their longer side, pixels."""
_ALIKE = 0.2
"""Correlation of a photo and a render under which they show different things. Median of five: fox and
caliterra with scenes of their own, 2,000 Gaussians after 20 steps, 0.86 and 0.50; others -0.26 to 0.06."""
_BLIND = 0.1
"""Share of views given for a scene that may see nothing of it untold."""


def found_views(scene: str | Path, splats: Splats, splits: Sequence[str], say: Say = unsaid) -> Path | None:
    """The views that lie beside a scene (`g2ard.io.find_views`), if they see it; says what came of it.

    Args:
        scene: the scene's path.
        splats: the scene.
        splits: what the run needs of them; none may be empty.
        say: told in one line which cameras are used, or why those that are there are not.

    Returns:
        A path for `load_views` and its kin; None if there are none, or none that fit.
    """
    from g2ard.errors import InputError
    from g2ard.io import find_views, read_view_set
    from g2ard.scene.splits import split_mask

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
    if seeing < _SEEING * count:
        say(f"views beside the scene are not used: {path}: {seeing} of {plural(count, 'camera')} see it")
        return None
    cameras = plural(count, "camera")
    say(f"views: {cameras} of {path} (found beside the scene; --views made for a pool of its own)")
    return path


def warn_of_sight(splats: Splats, cameras: Cameras, say: Say) -> None:
    """Say in one line that more than a tenth of the views given for a scene have nothing of it in sight."""
    blind = int((~cameras.facing(opaque_points(splats))).sum())
    if blind > _BLIND * len(cameras):
        say(
            f"warning: {blind} of {plural(len(cameras), 'view')} have nothing of the scene in sight: are "
            "both of one world? (`g2ard info` shows the extent of each)"
        )


def check_sight(splats: Splats, cameras: Cameras, say: Say = unsaid) -> None:
    """Refuse views of which none holds the middle of any Gaussian; else as `warn_of_sight`.

    Raises:
        InputError: with what to look at.
    """
    from g2ard.errors import InputError
    from g2ard.scene.cameras import unseeing

    if not cameras.facing(splats.means + splats.offset).any():
        raise InputError(unseeing(cameras, "the scene"))
    warn_of_sight(splats, cameras, say)


def warn_of_photos(
    splats: Splats, cameras: Cameras, background: tuple[float, float, float], say: Say
) -> None:
    """Say in one line that the scene's renders have nothing in common with its photos: the correlation of the
    brightness of their pixels, in the median of a few small photos, is next to none."""
    import numpy as np

    from g2ard.rendering.renderer import Renderer
    from g2ard.scene.targets import Photos, mask_of

    pictured = np.flatnonzero([path is not None for path in cameras.image_paths])
    tried = np.unique(np.linspace(0, len(pictured) - 1, min(_LOOKED_AT, len(pictured))).astype(int))
    photos = Photos(cameras.take(pictured[tried]).resized(_SMALL))
    renderer = Renderer(splats, background=background)
    alike = []
    for view in range(len(tried)):
        mask = mask_of(photos, view)
        counted = np.ones(photos[view].shape[:2], bool) if mask is None else mask
        pair = renderer.render(photos.cameras[view]).image[counted], photos[view][counted]
        centred = [image.mean(axis=1) - image.mean() for image in pair]
        scale = np.linalg.norm(centred[0]) * np.linalg.norm(centred[1])
        alike.append(float(centred[0] @ centred[1] / scale) if scale > 0 else 0.0)
    if alike and np.median(alike) < _ALIKE:
        say(
            f"warning: the scene looks like none of the photos (correlation {np.median(alike):.2f}): are "
            "both of one world? (`g2ard render --views` shows what views see; --renders leaves photos out)"
        )


def as_pool(cameras: Cameras) -> Cameras:
    """Found cameras at a pool's size where they have no photos to be compared with: INRIA's file states the
    size of the full photos, which its trainer had shrunk."""
    return cameras if any(cameras.image_paths) else cameras.resized(_SIDE)


def opaque_points(splats: Splats) -> NDArray[np.float64]:
    """Return (K, 3) world means of a sample of the Gaussians of opacity 0.5 or more, otherwise of all."""
    import numpy as np

    opaque = np.flatnonzero(splats.opacities >= 0.5)
    rows = opaque if len(opaque) else np.arange(len(splats))
    sample = rows[np.linspace(0, len(rows) - 1, min(_SAMPLE, len(rows))).astype(int)]
    return splats.means[sample].astype(np.float64) + splats.offset
