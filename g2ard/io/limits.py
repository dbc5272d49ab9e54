"""Limits on unpacked sizes, checked before memory is allocated."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING

from g2ard.errors import InputError, damaged
from g2ard.io.paths import check_regular
from g2ard.scene.cameras import LARGEST_IMAGE, check_image

if TYPE_CHECKING:
    from PIL.Image import Image

_LARGEST_RATIO = 100
_ALWAYS_UNPACKED = 64 << 20
"""Bytes that any file may unpack to; larger ones are limited by `_LARGEST_RATIO`."""


def check_unpacked(path: str | Path, packed: int, unpacked: int) -> None:
    """Raise an `InputError` for data that unpacks to over 64 MiB and over 100 times its size, in bytes.

    >>> check_unpacked("a.spz", 1 << 20, 100 << 20)
    >>> check_unpacked("b.spz", 1 << 10, 100 << 20)
    Traceback (most recent call last):
    ...
    g2ard.errors.InputError: b.spz: 1,024 bytes would unpack to 104,857,600; the limit is 67,108,864
    """
    most = max(_ALWAYS_UNPACKED, _LARGEST_RATIO * packed)
    if unpacked > most:
        raise InputError(f"{packed:,} bytes would unpack to {unpacked:,}; the limit is {most:,}", path=path)


@contextmanager
def opened_image(path: Path, content: IO[bytes] | None = None) -> Iterator[Image]:
    """Open `path`, or `content`, as a Pillow image after checking its size.

    Exceptions in the block become an `InputError` about a damaged image, except for `FileNotFoundError`.
    """
    from PIL import Image, UnidentifiedImageError

    if content is None:
        check_regular(path)
    try:
        with Image.open(content or path) as image:
            check_image(*image.size, path=path)
            yield image
    except (InputError, FileNotFoundError):
        raise
    except Image.DecompressionBombError as error:
        raise InputError(f"has more than {LARGEST_IMAGE:,} pixels", path=path) from error
    except UnidentifiedImageError as error:
        raise InputError("is not an image", path=path) from error
    except Exception as error:  # Pillow's decoders raise any exception for damaged files
        raise damaged(f"cannot be decoded ({str(error) or type(error).__name__})", path=path) from error
