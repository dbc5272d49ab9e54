"""Photos as arrays that fit their cameras, PNGs, and animations."""

from __future__ import annotations

import itertools
import re
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image, ImageCms, ImageOps

from g2ard.config.choices import BLACK, Colour
from g2ard.errors import InputError, MissingDependencyError
from g2ard.io.atomic import atomic_output
from g2ard.io.finding import MOVING, files_in
from g2ard.io.jsonfile import Place, Row, checked, read_json
from g2ard.io.photos import fits, opened_image, photo_size, turns
from g2ard.io.types import Bytes, Float, Float32, Mask, Size, Values
from g2ard.scene.cameras import Cameras
from g2ard.scene.lenses import PhotoLens
from g2ard.scene.samples import evenly_spaced

_BORDER_PHOTOS = 5  # photos whose borders are compared
_BORDER_COLOUR_SLACK = 3 / 255
"""Largest difference from a constant border colour."""

_BORDER_SHARE = 0.8
"""Least share of border pixels that have a constant border colour."""


def load_photo(
    cameras: Cameras, index: int, background: Sequence[float] | None = BLACK
) -> tuple[Float32, Mask | None]:
    """Read the photo of a view as an image of its pinhole camera, and its mask as `load_mask` does.

    A distorted photo is undistorted at its own resolution, then resized by area. Pixels outside of the mask,
    such as those beyond the photo's edge, have any colour. EXIF orientation counts only where the view's size
    needs it, because poses usually refer to stored pixels. Grey becomes three equal channels, and alpha is
    composited over the background. The image is (H, W, 3) float32 in [0, 1].

    Args:
        background: None keeps alpha, as premultiplied (H, W, 4) RGBA.
    """
    image = _image(cameras, index)
    mask = _mask(cameras, index, image)
    return (image if background is None else composited(image, background)), mask


def composited(image: Float32, background: Sequence[float]) -> Float32:
    """Composite premultiplied RGBA over a background; RGB is unchanged."""
    if image.shape[2] == 4:
        image = image[..., :3] + (1 - image[..., 3:]) * np.asarray(background, np.float32)
    return np.ascontiguousarray(image)


def _image(cameras: Cameras, index: int) -> Float32:
    path, name = cameras.image_paths[index], cameras.names[index]
    if path is None:
        raise InputError(f"({name}) has no photo", index=index, item="view", hint="pass views with photos")
    named = None if cameras.source is None else f"{cameras.source} names it as view {name!r}"
    try:
        target = int(cameras.widths[index]), int(cameras.heights[index])
        lens = cameras.lenses[index]
        image = _open(path, target) if lens is None else _opened(path, _modified(path), lens.size)
    except InputError as error:
        raise error.at(hint="; ".join(filter(None, (error.hint, named))) or None) from error
    height, width = image.shape[:2]
    if lens is not None and fits((width, height), lens.size):
        return _through(image, lens, cameras.Ks[index], target)
    if not fits((width, height), target if lens is None else lens.size):
        raise InputError(
            f"the photo is {width}×{height}, its view {target[0]}×{target[1]}: the aspects differ",
            path=path,
            hint="pass the uncropped photos that the poses were estimated from",
        )
    distortion = cameras.distortions[index]
    if distortion.any():
        K = cameras.Ks[index] * np.array([[width / target[0]], [height / target[1]], [1.0]])
        image = _undistorted(image, K, distortion)
    return resized(image, target)


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


def photo_traits(files: Sequence[Path]) -> PhotoTraits:
    """Look at the headers of all photos and the borders of a few; unreadable photos are ignored."""
    sizes: Counter[Size] = Counter()
    alpha = 0
    for photo in files:
        with suppress(InputError), opened_image(photo) as header:
            sizes[header.size] += 1
            alpha += header.has_transparency_data
    few = evenly_spaced(len(files), _BORDER_PHOTOS, floor=True)
    shown = []
    for i in few:
        with suppress(InputError):
            shown.append(_open(files[i]))
    if not any(image.shape[2] == 4 and image[..., 3].min() < 1 for image in shown):
        alpha = 0
    edges = [np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])[:, :3] for image in shown]
    if alpha or not edges:
        return PhotoTraits(alpha, None, sizes)
    border = np.concatenate(edges)
    colour = np.median(border, axis=0)
    same = (np.abs(border - colour).max(1) <= _BORDER_COLOUR_SLACK).mean() >= _BORDER_SHARE
    red, green, blue = colour.tolist()
    return PhotoTraits(0, (red, green, blue) if same else None, sizes)


def colour_text(colour: Colour) -> str:
    """Return a colour as `--background` takes it.

    >>> colour_text((1, 1, 1)), colour_text((0.5, 0.25, 1))
    ('white', '0.5,0.25,1')
    """
    named = {(0.0, 0.0, 0.0): "black", (1.0, 1.0, 1.0): "white"}
    red, green, blue = (round(float(value), 3) for value in colour)
    return named.get((red, green, blue), f"{red:g},{green:g},{blue:g}")


def find_exposures(cameras: Cameras) -> dict[str, Float]:
    """Return exposures by view name from 3DGS's exposure.json beside the photos' folder, if there is one.

    It holds a 3×4 matrix C per photo, named with or without the suffix: photo = C·(render, 1).
    """
    exposures: dict[str, Float] = {}
    tables: dict[Path, dict[str, Float]] = {}
    for name, photo in zip(cameras.names, cameras.image_paths, strict=True):
        if photo is None:
            continue
        path = exposure_file(photo)
        if path not in tables:
            content = read_json(path) if path.is_file() else {}
            tables[path] = {
                key: np.array(checked(rows, tuple[Row, Row, Row], Place(path).to(key)))
                for key, rows in content.items()
            }
        table = tables[path]
        for key in (name, photo.name, photo.stem):
            if key in table:
                exposures[name] = table[key]
                break
    return exposures


def exposure_file(photo: Path) -> Path:
    """Return the path of the table with a photo's exposure, which may not exist."""
    return photo.parent.parent / "exposure.json"


def load_mask(cameras: Cameras, index: int) -> Mask | None:
    """Read the (H, W) mask of a view's photo, in the pixels of `load_photo`; None if all count.

    Pixels count that the photo holds and whose mask is brighter than half of its brightest pixel; for a photo
    that is its own mask, and for a mask that is black all over, those whose alpha is above half. In a mask
    of labels, every label above 0 counts. instant-ngp's `dynamic_mask_*` leaves out what is white.
    """
    return _mask(cameras, index, None)


def _mask(cameras: Cameras, index: int, image: Float32 | None) -> Mask | None:
    """Return the mask of a photo. A photo that is its own mask is read, unless `image` holds it."""
    held, path = _held(cameras, index), cameras.mask_paths[index]
    if path is None:
        return held
    if path == cameras.image_paths[index]:
        own = _image(cameras, index) if image is None else image
        mask = own[..., 3] > 0.5 if own.shape[2] == 4 else None
    else:
        mask = _kept(_image(replace(cameras, image_paths=cameras.mask_paths), index))
        mask = ~mask if path.name.lower().startswith(MOVING) else mask
    if mask is None or held is None:
        return held if mask is None else np.ascontiguousarray(mask)
    return np.ascontiguousarray(mask & held)


_LABELS = 32 / 255  # brightest value below which the values of a mask are labels


def _kept(mask: Float32) -> Mask:
    """Return the pixels that a mask keeps."""
    shade = composited(mask, BLACK).max(2)
    if mask.shape[2] == 4 and not shade.any():
        return mask[..., 3] > 0.5
    top = float(shade.max())
    kept: Mask = shade > 0.5 * (top if top >= _LABELS else min(top, 1 / 255))
    return kept


def _held(cameras: Cameras, index: int) -> Mask | None:
    """Return the pixels of a view that its undistorted photo holds in full, or None if all are."""
    photo, distortion, lens = cameras.image_paths[index], cameras.distortions[index], cameras.lenses[index]
    if photo is None or (lens is None and not distortion.any()):
        return None
    target = int(cameras.widths[index]), int(cameras.heights[index])
    width, height = photo_size(photo, cameras.source, target if lens is None else lens.size)
    if lens is not None:
        times = _samples(lens, width, cameras.Ks[index])
        samples = _lens_lookup(lens, tuple(cameras.Ks[index].ravel()), target, times)[1]
        whole: Mask = np.all(samples.reshape(target[1], times, target[0], times), axis=(1, 3))
        return None if whole.all() else whole
    K = cameras.Ks[index] * np.array([[width / target[0]], [height / target[1]], [1.0]])
    held = _held_at(width, height, tuple(K.ravel()), tuple(distortion), target)
    return None if held.all() else held


@lru_cache(maxsize=2)
def _held_at(
    width: int, height: int, K: tuple[float, ...], distortion: tuple[float, ...], target: Size
) -> Mask:
    held = _lookup(width, height, K, distortion)[-1].reshape(height, width, 1)
    found = resized(held.astype(np.float32), target)[..., 0] > _WHOLE
    found.flags.writeable = False
    return found


_WHOLE = 0.999  # share of a pixel above which it counts as whole


def _open(path: Path, like: Size | None = None) -> Float32:
    """Decode a photo as (H, W, 3) sRGB, or as premultiplied (H, W, 4) RGBA; for `like` see `turns`."""
    with opened_image(path) as stored:
        wide, upright = _is_deep(stored), turns(stored, like)
        image = ImageOps.exif_transpose(stored) if upright else stored
        if image.mode == "F":
            values = np.asarray(image)[..., None]
        elif wide:
            words = _words(path, image, upright)
            white = _white(path.parent, path.suffix, int(words[..., :3].max()))
            values = words / white
            if words.shape[2] == 4 and words[..., 3].max() > white:  # alpha may have more bits than colours
                values[..., 3] = words[..., 3] / 65535
        else:
            values = np.asarray(_in_srgb(image), np.float32) / np.float32(255)
    if not (values.min() >= 0 and values.max() <= 1):  # also NaN
        text = f"expected values in [0, 1], found {values.min():g} to {values.max():g}"
        raise InputError(text, path=path, hint="convert it to 8 bits")
    values = np.repeat(values, 3 if values.shape[2] == 1 else 1, axis=2).astype(np.float32)
    if values.shape[2] == 4:
        values[..., :3] *= values[..., 3:]
    return values


def _is_deep(image: Image.Image) -> bool:
    """Return whether an image that is not decoded yet has 16 bits per channel, and no colour profile."""
    return image.mode.startswith("I") or (bool(_raw_mode(image)) and not image.info.get("icc_profile"))


def _raw_mode(image: Any) -> str:
    """Return what Pillow calls the 16-bit colours, or grey and alpha, of an image; nothing for others."""
    found = re.search("(RGB[AX]?|LA);16[BLN]", str(getattr(image, "tile", "")))
    return found[0] if found else ""


def _words(path: Path, image: Any, upright: bool) -> Values:
    """Return the (H, W, C) values of 16 bits. Of colours, Pillow decodes the upper bytes; told that they are
    of the other byte order, it decodes the lower ones. Grey and alpha have the size of its RGBA."""
    if image.mode.startswith("I"):
        return np.asarray(image)[..., None]
    lower: Any
    with opened_image(path) as lower:
        raw = _raw_mode(lower)
        big = raw[-1] == "B" or (raw[-1] == "N" and sys.byteorder == "big")
        other = raw[:-1] + ("L" if big else "B")
        if raw.startswith("LA"):  # only PNGs are
            lower._mode = other = "RGBA"
        for i, tile in enumerate(lower.tile):
            rest = () if isinstance(tile.args, str) else tile.args[1:]
            lower.tile[i] = tile._replace(args=(other, *rest) if rest else other)
        low = np.asarray(ImageOps.exif_transpose(lower) if upright else lower)
    if raw.startswith("LA"):
        return low.view(">u2")[..., [0, 0, 0, 1]]
    words = np.asarray(image).astype(np.uint16) * 256 + low
    return words[..., :3] if image.mode == "RGBX" else words


_BITS = (8, 10, 12, 14)  # bits of colours that are stored in 16


def _white(folder: Path, suffix: str, brightest: int) -> float:
    """Return the value of 16 bits that means white: the largest of the bits that the photos use."""
    top = _brightest(folder, suffix)
    return float(next((2**bits - 1 for bits in _BITS if 0 < top < 2**bits > brightest), 65535))


@lru_cache(maxsize=64)
def _brightest(folder: Path, suffix: str) -> int:
    """Return the brightest value of a few photos of 16 bits in a folder; 0 if each has one colour."""
    files, found = files_in(folder, suffix.lower()), 0
    for i in evenly_spaced(len(files), _BORDER_PHOTOS, floor=True):
        with suppress(InputError, OSError), opened_image(files[i]) as image:
            if _is_deep(image):
                words = _words(files[i], image, False)[..., :3]
                found = max(found, int(words.max()) if np.ptp(words) else 0)
    return found


def _in_srgb(image: Image.Image) -> Image.Image:
    """Return an 8-bit image as RGB or RGBA, with its colour profile converted to sRGB."""
    mode = "RGBA" if image.has_transparency_data else "RGB"
    change = _conversion(image.info.get("icc_profile"), image.mode if image.mode in ("L", "CMYK") else mode)
    if change is None:
        return image.convert(mode)
    own = image if image.mode in ("L", "CMYK") else image.convert(mode)
    converted: Image.Image = change.apply(own)
    return converted


@lru_cache(maxsize=8)
def _conversion(profile: bytes | None, mode: str) -> ImageCms.ImageCmsTransform | None:
    """Return the conversion of a colour profile to sRGB; None if it is that, or cannot be used."""
    with suppress(ImageCms.PyCMSError, ImportError, OSError, TypeError):
        own = ImageCms.ImageCmsProfile(BytesIO(profile or b""))
        if "srgb" not in ImageCms.getProfileDescription(own).lower():
            goal = "RGBA" if mode == "RGBA" else "RGB"
            colorimetric = ImageCms.Intent.RELATIVE_COLORIMETRIC
            return ImageCms.buildTransform(own, ImageCms.createProfile("sRGB"), mode, goal, colorimetric)
    return None


def _undistorted(image: Float32, K: Float, distortion: Float) -> Float32:
    """Sample the distorted photo for each pixel of the pinhole image."""
    height, width = image.shape[:2]
    u, v, _ = _lookup(width, height, tuple(K.ravel()), tuple(distortion))
    return _sampled(image, u, v).reshape(image.shape)


def _sampled(image: Float32, u: Float, v: Float, around: bool = False) -> Float32:
    """Return the (n, C) values at n places, bilinearly. Pixels have whole numbers, and edges are repeated.

    Args:
        around: whether the last column is beside the first, as in a panorama.
    """
    height, width = image.shape[:2]
    u, v = u if around else np.clip(u, 0, width - 1), np.clip(v, 0, height - 1)
    left, above = np.floor(u).astype(int), np.floor(v).astype(int)
    right, down = (u - left)[:, None].astype(np.float32), (v - above)[:, None].astype(np.float32)
    top, bottom = (
        image[row, left % width] * (1 - right) + image[row, (left + 1) % width] * right
        for row in (above, np.minimum(above + 1, height - 1))
    )
    return np.asarray(top * (1 - down) + bottom * down)


@lru_cache(maxsize=2)  # usually all photos share one lens
def _lookup(
    width: int, height: int, K: tuple[float, ...], distortion: tuple[float, ...]
) -> tuple[Float, Float, Mask]:
    """Return column and row of each pixel's source, and whether the photo holds it.

    OpenCV's model, pixel centres at +0.5:

    x' = x·(1 + k1 r² + k2 r⁴ + k3 r⁶) + 2 p1 x y + p2 (r² + 2 x²), y' likewise with p1 and p2 exchanged.
    """
    k1, k2, p1, p2, k3 = distortion
    matrix = np.array(K).reshape(3, 3)
    v, u = np.mgrid[0:height, 0:width] + 0.5
    x, y, _ = np.linalg.inv(matrix) @ np.stack([u.ravel(), v.ravel(), np.ones(u.size)])
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    bent = [
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        np.ones_like(x),
    ]
    u, v = matrix[:2] @ bent - 0.5
    held = (u >= -0.5) & (u <= width - 0.5) & (v >= -0.5) & (v <= height - 0.5) & (r2 < _fold(k1, k2, k3))
    return u, v, held


def _modified(path: Path) -> int | None:
    """Return a photo's time, None if it is missing, as `_open` will say."""
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return None


@lru_cache(maxsize=1)  # several views of a photo follow each other
def _opened(path: Path, modified: int | None, like: Size) -> Float32:
    return _open(path, like)


def _through(image: Float32, lens: PhotoLens, K: Float, size: Size) -> Float32:
    """Sample a photo through its lens for each pixel of a pinhole view: bilinearly at as many points a pixel
    as the photo is finer, which are averaged."""
    height, width = image.shape[:2]
    times = _samples(lens, width, K)
    pixels, _ = _lens_lookup(lens, tuple(K.ravel()), size, times)
    u, v = (pixels * (np.array([width, height]) / lens.size) - 0.5).T
    samples = _sampled(image, u, v, around=lens.model == "EQUIRECTANGULAR")
    return resized(samples.reshape(size[1] * times, size[0] * times, -1), size)


_MOST_SAMPLES = 8


def _samples(lens: PhotoLens, width: int, K: Float) -> int:
    """Return the number of samples along each side of a pixel: the pixels of a photo of this width there."""
    finer = width / lens.size[0] * max(lens.focal) / min(K[0, 0], K[1, 1])
    return int(np.clip(np.ceil(finer - 0.01), 1, _MOST_SAMPLES))


@lru_cache(maxsize=6)  # the faces of a cube
def _lens_lookup(lens: PhotoLens, K: tuple[float, ...], size: Size, times: int) -> tuple[Float, Mask]:
    """Return the pixel of a lens for each sample of a pinhole view, and whether its photo holds it."""
    v, u = (np.mgrid[0 : size[1] * times, 0 : size[0] * times] + 0.5) / times
    rays = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], 1) @ np.linalg.inv(np.array(K).reshape(3, 3)).T
    return lens.project(rays)


def _fold(k1: float, k2: float, k3: float) -> float:
    """Return r² where r·(1 + k1 r² + k2 r⁴ + k3 r⁶) stops growing, where the lens model ends."""
    roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1])
    return min((root.real for root in roots if abs(root.imag) < 1e-9 and root.real > 0), default=np.inf)


def resized(image: Float32, size: Size) -> Float32:
    """Resize an (H, W, C) float32 image to (width, height): by area when shrinking, bilinearly when growing.

    >>> resized(np.full((4, 8, 3), 0.5, np.float32), (2, 1)).tolist()
    [[[0.5, 0.5, 0.5], [0.5, 0.5, 0.5]]]
    """
    for axis, length in ((0, size[1]), (1, size[0])):
        if length < image.shape[axis]:
            image = _averaged(image, length, axis)
    height, width = image.shape[:2]
    if (width, height) != size:
        planes = [Image.fromarray(np.ascontiguousarray(image[..., c])) for c in range(image.shape[2])]
        grown = [np.asarray(plane.resize(size, Image.Resampling.BILINEAR), np.float32) for plane in planes]
        image = np.stack(grown, axis=2)
    return np.ascontiguousarray(image)


def _averaged(image: Float32, length: int, axis: int) -> Float32:
    """Return exact means over `length` equal parts of an axis, from differences of its running sum."""
    count = image.shape[axis]
    pad = [(1, 0) if i == axis else (0, 0) for i in range(3)]
    sums = np.pad(np.cumsum(image, axis=axis, dtype=float), pad)
    edges = np.linspace(0, count, length + 1)
    below = np.minimum(edges.astype(int), count - 1)
    share = np.expand_dims(edges - below, [i for i in range(3) if i != axis])
    low, high = sums.take(below, axis), sums.take(below + 1, axis)
    return (np.diff(low + share * (high - low), axis=axis) * (length / count)).astype(np.float32)


def to_bytes(image: ArrayLike) -> Bytes:
    """Convert values in [0, 1] to bytes, clipped and rounded to nearest; bytes are unchanged, NaN is black.

    >>> to_bytes([[-1.0, 0.5, 2.0]]).tolist()
    [[0, 128, 255]]
    """
    values = np.asarray(image)
    if values.dtype == np.uint8:
        return values
    return np.rint(np.clip(np.nan_to_num(values, nan=0.0), 0, 1) * 255).astype(np.uint8)


def as_saved(image: ArrayLike) -> Float32:
    """Round an image in [0, 1] like an 8-bit PNG: clipped, in multiples of 1/255.

    >>> (255 * as_saved([[-1.0, 0.5, 2.0]])).tolist()
    [[0.0, 128.0, 255.0]]
    """
    return to_bytes(image).astype(np.float32) / np.float32(255)


def write_png(path: str | Path, image: ArrayLike, *, overwrite: bool = False) -> None:
    """Write (H, W, 3), (H, W, 4) or (H, W) floats in [0, 1] or bytes as an 8-bit PNG, atomically."""
    values = to_bytes(image)
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[..., 0]
    if not values.size or not (values.ndim == 2 or (values.ndim == 3 and values.shape[2] in (3, 4))):
        raise InputError(f"expected an image, got an array of shape {values.shape}", path=path)
    with atomic_output(path, overwrite) as temporary:
        temporary.write_bytes(png_bytes(values))


def png_bytes(image: ArrayLike) -> bytes:
    """Return an image, as `write_png` takes it, as the content of a PNG file."""
    content = BytesIO()
    Image.fromarray(np.ascontiguousarray(to_bytes(image))).save(content, format="PNG", compress_level=3)
    return content.getvalue()


ANIMATIONS = (".gif", ".webp", ".mp4")


def check_animation(path: Path) -> None:
    """Check that an animation of this suffix can be written."""
    if path.suffix.lower() == ".mp4" and shutil.which("ffmpeg") is None:
        raise MissingDependencyError(
            "an .mp4 needs the program ffmpeg on PATH", path=path, hint="install it, or write .webp or .gif"
        )


def write_animation(
    path: Path, pictures: Iterable[Bytes], *, fps: float = 25, overwrite: bool = False
) -> None:
    """Write images of one size as an endless animation in the format of the suffix.

    A .gif rounds their duration to hundredths of a second.
    """
    check_animation(path)
    shown = iter(pictures)
    first = next(shown)
    frames = _of_size(path, first.shape, itertools.chain([first], shown))
    with atomic_output(path, overwrite) as temporary:
        if path.suffix.lower() == ".mp4":
            _encode(temporary, (first.shape[1], first.shape[0]), frames, fps)
            return
        image, *rest = [Image.fromarray(frame) for frame in frames]
        options: dict[str, Any] = {"duration": 1000 / fps, "loop": 0, "quality": 80, "optimize": True}
        image.save(temporary, save_all=True, append_images=rest, **options)


def _of_size(path: Path, shape: tuple[int, ...], frames: Iterable[Bytes]) -> Iterator[Bytes]:
    for frame in frames:
        if frame.shape != shape:
            sizes = " and ".join(f"{width}×{height}" for height, width, _ in (shape, frame.shape))
            raise InputError(f"views of one size make an animation, got {sizes}", path=path)
        yield np.ascontiguousarray(frame)


def _encode(path: Path, size: Size, frames: Iterable[Bytes], fps: float) -> None:
    """Pipe raw frames to ffmpeg; H.264 with 4:2:0 needs even sides, so odd ones lose a pixel."""
    command = ["ffmpeg", "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24"]
    command += ["-s", f"{size[0]}x{size[1]}", "-r", f"{fps:g}", "-i", "-"]
    command += ["-vf", "crop=trunc(iw/2)*2:trunc(ih/2)*2", "-pix_fmt", "yuv420p", "-crf", "18", str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stderr is not None
        try:
            for frame in frames:
                process.stdin.write(frame.tobytes())
            process.stdin.close()
        except BrokenPipeError:
            pass
        said = process.stderr.read().decode(errors="replace").strip()
    if process.returncode:
        raise InputError(f"ffmpeg failed: {said.splitlines()[-1] if said else process.returncode}", path=path)
