"""Photos and masks as images of their cameras: undistorted, resized and composited."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from g2ard.arrays import Float, Float32, Mask
from g2ard.config.choices import BLACK, Colour
from g2ard.errors import InputError
from g2ard.io.finding import MOVING
from g2ard.io.images import resize
from g2ard.io.photo_decoding import decode_photo
from g2ard.io.photo_headers import have_same_aspect, open_image, read_size
from g2ard.io.types import Size
from g2ard.scene.cameras import Cameras
from g2ard.scene.lenses import PhotoLens
from g2ard.scene.samples import evenly_spaced

_BORDER_PHOTOS = 5  # photos whose borders are compared
_BORDER_COLOUR_SLACK = 3 / 255  # largest difference from a constant border colour
_BORDER_SHARE = 0.8  # least share of border pixels that have a constant border colour


def load_photo(
    cameras: Cameras,
    index: int,
    background: Sequence[float] | None = BLACK,
) -> tuple[Float32, Mask | None]:
    """Read the photo of a view as an image of its pinhole camera, and its mask as `load_mask` does.

    A distorted photo is undistorted at its own resolution, then resized by area. Pixels outside of the mask,
    such as those beyond the photo's edge, have any colour. EXIF orientation counts only where the view's size
    needs it, because poses usually refer to stored pixels. Grey becomes three equal channels, and alpha is
    composited over the background. The image is (H, W, 3) float32 in [0, 1].

    Args:
        background: None keeps alpha, as premultiplied (H, W, 4) RGBA.
    """
    image = _load_image(cameras, index)
    mask = _load_mask(cameras, index, image)
    if background is not None:
        image = composite(image, background)
    return image, mask


def composite(image: Float32, background: Sequence[float]) -> Float32:
    """Composite premultiplied RGBA over a background; RGB is unchanged."""
    if image.shape[2] == 4:
        behind = (1 - image[..., 3:]) * np.asarray(background, np.float32)
        image = image[..., :3] + behind
    return np.ascontiguousarray(image)


def _load_image(cameras: Cameras, index: int) -> Float32:
    path = cameras.image_paths[index]
    name = cameras.names[index]
    if path is None:
        raise InputError(
            f"({name}) has no photo",
            index=index,
            item="view",
            hint="pass views with photos",
        )
    target = _size_of(cameras, index)
    lens = _lens_of(cameras, index)
    size = target
    if lens is not None:
        size = lens.size
    try:
        several = cameras.lenses[index] is not None  # views of one photo, which follow each other
        if several:
            image = _decode_once(path, _modification_time(path), size)
        else:
            image = decode_photo(path, size)
    except InputError as error:
        if cameras.source is None:
            raise
        named = f"{cameras.source} names it as view {name!r}"
        hint = "; ".join(filter(None, (error.hint, named)))
        raise error.at(hint=hint) from error
    height, width = image.shape[:2]
    if not have_same_aspect((width, height), size):
        raise InputError(
            f"the photo is {width}×{height}, its view {target[0]}×{target[1]}: the aspects differ",
            path=path,
            hint="pass the uncropped photos that the poses were estimated from",
        )
    if lens is None:
        return resize(image, target)
    return _resample(image, lens, cameras.Ks[index], target)


def _lens_of(cameras: Cameras, index: int) -> PhotoLens | None:
    """Return the lens of a view's photo; None for a pinhole."""
    distortion = cameras.distortions[index].tolist()
    if cameras.lenses[index] is not None or not any(distortion):
        return cameras.lenses[index]
    (fx, _, cx), (_, fy, cy), _ = cameras.Ks[index].tolist()
    params = (fx, fy, cx, cy, *distortion, 0.0, 0.0, 0.0)
    return PhotoLens("FULL_OPENCV", _size_of(cameras, index), params)


def _size_of(cameras: Cameras, index: int) -> Size:
    return int(cameras.widths[index]), int(cameras.heights[index])


@dataclass(frozen=True)
class PhotoTraits:
    """Properties of photos that decide which background fits them.

    Args:
        alpha: number of photos with alpha; 0 if none of a few has transparent pixels.
        border: colour that a few photos share along their borders; None if it varies, or with alpha.
        sizes: number of photos by width and height.
    """

    alpha: int
    border: Colour | None
    sizes: Mapping[Size, int]


def measure_traits(files: Sequence[Path]) -> PhotoTraits:
    """Look at the headers of all photos and the borders of a few; unreadable photos are ignored."""
    sizes: Counter[Size] = Counter()
    alpha = 0
    for photo in files:
        with suppress(InputError), open_image(photo) as header:
            sizes[header.size] += 1
            alpha += header.has_transparency_data
    few = evenly_spaced(len(files), _BORDER_PHOTOS, floor=True)
    shown = []
    for i in few:
        with suppress(InputError):
            shown.append(decode_photo(files[i]))
    if not any(map(_is_transparent, shown)):
        alpha = 0
    if alpha or not shown:
        return PhotoTraits(alpha, None, sizes)
    sides = []
    for image in shown:
        rgb = image[..., :3]
        sides += [rgb[0], rgb[-1], rgb[:, 0], rgb[:, -1]]
    border = np.concatenate(sides)
    colour = np.median(border, axis=0)
    away = np.abs(border - colour).max(1)
    if (away <= _BORDER_COLOUR_SLACK).mean() < _BORDER_SHARE:
        return PhotoTraits(0, None, sizes)
    red, green, blue = colour.tolist()
    return PhotoTraits(0, (red, green, blue), sizes)


def _is_transparent(image: Float32) -> bool:
    return image.shape[2] == 4 and bool(image[..., 3].min() < 1)


def load_mask(cameras: Cameras, index: int) -> Mask | None:
    """Read the (H, W) mask of a view's photo, in the pixels of `load_photo`; None if all count.

    Pixels count that the photo holds and whose mask is brighter than half of its brightest pixel; for a photo
    that is its own mask, and for a mask that is black all over, those whose alpha is above half. In a mask
    of labels, every label above 0 counts. instant-ngp's `dynamic_mask_*` leaves out what is white.
    """
    return _load_mask(cameras, index, None)


def _load_mask(cameras: Cameras, index: int, image: Float32 | None) -> Mask | None:
    """Return the mask of a photo. A photo that is its own mask is read, unless `image` holds it."""
    held = _find_held(cameras, index)
    path = cameras.mask_paths[index]
    if path is None:
        return held
    if path == cameras.image_paths[index]:
        if image is None:
            image = _load_image(cameras, index)
        if image.shape[2] < 4:
            return held
        mask = image[..., 3] > 0.5
    else:
        masks = replace(cameras, image_paths=cameras.mask_paths)
        mask = _threshold(_load_image(masks, index))
        if path.name.lower().startswith(MOVING):
            mask = ~mask
    if held is not None:
        mask = mask & held
    return np.ascontiguousarray(mask)


_LABELS = 32 / 255  # brightest value below which the values of a mask are labels


def _threshold(mask: Float32) -> Mask:
    """Return the pixels that a mask keeps."""
    shade = composite(mask, BLACK).max(2)
    if mask.shape[2] == 4 and not shade.any():
        return mask[..., 3] > 0.5
    top = float(shade.max())
    if top < _LABELS:
        top = min(top, 1 / 255)
    kept: Mask = shade > 0.5 * top
    return kept


def _find_held(cameras: Cameras, index: int) -> Mask | None:
    """Return the pixels of a view that its undistorted photo holds in full, or None if all are."""
    photo = cameras.image_paths[index]
    lens = _lens_of(cameras, index)
    if photo is None or lens is None:
        return None
    K = cameras.Ks[index]
    size = _size_of(cameras, index)
    width, _ = read_size(photo, cameras.source, lens.size)
    times = _samples_per_side(lens, width, K)
    _, samples = _look_up(lens, K, size, times)
    samples = samples.reshape(size[1], times, size[0], times)
    whole: Mask = np.all(samples, axis=(1, 3))
    if whole.all():
        return None
    return whole


def _sample(
    image: Float32,
    u: Float,
    v: Float,
    around: bool = False,
) -> Float32:
    """Return the (n, C) values at n places, bilinearly. Pixels have whole numbers, and edges are repeated.

    Args:
        around: whether the last column is beside the first, as in a panorama.
    """
    height, width = image.shape[:2]
    if not around:
        u = np.clip(u, 0, width - 1)
    v = np.clip(v, 0, height - 1)
    left = np.floor(u).astype(int)
    above = np.floor(v).astype(int)
    below = np.minimum(above + 1, height - 1)
    right = (u - left)[:, None].astype(np.float32)
    down = (v - above)[:, None].astype(np.float32)
    first = left % width
    second = (left + 1) % width
    top = image[above, first] * (1 - right) + image[above, second] * right
    bottom = image[below, first] * (1 - right) + image[below, second] * right
    return top * (1 - down) + bottom * down


def _modification_time(path: Path) -> int | None:
    """Return a photo's time, None if it is missing, as `decode_photo` will say."""
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return None


@lru_cache(maxsize=1)  # several views of a photo follow each other
def _decode_once(path: Path, modified: int | None, like: Size) -> Float32:
    return decode_photo(path, like)


def _resample(
    image: Float32,
    lens: PhotoLens,
    K: Float,
    size: Size,
) -> Float32:
    """Sample a photo through its lens for each pixel of a pinhole view: bilinearly at as many points a pixel
    as the photo is finer, which are averaged."""
    height, width = image.shape[:2]
    times = _samples_per_side(lens, width, K)
    scale = np.array([width, height]) / lens.size
    bands = []
    places, _ = _look_up(lens, K, size, times)
    for pixels in _bands(places.reshape(size[1], -1, 2)):
        u, v = (pixels.reshape(-1, 2) * scale - 0.5).T
        samples = _sample(image, u, v, around=lens.model == "EQUIRECTANGULAR")
        rows = len(pixels)
        fine = samples.reshape(rows * times, size[0] * times, -1)
        bands.append(resize(fine, (size[0], rows)))
    return np.concatenate(bands)


def _bands(rows: Float) -> list[Float]:
    """Split rows into bands that a processor's cache holds."""
    return np.array_split(rows, min(_BANDS, len(rows)))


_BANDS = 32
_MOST_SAMPLES = 8


def _samples_per_side(lens: PhotoLens, width: int, K: Float) -> int:
    """Return the number of samples along each side of a pixel: the pixels of a photo of this width there."""
    focal = min(K[0, 0], K[1, 1])
    finer = width / lens.size[0] * max(lens.focal) / focal
    samples = np.ceil(finer - 0.01)
    return int(np.clip(samples, 1, _MOST_SAMPLES))


def _look_up(
    lens: PhotoLens,
    K: Float,
    size: Size,
    times: int,
) -> tuple[Float, Mask]:
    """Return the pixel of a lens for each sample of a pinhole view, and whether its photo holds it."""
    look_up = _lookup_of_face
    if lens.model == "FULL_OPENCV":
        look_up = _lookup_of_view
    return look_up(lens, tuple(K.ravel()), size, times)


def _find_pixels(
    lens: PhotoLens,
    K: tuple[float, ...],
    size: Size,
    times: int,
) -> tuple[Float, Mask]:
    turn = np.linalg.inv(np.array(K).reshape(3, 3)).T
    across = (np.arange(size[0] * times) + 0.5) / times
    down = (np.arange(size[1] * times) + 0.5) / times
    bands = []
    for band in _bands(down):
        u, v = (grid.ravel() for grid in np.meshgrid(across, band))
        rays = np.stack([u, v, np.ones(u.size)], 1)
        bands.append(lens.project(rays @ turn))
    pixels, held = zip(*bands, strict=True)
    return np.concatenate(pixels), np.concatenate(held)


_lookup_of_view = lru_cache(maxsize=2)(_find_pixels)  # usually all photos share one lens
_lookup_of_face = lru_cache(maxsize=6)(_find_pixels)  # as many as a cube has
