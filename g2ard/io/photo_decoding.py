"""Decoding of photos to sRGB in [0, 1]: 8 and 16 bits, colour profiles and alpha."""

from __future__ import annotations

import re
import sys
from contextlib import suppress
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageCms, ImageOps

from g2ard.arrays import Float32, Values
from g2ard.errors import InputError
from g2ard.io.finding import files_in
from g2ard.io.photo_headers import needs_turn, open_image
from g2ard.io.types import Size
from g2ard.scene.samples import evenly_spaced


def decode_photo(path: Path, like: Size | None = None) -> Float32:
    """Decode a photo as (H, W, 3) sRGB, or as premultiplied (H, W, 4) RGBA; for `like` see `needs_turn`."""
    with open_image(path) as stored:
        wide = _is_deep(stored)
        upright = needs_turn(stored, like)
        image = stored
        if upright:
            image = ImageOps.exif_transpose(stored)
        if image.mode == "F":
            values = np.asarray(image)[..., None]
        elif wide:
            words = _read_words(path, image, upright)
            white = _choose_white(path.parent, path.suffix, int(words[..., :3].max()))
            values = words / white
            # alpha may have more bits than colours
            if words.shape[2] == 4 and words[..., 3].max() > white:
                values[..., 3] = words[..., 3] / 65535
        else:
            values = np.asarray(_convert_to_srgb(image), np.float32) / np.float32(255)
    if not (values.min() >= 0 and values.max() <= 1):  # also NaN
        text = f"expected values in [0, 1], found {values.min():g} to {values.max():g}"
        raise InputError(text, path=path, hint="convert it to 8 bits")
    if values.shape[2] == 1:
        values = np.repeat(values, 3, axis=2)
    values = values.astype(np.float32)
    if values.shape[2] == 4:
        values[..., :3] *= values[..., 3:]
    return values


def _is_deep(image: Image.Image) -> bool:
    """Return whether an image that is not decoded yet has 16 bits per channel, and no colour profile."""
    if image.mode.startswith("I"):
        return True
    return bool(_raw_mode(image)) and not image.info.get("icc_profile")


def _raw_mode(image: Any) -> str:
    """Return what Pillow calls the 16-bit colours, or grey and alpha, of an image; nothing for others."""
    found = re.search("(RGB[AX]?|LA);16[BLN]", str(getattr(image, "tile", "")))
    if found is None:
        return ""
    return found[0]


def _read_words(path: Path, image: Any, upright: bool) -> Values:
    """Return the (H, W, C) values of 16 bits. Of colours, Pillow decodes the upper bytes; told that they are
    of the other byte order, it decodes the lower ones. Grey and alpha have the size of its RGBA."""
    if image.mode.startswith("I"):
        return np.asarray(image)[..., None]
    lower: Any
    with open_image(path) as lower:
        raw = _raw_mode(lower)
        order = raw[-1]
        if order == "N":
            order = sys.byteorder[0].upper()
        other = raw[:-1] + _OTHER_ORDER[order]
        if raw.startswith("LA"):  # only PNGs are
            other = "RGBA"
            lower._mode = other
        for i, tile in enumerate(lower.tile):
            args: Any = other
            if not isinstance(tile.args, str) and len(tile.args) > 1:
                args = (other, *tile.args[1:])
            lower.tile[i] = tile._replace(args=args)
        if upright:
            lower = ImageOps.exif_transpose(lower)
        low = np.asarray(lower)
    if raw.startswith("LA"):
        return low.view(">u2")[..., [0, 0, 0, 1]]
    words = np.asarray(image).astype(np.uint16) * 256 + low
    if image.mode == "RGBX":
        return words[..., :3]
    return words


_OTHER_ORDER = {"B": "L", "L": "B"}  # big-endian, little-endian
_BITS = (8, 10, 12, 14)  # bits of colours that are stored in 16
_SAMPLED_PHOTOS = 5  # photos of a folder whose brightest value is compared


def _choose_white(folder: Path, suffix: str, brightest: int) -> float:
    """Return the value of 16 bits that means white: the largest of the bits that the photos use."""
    top = _find_brightest(folder, suffix)
    if top:
        for bits in _BITS:
            if max(top, brightest) < 2**bits:
                return 2.0**bits - 1
    return 65535.0


@lru_cache(maxsize=64)
def _find_brightest(folder: Path, suffix: str) -> int:
    """Return the brightest value of a few photos of 16 bits in a folder; 0 if each has one colour."""
    files = files_in(folder, suffix.lower())
    found = 0
    for i in evenly_spaced(len(files), _SAMPLED_PHOTOS, floor=True):
        with suppress(InputError, OSError), open_image(files[i]) as image:
            if _is_deep(image):
                words = _read_words(files[i], image, False)[..., :3]
                if np.ptp(words):
                    found = max(found, int(words.max()))
    return found


def _convert_to_srgb(image: Image.Image) -> Image.Image:
    """Return an 8-bit image as RGB or RGBA, with its colour profile converted to sRGB."""
    mode = "RGBA" if image.has_transparency_data else "RGB"
    own_mode = mode
    if image.mode in ("L", "CMYK"):
        own_mode = image.mode
    change = _make_conversion(image.info.get("icc_profile"), own_mode)
    if change is None:
        return image.convert(mode)
    if image.mode != own_mode:
        image = image.convert(own_mode)
    converted: Image.Image = change.apply(image)
    return converted


@lru_cache(maxsize=8)
def _make_conversion(profile: bytes | None, mode: str) -> ImageCms.ImageCmsTransform | None:
    """Return the conversion of a colour profile to sRGB; None if it is that, or cannot be used."""
    with suppress(ImageCms.PyCMSError, ImportError, OSError, TypeError):
        own = ImageCms.ImageCmsProfile(BytesIO(profile or b""))
        if "srgb" not in ImageCms.getProfileDescription(own).lower():
            return ImageCms.buildTransform(
                own,
                ImageCms.createProfile("sRGB"),
                inMode=mode,
                outMode="RGBA" if mode == "RGBA" else "RGB",
                renderingIntent=ImageCms.Intent.RELATIVE_COLORIMETRIC,
            )
    return None
