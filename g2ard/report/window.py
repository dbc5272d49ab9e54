"""Regions of interest: parts of an image that a report magnifies."""

from __future__ import annotations

from dataclasses import astuple, dataclass

from g2ard.errors import InputError


@dataclass(frozen=True)
class Window:
    """A rectangle of an image, as fractions of its width and height.

    Raises:
        InputError: it is empty or extends beyond the image.

    >>> Window(0.25, 0.5, 0.25, 0.25).pixels(100, 200)
    (slice(50, 75, None), slice(50, 100, None))
    """

    left: float
    top: float
    width: float
    height: float

    def __post_init__(self) -> None:
        spans = ((self.left, self.width), (self.top, self.height))
        if not all(start >= 0 and extent > 0 and start + extent <= 1 + 1e-6 for start, extent in spans):
            given = ",".join(f"{value:g}" for value in (self.left, self.top, self.width, self.height))
            raise InputError(
                f"expected left, top, width and height in shares of the image, got {given}", parameter="crop"
            )

    def pixels(self, height: int, width: int) -> tuple[slice, slice]:
        """Return the rows and columns in an image of that size, at least one of each."""
        rows = _span(self.top, self.height, height)
        return rows, _span(self.left, self.width, width)


@dataclass(frozen=True)
class Crop:
    """A requested window.

    Args:
        window: the window.
        view: name of the view; None means every view shown.
    """

    window: Window
    view: str | None = None

    @classmethod
    def parse(cls, text: str) -> Crop:
        """Parse [VIEW:]LEFT,TOP,WIDTH,HEIGHT.

        Raises:
            InputError: not four numbers that form a window.

        >>> Crop.parse("a:b.jpg:0,0,.5,.5")
        Crop(window=Window(left=0.0, top=0.0, width=0.5, height=0.5), view='a:b.jpg')
        """
        view, _, numbers = text.rpartition(":")
        try:
            left, top, width, height = (float(part) for part in numbers.split(","))
        except ValueError:
            raise InputError(
                f"expected [VIEW:]LEFT,TOP,WIDTH,HEIGHT, got {text!r}", parameter="crop"
            ) from None
        return cls(Window(left, top, width, height), view or None)

    def __str__(self) -> str:
        at = ",".join(str(value) for value in astuple(self.window))
        return at if self.view is None else f"{self.view}:{at}"


def _span(start: float, extent: float, size: int) -> slice:
    first = min(int(start * size + 1e-6), size - 1)
    return slice(first, max(first + 1, min(size, round((start + extent) * size))))
