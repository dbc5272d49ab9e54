"""Photos' headers: size, EXIF, alpha, and formats that cannot be read."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING

from g2ard.errors import InputError, damaged
from g2ard.io.finding import other_photo
from g2ard.io.paths import about, check_regular
from g2ard.io.signs import PHOTOS, foreign
from g2ard.io.types import Size
from g2ard.scene.cameras import LARGEST_IMAGE, check_image

if TYPE_CHECKING:
    from PIL import Image


ASPECT_SLACK = 0.02
"""Relative difference in aspect ratio that rounding may cause; more means another photo."""
_ORIENTATION = 0x0112  # tag of the orientation, 1 to 8
_EXIF = 0x8769  # tag of EXIF's own directory
_FOCAL = 0x920A  # tag of the focal length in mm
_FILM_FOCAL = 0xA405  # tag of the equivalent focal length on 35 mm film, in mm
_SENSOR_PIXELS = 0xA20E  # tag of the sensor's pixels per unit
_SENSOR_UNIT = 0xA210  # tag of that unit
_STORED_WIDTH = 0xA002  # tag of the photo's width in pixels
# millimetres of a unit of sensor pixels: inch, cm, mm and µm
_UNITS = {
    2: 25.4,
    3: 10.0,
    4: 1.0,
    5: 1e-3,
}
_FILM_DIAGONAL = math.hypot(36, 24)  # diagonal of 35 mm film, mm


@contextmanager
def open_image(path: Path, content: IO[bytes] | None = None) -> Iterator[Image.Image]:
    """Open `path`, or `content`, as a Pillow image after checking its size.

    A missing file is an `InputError`; so are exceptions in the block, about a damaged image.
    """
    from PIL import Image, UnidentifiedImageError

    if content is None:
        check_regular(path)
    with about(path):
        try:
            with Image.open(content or path) as image:
                check_image(*image.size)
                yield image
        except InputError:
            raise
        except FileNotFoundError as error:
            raise InputError("no such photo") from error
        except Image.DecompressionBombError as error:
            raise InputError(f"has more than {LARGEST_IMAGE:,} pixels") from error
        except UnidentifiedImageError as error:
            if content is None and _begins_with(path, _TIFF):
                raise InputError(_OTHER_TIFF, hint=_CONVERT_TIFF) from error
            raise InputError("is not an image") from error
        except Exception as error:  # Pillow's decoders raise any exception for damaged files
            raise damaged(f"cannot be decoded ({str(error) or type(error).__name__})") from error


_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_OTHER_TIFF = (
    "is a TIFF of pixels that cannot be read, such as floats, or other bands than red, green, blue"
)
_CONVERT_TIFF = "`gdal_translate -b 1 -b 2 -b 3 -ot Byte -scale IN.tif OUT.png` converts it, if these are its bands"


def _begins_with(path: Path, starts: tuple[bytes, ...]) -> bool:
    """Return whether a file begins with one of some bytes; False if it cannot be read."""
    with suppress(OSError), path.open("rb") as file:
        return file.read(8).startswith(starts)
    return False


def read_size(
    path: Path,
    listed_in: Path | None = None,
    like: tuple[float, float] | None = None,
) -> Size:
    """Read width and height from a photo's header, upright by EXIF if only that fits the size `like`."""
    try:
        with open_image(path) as image:
            if needs_turn(image, like):
                return swap_sides(image.size)
            return image.size
    except InputError as error:
        if listed_in is None:
            raise
        raise error.at(hint=f"it is listed in {listed_in}") from None


def swap_sides(size: Size) -> Size:
    return size[1], size[0]


def needs_turn(image: Image.Image, like: tuple[float, float] | None) -> bool:
    """Return whether EXIF turns an image by a quarter, and only then it has the aspect of `like`.

    Poses refer to stored pixels, unless the size of their views shows that they refer to upright photos.
    """
    if like is None or have_same_aspect(image.size, like):
        return False
    if not have_same_aspect(swap_sides(image.size), like):
        return False
    return orientation(image) in (5, 6, 7, 8)


def orientation(image: Image.Image) -> int:
    """Return EXIF's orientation of an image, 1 for one that is stored upright."""
    return int(image.getexif().get(_ORIENTATION, 1))


def have_same_aspect(size: tuple[float, float], like: tuple[float, float]) -> bool:
    """Return whether two sizes have the same aspect."""
    one = size[0] * like[1]
    other = size[1] * like[0]
    return abs(one - other) <= ASPECT_SLACK * other


def read_focal(path: Path) -> float | None:
    """Return the focal length in pixels by a photo's EXIF, None without one or for a broken photo.

    It comes from the focal length for 35 mm film, whose frame has a diagonal of 43.27 mm; otherwise from that
    in millimetres and the sensor's pixels per unit.
    """
    try:
        with open_image(path) as image:
            size = image.size
            tags = image.getexif().get_ifd(_EXIF)
    except InputError:
        return None
    with suppress(TypeError, ValueError, ZeroDivisionError):
        film = float(tags.get(_FILM_FOCAL, 0))
        found = film * math.hypot(*size) / _FILM_DIAGONAL
        if not film:
            unit = _UNITS.get(tags.get(_SENSOR_UNIT, 2), 25.4)
            per_mm = float(tags.get(_SENSOR_PIXELS, 0)) / unit
            resized = size[0] / float(tags.get(_STORED_WIDTH, size[0]))
            found = float(tags.get(_FOCAL, 0)) * per_mm * resized
        if 0.1 < found / max(size) < 100:
            return found
    return None


def describe_unreadable(photo: Path) -> str | None:
    """Return the format of a photo that cannot be read, by its suffix and first bytes, or None."""
    by_suffix = other_photo(photo)
    if by_suffix is not None:
        return by_suffix
    if _begins_with(photo, _TIFF):
        try:
            with open_image(photo):
                return None
        except InputError as error:
            if not error.hint:
                return None
            return f"{error.message.removeprefix('is ')} ({error.hint})"
    if _begins_with(photo, PHOTOS):
        return None
    sign = foreign(photo)
    if sign is None:
        return None
    return f"{sign.what} ({sign.todo})"


def has_alpha(photo: Path) -> bool:
    """Return whether a photo's header declares transparency; False if it cannot be read."""
    try:
        with open_image(photo) as image:
            return image.has_transparency_data
    except InputError:
        return False
