"""Contact sheets: images in a grid, with labels and captions."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image, ImageDraw, ImageFont

from g2ard.arrays import Bytes
from g2ard.errors import InputError
from g2ard.io.images import to_bytes

_SHEET_GAP = 6  # pixels between the images of a contact sheet


def draw_contact_sheet(
    rows: Sequence[Sequence[ArrayLike]], labels: Sequence[str], *, row_labels: Sequence[str] = ()
) -> Bytes:
    """Arrange images of any sizes in a grid on a dark background: a row per view, a column per kind.

    Rows may be short, and have captions below.
    """
    grid: list[list[Image.Image]] = []
    heights: list[int] = []
    widths = [0] * max(map(len, rows), default=0)
    for images in rows:
        cells = [
            Image.fromarray(np.ascontiguousarray(to_bytes(image))).convert("RGB")
            for image in images
        ]
        grid.append(cells)
        heights.append(max((cell.height for cell in cells), default=0))
        for c, one in enumerate(cells):
            widths[c] = max(widths[c], one.width)
    columns = len(widths)
    if not columns:
        raise InputError("a contact sheet needs images")
    text = max(11, min(28, max(widths) // 20))
    font = ImageFont.load_default(text)
    line = round(1.6 * text)
    foot = line if row_labels else 0
    for c, label in enumerate(labels[:columns]):
        widths[c] = max(widths[c], math.ceil(font.getlength(label)))
    longest = max((math.ceil(font.getlength(caption)) for caption in row_labels), default=0)
    gaps = _SHEET_GAP * (columns - 1)
    widths[-1] += max(0, longest - sum(widths) - gaps)
    lefts = []
    left = _SHEET_GAP
    for width in widths:
        lefts.append(left)
        left += width + _SHEET_GAP
    bottom = line + sum(heights) + (foot + _SHEET_GAP) * len(grid) + _SHEET_GAP
    sheet = Image.new("RGB", (left, bottom), (24, 24, 24))
    draw = ImageDraw.Draw(sheet)
    for left, label in zip(lefts, labels, strict=False):
        draw.text(
            (left, _SHEET_GAP),
            label,
            fill=(235, 235, 235),
            font=font,
        )
    top = _SHEET_GAP + line
    for r, (row, height) in enumerate(zip(grid, heights, strict=True)):
        for left, cell in zip(lefts, row, strict=False):
            sheet.paste(cell, (left, top))
        if r < len(row_labels):
            draw.text(
                (_SHEET_GAP, top + height),
                row_labels[r],
                fill=(200, 200, 200),
                font=font,
            )
        top += height + foot + _SHEET_GAP
    return np.asarray(sheet)
