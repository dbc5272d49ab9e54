"""How much a file may unpack to, checked before room is made: a few bytes can ask for gigabytes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from g2ard.errors import DAMAGED, InputError
from g2ard.io.paths import check_regular

if TYPE_CHECKING:
    from PIL.Image import Image

LARGEST_IMAGE = 160_000_000
"""Pixels of an image, as a file stores it or as a view asks for it: 12 bytes each once decoded."""

_LARGEST_RATIO = 100
_ALWAYS_UNPACKED = 64 << 20
"""Bytes: what any file may unpack to; past that, `_LARGEST_RATIO` times its own size."""


def check_unpacked(path: str | Path, packed: int, unpacked: int) -> None:
    """Refuse what would unpack to more than 64 MiB and to more than 100 times its size.

    Args:
        path: the file, for errors.
        packed: bytes as stored.
        unpacked: bytes it says it holds.

    Raises:
        InputError: it is past the limit.

    >>> check_unpacked("a.spz", 1 << 20, 100 << 20)
    >>> check_unpacked("b.spz", 1 << 10, 100 << 20)
    Traceback (most recent call last):
    ...
    g2ard.errors.InputError: b.spz: 1,024 bytes would unpack to 104,857,600; at most 67,108,864 are taken
    """
    most = max(_ALWAYS_UNPACKED, _LARGEST_RATIO * packed)
    if unpacked > most:
        raise InputError(
            f"{packed:,} bytes would unpack to {unpacked:,}; at most {most:,} are taken", path=path
        )


def check_image(width: int, height: int, **fields: Any) -> None:
    """Refuse an image of more than `LARGEST_IMAGE` pixels.

    Args:
        width, height: of the image.
        fields: of the error.

    Raises:
        InputError: it is larger.
    """
    if width * height > LARGEST_IMAGE:
        raise InputError(f"has {width:,}×{height:,} pixels; at most {LARGEST_IMAGE:,} are taken", **fields)


@contextmanager
def opened_image(path: Path, content: IO[bytes] | None = None) -> Iterator[Image]:
    """Open a Pillow image, with its size checked before its pixels are decoded.

    Any exception in the block is reported as a broken image.

    Args:
        path: the image.
        content: its bytes, if they are not to be read from `path`.

    Raises:
        InputError: it is no image, not whole, or past `LARGEST_IMAGE`.
        FileNotFoundError: there is no such file.
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
        raise InputError("not an image", path=path) from error
    except Exception as error:  # on damage Pillow's decoders raise whatever they stumble over
        raise InputError(
            f"not a whole image ({str(error) or type(error).__name__})", path=path, hint=DAMAGED
        ) from error
